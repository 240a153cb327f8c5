"""Gymnasium environments that are stepped together, one per lane, in this process or each in its own process.

The environments do not reset themselves: `restart` begins the next episodes.
"""

import atexit
import contextlib
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from gymnasium import logger
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from jaxtyping import Array, Bool, Float, Int, Key

from beliefrl.errors import Fault, UserError, said
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.seen_environment import Environment
from beliefrl.tasks.settings import settings_kept
from beliefrl.training.environment_process import CLOSING, Factory

HANDOVER = 5e-4  # approximate seconds for passing a step to other processes
SLOW = 60.0  # seconds after which a call that has not returned is reported
LOOK_EVERY = 1.0  # seconds between two looks for such a call
RESET = 60.0  # seconds that a reset may take, if steps have a limit


class StepResults(NamedTuple):
    """What the environments return for a step, numpy arrays."""

    obs: Any  # (lane, obs) float32
    reward: Any  # (lane,) float32
    terminated: Any  # (lane,) bool
    truncated: Any  # (lane,) bool
    measures: dict[str, Any]  # leaves (lane,) float32


class _Call(NamedTuple):
    """A call of the environments, and when it began."""

    name: str
    began: float
    limit: float | None  # seconds that it may take


class Lockstep:
    """Environments of a task, all stepped together."""

    def __init__(
        self,
        task: GymnasiumTask,
        lanes: Sequence[str],
        processes: str = "never",
        notify: Callable[[str], None] | None = None,
        timeout: float | None = None,
    ):
        """Make an environment for each of `lanes`, the names of the environments in messages.

        Args:
            task: the task of all of them.
            lanes: for example "seed 0".
            processes: "always" gives each a process of its own, "never" none, "auto" decides by a measurement.
                Each process imports the main module of this one: guard it by `if __name__ == "__main__":`.
            notify: called from another thread with a sentence if making, a reset or a step takes longer than SLOW.
            timeout: maximum seconds of a step, and of a reset if it is more than RESET. A longer one raises a Fault.
                Environments in this process have no limit, because nothing can interrupt them.

        Raises:
            UserError: the environment cannot be made, or is not supported.
        """
        self.task, self.lanes, self.timeout = task, lanes, timeout
        self.steps = 0
        self._is_wide = jax.config.read("jax_enable_x64")
        self._envs: Any = None
        self._are_made = False
        self._call: _Call | None = None  # the call of the environments that has not returned
        self._closed = threading.Event()
        if notify is not None:
            threading.Thread(target=self._watch, args=(notify,), daemon=True).start()
        made: list[Environment] = []
        try:
            with self._calling("gymnasium.make"):
                self.apart = processes == "always" or (processes == "auto" and _pays(task, len(lanes)))
                if self.apart:
                    self._start_processes([Factory(task, lane) for lane in lanes])
                else:
                    factories = [partial(_kept, made, Factory(task, lane)) for lane in lanes]
                    self._envs = SyncVectorEnv(factories, autoreset_mode=AutoresetMode.DISABLED)
            self._are_made = True
        except BaseException:
            self._closed.set()  # nothing is under way that could be slow
            for environment in made:
                environment.close()
            if self._envs is not None:
                self._end_processes(0.0)
            raise

    def _start_processes(self, factories: list[Factory]) -> None:
        # Forking a process in which JAX runs threads may never return. A daemon could not start processes of its own.
        settings: dict[str, Any] = {"context": "spawn", "daemon": False, "autoreset_mode": AutoresetMode.DISABLED}
        self._envs = AsyncVectorEnv.__new__(AsyncVectorEnv)  # so that its processes can be ended if one cannot start
        with settings_kept():  # an environment is made here too, to see its spaces
            try:
                AsyncVectorEnv.__init__(self._envs, factories, **settings)
            except (UserError, EOFError, OSError, MemoryError):
                raise
            except Exception as error:  # of an object that cannot be sent
                raise UserError(
                    f"{self.task.name} cannot be sent to a process of its own ({said(error)}): make such objects in "
                    "its function or class, or use processes=never."
                ) from None
        atexit.register(self.close)  # at its exit Python would wait for processes that ignore SIGTERM

    def reset(self, seeds: Int[np.ndarray, " lane"]) -> Any:
        """Begin an episode in every environment; returns the observations, (lane, obs)."""
        return self._reset(seed=[int(seed) for seed in seeds])

    def step(self, actions: Float[np.ndarray, "lane action"]) -> StepResults:
        """Step every environment. Actions that are not finite, of seeds that have diverged, become zeros."""
        self.steps += 1
        actions = np.where(np.isfinite(actions), actions, np.float32(0))
        with self._calling("step", self.timeout) as call:
            if self.apart:
                self._envs.step_async(actions)
                obs, reward, terminated, truncated, info = self._envs.step_wait(call.limit)
            else:
                obs, reward, terminated, truncated, info = self._envs.step(actions)
        measures = {name: np.asarray(info[name], np.float32) for name in self.task.spec.measures}
        return StepResults(obs, reward.astype(np.float32), terminated, truncated, measures)

    def restart(self, done: Bool[np.ndarray, " lane"]) -> Any:
        """Begin an episode where `done`; returns the observations of all environments, (lane, obs)."""
        return self._reset(options={"reset_mask": done})

    def _reset(self, **how: Any) -> Any:
        with self._calling("reset", self.timeout and max(RESET, self.timeout)) as call:
            if not self.apart:
                return self._envs.reset(**how)[0]
            self._envs.reset_async(**how)
            return self._envs.reset_wait(call.limit)[0]

    def close(self) -> None:
        """Close all environments; errors while closing are ignored."""
        self._closed.set()
        atexit.unregister(self.close)
        if self.apart and not self._envs.closed:
            self._end_processes(0.0 if self._call is not None else CLOSING)  # a call may never return
        with contextlib.suppress(Exception):
            self._envs.close()

    def _end_processes(self, seconds: float) -> None:
        """Ask all processes to close their environments and end. Kill those that have not ended after `seconds`."""
        for pipe in filter(None, getattr(self._envs, "parent_pipes", ())):  # None after an error of an environment
            with contextlib.suppress(OSError):  # its process has ended
                pipe.send(("close", None))
        until = time.monotonic() + seconds
        for process in getattr(self._envs, "processes", ()):  # some may not have been started
            if process.pid is None:
                continue
            process.join(max(0.0, until - time.monotonic()))
            process.kill()  # one that has not ended ignores milder signals
            process.join()
        self._envs.closed = True

    @contextlib.contextmanager
    def _calling(self, name: str, limit: float | None = None) -> Iterator["_Call"]:
        """Record the current call. Raises a Fault if the process of a lane dies during the call, or takes too long."""
        self._call = call = _Call(name, time.monotonic(), limit)
        try:
            with _silence():
                yield call
        except (EOFError, ConnectionError):
            raise Fault(self._death()) from None
        except multiprocessing.TimeoutError:
            raise Fault(self._delay(call)) from None
        except Exception:  # the call has returned, with an error of an environment
            self._call = None
            jax.config.update("jax_enable_x64", self._is_wide)
            raise
        self._call = None
        if jax.config.read("jax_enable_x64") != self._is_wide:
            jax.config.update("jax_enable_x64", self._is_wide)
            raise Fault(
                f"{self.task.name} has switched JAX to {32 if self._is_wide else 64} bits, which changes the training: "
                "give it a process of its own, --processes always."
            )

    def _watch(self, notify: Callable[[str], None]) -> None:
        """Report every call that takes longer than SLOW, once."""
        reported = None
        while not self._closed.wait(LOOK_EVERY):
            call = self._call
            if call is None or call is reported or time.monotonic() - call.began < SLOW:
                continue
            reported = call
            at = f" (step {self.steps})" if self.steps else ""
            with contextlib.suppress(Exception):  # an error of the listener must not end the watch
                notify(f"{self.task.name}{at}: {call.name} has not returned for {SLOW:.0f} s: it is slow, or it hangs.")

    def _delay(self, call: "_Call") -> str:
        late = [lane for lane, pipe in zip(self.lanes, self._envs.parent_pipes, strict=True) if not pipe.poll(0)]
        who = " and ".join(late) or "one of them"
        late_call = f"{self.task.name} (step {self.steps}): the {call.name} of {who}"
        return f"{late_call} has not returned after {call.limit:g} s: fix it, or allow more time with step_timeout."

    def _death(self) -> str:
        dead = []
        processes = getattr(self._envs, "processes", ())
        for lane, process in zip(self.lanes, processes, strict=False):  # some may not have been started
            if process.pid is not None:
                process.join(timeout=0.5)
            if process.exitcode is not None:
                dead.append(f"{lane} (exit code {process.exitcode})")
        who = " and ".join(dead) or "one of them"
        killed = any(process.exitcode is not None and process.exitcode < 0 for process in processes)
        why = ", killed or out of memory" if killed or not dead else ""
        if not self._are_made:
            why += ' before its environment was made (see above; a script needs `if __name__ == "__main__":`)'
        return f"{self.task.name} (step {self.steps}): the process of {who} has ended{why}."


def _kept(made: list[Environment], factory: Factory) -> Environment:
    made.append(factory())
    return made[-1]


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep Gymnasium from printing a worker's traceback: the Fault carries its message."""
    level, logger.min_level = logger.min_level, logger.ERROR + 1
    try:
        yield
    finally:
        logger.min_level = level


def _pays(task: GymnasiumTask, lanes: int) -> bool:
    """Whether processes of their own are faster, measured with some random steps."""
    cores = min(lanes, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    return cores > 1 and lanes * step_seconds(task) * (1 - 1 / cores) > HANDOVER


def step_seconds(task: GymnasiumTask) -> float:
    """The median time of 20 steps with random actions; 0 if it cannot be measured."""
    try:
        with settings_kept(), contextlib.closing(task.environment()) as environment:
            environment.reset(seed=0)
            actions = np.random.default_rng(0).uniform(-1, 1, (20, task.spec.action_dim))
            times = []
            for action in actions:
                before = time.perf_counter()
                _, _, terminated, truncated, _ = environment.step(action)
                times.append(time.perf_counter() - before)
                if terminated or truncated:
                    environment.reset()
    except UserError:
        return 0.0
    return float(np.median(times))


def environment_seeds(keys: Key[Array, "*axes"]) -> Int[np.ndarray, " lane"]:
    """A seed for the environment of each key."""
    return np.asarray(jax.vmap(lambda key: jax.random.randint(key, (), 0, 2**31 - 1))(keys.reshape(-1)))
