"""An agent in its task: act, step, time limit, reset, record; and evaluation.

One environment step, at timestep t of an episode:

    the agent perceives timestep t and acts        -> a_t, memory
    the replay stores timestep t and the agent's note
    the task steps                               -> timestep t+1
    if it is terminal or the time limit is reached, the replay stores timestep t+1 as well and a new episode begins

So every step of the loop is one step of the environment, and the current timestep is not yet in the replay.
All functions are for one seed; `phases` maps them over seeds.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from beliefrl.agents import Agent
from beliefrl.errors import UserError
from beliefrl.tasks import Task
from beliefrl.tasks.interface import check_measures
from beliefrl.training import replay as ring
from beliefrl.training.replay import Replay
from beliefrl.types import Spec, StoredTimestep, Timestep


class ActorState(NamedTuple):
    """One agent at one timestep of one episode."""

    task_state: Any
    step: Timestep  # the current timestep
    memory: Any  # before that timestep is perceived
    length: Int[Array, ""]  # steps of this episode so far
    episode_return: Float[Array, ""]  # undiscounted, so far


class Episode(NamedTuple):
    """The report of an environment step about its episode. The other fields are valid only where `done`."""

    done: Bool[Array, "*batch"]
    episode_return: Float[Array, "*batch"]  # undiscounted
    length: Int[Array, "*batch"]
    measures: dict[str, Float[Array, "*batch"]]  # by name, as `Spec.measures`


def no_episodes(spec: Spec, shape: tuple[int, ...]) -> Episode:
    """Empty reports of this shape."""
    number = jnp.zeros(shape)
    return Episode(number.astype(bool), number, number.astype(int), dict.fromkeys(spec.measures, number))


def measured(task: Task, task_state: Any) -> dict[str, Float[Array, ""]]:
    """The measures of a task at a state.

    Raises:
        UserError: the task does not return the measures that `spec.measures` names.
    """
    names, kind = task.spec.measures, type(task).__name__
    found: Any = task.measures(task_state) if names else {}  # pyright: ignore[reportAttributeAccessIssue]
    if set(found) != set(names):
        raise UserError(f"{kind}.measures returns {sorted(found)}: its spec names {sorted(names)}, so return these.")
    check_measures(names, kind)
    return {name: jnp.asarray(found[name], float) for name in names}


def strong(tree: Any) -> Any:
    """The tree without weak types. Python numbers in a task or agent cause them, and then XLA compiles twice."""

    def cast(leaf: Any) -> Array:
        leaf = jnp.asarray(leaf)
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return leaf if is_key else jax.lax.convert_element_type(leaf, leaf.dtype)

    return jax.tree.map(cast, tree)


def select(condition: Bool[Array, "..."], new: Any, old: Any) -> Any:
    """The tree `new` where the condition is true, and `old` elsewhere."""
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), new, old)


def first(agent: Agent, spec: Spec, task_state: Any, obs: Float[Array, " obs"]) -> ActorState:
    """The first timestep of an episode: no reward, no action before it, an empty memory."""
    step = Timestep(
        obs=obs,
        reward=jnp.array(0.0),
        prev_action=jnp.zeros(spec.action_dim),
        is_first=jnp.array(True),
        terminated=jnp.array(False),
    )
    return strong(ActorState(task_state, step, agent.reset(spec), jnp.array(0), jnp.array(0.0)))


def begin(agent: Agent, task: Task, key: Key[Array, ""]) -> ActorState:
    """The actor at the start of an episode."""
    return first(agent, task.spec, *task.reset(key))


def stored(agent: Agent, actor: ActorState) -> StoredTimestep:
    """A timestep in the form in which the replay stores it; only shapes and types are used."""
    return StoredTimestep(actor.step, agent.note(actor.memory))


def act(
    agent: Agent, state: Any, actor: ActorState, key: Key[Array, ""], explore: Bool[Array, ""]
) -> tuple[Float[Array, " action"], Any]:
    """The action at the current timestep, and the memory after it; `key` is the key of `move`."""
    key_act, _ = jax.random.split(key)
    return agent.act(state, actor.memory, actor.step, key_act, explore)


def arrive(
    actor: ActorState,
    memory: Any,
    action: Float[Array, " action"],
    task_state: Any,
    obs: Float[Array, " obs"],
    reward: Float[Array, ""],
    terminated: Bool[Array, ""],
) -> ActorState:
    """The next timestep, terminal or not, with the memory after the previous timestep."""
    step = Timestep(obs, reward, action, jnp.array(False), terminated)
    return strong(ActorState(task_state, step, memory, actor.length + 1, actor.episode_return + reward))


def move(
    agent: Agent, task: Task, state: Any, actor: ActorState, key: Key[Array, ""], explore: Bool[Array, ""]
) -> tuple[ActorState, Episode]:
    """Act and step; returns the actor at the next timestep."""
    action, memory = act(agent, state, actor, key, explore)
    _, key_task = jax.random.split(key)
    task_state, obs, reward, terminated = task.step(actor.task_state, action, key_task)
    after = arrive(actor, memory, action, task_state, obs, reward, terminated)
    done = terminated | (after.length >= task.spec.max_steps)
    return after, Episode(done, after.episode_return, after.length, measured(task, task_state))


def record(
    agent: Agent,
    state: Any,
    replay: Replay,
    actor: ActorState,
    after: ActorState,
    fresh: ActorState,
    done: Bool[Array, ""],
    key: Key[Array, ""],
) -> tuple[ActorState, Replay]:
    """Store the current timestep, and `after` if it is the last; returns the actor at the new current timestep."""
    replay = ring.add(replay, StoredTimestep(actor.step, agent.note(after.memory)))
    # Only the note is used. If it does not depend on the action, XLA removes the acting.
    _, last = agent.act(state, after.memory, after.step, key, jnp.array(True))
    replay = ring.add(replay, StoredTimestep(after.step, agent.note(last)), done)
    return select(done, fresh, after), replay


def advance(
    agent: Agent, task: Task, state: Any, actor: ActorState, replay: Replay, key: Key[Array, ""]
) -> tuple[ActorState, Replay, Episode]:
    """Make and record one environment step of training."""
    key_move, key_last, key_reset = jax.random.split(key, 3)
    after, episode = move(agent, task, state, actor, key_move, jnp.array(True))
    fresh = begin(agent, task, key_reset)
    return *record(agent, state, replay, actor, after, fresh, episode.done, key_last), episode


def refresh(
    agent: Agent, spec: Spec, state: Any, actor: ActorState, replay: Replay, key: Key[Array, ""], length: int
) -> tuple[ActorState, Replay]:
    """Perceive the first `length` timesteps of the replay again, with the changed networks.

    Returns the actor with the memory that these networks give, and the replay with new notes.
    """
    steps, exists = ring.history(replay, length)
    empty = agent.reset(spec)

    def perceive(memory, inputs):
        step, exists, key = inputs
        before = select(step.is_first, empty, memory)
        _, after = agent.act(state, before, step, key, jnp.array(True))
        memory = select(exists, after, memory)
        return memory, agent.note(memory)

    memory, notes = jax.lax.scan(perceive, empty, (steps, exists, jax.random.split(key, length)))
    memory = select(actor.step.is_first, empty, memory)
    return strong(actor._replace(memory=memory)), ring.annotate(replay, notes, length)


def evaluate(agent: Agent, task: Task, state: Any, key: Key[Array, ""], explore: Bool[Array, " episodes"]) -> Episode:
    """Play whole episodes in parallel, apart from training; leaves (episodes,).

    `explore` defines for each episode whether actions are sampled. Otherwise they are the mode of the policy.
    """
    key_reset, key_steps = jax.random.split(key)
    episodes = explore.shape[0]
    actors = jax.vmap(lambda key: begin(agent, task, key))(jax.random.split(key_reset, episodes))
    result = no_episodes(task.spec, (episodes,))

    def step(carry):
        time, actors, result = carry
        keys = jax.random.split(jax.random.fold_in(key_steps, time), episodes)
        actors, now = jax.vmap(lambda actor, key, explore: move(agent, task, state, actor, key, explore))(
            actors, keys, explore
        )
        result = select(result.done, result, now)
        return time + 1, actors, result

    def unfinished(carry):
        return ~jnp.all(carry[2].done)

    return jax.lax.while_loop(unfinished, step, (jnp.array(0), actors, result))[2]
