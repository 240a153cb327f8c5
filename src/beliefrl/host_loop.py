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
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from beliefrl import phases, rollout
from beliefrl.agents import Agent
from beliefrl.lockstep import Lockstep
from beliefrl.phases import ACT, REVIVE, Metrics, Program, Seed, Stretch, step_key
from beliefrl.rollout import Episode
from beliefrl.tasks.gymnasium import Fault, GymnasiumTask
from beliefrl.types import Spec, Step


def program(
    agent: Agent, task: GymnasiumTask, capacity: int, episodes: int, seeds: Sequence[int], processes: str
) -> Program:
    """The phases of training with environments of their own for each of `seeds`."""
    _keep_memory()
    loop = HostLoop(agent, task, capacity, seeds, processes)
    evaluation = Evaluation(agent, task, seeds, processes)

    def close() -> None:
        loop.environments.close()
        evaluation.close()

    return Program(
        begin=loop.begin,
        explore=loop.explore,
        pretrain=jax.jit(jax.vmap(partial(phases.pretrain, agent), in_axes=(0, None, None)), donate_argnums=0),
        relive=jax.jit(jax.vmap(partial(phases.relive, agent, task.spec)), donate_argnums=0),
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

    def __init__(self, agent: Agent, task: GymnasiumTask, capacity: int, seeds: Sequence[int], processes: str):
        """An environment for each of `seeds`."""
        self.agent, self.spec = agent, task.spec
        self.environments = Lockstep(task, [f"seed {seed}" for seed in seeds], processes)
        self._begin = jax.jit(jax.vmap(partial(_begin, agent, task.spec, capacity)))
        self._first = jax.jit(jax.vmap(lambda obs: rollout.first(agent, task.spec, (), obs)))
        self._act = jax.jit(jax.vmap(partial(_act, agent), in_axes=(0, None)))
        go_on, learn = partial(_go_on, agent, task.spec), partial(_learn, agent, task.spec)
        self._go_on = jax.jit(jax.vmap(go_on, in_axes=(0, 0, 0, None)), donate_argnums=1)
        self._learn = jax.jit(jax.vmap(learn, in_axes=(0, 0, None)), donate_argnums=0)

    def begin(self, keys: Key[Array, " seed"]) -> Seed:
        """Seeds before their first steps."""
        return self._begin(keys, self.environments.reset(environment_seeds(keys)))

    def shapes(self, keys: Key[Array, " seed"]) -> Seed:
        """What `begin` gives, without its numbers."""
        obs = jax.ShapeDtypeStruct((len(keys), self.spec.obs_dim), jnp.float32)
        return jax.eval_shape(self._begin, keys, obs)

    def revive(self, seeds: Seed, step: int) -> Seed:
        """Seeds whose environments were not saved: a new episode begins, as if the one in hand had never gone on."""
        keys = jax.vmap(lambda key: step_key(key, jnp.asarray(step), REVIVE))(seeds.key)
        return seeds._replace(actor=self._first(self.environments.reset(environment_seeds(keys))))

    def explore(self, seeds: Seed, first: int, steps: int) -> tuple[Seed, Stretch]:
        """Environment steps without updates."""
        told, deed, networks = _Told(), self._act(seeds, first), _networks(seeds.state)
        for step in range(first, first + steps):
            answer = self._step(seeds, deed, step, told)
            rest, deed, episode = self._go_on(networks, seeds._replace(state=()), answer, step)
            seeds = rest._replace(state=seeds.state)
            told.episodes.append(episode)
        return seeds, told.stretch()

    def learn(self, seeds: Seed, first: int, cycles: int) -> tuple[Seed, Stretch]:
        """`cycles` cycles of steps and updates from environment step `first` on."""
        told, deed, cycle = _Told(), self._act(seeds, first), self.agent.cycle
        for step in range(first, first + cycles * cycle):
            answer = self._step(seeds, deed, step, told)
            if (step + 1 - first) % cycle:
                rest, deed, episode = self._go_on(_networks(seeds.state), seeds._replace(state=()), answer, step)
                seeds = rest._replace(state=seeds.state)
            else:
                seeds, deed, episode, metrics = self._learn(seeds, answer, step)
                told.metrics.append(metrics)
            told.episodes.append(episode)
        return seeds, told.stretch()

    def _step(self, seeds: Seed, deed: "Deed", step: int, told: "_Told") -> "Answer":
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


def environment_seeds(keys: Key[Array, "*lane"]) -> Int[np.ndarray, "*lane"]:
    """A seed for the environment of each key."""
    return np.asarray(jax.vmap(lambda key: jax.random.randint(key, (), 0, 2**31 - 1))(keys.reshape(-1))).reshape(
        keys.shape
    )


def _begin(agent: Agent, spec: Spec, capacity: int, key: Key[Array, ""], obs: Float[Array, " obs"]) -> Seed:
    key_state, _, key = jax.random.split(key, 3)
    return phases.seed_of(agent, spec, capacity, rollout.first(agent, spec, (), obs), key_state, key)


def _act(agent: Agent, seed: Seed, step: Int[Array, ""]) -> Deed:
    key_move, _, _ = jax.random.split(step_key(seed.key, step, ACT), 3)
    return Deed(*rollout.act(agent, seed.state, seed.actor, key_move, jnp.array(True)))


def _record(agent: Agent, spec: Spec, seed: Seed, answer: Answer, step: Int[Array, ""]) -> tuple[Seed, Episode]:
    """Record what the environment answered at this step."""
    _, key_last, _ = jax.random.split(step_key(seed.key, step, ACT), 3)
    action, memory = answer.deed
    after = rollout.arrive(seed.actor, memory, action, (), answer.obs, answer.reward, answer.terminated)
    fresh = rollout.first(agent, spec, (), answer.fresh)
    actor, replay = rollout.record(agent, seed.state, seed.replay, seed.actor, after, fresh, answer.done, key_last)
    episode = Episode(answer.done, after.total, after.length, answer.success)
    return seed._replace(actor=actor, replay=replay), episode


def _networks(state: Any) -> Any:
    """What of an agent's state acting needs: not the optimisers, hundreds of arrays that a call would look at."""
    idle = [name for name in getattr(state, "_fields", ()) if "optimiser" in name]
    return state._replace(**dict.fromkeys(idle, ())) if idle else state


def _go_on(
    agent: Agent, spec: Spec, networks: Any, rest: Seed, answer: Answer, step: Int[Array, ""]
) -> tuple[Seed, Deed, Episode]:
    """Record, and act again."""
    seed, episode = _record(agent, spec, rest._replace(state=networks), answer, step)
    return seed._replace(state=()), _act(agent, seed, step + 1), episode


def _learn(
    agent: Agent, spec: Spec, seed: Seed, answer: Answer, step: Int[Array, ""]
) -> tuple[Seed, Deed, Episode, Metrics]:
    """Record the last step of a cycle, learn, and act again."""
    seed, episode = _record(agent, spec, seed, answer, step)
    state, metrics = phases.learn_cycle(agent, seed, step + 1 - agent.cycle)
    seed = seed._replace(state=state)
    return seed, _act(agent, seed, step + 1), episode, metrics


class Evaluation:
    """Environments for evaluation: two for each seed, one played with sampled and one with mode actions."""

    def __init__(self, agent: Agent, task: GymnasiumTask, seeds: Sequence[int], processes: str):
        """They are made at the first evaluation."""
        self.agent, self.task, self.seeds, self.processes = agent, task, seeds, processes
        self.environments: Lockstep | None = None
        lanes = jax.vmap(partial(_perceive, agent, task.spec), in_axes=(None, 0, 0, 0, 0, None))
        self._perceive = jax.jit(jax.vmap(lanes, in_axes=(0, 0, 0, 0, None, None)))

    def play(self, states: Any, keys: Key[Array, " seed"], episodes: int) -> Episode:
        """`episodes` episodes, one after the other; leaves (seed, 2, episodes)."""
        if self.environments is None:
            lanes = [f"evaluation of seed {seed}" for seed in self.seeds for _ in range(2)]
            self.environments = Lockstep(self.task, lanes, self.processes)
        keys = jax.vmap(lambda key: jax.random.split(key, 2))(keys)
        obs = self.environments.reset(environment_seeds(keys).reshape(-1))
        lanes = len(obs)
        action: Any = np.zeros((lanes, self.task.spec.action_dim), np.float32)
        never: Any = np.zeros(lanes, bool)
        step = Step(obs, never.astype(np.float32), action, ~never, never)
        empty = self.agent.reset(self.task.spec)
        memory = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*keys.shape, *leaf.shape)), empty)
        record, total, length = _Record(lanes, episodes), np.zeros(lanes), np.zeros(lanes, int)
        explore, time = np.array([True, False]), 0
        while not record.full:
            perceived = jax.tree.map(lambda leaf: leaf.reshape(*keys.shape, *leaf.shape[1:]), step)
            action, memory = self._perceive(states, memory, perceived, keys, explore, time)
            action = np.asarray(action).reshape(lanes, -1)
            obs, reward, terminated, truncated, success = self.environments.step(action)
            total, length, done, time = total + reward, length + 1, terminated | truncated, time + 1
            record.add(done, total, length, success)
            if done.any():
                obs = self.environments.restart(done)
                total, length = np.where(done, 0.0, total), np.where(done, 0, length)
            step = Step(obs, reward * ~done, action * ~done[:, None], done, never)
        return jax.tree.map(lambda leaf: leaf.reshape(*keys.shape, episodes), record.episodes)

    def close(self) -> None:
        """Close the environments, if there are any."""
        if self.environments is not None:
            self.environments.close()


def _perceive(
    agent: Agent,
    spec: Spec,
    state: Any,
    memory: Any,
    step: Step,
    key: Key[Array, ""],
    explore: Bool[Array, ""],
    time: Int[Array, ""],
) -> tuple[Float[Array, " action"], Any]:
    empty = agent.reset(spec)
    memory = jax.tree.map(lambda new, old: jnp.where(step.is_first, new, old), empty, memory)
    return agent.act(state, memory, step, jax.random.fold_in(key, time), explore)


class _Record:
    """The first episodes of every lane."""

    def __init__(self, lanes: int, episodes: int):
        shape = (lanes, episodes)
        columns: Any = [np.zeros(shape, kind) for kind in (bool, np.float32, np.int32, bool)]
        self.episodes = Episode(*columns)
        self.count = np.zeros(lanes, int)

    @property
    def full(self) -> bool:
        """Whether every lane has all its episodes."""
        return bool(self.episodes.done.all())

    def add(self, done: Any, *values: Any) -> None:
        """What ended, where `done` and still wanted; values are Episode's other fields, leaves (lane,)."""
        lanes = np.flatnonzero(done & (self.count < self.episodes.done.shape[1]))
        for column, value in zip(self.episodes, (done, *values), strict=True):
            column[lanes, self.count[lanes]] = value[lanes]
        self.count[lanes] += 1
