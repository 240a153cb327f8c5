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
from beliefrl.training.phases import REVIVE, Metrics, Program, SeedState, Stretch, step_key
from beliefrl.training.replay import Replay
from beliefrl.training.rollout import ActorState, Episode
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
    envs: int = 1,
) -> Program:
    """The phases of training, with `envs` environments for each of `seeds`.

    `processes`, `notify` and `timeout` are those of `Lockstep`.
    """
    copies = [""] if envs == 1 else [f", environment {copy}" for copy in range(envs)]
    lanes = [f"seed {seed}{copy}" for seed in seeds for copy in copies]
    loop = HostLoop(agent, task, capacity, Lockstep(task, lanes, processes, notify, timeout), envs)
    evaluation = Evaluation(agent, task, seeds, processes, notify, timeout)

    def close() -> None:
        loop.environments.close()
        evaluation.close()

    return Program(
        begin=loop.begin,
        explore=loop.explore,
        pretrain=jax.jit(partial(phases.pretrain, agent), donate_argnums=0),
        refresh=jax.jit(jax.vmap(partial(phases.refresh, agent, task.spec, envs=envs)), donate_argnums=0),
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

    action: Float[Array, "*lanes action"]
    memory: Any  # after that timestep


class StepResult(NamedTuple):
    """What the agent returned, and what its environments returned. *lanes* is (seed,), or (seed, env) with several."""

    output: ActorOutput
    obs: Any  # (*lanes, obs)
    reward: Any  # lanes
    terminated: Any  # lanes
    done: Any  # lanes
    measures: dict[str, Any]  # leaves of shape lanes
    fresh: Any  # (*lanes, obs), the first observation of the next episode where done


class HostLoop:
    """The environments of a training, and what is compiled around them."""

    def __init__(self, agent: Agent, task: GymnasiumTask, capacity: int, environments: Lockstep, envs: int = 1):
        """`environments` has `envs` for each seed."""
        self.agent, self.spec, self.environments, self.envs = agent, task.spec, environments, envs
        first = phases.on_each_env(envs, lambda obs: rollout.first(agent, task.spec, (), obs))
        self._begin = jax.jit(jax.vmap(partial(_begin, agent, task.spec, capacity, envs)))
        self._first = jax.jit(jax.vmap(first))
        self._act = jax.jit(jax.vmap(partial(_act, agent, envs), in_axes=(0, None)))
        go_on, learn = partial(_go_on, agent, task.spec, envs), partial(_learn, agent, task.spec, envs)
        self._go_on: Any = jax.jit(jax.vmap(go_on, in_axes=(0, 0, 0, None)), donate_argnums=1)
        self._learn: Any = jax.jit(jax.vmap(learn, in_axes=(0, 0, None)), donate_argnums=0)

    def begin(self, keys: Key[Array, " seed"]) -> SeedState:
        """Seeds before their first steps."""
        return self._begin(keys, self._reset(keys))

    def shapes(self, keys: Key[Array, " seed"]) -> SeedState:
        """What `begin` gives, without its numbers."""
        obs = jax.ShapeDtypeStruct((*self._lanes(len(keys)), self.spec.obs_dim), jnp.float32)
        return jax.eval_shape(self._begin, keys, obs)

    def _lanes(self, seeds: int) -> tuple[int, ...]:
        """The shape of what there is for each environment: (seed,), or (seed, env) with several."""
        return (seeds,) if self.envs == 1 else (seeds, self.envs)

    def _reset(self, keys: Key[Array, " seed"]) -> Any:
        """Begin an episode in every environment; returns the observations, (*lanes, obs)."""
        if self.envs > 1:
            keys = jax.vmap(lambda key: jax.random.split(key, self.envs))(keys)
        obs = self.environments.reset(environment_seeds(keys).reshape(-1))
        return obs.reshape(*keys.shape, -1)

    def revive(self, seeds: SeedState, step: int) -> SeedState:
        """Seeds read from a checkpoint, which has no environments: a new episode begins in each."""
        keys = jax.vmap(lambda key: step_key(key, jnp.asarray(step), REVIVE))(seeds.key)
        return seeds._replace(actor=self._first(self._reset(keys)))

    def explore(self, seeds: SeedState, first: int, steps: int) -> tuple[SeedState, Stretch]:
        """Environment steps without updates; 0 only compiles."""
        log, output = _StretchLog(), self._act(seeds, first)
        if steps == 0:
            self._compile(seeds, output, learns=False)
        for step in range(first, first + steps, self.envs):
            result = self._step(seeds, output, step, log)
            seeds, output, episode = self._proceed(seeds, result, step)
            log.episodes.append(episode)
        return seeds, log.stretch()

    def learn(self, seeds: SeedState, first: int, rounds: int) -> tuple[SeedState, Stretch]:
        """`rounds` rounds of steps and updates from environment step `first` on; 0 only compiles."""
        log, output, length = _StretchLog(), self._act(seeds, first), phases.round_length(self.agent, self.envs)
        if rounds == 0:
            self._compile(seeds, output, learns=True)
        for step in range(first, first + rounds * length, self.envs):
            result = self._step(seeds, output, step, log)
            if (step + self.envs - first) % length:
                seeds, output, episode = self._proceed(seeds, result, step)
            else:
                seeds, output, episode, metrics = self._learn(seeds, result, step)
                log.metrics.append(metrics)
            log.episodes.append(episode)
        return seeds, log.stretch()

    def _proceed(self, seeds: SeedState, result: StepResult, step: int) -> tuple[SeedState, ActorOutput, Episode]:
        """Record the results of a step, and act again; the agent's state stays as it is."""
        rest, output, episode = self._go_on(seeds.state, seeds._replace(state=()), result, step)
        return rest._replace(state=seeds.state), output, episode

    def _compile(self, seeds: SeedState, output: ActorOutput, learns: bool) -> None:
        """Compile what follows a step of the environments: else a compilation would look like a slow environment."""
        lanes = output.action.shape[:-1]
        obs, number, never = (
            np.zeros((*lanes, self.spec.obs_dim), np.float32),
            np.zeros(lanes, np.float32),
            np.zeros(lanes, bool),
        )
        result = StepResult(output, obs, number, never, never, dict.fromkeys(self.spec.measures, number), obs)
        single = phases.round_length(self.agent, self.envs) == self.envs  # updates after every step
        if isinstance(self._go_on, jax.stages.Wrapped) and not (learns and single):
            rest = seeds._replace(state=())
            self._go_on = self._go_on.lower(seeds.state, rest, result, 0).compile()
        if learns:
            self._learn = self._learn.lower(seeds, result, 0).compile()

    def _step(self, seeds: SeedState, output: ActorOutput, step: int, log: "_StretchLog") -> StepResult:
        """One step of every environment."""
        try:
            actions = np.asarray(output.action)
            obs, reward, terminated, truncated, measures = self.environments.step(
                actions.reshape(-1, self.spec.action_dim)
            )
            done = terminated | truncated
            fresh = self.environments.restart(done) if done.any() else obs
        except Fault as fault:
            fault.seeds, fault.step, fault.stretch = seeds, step, log.stretch()
            raise
        lanes = actions.shape[:-1]
        results = jax.tree.map(
            lambda leaf: leaf.reshape(*lanes, *leaf.shape[1:]), (obs, reward, terminated, done, measures, fresh)
        )
        return StepResult(output, *results)


class _StretchLog:
    """The metrics and episodes of a stretch, gathered step by step."""

    def __init__(self):
        self.metrics: list[Metrics] = []  # of every round
        self.episodes: list[Episode] = []  # one a step, leaves (*lanes,)

    def stretch(self) -> Stretch:
        """Means over its updates; episodes with leaves (seed, step)."""
        metrics, episodes = jax.device_get((self.metrics, self.episodes))
        means = jax.tree.map(lambda *each: np.mean(each, axis=0), *metrics) if metrics else {}
        columns = jax.tree.map(lambda *each: np.stack(each, axis=1), *episodes) if episodes else None
        return Stretch(means, jax.tree.map(lambda column: column.reshape(len(column), -1), columns))


def _begin(
    agent: Agent, spec: Spec, capacity: int, envs: int, key: Key[Array, ""], obs: Float[Array, "*env obs"]
) -> SeedState:
    key_state, _, key = jax.random.split(key, 3)
    actor = phases.on_each_env(envs, lambda obs: rollout.first(agent, spec, (), obs))(obs)
    return phases.seed_of(agent, spec, capacity, actor, key_state, key, envs)


def _act(agent: Agent, envs: int, seed: SeedState, step: Int[Array, ""]) -> ActorOutput:
    def act(actor: ActorState, key: Key[Array, ""]) -> ActorOutput:
        key_move, _, _ = jax.random.split(key, 3)
        return ActorOutput(*rollout.act(agent, seed.state, actor, key_move, jnp.array(True)))

    return phases.on_each_env(envs, act)(seed.actor, phases.acting_keys(seed.key, step, envs))


def _record(
    agent: Agent, spec: Spec, envs: int, seed: SeedState, result: StepResult, step: Int[Array, ""]
) -> tuple[SeedState, Episode]:
    """Record the results of this step.

    The replay is written in a loop whose length XLA does not know: else XLA copies the whole ring (`phases._round`).
    """

    def arrive(actor: ActorState, result: StepResult) -> ActorState:
        action, memory = result.output
        return rollout.arrive(actor, memory, action, (), result.obs, result.reward, result.terminated)

    def record(
        actor: ActorState, replay: Replay, after: ActorState, result: StepResult, key: Key[Array, ""]
    ) -> tuple[ActorState, Replay]:
        _, key_last, _ = jax.random.split(key, 3)
        fresh = rollout.first(agent, spec, (), result.fresh)
        return rollout.record(agent, seed.state, replay, actor, after, fresh, result.done, key_last)

    def once(_, carry):
        return phases.on_each_env(envs, record)(*carry, after, result, keys)

    keys, after = phases.acting_keys(seed.key, step, envs), phases.on_each_env(envs, arrive)(seed.actor, result)
    actor, replay = jax.lax.fori_loop(step, step + 1, once, (seed.actor, seed.replay))
    episode = Episode(result.done, after.episode_return, after.length, result.measures)
    return seed._replace(actor=actor, replay=replay), episode


def _go_on(
    agent: Agent, spec: Spec, envs: int, state: Any, rest: SeedState, result: StepResult, step: Int[Array, ""]
) -> tuple[SeedState, ActorOutput, Episode]:
    """Record, and act again."""
    seed, episode = _record(agent, spec, envs, rest._replace(state=state), result, step)
    return seed._replace(state=()), _act(agent, envs, seed, step + envs), episode


def _learn(
    agent: Agent, spec: Spec, envs: int, seed: SeedState, result: StepResult, step: Int[Array, ""]
) -> tuple[SeedState, ActorOutput, Episode, Metrics]:
    """Record the last step of a round, learn, and act again."""
    seed, episode = _record(agent, spec, envs, seed, result, step)
    seed, metrics = phases.learn_round(agent, seed, step + envs - phases.round_length(agent, envs), envs)
    return seed, _act(agent, envs, seed, step + envs), episode, metrics
