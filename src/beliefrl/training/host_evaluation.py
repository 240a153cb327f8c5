"""Evaluation where the environments run on the host."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from beliefrl.agents import Agent
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import rollout
from beliefrl.training.lockstep import Lockstep, environment_seeds
from beliefrl.training.rollout import Episode
from beliefrl.types import Spec, Timestep


class Evaluation:
    """Episodes with sampled and with mode actions, in environments of their own or in those of the training."""

    def __init__(
        self,
        agent: Agent,
        task: GymnasiumTask,
        seeds: Sequence[int],
        make: Callable[[Sequence[str]], Lockstep],
        shared: Lockstep | None = None,
    ):
        """`shared` are the environments of the training, one for each seed.

        If it is None, `make` makes two for each seed at the first evaluation, one for sampled and one for mode actions.
        It is called with their names.
        """
        self.agent, self.task, self.seeds, self._make = agent, task, seeds, make
        self.environments, self.is_shared = shared, shared is not None
        lanes = jax.vmap(partial(_perceive, agent, task.spec), in_axes=(None, 0, 0, 0, 0, None))
        self._perceive = jax.jit(jax.vmap(lanes, in_axes=(0, 0, 0, 0, None, None)))

    def play(
        self,
        states: Any,
        keys: Key[Array, " seed"],
        episodes: int,
        ended: Callable[[int], None] = lambda count: None,
    ) -> Episode:
        """`episodes` episodes, one after the other; leaves (seed, 2, episodes). `ended` is called with their count."""
        if self.environments is None:
            lanes = [f"evaluation of seed {seed}" for seed in self.seeds for _ in range(2)]
            self.environments = self._make(lanes)
        keys, explore = jax.vmap(lambda key: jax.random.split(key, 2))(keys), np.array([True, False])
        play = partial(self._play, self.environments, states)
        if not self.is_shared:
            return play(keys, explore, episodes, ended)
        sampled = play(keys[:, :1], explore[:1], episodes, ended)
        before = sampled.done.size
        mode = play(keys[:, 1:], explore[1:], episodes, lambda count: ended(before + count))
        return jax.tree.map(lambda *each: np.concatenate(each, axis=1), sampled, mode)

    def _play(
        self,
        environments: Lockstep,
        states: Any,
        keys: Key[Array, "seed lane"],
        explore: Bool[np.ndarray, " lane"],
        episodes: int,
        ended: Callable[[int], None],
    ) -> Episode:
        """Episodes in every lane of every seed; leaves (seed, lane, episodes). `explore` says which are sampled."""
        obs = environments.reset(environment_seeds(keys))
        lanes = len(obs)
        action: Any = np.zeros((lanes, self.task.spec.action_dim), np.float32)
        never: Any = np.zeros(lanes, bool)
        step = Timestep(obs, never.astype(np.float32), action, ~never, never)
        empty = self.agent.reset(self.task.spec)
        memory = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*keys.shape, *leaf.shape)), empty)
        record, returns, length = _Record(self.task.spec, lanes, episodes), np.zeros(lanes), np.zeros(lanes, int)
        time = 0
        while not record.full:
            perceived = jax.tree.map(lambda leaf: leaf.reshape(*keys.shape, *leaf.shape[1:]), step)
            action, memory = self._perceive(states, memory, perceived, keys, explore, time)
            action = np.asarray(action).reshape(lanes, -1)
            obs, reward, terminated, truncated, measures = environments.step(action)
            returns, length, done, time = returns + reward, length + 1, terminated | truncated, time + 1
            now: Any = done, returns, length, measures
            record.add(Episode(*now))
            if done.any():
                ended(int(record.episodes.done.sum()))
            if done.any() and not record.full:
                obs = environments.restart(done)
                returns, length = np.where(done, 0.0, returns), np.where(done, 0, length)
            step = Timestep(obs, reward * ~done, action * ~done[:, None], done, never)
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
    step: Timestep,
    key: Key[Array, ""],
    explore: Bool[Array, ""],
    time: Int[Array, ""],
) -> tuple[Float[Array, " action"], Any]:
    before = rollout.select(step.is_first, agent.reset(spec), memory)
    return agent.act(state, before, step, jax.random.fold_in(key, time), explore)


class _Record:
    """The first episodes of every lane."""

    def __init__(self, spec: Spec, lanes: int, episodes: int):
        self.episodes: Any = jax.tree.map(np.array, rollout.no_episodes(spec, (lanes, episodes)))
        self.count = np.zeros(lanes, int)

    @property
    def full(self) -> bool:
        """Whether every lane has all its episodes."""
        return bool(self.episodes.done.all())

    def add(self, now: Episode) -> None:
        """Add the episodes that are `done` and still needed; leaves (lane,)."""
        lanes = np.flatnonzero(now.done & (self.count < self.episodes.done.shape[1]))
        for column, value in zip(*map(jax.tree.leaves, (self.episodes, now)), strict=True):
            column[lanes, self.count[lanes]] = value[lanes]
        self.count[lanes] += 1
