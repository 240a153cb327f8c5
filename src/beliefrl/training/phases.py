"""Algorithm 1 of the paper: explore, pre-train, then learn in cycles; compiled, and for many seeds in one program.

    explore    step_start_rl environment steps with the untrained policy
    pretrain   updates on these steps; then the states in the replay and the actor's memory are computed again
    learn      cycles: act and record for the steps of a cycle; then sample from the replay, and make the updates

The step counter is not mapped over seeds. Each phase is a compiled function of its own, called for a block (stretch) of
steps. The number of steps is an argument, so each phase is compiled once, and no result depends on the length of the
blocks. Random keys are derived from the seed's key and the number of the step. `schedule` calls the phases.

The outermost loop of a phase (over steps, updates or rounds) is not mapped over seeds. Its body is. JAX then traces
the body once. If the loop itself were mapped, JAX would trace it three times.

A seed may have several environments, `envs`, each with an actor and a ring of the replay of its own: the actors' and
the replay's leaves then have an axis `env`. All environments step together, and steps are counted over all of them.
Learning goes on in rounds: the fewest steps that are whole cycles and whole steps of all environments, then the
updates of these cycles. With one environment a round is a cycle, and there is no axis `env`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from beliefrl.agents import Agent
from beliefrl.tasks import Task
from beliefrl.training import replay as ring
from beliefrl.training import rollout, rounds
from beliefrl.training.keys import PRETRAIN, REFRESH, acting_keys, step_key
from beliefrl.training.replay import Readers, Replay
from beliefrl.training.rollout import ActorState, Episode
from beliefrl.training.rounding import at_precision
from beliefrl.training.rounds import Metrics, round_length, stretch_length
from beliefrl.types import Spec


def on_each_env(envs: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function of one environment's arrays as one of those of all environments of a seed."""
    return function if envs == 1 else jax.vmap(function)


class SeedState(NamedTuple):
    """Everything that the training of one seed changes. Mapped over seeds, every leaf has a leading axis `seed`."""

    state: Any  # the agent's
    actor: ActorState
    replay: Replay
    readers: Readers | None  # of the replay, if the agent's windows are read in order
    key: Key[Array, ""]


class Stretch(NamedTuple):
    """Metrics and episodes of a stretch of steps; leaves have a leading axis `seed`."""

    metrics: Metrics  # means over its updates
    episodes: Episode | None  # leaves (seed, stretch): one entry a step, done only where an episode ended


def begin(agent: Agent, task: Task, capacity: int, key: Key[Array, ""], envs: int = 1) -> SeedState:
    """A seed before its first step; its replay holds `capacity` timesteps of each environment."""
    key_state, key_actor, key = jax.random.split(key, 3)
    keys = key_actor if envs == 1 else jax.random.split(key_actor, envs)
    actor = on_each_env(envs, partial(rollout.begin, agent, task))(keys)
    return seed_of(agent, task.spec, capacity, actor, key_state, key, envs)


def seed_of(
    agent: Agent,
    spec: Spec,
    capacity: int,
    actor: ActorState,
    key_state: Key[Array, ""],
    key: Key[Array, ""],
    envs: int = 1,
) -> SeedState:
    """A new agent and an empty replay for actors at their first timestep."""
    state = rollout.strong(agent.init(key_state, spec))
    replay = on_each_env(envs, lambda actor: ring.init(rollout.stored(agent, actor), capacity))(actor)
    return SeedState(state, actor, replay, ring.init_readers(agent.window), key)


def _write(log: Episode, index: Int[Array, ""], episode: Episode) -> Episode:
    """The log with an entry at `index`, or with one for each environment from there on."""

    def write(column: Array, entry: Array) -> Array:
        if entry.ndim:
            return jax.lax.dynamic_update_slice_in_dim(column, entry, index, axis=0)
        return column.at[index].set(entry)

    return jax.tree.map(write, log, episode)


def explore(
    agent: Agent, task: Task, seeds: SeedState, first: Int[Array, ""], steps: Int[Array, ""], envs: int = 1
) -> tuple[SeedState, Stretch]:
    """Environment steps `first` to `first + steps` without updates; at most `stretch_length` of them."""

    def step(i, carry):
        seeds, log = carry
        act = jax.vmap(partial(_act, agent, task, envs), in_axes=(0, 0, None, None))
        return act(seeds, log, first + i * envs, i * envs)

    none = rollout.no_episodes(task.spec, (len(seeds.key), stretch_length(agent, envs)))
    seeds, log = jax.lax.fori_loop(0, steps // envs, step, (seeds, none))
    return seeds, Stretch({}, log)


def _act(
    agent: Agent, task: Task, envs: int, seed: SeedState, log: Episode, step: Int[Array, ""], index: Int[Array, ""]
) -> tuple[SeedState, Episode]:
    """One step of every environment of a seed. Their entries in the log begin at `index`."""
    advance = on_each_env(envs, partial(rollout.advance, agent, task, seed.state))
    actor, replay, episode = advance(seed.actor, seed.replay, acting_keys(seed.key, step, envs))
    return seed._replace(actor=actor, replay=replay), _write(log, index, episode)


def _zeros(shapes: Any) -> Metrics:
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


def pretrain(
    agent: Agent, seeds: SeedState, first: Int[Array, ""], updates: Int[Array, ""]
) -> tuple[SeedState, Metrics]:
    """Updates `first` to `first + updates` of the pre-training; metrics are their means."""

    @partial(jax.jit, inline=True)  # traced once, for its shapes and for the loop
    @partial(jax.vmap, in_axes=(0, None))
    def update(seed: SeedState, number: Int[Array, ""]) -> tuple[SeedState, Metrics]:
        key_sample, key = jax.random.split(step_key(seed.key, number, PRETRAIN))
        windows, readers = ring.windows(seed.replay, seed.readers, key_sample, agent.pretrain_windows, agent.window)
        state, metrics = at_precision(agent.pretrain)(seed.state, windows, key)
        return seed._replace(state=state, readers=readers), metrics

    def step(i, carry):
        seeds, totals = carry
        seeds, metrics = update(seeds, first + i)
        return seeds, jax.tree.map(jnp.add, totals, metrics)

    totals = _zeros(jax.eval_shape(update, seeds, first)[1])
    seeds, totals = jax.lax.fori_loop(0, updates, step, (seeds, totals))
    return seeds, jax.tree.map(lambda total: total / jnp.maximum(updates, 1), totals)


def refresh(agent: Agent, spec: Spec, seed: SeedState, envs: int = 1) -> SeedState:
    """Recompute the notes and the actors' memories with the pre-trained networks (at most 2 timesteps a step)."""
    length = min(2 * -(-agent.step_start_rl // envs), ring.capacity(seed.replay))
    key = jax.random.fold_in(seed.key, REFRESH)
    keys = key if envs == 1 else jax.random.split(key, envs)
    again = partial(rollout.refresh, agent, spec, seed.state, length=length)
    actor, replay = on_each_env(envs, again)(seed.actor, seed.replay, keys)
    return seed._replace(actor=actor, replay=replay)


def learn(
    agent: Agent, task: Task, seeds: SeedState, first: Int[Array, ""], rounds: Int[Array, ""], envs: int = 1
) -> tuple[SeedState, Stretch]:
    """`rounds` rounds of learning from environment step `first` on; at most `stretch_length` steps in all."""
    # Traced once, for its shapes and for the loop.
    one_round = jax.jit(jax.vmap(partial(_round, agent, task, envs), in_axes=(0, 0, None, None)), inline=True)
    none = rollout.no_episodes(task.spec, (len(seeds.key), stretch_length(agent, envs)))
    shapes, length = jax.eval_shape(one_round, seeds, none, first, first)[2], round_length(agent, envs)

    def step(i, carry):
        seeds, log, totals = carry
        seeds, log, metrics = one_round(seeds, log, first + i * length, i * length)
        return seeds, log, jax.tree.map(jnp.add, totals, metrics)

    seeds, log, totals = jax.lax.fori_loop(0, rounds, step, (seeds, none, _zeros(shapes)))
    return seeds, Stretch(jax.tree.map(lambda total: total / jnp.maximum(rounds, 1), totals), log)


def _round(
    agent: Agent, task: Task, envs: int, seed: SeedState, log: Episode, first: Int[Array, ""], index: Int[Array, ""]
) -> tuple[SeedState, Episode, Metrics]:
    """One round, from environment step `first` on, whose entries in the log begin at `index`.

    Its timesteps are added before any are drawn, and in a loop whose length XLA does not know (it would inline one of a
    single step): in either other form XLA copies the whole ring.
    """
    length = round_length(agent, envs)

    def act(number, carry):
        seed, log = carry
        step = number * envs
        return _act(agent, task, envs, seed, log, step, index + step - first)

    seed, log = jax.lax.fori_loop(first // envs, (first + length) // envs, act, (seed, log))
    seed, metrics = learn_round(agent, seed, first, envs)
    return seed, log, metrics


def learn_round(agent: Agent, seed: SeedState, first: Int[Array, ""], envs: int = 1) -> tuple[SeedState, Metrics]:
    """The updates after the steps of the round that began at environment step `first`; metrics are their means."""
    windows, readers = rounds.draw(agent, seed.replay, seed.readers, seed.key, first, envs)
    state, metrics = rounds.learn(agent, seed.state, windows, seed.key, first, envs)
    return seed._replace(state=state, readers=readers), metrics


def evaluate(agent: Agent, task: Task, state: Any, key: Key[Array, ""], episodes: int) -> Episode:
    """Episodes with sampled actions, then as many with mode actions; leaves (2, episodes)."""
    sampled: Bool[Array, " 2*episodes"] = jnp.arange(2 * episodes) < episodes
    result = rollout.evaluate(agent, task, state, key, sampled)
    return jax.tree.map(lambda leaf: leaf.reshape(2, episodes), result)


class Program(NamedTuple):
    """The phases of training, compiled for many seeds: leaves of every SeedState have a leading axis `seed`."""

    begin: Callable[..., SeedState]  # keys (seed,)
    explore: Callable[..., tuple[SeedState, Stretch]]  # seeds, first, steps
    pretrain: Callable[..., tuple[SeedState, Metrics]]  # seeds, first, updates
    refresh: Callable[..., SeedState]  # seeds
    learn: Callable[..., tuple[SeedState, Stretch]]  # seeds, first, rounds
    evaluate: Callable[..., Episode]  # states (seed, ...), keys (seed,); leaves (seed, 2, episodes)
    shapes: Callable[..., SeedState]  # keys (seed,); what `begin` gives, without its numbers
    revive: Callable[..., SeedState] = lambda seeds, step: seeds  # after they were read from a checkpoint
    close: Callable[[], None] = lambda: None  # after the last phase


RUN_ONCE = {"xla_backend_optimization_level": 0}  # compiles in half the time; the numbers drawn are the same


def compile_program(agent: Agent, task: Task, capacity: int, episodes: int, envs: int = 1) -> Program:
    """The phases as compiled functions. They donate the memory of the seeds that they are given."""
    start = jax.jit(jax.vmap(partial(begin, agent, task, capacity, envs=envs)), compiler_options=RUN_ONCE)
    return Program(
        begin=start,
        explore=jax.jit(partial(explore, agent, task, envs=envs), donate_argnums=0),
        pretrain=jax.jit(partial(pretrain, agent), donate_argnums=0),
        refresh=jax.jit(jax.vmap(partial(refresh, agent, task.spec, envs=envs)), donate_argnums=0),
        learn=jax.jit(partial(learn, agent, task, envs=envs), donate_argnums=0),
        evaluate=jax.jit(jax.vmap(partial(evaluate, agent, task, episodes=episodes))),
        shapes=partial(jax.eval_shape, start),
    )
