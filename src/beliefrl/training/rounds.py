"""Rounds of learning: windows of the replay, then updates.

A round is the fewest steps that are whole cycles of the agent and whole steps of all its environments. With one
environment a round is a cycle. The updates of its cycles follow the steps.

The windows of all cycles are drawn before the first update. So the updates do not need the replay, and the host loop
can make them while it records the next steps (`overlap`).
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from beliefrl.agents import Agent
from beliefrl.errors import UserError
from beliefrl.training import replay as ring
from beliefrl.training.keys import CYCLE, SAMPLE, UPDATE, step_key
from beliefrl.training.replay import Readers, Replay
from beliefrl.training.rounding import at_precision
from beliefrl.types import Window

Metrics = dict[str, Float[Array, "..."]]


def round_length(agent: Agent, envs: int = 1) -> int:
    """Environment steps of a round of learning, summed over the environments of a seed."""
    return math.lcm(agent.cycle, envs)


def stretch_length(agent: Agent, envs: int = 1) -> int:
    """Environment steps between two entries of the log, at most: whole rounds, about 100 steps."""
    length = round_length(agent, envs)
    return max(100 // length, 1) * length


def draw(
    agent: Agent, replay: Replay, readers: Readers | None, key: Key[Array, ""], first: Int[Array, ""], envs: int = 1
) -> tuple[Window, Readers | None]:
    """The windows for the updates of the round that began at environment step `first`.

    If the round has several cycles, leaves have a leading axis `cycle`.

    Args:
        agent: how many windows it learns from in a cycle, and their shape.
        replay: of all environments of the seed.
        readers: of the replay, if the agent's windows are read in order.
        key: the key of the seed.
        first: the step.
        envs: environments of the seed.
    """

    def of_cycle(readers: Readers | None, number: Any) -> tuple[Readers | None, Window]:
        key_sample = step_key(key, first + number * agent.cycle, SAMPLE)
        windows, readers = ring.windows(replay, readers, key_sample, agent.cycle_windows, agent.window)
        return readers, windows

    cycles = round_length(agent, envs) // agent.cycle
    readers, windows = of_cycle(readers, 0) if cycles == 1 else jax.lax.scan(of_cycle, readers, jnp.arange(cycles))
    return windows, readers


def learn(
    agent: Agent, state: Any, windows: Window, key: Key[Array, ""], first: Int[Array, ""], envs: int = 1
) -> tuple[Any, Metrics]:
    """The agent's state after the updates of the round that began at environment step `first`; means of their metrics.

    Args:
        agent: the agent.
        state: its state before.
        windows: what `draw` returned.
        key: the key of the seed.
        first: the step.
        envs: environments of the seed.

    Raises:
        UserError: `begin_cycle` and `update` return a metric of the same name.
    """

    def cycle(state: Any, inputs: tuple[Int[Array, ""], Window]) -> tuple[Any, Metrics]:
        number, windows = inputs
        return _learn_cycle(agent, state, windows, key, first + number * agent.cycle)

    cycles = round_length(agent, envs) // agent.cycle
    if cycles == 1:
        return _learn_cycle(agent, state, windows, key, first)
    state, metrics = jax.lax.scan(cycle, state, (jnp.arange(cycles), windows))
    return state, jax.tree.map(lambda each: jnp.mean(each, axis=0), metrics)


def _learn_cycle(
    agent: Agent, state: Any, windows: Window, key: Key[Array, ""], first: Int[Array, ""]
) -> tuple[Any, Metrics]:
    """The updates after the steps of one cycle, and their metrics."""
    begin_cycle = at_precision(agent.begin_cycle)
    state, batches, model_metrics = begin_cycle(state, windows, step_key(key, first, CYCLE))

    count = len(jax.tree.leaves(batches)[0])
    begun = first * -(-count // agent.cycle)  # no two updates share a key

    def update(state, inputs):
        number, batch = inputs
        return at_precision(agent.update)(state, batch, step_key(key, begun + number, UPDATE))

    updates = jnp.arange(count)
    state, metrics = jax.lax.scan(update, state, (updates, batches))
    for name in model_metrics.keys() & metrics.keys():
        raise UserError(f"begin_cycle and update of the agent both return a metric {name!r}: rename one of them.")
    return state, model_metrics | jax.tree.map(jnp.mean, metrics)
