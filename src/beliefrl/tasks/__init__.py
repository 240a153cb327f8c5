"""Tasks: what an agent is placed in. A new task is one file and one line in `TASKS`."""

import dataclasses
import difflib
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.tasks.cartpole import CartPole
from beliefrl.tasks.pendulum import Pendulum
from beliefrl.tasks.target_reaching import TargetReaching
from beliefrl.types import Spec, UserError


@runtime_checkable
class Task(Protocol):
    """A frozen dataclass of physical constants with pure methods; no time limit and no reset of its own.

    `rollout` cuts episodes at `spec.max_steps` and resets them.
    """

    @property
    def spec(self) -> Spec:
        """Sizes of the observation and the action, and the time limit in steps."""
        ...

    def reset(self, key: Key[Array, ""]) -> tuple[Any, Float[Array, " obs"]]:
        """Draw a first state; returns it and its observation."""
        ...

    def step(
        self, state: Any, action: Float[Array, " action"], key: Key[Array, ""]
    ) -> tuple[Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""]]:
        """Do an action in [-1, 1]; returns the next state, its observation, the reward, and whether it is terminal."""
        ...

    def success(self, state: Any) -> Bool[Array, ""]:
        """Whether the episode has reached its aim; False for ever where `spec.has_success` is False."""
        ...


@dataclasses.dataclass(frozen=True)
class Observed:
    """A task of which only some entries of the observation are seen (Appendix B: velocities only, no velocities)."""

    task: Any
    indices: tuple[int, ...]

    @property
    def spec(self) -> Spec:
        return self.task.spec._replace(obs_dim=len(self.indices))

    def _see(self, obs: Float[Array, " full"]) -> Float[Array, " obs"]:
        return obs[jnp.array(self.indices)]

    def reset(self, key: Key[Array, ""]) -> tuple[Any, Float[Array, " obs"]]:
        state, obs = self.task.reset(key)
        return state, self._see(obs)

    def step(
        self, state: Any, action: Float[Array, " action"], key: Key[Array, ""]
    ) -> tuple[Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""]]:
        state, obs, reward, terminated = self.task.step(state, action, key)
        return state, self._see(obs), reward, terminated

    def success(self, state: Any) -> Bool[Array, ""]:
        return self.task.success(state)


def observe(task: Task, indices: tuple[int, ...]) -> Observed:
    """The same task of which only the entries `indices` of the observation are seen.

    Raises:
        UserError: an index outside the observation, or none at all.
    """
    size = task.spec.obs_dim
    if not indices or any(not 0 <= i < size for i in indices):
        raise UserError(
            f"observe={tuple(indices)} does not fit an observation of {size}: give indices from 0 to {size - 1}."
        )
    return Observed(task, tuple(indices))


TASKS: dict[str, type[Any]] = {
    "pendulum": Pendulum,
    "cartpole": CartPole,
    "target-reaching": TargetReaching,
}
MASKS = {"-v": "velocities", "-p": "positions"}


def names() -> dict[str, str]:
    """Every task's name with a sentence on it, in the order of the paper's table (Appendix B)."""
    listed = {}
    for name, task in TASKS.items():
        about = (task.__doc__ or "").split("\n")[0]
        listed[name] = about
        if hasattr(task, "VELOCITIES"):
            listed[f"{name}-v"] = f"{name}, velocities only: entries {_spaced(task.VELOCITIES)} of its observation"
            listed[f"{name}-p"] = f"{name}, no velocities: entries {_spaced(task.POSITIONS)} of its observation"
    return listed


def _spaced(indices: tuple[int, ...]) -> str:
    return ", ".join(map(str, indices))


def make(name: str, **constants: Any) -> Task:
    """The task of that name; `constants` replace its physical constants.

    "pendulum-v" is pendulum with velocities only, "pendulum-p" (positions) without velocities.

    Raises:
        UserError: no task has that name, or it has no such constant.
    """
    known = names()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else "`beliefrl tasks` lists them all."
        raise UserError(f"There is no task {name!r}: {hint}")
    base, mask = (name[:-2], name[-2:]) if name[-2:] in MASKS else (name, "")
    fields = [field.name for field in dataclasses.fields(TASKS[base])]
    for constant in constants:
        if constant not in fields:
            raise UserError(f"The task {base} has no constant {constant!r}: it has {', '.join(fields)}.")
    task = TASKS[base](**constants)
    if not mask:
        return task
    return observe(task, task.VELOCITIES if mask == "-v" else task.POSITIONS)


def describe(task: Any) -> dict[str, Any]:
    """{"task": the name for `make`, "constants": what it was made with}.

    A task that `make` cannot make is named module:Class, and has no constants.
    """
    base, indices = (task.task, task.indices) if isinstance(task, Observed) else (task, None)
    masks = {None: "", getattr(base, "VELOCITIES", ()): "-v", getattr(base, "POSITIONS", ()): "-p"}
    for name, known in TASKS.items():
        if type(base) is known and indices in masks:
            return {"task": name + masks[indices], "constants": dataclasses.asdict(base)}
    return {"task": f"{type(task).__module__}:{type(task).__qualname__}", "constants": {}}
