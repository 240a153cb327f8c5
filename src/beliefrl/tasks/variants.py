"""The same task with fewer entries of its observation, with faults, or with an action repeat."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.errors import UserError, short
from beliefrl.tasks.faults import NONE, STREAM, Draws, Faults
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.repeat import LONGEST, actions, repeated_step
from beliefrl.tasks.traced import check_spec
from beliefrl.types import Spec, check_indices, check_whole


class FaultyState(NamedTuple):
    """The state of a task, and of its faults."""

    task: Any
    waiting: Float[Array, "delay obs"]
    action: Float[Array, " action"]  # the last one that was applied


@dataclasses.dataclass(frozen=True)
class Variant:
    """A JAX task as the agent sees it, with the same fields as a GymnasiumTask. Its true states are those of the task.

    Actions are repeated first, then entries are selected, and faults apply to these.
    """

    task: Any
    indices: tuple[int, ...] | None = None
    """Entries of the observation that the agent sees (Appendix B: velocities only, no velocities); None: all."""
    faults: Faults = NONE
    """Missing and faulty sensors."""
    steps_per_action: int = 1
    """Steps of the task for which an action is applied. For the agent they are one step."""

    def __post_init__(self) -> None:
        """Raise a UserError if the indices or the noise do not fit the observation."""
        if self.indices is not None:
            check_indices(self.indices, self.task.spec.obs_dim)
        self.faults.observed_size(self._size)

    @property
    def _size(self) -> int:
        return self.task.spec.obs_dim if self.indices is None else len(self.indices)

    @property
    def spec(self) -> Spec:
        """As of the task. The time limit is rounded up to whole actions."""
        spec, size = self.task.spec, self.faults.observed_size(self._size)
        return spec._replace(obs_dim=size, max_steps=actions(spec.max_steps, self.steps_per_action))

    @property
    def entry_names(self) -> tuple[str, ...]:
        """The name of each entry that the agent sees.

        Raises:
            UserError: the number of the task's names differs from the number of its entries.
        """
        size = self.task.spec.obs_dim
        names = getattr(self.task, "entry_names", None) or [f"entry {i}" for i in range(size)]
        if len(names) != size:
            raise UserError(
                f"{type(self.task).__name__} has {len(names)} entry_names for an observation of {size}: give one name "
                "for each entry."
            )
        return tuple(names if self.indices is None else (names[i] for i in self.indices))

    def reset(self, key: Key[Array, ""]) -> tuple[Any, Float[Array, " obs"]]:
        state, obs = self.task.reset(key)
        obs = self._selected(obs)
        if self.faults == NONE:
            return state, obs
        waiting, seen = self.faults.observe(jnp, self.faults.start(jnp, obs), obs, self._draws(key))
        return FaultyState(state, waiting, jnp.zeros(self.task.spec.action_dim)), seen

    def step(
        self, state: Any, action: Float[Array, " action"], key: Key[Array, ""]
    ) -> tuple[Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""]]:
        if self.faults == NONE:
            return self._true_step(state, action, key)
        draws = self._draws(key)
        action = self.faults.applied(jnp, action, state.action, draws)
        inner, obs, reward, terminated = self._true_step(state.task, action, key)
        waiting, seen = self.faults.observe(jnp, state.waiting, obs, draws)
        return FaultyState(inner, waiting, action), seen, reward, terminated

    def measures(self, state: Any) -> dict[str, Array]:
        return self.task.measures(state if self.faults == NONE else state.task)

    def _true_step(
        self, state: Any, action: Float[Array, " action"], key: Key[Array, ""]
    ) -> tuple[Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""]]:
        """A step without faults."""
        state, obs, reward, terminated = repeated_step(self.task, state, action, key, self.steps_per_action)
        return state, self._selected(obs), reward, terminated

    def _selected(self, obs: Float[Array, " full"]) -> Float[Array, " seen"]:
        return obs if self.indices is None else obs[jnp.array(self.indices)]

    def _draws(self, key: Key[Array, ""]) -> Draws:
        noise, entries, whole, action = jax.random.split(jax.random.fold_in(key, STREAM), 4)
        return Draws(
            jax.random.normal(noise, (self._size,)),
            jax.random.uniform(entries, (self._size,)),
            jax.random.uniform(whole),
            jax.random.uniform(action),
        )


def as_task(task: Any) -> Any:
    """The task itself, or one that makes environments of this Gymnasium class.

    Raises:
        UserError: it is an environment, another class, or no task at all.
    """
    if isinstance(task, type) and issubclass(task, gymnasium.Env):
        return GymnasiumTask(task)
    if isinstance(task, gymnasium.Env):
        raise UserError(_not_one(task))
    if isinstance(task, gymnasium.vector.VectorEnv):
        raise UserError("A vector environment is not needed: give the class or name of one environment, and envs=N.")
    if isinstance(task, GymnasiumTask):  # its spec would make an environment
        return task
    lacks = [name for name in ("spec", "reset", "step") if not hasattr(task, name)]
    if isinstance(task, type) and not lacks:
        raise UserError(f"{task.__name__} is a class: give a task, {task.__name__}().")
    if isinstance(task, type) or lacks:
        raise UserError(
            f"{short(task)} is no task: give a task (make_task makes one from its name), a GymnasiumTask, or a class "
            "of Gymnasium environments."
        )
    check_spec(task)
    return task


def _not_one(environment: Any) -> str:
    """Why a Gymnasium environment is no task, and what is."""
    kind, name = type(environment.unwrapped).__name__, getattr(getattr(environment, "spec", None), "id", None)
    give = f"its class, {kind}" if name is None else f"its name, 'gym:{name}'"
    return (
        f"{kind} is given as one environment, but several are needed: give {give}, or a function that makes a new one, "
        f"GymnasiumTask(lambda: {kind}(...))."
    )


def as_variant(task: Any) -> Variant | GymnasiumTask:
    """The task with the fields `indices`, `faults` and `steps_per_action`."""
    return task if isinstance(task, Variant | GymnasiumTask) else Variant(task)


def _changed(task: Any, **fields: Any) -> Any:
    """The same task with other fields; the bare JAX task if it needs none of them."""
    new = dataclasses.replace(as_variant(task), **fields)
    if isinstance(new, Variant) and (new.indices, new.faults, new.steps_per_action) == (None, NONE, 1):
        return new.task
    return new


def observe(task: Any, indices: tuple[int, ...]) -> Any:
    """The same task with only the entries `indices` of its observation.

    `task` may also be a class of Gymnasium environments.

    Raises:
        UserError: an index is outside the observation or occurs twice, there is no index, the task has faults, or
            `task` is no task.
    """
    variant = as_variant(as_task(task))
    if variant.faults != NONE:
        raise UserError("The task has faults already: select the entries first, then add the faults (with_faults).")
    if isinstance(indices, str) or not isinstance(indices, Iterable):
        check_indices(indices, 0)  # says what is wrong
    if variant.indices is not None:
        check_indices(indices, len(variant.indices))
        indices = tuple(variant.indices[i] for i in indices)
    chosen = dataclasses.replace(variant, indices=tuple(indices))
    _ = chosen.spec  # checks the indices in the only environment that is made: it may be a robot
    return chosen


def with_faults(task: Any, faults: Faults | Mapping[str, Any] | None) -> Any:
    """The same task with missing and faulty sensors; without any faults, the task itself.

    `task` may also be a class of Gymnasium environments, and `faults` a dictionary, such as {"noise": 0.1}.

    Raises:
        UserError: the task has faults already, there is no such fault, the noise does not fit its observation, or
            `task` is no task.
    """
    task, faults = as_task(task), Faults.of(faults)
    if faults == NONE:
        return task
    if as_variant(task).faults != NONE:
        raise UserError("The task has faults already: give all faults at once.")
    return _changed(task, faults=faults)


def with_action_repeat(task: Any, steps_per_action: int) -> Any:
    """The same task, in which each action is applied for `steps_per_action` steps, unless the episode ends before.

    For the agent they are one step. It observes the last observation, and its reward is the sum of their rewards.
    Faults apply to the agent's steps. `task` may also be a class of Gymnasium environments.

    Raises:
        UserError: `steps_per_action` is not a whole number from 1 to 10,000, or `task` is no task.
    """
    check_whole("steps_per_action", steps_per_action, 1, LONGEST)
    return _changed(as_task(task), steps_per_action=int(steps_per_action))


def full(task: Any) -> Any:
    """The same task with its full observation and without faults."""
    return _changed(task, indices=None, faults=NONE)


def steps_per_action(task: Any) -> int:
    """The number of the task's steps for which an action is applied."""
    return as_variant(task).steps_per_action


def entries(task: Any) -> tuple[int, ...]:
    """Indices of the entries that the agent sees in the task's full observation, in the agent's order.

    The flag of `Faults.flicker_flag` has the index after the last one of the full observation.
    """
    variant = as_variant(task)
    if variant.indices is None:
        return tuple(range(variant.spec.obs_dim))
    return (*variant.indices, full(task).spec.obs_dim) if variant.faults.flicker_flag else tuple(variant.indices)


def entry_names(task: Any) -> tuple[str, ...]:
    """The label of each entry that the agent sees: the task's name for it, or its index, "entry 2".

    Raises:
        UserError: the number of names differs from the number of entries.
    """
    variant = as_variant(task)
    return (*variant.entry_names, "lost") if variant.faults.flicker_flag else variant.entry_names
