"""A Gymnasium environment as the agent sees it, with checks of everything that it returns."""

import contextlib
import weakref
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from beliefrl.errors import Fault, UserError, said, short
from beliefrl.tasks.faults import STREAM, Draws
from beliefrl.tasks.interface import measure_of
from beliefrl.tasks.repeat import actions
from beliefrl.tasks.spaces import check_actions, flat_bounds, flat_size, limits, misfit, observation_names, scale
from beliefrl.types import as_array, check_indices

_in_use: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()  # innermost environments by their id
HUGE = 1e15  # an observed entry or a reward beyond this: its square, summed over a batch, may not be finite in float32
ENDLESS = 10_000  # steps after which an episode without a time limit is considered endless


class Environment(gymnasium.Env[np.ndarray, np.ndarray]):
    """A Gymnasium environment as the agent sees it: the entries it observes, float32, and actions in [-1, 1].

    Any error inside the environment becomes a Fault that names the environment, the seed and the step.
    """

    def __init__(self, task: Any, seed: str = ""):
        """Make the environment and check its spaces."""
        self.task, self.seed = task, seed
        self.steps, self.length = 0, 0  # actions in total, and steps of the environment in this episode
        self._is_reset = False  # ever
        self._measured: dict[str, float] = {}  # in this episode
        self._bare: Any = None  # the innermost environment, while it is in use
        self.inner = task.bare()
        self._check_new()
        self.inner_action_space: Any = getattr(self.inner, "action_space", None)
        self.inner_observation_space: Any = getattr(self.inner, "observation_space", None)
        try:
            self._prepare(task)
        except BaseException:
            self.close()
            raise

    def _check_new(self) -> None:
        """Raise a UserError if `make` has returned an environment that is in use: two would step the same one."""
        bare = self.inner
        with contextlib.suppress(Exception):  # an environment may be anything
            bare = self.inner.unwrapped
        if _in_use.get(id(bare), self) is bare:
            raise UserError(
                f"{self.task.name} is one environment, which is already in use: make a new one in each call, such as "
                "GymnasiumTask(lambda: MyEnvironment()). If there can be only one, such as a robot, use share_env."
            )
        with contextlib.suppress(TypeError):  # its class may not allow weak references
            _in_use[id(bare)] = bare
            self._bare = bare

    def _prepare(self, task: Any) -> None:
        """Check the spaces; set which entries are observed, and the time limit."""
        check_actions(self.inner_action_space, task.name)
        self._size = flat_size(self.inner_observation_space, task.name)
        if task.indices is not None:
            check_indices(task.indices, self._size)
        self.indices = np.arange(self._size) if task.indices is None else np.array(task.indices)
        self.whole = np.full(self._size, np.nan)  # the newest observation with all of its entries, as returned
        self._lowest, self._highest = limits(self.inner_observation_space, self.indices)
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.indices.size,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (self.inner_action_space.low.size,), np.float32)
        self.render_mode = getattr(self.inner, "render_mode", None)  # an environment may lack both
        metadata = getattr(self.inner, "metadata", None)
        self.metadata = metadata if isinstance(metadata, dict) else {}
        self._longest = task.max_steps or _time_limit(self.inner)  # of its own steps
        self.limit = self._longest and actions(self._longest, task.steps_per_action)  # of the agent's

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        self.length, self._measured, self._is_reset = 0, {}, True
        result = self._call("reset", lambda: self.inner.reset(seed=seed, **({"options": options} if options else {})))
        if not (isinstance(result, tuple) and len(result) == 2):
            raise self._fault("reset did not return (observation, info)")
        obs, _ = self._seen(result[0]), self._measures(result[1], False)
        return obs, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply an action (action,) in [-1, 1].

        Raises:
            UserError: the action has the wrong shape, `reset` has not been called, or the environment misbehaves.
        """
        if np.shape(action) != self.action_space.shape:
            raise UserError(f"The action has the shape {np.shape(action)}: it must be {self.action_space.shape}.")
        if not self._is_reset:
            raise UserError("The environment has no state yet: call reset first.")
        return self._apply(action)

    def _apply(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps, scaled = self.steps + 1, scale(self.inner_action_space, action)
        obs, total, terminated, truncated, info = self._step(scaled.copy())  # the environment may change its array
        for _ in range(self.task.steps_per_action - 1):
            if terminated or truncated:
                break
            obs, reward, terminated, truncated, info = self._step(scaled.copy())
            total += reward
        return obs, total, terminated, truncated, info

    def _step(self, scaled: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.length += 1
        result = self._call("step", lambda: self.inner.step(scaled))
        if not (isinstance(result, tuple) and len(result) == 5):
            raise self._fault("step did not return (observation, reward, terminated, truncated, info)")
        obs, reward, terminated, truncated, info = result
        obs, reward = self._seen(obs), self._number(reward)
        terminated, truncated = self._flag(terminated, "terminated"), self._flag(truncated, "truncated")
        truncated = truncated or self.length == self.task.max_steps
        if not (terminated or truncated) and self.length >= (self._longest or ENDLESS):
            raise self._fault(
                f"the episode has not ended after {self.length} steps: fix the environment, or give it a time limit, "
                "max_episode_steps for gym:ID and max_steps in a GymnasiumTask"
            )
        return obs, reward, terminated, truncated, self._measures(info, terminated or truncated)

    def _measures(self, info: Any, ended: bool) -> dict[str, Any]:
        """The task's measures as the infos of this episode reported them last; 0 before. Success may be missing."""
        for name in self.task.measures:
            value = measure_of(info, name)
            if value is not None:
                self._measured[name] = value
            elif ended and name not in ("success", *self._measured):
                raise self._fault(f"no info of an episode has a number {name!r}, which the task measures")
        return dict.fromkeys(self.task.measures, 0.0) | self._measured

    def render(self) -> Any:
        """The picture that the environment renders."""
        return self.inner.render()

    def close(self) -> None:
        """Close the environment, ignoring errors."""
        if self._bare is not None:
            _in_use.pop(id(self._bare), None)
            self._bare = None
        with contextlib.suppress(Exception):
            self.inner.close()

    def _fault(self, what: str) -> Fault:
        seed = f"{self.seed}, " if self.seed else ""
        return Fault(f"{self.task.name} ({seed}step {self.steps}): {what}.")

    def _call(self, name: str, function: Callable[[], Any]) -> Any:
        try:
            result = function()
        except (Exception, SystemExit) as error:  # an environment may raise anything
            raise self._fault(f"{name} raised {said(error)}") from None
        space = self.inner.action_space
        if space is not self.inner_action_space and space != self.inner_action_space:
            raise self._fault(
                f"its action space changed from {short(self.inner_action_space)} to {short(space)}, but must not change"
            )
        return result

    def _seen(self, obs: Any) -> np.ndarray:
        """The entries that the agent observes, as float32, after all checks."""
        space = self.inner_observation_space
        if isinstance(space, spaces.Box):
            value = as_array(obs)
            if value.dtype.kind not in "biuf":
                raise self._fault(f"the observation has type {value.dtype}, but its space says {space.dtype}")
            if value.shape != space.shape:
                raise self._fault(f"the observation has shape {value.shape}, but its space says {space.shape}")
        else:
            value = self._flattened(space, obs)
        self.whole = value.reshape(-1)
        with np.errstate(over="ignore"):
            flat = self.whole[self.indices].astype(np.float32)
        fits = np.abs(flat) <= HUGE  # NaN does not
        if not fits.all():
            entry = int(self.indices[~fits][0])
            raise self._fault(
                f"entry {entry} of the observation{self._named(entry)} is {self.whole[entry]}, but must be a number "
                f"from -{HUGE:g} to {HUGE:g}"
            )
        far = (flat < self._lowest) | (flat > self._highest)
        if far.any():
            entry = int(self.indices[far][0])
            bounds = flat_bounds(space)
            raise self._fault(
                f"entry {entry} of the observation{self._named(entry)} is {self.whole[entry]}, far outside its "
                f"space, which says {bounds.low[entry]} to {bounds.high[entry]}: correct the observation or its space"
            )
        return flat

    def _flattened(self, space: Any, obs: Any) -> np.ndarray:
        """An observation of a composite or discrete space as a flat array."""
        where = None
        with contextlib.suppress(Exception):  # an observation may be anything
            where = misfit(space, obs)
            value = np.asarray(spaces.flatten(space, obs))
            if where is None and value.shape == (self._size,):
                return value
        raise self._fault(f"the observation does not fit its space {short(space)}{f' at {where}' if where else ''}")

    def _named(self, entry: int) -> str:
        """The name of an entry in brackets, if it has one."""
        name = observation_names(self.inner, self.inner_observation_space, self.task.name)[entry]
        return "" if name == f"entry {entry}" else f" ({name})"

    def _number(self, reward: Any) -> float:
        value = as_array(reward)
        if value.shape != () or value.dtype.kind not in "biuf":
            shown = f"of shape {value.shape}" if value.shape else repr(reward)
            raise self._fault(f"the reward is {shown}, but must be one number")
        if not abs(float(value)) <= HUGE:
            raise self._fault(f"the reward is {value}, but must be a number from -{HUGE:g} to {HUGE:g}")
        return float(value)

    def _flag(self, value: Any, name: str) -> bool:
        flag = as_array(value)
        if flag.shape != () or flag.dtype.kind not in "biu" or flag not in (0, 1):
            raise self._fault(f"{name} is {short(value)}, but must be True or False")
        return bool(flag)


def _time_limit(environment: Any) -> int | None:
    """The time limit that an environment was registered with, or that a wrapper gives it."""
    registered = getattr(environment, "spec", None)  # an environment may have anything under this name
    if registered and hasattr(registered, "max_episode_steps"):
        return registered.max_episode_steps
    while isinstance(environment, gymnasium.Wrapper):
        if isinstance(environment, TimeLimit):
            return environment._max_episode_steps
        environment = environment.env
    return None


class FaultyEnvironment(Environment):
    """The same with the faults of its task. Their random numbers come from the seed that `reset` gets."""

    def __init__(self, task: Any, seed: str = ""):
        """Make the environment, and check that the noise fits its observation."""
        super().__init__(task, seed)
        self._random = np.random.default_rng()

    def _prepare(self, task: Any) -> None:
        super()._prepare(task)
        self._faults = task.faults
        size = task.faults.observed_size(self.indices.size)
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode."""
        obs, info = super().reset(seed=seed, options=options)
        if seed is not None:
            self._random = np.random.default_rng((seed, STREAM))
        self._waiting = self._faults.start(np, obs)
        self._action = np.zeros(self.inner_action_space.low.size, np.float32)
        return self._observed(obs, self._draws()), info

    def _apply(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply an action, or the previous one again."""
        draws = self._draws()
        self._action = self._faults.applied(np, action, self._action, draws)
        obs, reward, terminated, truncated, info = super()._apply(self._action)
        return self._observed(obs, draws), reward, terminated, truncated, info

    def _observed(self, obs: np.ndarray, draws: Draws) -> np.ndarray:
        self._waiting, seen = self._faults.observe(np, self._waiting, obs, draws)
        return seen

    def _draws(self) -> Draws:
        size, normal, uniform = self.indices.size, self._random.standard_normal, self._random.random
        return Draws(normal(size, np.float32), uniform(size, np.float32), uniform(), uniform())
