"""Algorithm 1 where the environments run on the host: the phases of `phases`, with Gymnasium's environments in them.

The agent acts, records and learns by the same functions as in the compiled loop; only the step of the task is outside.
A call of a compiled function costs as much as acting does, so there is one for every step of the environments:

    act             the first action of a stretch of steps
    environments    a step, in lockstep
    go on           record what they answered; when a cycle's steps are done, learn (`phases.learn_cycle`); act again

A fault of an environment ends the training with what was learned and recorded until then.
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
    tell: Callable[[str], None] | None = None,
) -> Program:
    """The phases of training with environments of their own for each of `seeds`; `tell` is as in `Lockstep`."""
    _keep_memory()
    loop = HostLoop(agent, task, capacity, Lockstep(task, [f"seed {seed}" for seed in seeds], processes, tell))
    evaluation = Evaluation(agent, task, seeds, processes, tell)

    def close() -> None:
        loop.environments.close()
        evaluation.close()

    return Program(
        begin=loop.begin,
        explore=loop.explore,
        pretrain=jax.jit(jax.vmap(partial(phases.pretrain, agent), in_axes=(0, None, None)), donate_argnums=0),
        refresh=jax.jit(jax.vmap(partial(phases.refresh, agent, task.spec)), donate_argnums=0),
        learn=loop.learn,
        evaluate=partial(evaluation.play, episodes=episodes),
        shapes=loop.shapes,
        revive=loop.revive,
        close=close,
    )


def _keep_memory() -> None:
    """Let the C library keep freed memory for the next call.

    A compiled function takes its scratch memory anew at every call, and where that is large the C library gives it back
    to the system each time: 10 ms of VRM's updates of a cycle were the system clearing pages again.
    """
    if sys.platform == "linux":
        mmap_threshold, trim_threshold, most = -3, -1, 2**31 - 1
        libc = ctypes.CDLL(None)
        if hasattr(libc, "mallopt"):  # glibc's
            libc.mallopt(mmap_threshold, most)
            libc.mallopt(trim_threshold, most)


class Deed(NamedTuple):
    """What the agent does at the moment in hand."""

    action: Float[Array, "*seed action"]
    memory: Any  # once it has perceived that moment


class Answer(NamedTuple):
    """What the agent did, and what its environment answered."""

    deed: Deed
    obs: Any  # (seed, obs)
    reward: Any  # (seed,)
    terminated: Any  # (seed,)
    done: Any  # (seed,)
    success: Any  # (seed,)
    fresh: Any  # (seed, obs), the first observation of the next episode, where done


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
        """Seeds whose environments were not saved: a new episode begins, as if the one in hand had never gone on."""
        keys = jax.vmap(lambda key: step_key(key, jnp.asarray(step), REVIVE))(seeds.key)
        return seeds._replace(actor=self._first(self.environments.reset(environment_seeds(keys))))

    def explore(self, seeds: SeedState, first: int, steps: int) -> tuple[SeedState, Stretch]:
        """Environment steps without updates; none of them only compiles."""
        told, deed, networks = _Told(), self._act(seeds, first), self.agent.networks(seeds.state)
        if steps == 0:
            self._compile(seeds, deed, learns=False)
        for step in range(first, first + steps):
            answer = self._step(seeds, deed, step, told)
            rest, deed, episode = self._go_on(networks, seeds._replace(state=()), answer, step)
            seeds = rest._replace(state=seeds.state)
            told.episodes.append(episode)
        return seeds, told.stretch()

    def learn(self, seeds: SeedState, first: int, cycles: int) -> tuple[SeedState, Stretch]:
        """`cycles` cycles of steps and updates from environment step `first` on; none of them only compiles."""
        told, deed, cycle = _Told(), self._act(seeds, first), self.agent.cycle
        if cycles == 0:
            self._compile(seeds, deed, learns=True)
        for step in range(first, first + cycles * cycle):
            answer = self._step(seeds, deed, step, told)
            if (step + 1 - first) % cycle:
                rest, deed, episode = self._go_on(
                    self.agent.networks(seeds.state), seeds._replace(state=()), answer, step
                )
                seeds = rest._replace(state=seeds.state)
            else:
                seeds, deed, episode, metrics = self._learn(seeds, answer, step)
                told.metrics.append(metrics)
            told.episodes.append(episode)
        return seeds, told.stretch()

    def _compile(self, seeds: SeedState, deed: "Deed", learns: bool) -> None:
        """Compile what follows a step of the environments, so that no compilation is taken for a slow environment."""
        lanes = len(deed.action)
        obs, number, never = (
            np.zeros((lanes, self.spec.obs_dim), np.float32),
            np.zeros(lanes, np.float32),
            np.zeros(lanes, bool),
        )
        answer = Answer(deed, obs, number, never, never, never, obs)
        if isinstance(self._go_on, jax.stages.Wrapped) and (self.agent.cycle > 1 or not learns):
            rest = seeds._replace(state=())
            self._go_on = self._go_on.lower(self.agent.networks(seeds.state), rest, answer, 0).compile()
        if learns:
            self._learn = self._learn.lower(seeds, answer, 0).compile()

    def _step(self, seeds: SeedState, deed: "Deed", step: int, told: "_Told") -> "Answer":
        """One step of every environment."""
        try:
            obs, reward, terminated, truncated, success = self.environments.step(np.asarray(deed.action))
            done = terminated | truncated
            fresh = self.environments.restart(done) if done.any() else obs
        except Fault as fault:
            fault.seeds, fault.step, fault.told = seeds, step, told.stretch()
            raise
        return Answer(deed, obs, reward, terminated, done, success, fresh)


class _Told:
    """What a stretch tells, gathered on the way."""

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


def _act(agent: Agent, seed: SeedState, step: Int[Array, ""]) -> Deed:
    key_move, _, _ = jax.random.split(step_key(seed.key, step, ACT), 3)
    return Deed(*rollout.act(agent, seed.state, seed.actor, key_move, jnp.array(True)))


def _record(
    agent: Agent, spec: Spec, seed: SeedState, answer: Answer, step: Int[Array, ""]
) -> tuple[SeedState, Episode]:
    """Record what the environment answered at this step."""
    _, key_last, _ = jax.random.split(step_key(seed.key, step, ACT), 3)
    action, memory = answer.deed
    after = rollout.arrive(seed.actor, memory, action, (), answer.obs, answer.reward, answer.terminated)
    fresh = rollout.first(agent, spec, (), answer.fresh)
    actor, replay = rollout.record(agent, seed.state, seed.replay, seed.actor, after, fresh, answer.done, key_last)
    episode = Episode(answer.done, after.total, after.length, answer.success)
    return seed._replace(actor=actor, replay=replay), episode


def _go_on(
    agent: Agent, spec: Spec, networks: Any, rest: SeedState, answer: Answer, step: Int[Array, ""]
) -> tuple[SeedState, Deed, Episode]:
    """Record, and act again."""
    seed, episode = _record(agent, spec, rest._replace(state=networks), answer, step)
    return seed._replace(state=()), _act(agent, seed, step + 1), episode


def _learn(
    agent: Agent, spec: Spec, seed: SeedState, answer: Answer, step: Int[Array, ""]
) -> tuple[SeedState, Deed, Episode, Metrics]:
    """Record the last step of a cycle, learn, and act again."""
    seed, episode = _record(agent, spec, seed, answer, step)
    state, metrics = phases.learn_cycle(agent, seed, step + 1 - agent.cycle)
    seed = seed._replace(state=state)
    return seed, _act(agent, seed, step + 1), episode, metrics
