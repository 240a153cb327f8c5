"""Tasks: the environments that agents act in. A new task needs one file and one line in `catalogue.TASKS`."""

import dataclasses
import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Key

from beliefrl import catalogue
from beliefrl.catalogue import KNOWN, MASKS, PREFIX, ROBOTS, Known, split_mask
from beliefrl.catalogue import TASK_GROUP as GROUP
from beliefrl.catalogue import our_task_names as our_names
from beliefrl.catalogue import task_names as names
from beliefrl.errors import UserError, said, short
from beliefrl.imports import declared, declared_name, load, load_declared, path
from beliefrl.tasks import registered
from beliefrl.tasks.faults import NONE, Faults
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.variants import Variant, as_task, as_variant, observe, with_action_repeat, with_faults
from beliefrl.tasks.variants import entries as entries
from beliefrl.tasks.variants import entry_names as entry_names
from beliefrl.tasks.variants import full as full
from beliefrl.tasks.variants import steps_per_action as steps_per_action
from beliefrl.types import Spec, tuples


@runtime_checkable
class Task(Protocol):
    """A frozen dataclass of physical constants with pure methods. It does not reset itself, nor apply its time limit.

    `rollout` truncates episodes at `spec.max_steps` and resets them. Other members are optional. A task that can be
    rendered has a method `draw(states)`, which returns the `drawing.Picture` of an episode's states so far.
    `entry_names` is a tuple with the name of each entry of its observation, followed by the unit in brackets, for
    figures: ("cos θ", "sin θ", "θ̇ (rad/s)"). VELOCITIES and POSITIONS are the indices that its versions -v and -p
    show. If `spec.measures` names numbers such as "success", a method `measures(state)` returns them by name. Their
    values at the last state of an episode are recorded.
    """

    @property
    def spec(self) -> Spec:
        """Sizes of the observation and the action, and the time limit in steps."""
        ...

    def reset(self, key: Key[Array, ""]) -> tuple[Any, Float[Array, " obs"]]:
        """Draw an initial state; returns it and its observation."""
        ...

    def step(
        self, state: Any, action: Float[Array, " action"], key: Key[Array, ""]
    ) -> tuple[Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""]]:
        """Apply an action in [-1, 1]; returns the next state, its observation, the reward, and terminated."""
        ...


TASKS: dict[str, type[Any]] = {name: load(path) for name, path in catalogue.TASKS.items()}


def knows(name: str) -> bool:
    """Whether `make` may know a task of that name."""
    return name.startswith(PREFIX) or name in our_names() or _declared(name) is not None


def _declared(name: str) -> tuple[str, str] | None:
    """The entry point, (name, module:Class), of a package's task with this name, or whose -v or -p version this is."""
    theirs = declared(GROUP, our_names())
    for each in (name, split_mask(name)[0]):
        if each in theirs:
            return each, theirs[each]
    return None


def _declared_class(name: str, value: str) -> type:
    """The class of an entry point, after a check that it is a task's."""
    kind = load_declared(GROUP, name, value)
    lacks = [each for each in vars(Task) if not each.startswith("_") and each not in dir(kind)]
    if lacks or not dataclasses.is_dataclass(kind):
        what = f"lacks {', '.join(lacks)}" if lacks else "is no dataclass"
        raise UserError(f"{name}, the entry point {value}, is no task: it {what} (see beliefrl.Task).")
    return kind


def masks(task: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The indices of the velocities and of all other entries; empty if the task does not define them."""
    if isinstance(task, Known):
        return task.velocities, task.positions
    return tuple(getattr(task, "VELOCITIES", ())), tuple(getattr(task, "POSITIONS", ()))


def given(task: Any) -> Any:
    """The task itself, the one with this name, or one that makes environments of this Gymnasium class.

    Raises:
        UserError: there is no such name, or it is an environment, another class, or no task at all.
    """
    return make(task) if isinstance(task, str) else as_task(task)


def make(
    name: str,
    /,
    observe: Sequence[int | str] | int | str | None = None,
    faults: Faults | Mapping[str, Any] | None = None,
    steps_per_action: int = 1,
    **constants: Any,
) -> Any:
    """Make the task with a name.

    "pendulum-v" is the pendulum with velocities only, "pendulum-p" (positions) the one without velocities. "gym:ID" is
    any Gymnasium environment, "gym:PACKAGE:ID" one that a package registers.

    Args:
        name: name of the task.
        observe: indices of the entries that the agent sees, in that order. "velocities" or "positions" if the task
            defines them. None: all entries.
        faults: missing and faulty sensors, which apply to the entries that the agent sees; also as a dictionary such as
            {"noise": 0.1}. None: no faults.
        steps_per_action: number of the task's steps for which an action is applied (`with_action_repeat`).
        constants: physical constants of the task to change, or arguments of gymnasium.make. For a Gymnasium environment
            also `measures`: the entries of its info that are recorded, such as "success".

    Raises:
        UserError: there is no such task, constant or fault, a value is impossible, or `observe` or the noise does not
            fit the task.
    """
    task = with_action_repeat(_make(name, constants), steps_per_action)
    task = task if observe is None else observed(name, task, observe)
    return with_faults(task, faults)


def _make(name: str, constants: dict[str, Any]) -> Any:
    if not isinstance(name, str):
        raise UserError(f"{short(name)} is not the name of a task: make_task takes a name.")
    if name.startswith(PREFIX):
        return registered.make(name.removeprefix(PREFIX), constants)
    if name not in our_names():
        return _make_declared(name, constants)
    base, mask = split_mask(name)
    if base in ROBOTS:
        robot = ROBOTS[base]
        task = registered.make(robot.id, dict(robot.arguments) | constants, name)
        return task if mask is None else dataclasses.replace(task, indices=getattr(robot, mask))
    task = _built(base, TASKS[base], constants)
    return task if mask is None else Variant(task, getattr(task, mask.upper()))


def _make_declared(name: str, constants: dict[str, Any]) -> Any:
    """A task of an installed package, or a version of it with a part of the observation."""
    found = _declared(name)
    if found is None:
        near = _similar(name) or (f"{PREFIX}{name}" if ":" in name else None)
        hint = f"did you mean {near}?" if near else "`beliefrl tasks` lists them all."
        raise UserError(f"There is no task {name!r}: {hint}")
    base, value = found
    task = _built(base, _declared_class(base, value), constants)
    _, mask = split_mask(name)
    return task if mask is None or name == base else observed(base, task, mask)


def _built(name: str, kind: type, constants: dict[str, Any]) -> Any:
    fields = [field.name for field in dataclasses.fields(kind)]
    for constant in constants:
        if constant not in fields:
            raise UserError(f"The task {name} has no constant {constant!r}: it has {', '.join(fields)}.")
    try:
        return kind(**tuples(constants))
    except UserError:
        raise
    except Exception as error:  # a task of a package may raise anything
        if name in TASKS:
            raise
        raise UserError(f"The task {name} cannot be made: {said(error)}.") from None


def _similar(name: str) -> str | None:
    """The task with the most similar name; `name` may be a Gymnasium id without its prefix."""
    near = difflib.get_close_matches(name, names(), n=1)
    return near[0] if near and name not in registered.ids() else registered.similar(name)


def observed(name: str, task: Any, entries: Sequence[int | str] | int | str) -> Any:
    """The task `name` with only these entries of its observation, which have the form of `observe` in `make`."""
    return observe(task, _indices(name, task, entries))


def _indices(name: str, task: Any, observe: Sequence[int | str] | int | str) -> tuple[int, ...]:
    """The indices that `observe` selects for a task."""
    given = list(observe) if isinstance(observe, Iterable) and not isinstance(observe, str) else [observe]
    if len(given) == 1 and given[0] in MASKS.values():
        known: Any = KNOWN.get(name.removeprefix(PREFIX), ROBOTS.get(name))
        velocities, positions = masks(known or TASKS.get(name) or with_action_repeat(task, 1))
        if not velocities:
            raise UserError(f"{name} does not define which entries are {given[0]}: give their indices.")
        return velocities if given[0] == "velocities" else positions
    try:
        return tuple(int(str(entry)) for entry in given)  # int(1.5) is 1
    except (TypeError, ValueError, OverflowError):
        raise UserError(
            f"observe={' '.join(map(str, given))} cannot be understood: give indices, or velocities, or positions."
        ) from None


def describe(task: Any) -> dict[str, Any]:
    """{"task": name, "constants": constants, "observe": indices}, the arguments of `make` for a task.

    "observe" is None if the name implies the indices. "faults" with their settings is added if the task has any. An
    action repeat is one of the constants. A task that `make` cannot make has the name module:Class and no other
    constants. Nothing is imported.
    """
    variant = as_variant(task)
    found = _describe_gymnasium(variant) if isinstance(variant, GymnasiumTask) else _describe_jax(variant)
    if variant.steps_per_action != 1:
        found["constants"]["steps_per_action"] = variant.steps_per_action
    return found if variant.faults == NONE else found | {"faults": variant.faults.settings()}


def _describe_jax(variant: Variant) -> dict[str, Any]:
    task, indices = variant.task, variant.indices
    velocities, positions = masks(task)
    suffix = {None: "", velocities: "-v", positions: "-p"}.get(indices)
    name = next((name for name, known in TASKS.items() if type(task) is known), None)
    name = name or declared_name(GROUP, type(task), our_names())
    if name is not None and suffix is not None:
        return {"task": name + suffix, "constants": dataclasses.asdict(task), "observe": None}
    constants = {} if name is None else dataclasses.asdict(task)
    observe = None if indices is None else list(indices)
    return {"task": name or path(type(task)), "constants": constants, "observe": observe}


def _describe_gymnasium(task: GymnasiumTask) -> dict[str, Any]:
    base, mask = split_mask(task.name)
    robot = None if mask is None else ROBOTS.get(base)
    implied = robot is not None and task.indices == getattr(robot, str(mask))
    name = base if robot is not None and not implied else task.name  # the indices are of the full observation
    observe = None if implied or task.indices is None else list(task.indices)
    measures = {"measures": list(task.measures)} if task.measures and hasattr(task.make, "id") else {}
    return {"task": name, "constants": {**task.arguments, **measures}, "observe": observe}
