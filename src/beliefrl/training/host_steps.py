"""What is compiled around a step of Gymnasium environments: the parts of a step of `host_loop`.

The agent acts, records and learns with the same functions as in the compiled loop.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from beliefrl.agents import Agent
from beliefrl.training import phases, rollout, rounds
from beliefrl.training.keys import acting_keys
from beliefrl.training.phases import SeedState
from beliefrl.training.replay import Replay
from beliefrl.training.rollout import ActorState, Episode
from beliefrl.training.rounds import Metrics
from beliefrl.types import Spec, Window


class ActorOutput(NamedTuple):
    """What the agent returns at the current timestep."""

    action: Float[Array, "*lanes action"]
    memory: Any  # after that timestep


class UpdateInputs(NamedTuple):
    """What the updates of a round need besides the agent's state."""

    windows: Window
    key: Key[Array, "*seed"]  # the seed's, in memory of its own: the next step reuses that of the other


class StepResult(NamedTuple):
    """What the agent returned, and what its environments returned. *lanes* is (seed,), or (seed, env) with several."""

    output: ActorOutput
    obs: Any  # (*lanes, obs)
    reward: Any  # lanes
    terminated: Any  # lanes
    done: Any  # lanes
    measures: dict[str, Any]  # leaves of shape lanes
    fresh: Any  # (*lanes, obs), the first observation of the next episode where done


def begin(
    agent: Agent, spec: Spec, capacity: int, envs: int, key: Key[Array, ""], obs: Float[Array, "*env obs"]
) -> SeedState:
    key_state, _, key = jax.random.split(key, 3)
    actor = phases.on_each_env(envs, lambda obs: rollout.first(agent, spec, (), obs))(obs)
    return phases.seed_of(agent, spec, capacity, actor, key_state, key, envs)


def act(agent: Agent, envs: int, seed: SeedState, step: Int[Array, ""]) -> ActorOutput:
    def act(actor: ActorState, key: Key[Array, ""]) -> ActorOutput:
        key_move, _, _ = jax.random.split(key, 3)
        return ActorOutput(*rollout.act(agent, seed.state, actor, key_move, jnp.array(True)))

    return phases.on_each_env(envs, act)(seed.actor, acting_keys(seed.key, step, envs))


def record(
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

    keys, after = acting_keys(seed.key, step, envs), phases.on_each_env(envs, arrive)(seed.actor, result)
    actor, replay = jax.lax.fori_loop(step, step + 1, once, (seed.actor, seed.replay))
    episode = Episode(result.done, after.episode_return, after.length, result.measures)
    return seed._replace(actor=actor, replay=replay), episode


def go_on(
    agent: Agent, spec: Spec, envs: int, state: Any, rest: SeedState, result: StepResult, step: Int[Array, ""]
) -> tuple[SeedState, ActorOutput, Episode]:
    """Record, and act again."""
    seed, episode = record(agent, spec, envs, rest._replace(state=state), result, step)
    return seed._replace(state=()), act(agent, envs, seed, step + envs), episode


def learn(
    agent: Agent, spec: Spec, envs: int, seed: SeedState, result: StepResult, step: Int[Array, ""]
) -> tuple[SeedState, ActorOutput, Episode, Metrics]:
    """Record the last step of a round, learn, and act again."""
    seed, episode = record(agent, spec, envs, seed, result, step)
    seed, metrics = phases.learn_round(agent, seed, _first(agent, step, envs), envs)
    return seed, act(agent, envs, seed, step + envs), episode, metrics


def end_round(
    agent: Agent, spec: Spec, envs: int, state: Any, rest: SeedState, result: StepResult, step: Int[Array, ""]
) -> tuple[SeedState, ActorOutput, Episode, UpdateInputs]:
    """Record the last step of a round, draw the windows for its updates, and act again without the updates."""
    rest, output, episode = go_on(agent, spec, envs, state, rest, result, step)
    windows, readers = rounds.draw(agent, rest.replay, rest.readers, rest.key, _first(agent, step, envs), envs)
    return rest._replace(readers=readers), output, episode, UpdateInputs(windows, rest.key)


def update(agent: Agent, envs: int, state: Any, inputs: UpdateInputs, step: Int[Array, ""]) -> tuple[Any, Metrics]:
    """The updates of the round that ended with this step."""
    return rounds.learn(agent, state, *inputs, _first(agent, step, envs), envs)


def _first(agent: Agent, last: Int[Array, ""], envs: int) -> Int[Array, ""]:
    """The first step of the round that ended with the step `last`."""
    return last + envs - rounds.round_length(agent, envs)
