"""Tiny worlds with known values: what VRM must learn before anything else; two cannot be solved without memory."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import agents
from beliefrl.training import phases
from beliefrl.types import Spec
from worlds import Counting

SMALL = {
    "step_start_rl": 100,
    "train_times_fivrm": 300,
    "seq_len": 8,
    "burn_in": 8,
    "batch_size": 8,
    "d_size": 16,
    "z_size": 4,
    "hidden_size": 16,
    "policy_layers": (32,),
    "value_layers": (32,),
    "lr_actor": 3e-3,
    "lr_critic": 3e-3,
    "lr_model": 3e-3,
    "tau": 0.05,
}
GREEDY = {"lr_alpha": 0.05, "target_entropy": -100.0}  # the temperature falls to nothing: values are plain returns

REMEMBERING = {
    "train_times_fivrm": 2000,
    "lr_model": 1e-3,
    "lr_alpha": 3e-3,
    "d_size": 32,
    "hidden_size": 32,
    "policy_layers": (64, 64),
    "value_layers": (64, 64),
}


@dataclasses.dataclass(frozen=True)
class Constant(Counting):
    """Pays 1 a step whatever is done, and shows nothing."""

    def step(self, state, action, key):
        state, obs, _, terminated = super().step(state, action, key)
        return state, jnp.zeros_like(obs), jnp.array(1.0), terminated


@dataclasses.dataclass(frozen=True)
class Recall:
    """Shows a sign once, in the first observation or as the first step's reward; pays action x sign at the last step.

    The terminal observation shows the sign again: a model that predicts has a reason to remember.
    """

    shown_in: str
    delay: int = 2

    @property
    def spec(self):
        return Spec(obs_dim=2, action_dim=1, max_steps=self.delay + 1)

    def observation(self, sign, time):
        shown = jnp.where(((time == 0) & (self.shown_in == "obs")) | (time > self.delay), sign, 0.0)
        return jnp.stack([shown, (time == self.delay).astype(float)])

    def reset(self, key) -> tuple[Any, Any]:
        sign = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
        return (sign, jnp.array(0)), self.observation(sign, jnp.array(0))

    def step(self, state, action, key):
        sign, time = state
        shown = jnp.where((time == 0) & (self.shown_in == "reward"), sign, 0.0)
        reward = jnp.where(time == self.delay, action[0] * sign, shown)
        return (sign, time + 1), self.observation(sign, time + 1), reward, time == self.delay


def learn(task, steps, seeds=1, **hyperparameters):
    """Train a small VRM; returns the last stretch's metrics and the mode actions' mean return."""
    agent = agents.make("vrm", **(SMALL | hyperparameters))
    program = phases.compile_program(agent, task, capacity=2 * steps, episodes=32)
    keys = jax.random.split(jax.random.key(0), seeds)
    seeds, step = program.begin(keys), agent.step_start_rl
    seeds, _ = program.explore(seeds, 0, step)
    seeds, _ = program.pretrain(seeds, 0, agent.pretrain_updates)
    seeds = program.refresh(seeds)
    while step < steps:
        seeds, stretch = program.learn(seeds, step, 20)
        step += 100
    return stretch.metrics, np.asarray(program.evaluate(seeds.state, keys).episode_return)[:, 1].mean()


@pytest.mark.slow
def test_beyond_a_termination_there_is_no_value():
    metrics, _ = learn(Constant(ends=1), 800, gamma=0.5, **GREEDY)
    assert float(metrics["q"][0]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_beyond_a_time_limit_there_is_value():
    """1 + 0.5 + 0.25 + ... = 2, although no episode has more than 2 steps."""
    metrics, _ = learn(Constant(max_steps=2), 800, gamma=0.5, **GREEDY)
    assert float(metrics["q"][0]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(
    "shown_in", [pytest.param("obs", marks=pytest.mark.nightly), pytest.param("reward", marks=pytest.mark.slow)]
)
def test_what_was_shown_once_is_remembered(shown_in):
    """Without memory the best mean return is 0, with it nearly 1."""
    _, total = learn(Recall(shown_in), 2000, **REMEMBERING)
    assert total > 0.8
