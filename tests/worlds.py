"""Tasks and an agent with nothing in them but what a test needs to see."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from beliefrl.types import Spec, WindowShape, transitions


@dataclasses.dataclass(frozen=True)
class Counting:
    """Observes how many steps the episode has had; pays that number; terminates at `ends`, if that comes first."""

    ends: int = 1000
    max_steps: int = 7

    @property
    def spec(self):
        return Spec(obs_dim=1, action_dim=1, max_steps=self.max_steps, has_success=True)

    def reset(self, key):
        return jnp.array(0), jnp.zeros(1)

    def step(self, state, action, key):
        state = state + 1
        return state, state[None].astype(float), state.astype(float), state >= self.ends

    def success(self, state):
        return state >= 5


class CountingState(NamedTuple):
    offset: Any  # what `relive` can see changing
    seen: Any  # transitions that were checked


@dataclasses.dataclass(frozen=True)
class CountingAgent:
    """Counts the moments it perceives, notes the count, and checks every window that it is given.

    `broken` counts what contradicts: an observation that is not the count, a note that is not the observation, a
    transition whose parts are not one moment apart, a terminal moment followed by anything.
    """

    step_start_rl: int = 10
    train_interval_rl: int = 2
    pretrain_updates: int = 3
    cycle: int = 4
    pretrain_windows: int = 5
    cycle_windows: int = 8
    window: ClassVar = WindowShape(3, 6)

    def init(self, key, spec):
        return CountingState(jnp.zeros(()), jnp.zeros((), int))

    def reset(self, spec):
        return jnp.zeros(())

    def act(self, state, memory, step, key, explore):
        action = jnp.where(explore, jax.random.uniform(key, (1,), minval=-1.0), 0.5)
        return action, memory + 1

    def note(self, memory):
        return (memory - 1,)

    def check(self, window):
        step, obs = window.step, window.step.obs[..., 0]
        valid = transitions(window, self.window.burn_in)
        now, after = slice(self.window.burn_in, -1), slice(self.window.burn_in + 1, None)
        wrong = obs[:, after] != obs[:, now] + 1
        wrong |= step.reward[:, after] != obs[:, after]
        wrong |= step.terminated[:, now]
        broken = jnp.sum(wrong & valid) + jnp.sum((window.note[0] != obs) & window.exists)
        return {"broken": broken.astype(float), "valid": jnp.sum(valid).astype(float)}

    def pretrain(self, state, windows, key):
        return state._replace(offset=state.offset + 1), self.check(windows)

    def begin_cycle(self, state, windows, key):
        batches = jax.tree.map(lambda leaf: leaf.reshape(2, 4, *leaf.shape[1:]), windows)
        return state, batches, {}

    def update(self, state, batch, key):
        metrics = self.check(batch)
        return state._replace(seen=state.seen + metrics["valid"].astype(int)), metrics
