"""Types for the whole library: a timestep, a window, a task's sizes.

Axis names in shapes, everywhere: `seed` (one training each), `batch` (windows), `time` (timesteps of a window),
`obs`, `action`, `belief` (input of the controller), `d` (recurrent state), `z` (latent variable), `x` (perception).
"""

import dataclasses
import json
import numbers
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from beliefrl.errors import UserError, short

LARGEST = 2**31 - 1  # integer in a compiled program
WIDEST = 100_000  # layer or state of a network
LAST_SEED = 2_000_000_000  # number of a seed


def check_range(settings: Any, names: Sequence[str], low: int | float, high: int | float = LARGEST) -> None:
    """Raise a UserError if a field of a dataclass, or an entry of a tuple field, is not a number in [low, high].

    A field of type int accepts only whole numbers. A field of a tuple type accepts only tuples of the declared length.
    NaN lies in no range. True and False do not count as numbers.
    """
    declared = {field.name: field.type for field in dataclasses.fields(settings)}
    for name in names:
        value, kinds = getattr(settings, name), typing.get_args(declared[name]) or (declared[name],)
        several = typing.get_origin(declared[name]) is tuple
        count = len(kinds) if several and ... not in kinds else None
        entries = value if several and isinstance(value, tuple) else (value,)
        whole = int in kinds
        numeric = all(_is_number(entry, whole) for entry in entries)
        fits = isinstance(value, tuple) == several and len(entries) == (count or max(len(entries), 1))
        if not fits or not numeric or not all(low <= entry <= high for entry in entries):
            too_large = numeric and any(entry > high for entry in entries)
            number = "whole number" if whole else "number"
            what = f"{count or 'a tuple of'} {number}s" if several else f"a {number}"
            raise UserError(f"{name}={value} is impossible: it must be {what} {_bounds(low, high, too_large)}.")


def check_whole(name: str, value: Any, low: int, high: int = LARGEST, optional: bool = False) -> None:
    """Raise a UserError if the value of an argument is not a whole number in [low, high], or None if `optional`."""
    if optional and value is None:
        return
    if not _is_number(value, whole=True) or not low <= value <= high:
        bounds = _bounds(low, high, too_large=_is_number(value, whole=True) and value > high)
        raise UserError(f"{name}={short(value)} is impossible: it must be a whole number {bounds}.")


def _bounds(low: int | float, high: int | float, too_large: bool) -> str:
    return f"from {low} to {high}" if too_large or high < LARGEST else f"of at least {low}"


def _is_number(value: Any, whole: bool) -> bool:
    return isinstance(value, numbers.Integral if whole else numbers.Real) and not isinstance(value, bool)


def check_indices(indices: Sequence[Any], size: int) -> None:
    """Raise a UserError unless `indices` has at least one index of an observation with `size` entries, each once."""
    allowed = f"give indices from 0 to {size - 1}."
    if isinstance(indices, str) or not isinstance(indices, Iterable):
        raise UserError(f"observe={short(indices)} is not a list of indices: give a tuple, such as (0, 1).")
    for position, index in enumerate(indices):
        if not (_is_number(index, whole=True) and 0 <= index < size):
            has = "1 entry" if size == 1 else f"{size} entries"
            raise UserError(f"{index} is not an index of the observation, which has {has}: {allowed}")
        if index in indices[:position]:
            given = " ".join(map(str, indices))
            raise UserError(f"observe={given} has the index {index} twice: give each index once.")
    if not len(indices):
        raise UserError(f"observe has no index: {allowed}")


def tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same values with tuples in place of lists, also inside lists. JSON writes tuples as lists."""

    def frozen(value: Any) -> Any:
        return tuple(map(frozen, value)) if isinstance(value, list) else value

    return {name: frozen(value) for name, value in values.items()}


def plain(value: Any) -> Any:
    """The value as JSON has it: tuples are lists, NumPy's numbers are numbers, and what JSON does not have is text."""

    def simple(value: Any) -> Any:
        if isinstance(value, np.floating):
            return float(value)
        return value.tolist() if isinstance(value, np.ndarray | np.generic | jax.Array) else str(value)

    return json.loads(json.dumps(value, default=simple))


def as_array(value: Any) -> np.ndarray:
    """The value as an array; an empty array of objects if it cannot be one."""
    try:
        return np.asarray(value)
    except Exception:  # rows of different lengths, or an error of the value's class
        return np.empty(0, object)


def check_choice(settings: object, name: str, choices: Sequence[str | bool]) -> None:
    """Raise a UserError if a field of `settings` is not one of the choices."""
    value = getattr(settings, name)
    if not any(
        value == choice and isinstance(value, bool) == isinstance(choice, bool) for choice in choices
    ):  # 1 == True
        raise UserError(f"{name}={value!r} is impossible: it must be {' or '.join(map(str, choices))}.")


class Spec(NamedTuple):
    """The sizes of a task. An agent knows nothing else about it before training."""

    obs_dim: int  # numbers in an observation
    action_dim: int  # degrees of freedom; every action lies in [-1, 1]
    max_steps: int  # time limit of an episode: it truncates, it does not terminate
    measures: tuple[str, ...] = ()  # further numbers that the task reports for an episode, such as "success"


class Timestep(NamedTuple):
    """One timestep: the observation at t, and the action and the reward just before it.

    Two neighbouring timesteps form a transition (o_t, a_t, r_t, o_{t+1}), unless the second has is_first. a_t is the
    prev_action of the second, and r_t its reward. The last observation of an episode is a timestep too.
    """

    obs: Float[Array, "*batch obs"]  # o_t
    reward: Float[Array, "*batch"]  # r_{t-1}, which came with o_t; 0 at the first timestep
    prev_action: Float[Array, "*batch action"]  # a_{t-1} in [-1, 1]; zeros at the first timestep
    is_first: Bool[Array, "*batch"]  # an episode begins here: the memory is empty
    terminated: Bool[Array, "*batch"]  # o_t is terminal: there is no value beyond it


def perception(step: Timestep) -> Float[Array, "*batch x"]:
    """x_t = (o_t, r_{t-1})."""
    return jnp.concatenate([step.obs, step.reward[..., None]], axis=-1)


class StoredTimestep(NamedTuple):
    """An entry of the replay: a timestep, and the agent's note on it (any pytree, may be empty)."""

    step: Timestep
    note: Any


class Reading(NamedTuple):
    """Which readers have read the windows of a batch."""

    reader: Int[Array, " batch"]  # their indices
    continues: Bool[Array, " batch"]  # the window begins with the last timestep of the reader's window before


class Window(NamedTuple):
    """Windows of consecutive timesteps from the replay.

    In windows that are drawn at random, is_first is also set at the oldest stored timestep.
    """

    step: Timestep  # leaves (time, batch, ...)
    note: Any
    exists: Bool[Array, " time *batch"]  # False outside of the stored timesteps
    reading: Reading | None = None  # if the windows are read in order

    def between(self, start: int, stop: int | None) -> "Window":
        """The timesteps from `start` to `stop`, as in a slice."""
        step, note, exists = jax.tree.map(lambda leaf: leaf[start:stop], self[:3])
        return Window(step, note, exists, self.reading)


class WindowShape(NamedTuple):
    """The windows of an agent: `burn_in` timesteps, then `length` transitions, so burn_in + length + 1 timesteps.

    Without readers, windows are drawn at random. With readers they are read in order and have no burn-in: at each turn
    a reader reads the window that follows its last one, or it first jumps to a random place.
    """

    burn_in: int
    length: int
    readers: int = 0
    jump: float = 0.0  # probability that a reader jumps before it reads
    least: int | None = None  # stored transitions that a randomly drawn window needs; None: `length`


def transitions(window: Window, burn_in: int) -> Bool[Array, " length *batch"]:
    """Whether each pair of neighbouring timesteps after the burn-in is a transition."""
    now, after = window.exists[burn_in:-1], window.exists[burn_in + 1 :]
    return now & after & ~window.step.is_first[burn_in + 1 :]
