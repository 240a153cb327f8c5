"""Algorithm 1 with Gymnasium environments, which run on the host: the same phases as in `phases`.

The agent acts, records and learns with the same functions as in the compiled loop. Only the step of the task is
outside. A call of a compiled function takes as much time as acting, so there is one call for each environment step:

    act             the first action of a stretch of steps
    environments    a step, in lockstep
    go on           record their results; when a cycle's steps are done, learn (`phases.learn_cycle`); act again

If an environment fails, the training ends. What was learned and recorded until then is saved.
"""

import ctypes
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from beliefrl.agents import Agent
from beliefrl.tasks.gymnasium import Fault, GymnasiumTask
from beliefrl.training import phases, rollout
from beliefrl.training.host_evaluation import Evaluation
from beliefrl.training.lockstep import Lockstep, environment_seeds
from beliefrl.training.phases import ACT, REVIVE, Metrics, Program, SeedState, Stretch, step_key
from beliefrl.training.rollout import Episode
from beliefrl.types import Spec


def program(
    agent: Agent,
    task: GymnasiumTask,
    capacity: int,
    episodes: int,
    seeds: Sequence[int],
    processes: str,
    notify: Callable[[str], None] | None = None,
    timeout: float | None = None,
) -> Program:
    """The phases of training, with an environment for each of `seeds`; the last three arguments are `Lockstep`'s."""
    environments = Lockstep(task, [f"seed {seed}" for seed in seeds], processes, notify, timeout)
    loop = HostLoop(agent, task, capacity, environments)
    evaluation = Evaluation(agent, task, seeds, processes, notify, timeout)

    def close() -> None:
        loop.environments.close()
        evaluation.close()

    return Program(
        begin=loop.begin,
        explore=loop.explore,
        pretrain=jax.jit(partial(phases.pretrain, agent), donate_argnums=0),
        refresh=jax.jit(jax.vmap(partial(phases.refresh, agent, task.spec)), donate_argnums=0),
        learn=loop.learn,
        evaluate=partial(evaluation.play, episodes=episodes),
        shapes=loop.shapes,
        revive=loop.revive,
        close=close,
    )


def keep_memory() -> None:
    """Let the C library keep freed memory for the next call: a setting of the whole process.

    A compiled function allocates its scratch memory at every call. If it is large, the C library returns it to the
    system each time, and the system clears the pages again: 10 ms for VRM's updates of a cycle.
    """
    if sys.platform == "linux":
        mmap_threshold, trim_threshold, most = -3, -1, 2**31 - 1
        libc = ctypes.CDLL(None)
        if hasattr(libc, "mallopt"):  # glibc's
            libc.mallopt(mmap_threshold, most)
            libc.mallopt(trim_threshold, most)


class ActorOutput(NamedTuple):
    """What the agent returns at the current timestep."""

    action: Float[Array, "*seed action"]
    memory: Any  # after that timestep


class StepResult(NamedTuple):
    """What the agent returned, and what its environment returned for that action."""

    output: ActorOutput
    obs: Any  # (seed, obs)
    reward: Any  # (seed,)
    terminated: Any  # (seed,)
    done: Any  # (seed,)
    measures: dict[str, Any]  # leaves (seed,)
    fresh: Any  # (seed, obs), the first observation of the next episode where done


class HostLoop:
    """The environments of a training, and what is compiled around them."""

    def __init__(self, agent: Agent, task: GymnasiumTask, capacity: int, environments: Lockstep):
        """`environments` has one for each seed."""
        self.agent, self.spec, self.environments = agent, task.spec, environments
        self._begin = jax.jit(jax.vmap(partial(_begin, agent, task.spec, capacity)))
        self._first = jax.jit(jax.vmap(lambda obs: rollout.first(agent, task.spec, (), obs)))
        self._act = jax.jit(jax.vmap(partial(_act, agent), in_axes=(0, None)))
        go_on, learn = partial(_go_on, agent, task.spec), partial(_learn, agent, task.spec)
        self._go_on: Any = jax.jit(jax.vmap(go_on, in_axes=(0, 0, 0, None)), donate_argnums=1)
        self._learn: Any = jax.jit(jax.vmap(learn, in_axes=(0, 0, None)), donate_argnums=0)

    def begin(self, keys: Key[Array, " seed"]) -> SeedState:
        """Seeds before their first steps."""
        return self._begin(keys, self.environments.reset(environment_seeds(keys)))

    def shapes(self, keys: Key[Array, " seed"]) -> SeedState:
        """What `begin` gives, without its numbers."""
        obs = jax.ShapeDtypeStruct((len(keys), self.spec.obs_dim), jnp.float32)
        return jax.eval_shape(self._begin, keys, obs)

    def revive(self, seeds: SeedState, step: int) -> SeedState:
        """Seeds read from a checkpoint, which has no environments: a new episode begins in each."""
        keys = jax.vmap(lambda key: step_key(key, jnp.asarray(step), REVIVE))(seeds.key)
        return seeds._replace(actor=self._first(self.environments.reset(environment_seeds(keys))))

    def explore(self, seeds: SeedState, first: int, steps: int) -> tuple[SeedState, Stretch]:
        """Environment steps without updates; 0 only compiles."""
        log, output, networks = _StretchLog(), self._act(seeds, first), self.agent.networks(seeds.state)
        if steps == 0:
            self._compile(seeds, output, learns=False)
        for step in range(first, first + steps):
            result = self._step(seeds, output, step, log)
            rest, output, episode = self._go_on(networks, seeds._replace(state=()), result, step)
            seeds = rest._replace(state=seeds.state)
            log.episodes.append(episode)
        return seeds, log.stretch()

    def learn(self, seeds: SeedState, first: int, cycles: int) -> tuple[SeedState, Stretch]:
        """`cycles` cycles of steps and updates from environment step `first` on; 0 only compiles."""
        log, output, cycle = _StretchLog(), self._act(seeds, first), self.agent.cycle
        if cycles == 0:
            self._compile(seeds, output, learns=True)
        for step in range(first, first + cycles * cycle):
            result = self._step(seeds, output, step, log)
            if (step + 1 - first) % cycle:
                rest, output, episode = self._go_on(
                    self.agent.networks(seeds.state), seeds._replace(state=()), result, step
                )
                seeds = rest._replace(state=seeds.state)
            else:
                seeds, output, episode, metrics = self._learn(seeds, result, step)
                log.metrics.append(metrics)
            log.episodes.append(episode)
        return seeds, log.stretch()

    def _compile(self, seeds: SeedState, output: ActorOutput, learns: bool) -> None:
        """Compile what follows a step of the environments: else a compilation would look like a slow environment."""
        lanes = len(output.action)
        obs, number, never = (
            np.zeros((lanes, self.spec.obs_dim), np.float32),
            np.zeros(lanes, np.float32),
            np.zeros(lanes, bool),
        )
        result = StepResult(output, obs, number, never, never, dict.fromkeys(self.spec.measures, number), obs)
        if isinstance(self._go_on, jax.stages.Wrapped) and (self.agent.cycle > 1 or not learns):
            rest = seeds._replace(state=())
            self._go_on = self._go_on.lower(self.agent.networks(seeds.state), rest, result, 0).compile()
        if learns:
            self._learn = self._learn.lower(seeds, result, 0).compile()

    def _step(self, seeds: SeedState, output: ActorOutput, step: int, log: "_StretchLog") -> StepResult:
        """One step of every environment."""
        try:
            obs, reward, terminated, truncated, measures = self.environments.step(np.asarray(output.action))
            done = terminated | truncated
            fresh = self.environments.restart(done) if done.any() else obs
        except Fault as fault:
            fault.seeds, fault.step, fault.stretch = seeds, step, log.stretch()
            raise
        return StepResult(output, obs, reward, terminated, done, measures, fresh)


class _StretchLog:
    """The metrics and episodes of a stretch, gathered step by step."""

    def __init__(self):
        self.metrics: list[Metrics] = []  # of every cycle
        self.episodes: list[Episode] = []  # one a step, leaves (seed,)

    def stretch(self) -> Stretch:
        """Means over its updates; episodes with leaves (seed, step)."""
        metrics, episodes = jax.device_get((self.metrics, self.episodes))
        means = jax.tree.map(lambda *each: np.mean(each, axis=0), *metrics) if metrics else {}
        return Stretch(means, jax.tree.map(lambda *each: np.stack(each, axis=1), *episodes) if episodes else None)


def _begin(agent: Agent, spec: Spec, capacity: int, key: Key[Array, ""], obs: Float[Array, " obs"]) -> SeedState:
    key_state, _, key = jax.random.split(key, 3)
    return phases.seed_of(agent, spec, capacity, rollout.first(agent, spec, (), obs), key_state, key)


def _act(agent: Agent, seed: SeedState, step: Int[Array, ""]) -> ActorOutput:
    key_move, _, _ = jax.random.split(step_key(seed.key, step, ACT), 3)
    return ActorOutput(*rollout.act(agent, seed.state, seed.actor, key_move, jnp.array(True)))


def _record(
    agent: Agent, spec: Spec, seed: SeedState, result: StepResult, step: Int[Array, ""]
) -> tuple[SeedState, Episode]:
    """Record the result of this step."""
    _, key_last, _ = jax.random.split(step_key(seed.key, step, ACT), 3)
    action, memory = result.output
    after = rollout.arrive(seed.actor, memory, action, (), result.obs, result.reward, result.terminated)
    fresh = rollout.first(agent, spec, (), result.fresh)
    actor, replay = rollout.record(agent, seed.state, seed.replay, seed.actor, after, fresh, result.done, key_last)
    episode = Episode(result.done, after.episode_return, after.length, result.measures)
    return seed._replace(actor=actor, replay=replay), episode


def _go_on(
    agent: Agent, spec: Spec, networks: Any, rest: SeedState, result: StepResult, step: Int[Array, ""]
) -> tuple[SeedState, ActorOutput, Episode]:
    """Record, and act again."""
    seed, episode = _record(agent, spec, rest._replace(state=networks), result, step)
    return seed._replace(state=()), _act(agent, seed, step + 1), episode


def _learn(
    agent: Agent, spec: Spec, seed: SeedState, result: StepResult, step: Int[Array, ""]
) -> tuple[SeedState, ActorOutput, Episode, Metrics]:
    """Record the last step of a cycle, learn, and act again."""
    seed, episode = _record(agent, spec, seed, result, step)
    state, metrics = phases.learn_cycle(agent, seed, step + 1 - agent.cycle)
    seed = seed._replace(state=state)
    return seed, _act(agent, seed, step + 1), episode, metrics
