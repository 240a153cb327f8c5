"""Checks of what a user passes to `Policy.predict`."""

from numbers import Real
from typing import Any

import numpy as np

from beliefrl.errors import UserError, short
from beliefrl.types import as_array

State = tuple[np.ndarray, ...]  # the leaves of the memory and the previous action, each (batch, ...)


def numbers(value: Any, name: str) -> np.ndarray:
    """The value of obs, reward or action as an array of real numbers.

    As in a training, an observation and one reward may be bools: 1 where True. Several bools as the reward are refused,
    since they are rather the flags of episodes.

    Raises:
        UserError: an entry is not a number.
    """
    if isinstance(value, dict):
        raise UserError(f"{name} is a dictionary: give one flat array, with the entries that the agent observes.")
    array = as_array(value)
    for index, entry in np.ndenumerate(array if array.dtype == object else ()):
        if not isinstance(entry, Real):
            raise UserError(f"{_place(name, index)} is {short(entry)}: give finite numbers.")
    may_be_bool = name == "obs" or (name == "reward" and array.shape == ())
    if array.dtype.kind not in ("biuf" if may_be_bool else "iuf"):
        raise UserError(f"{name} must be real numbers, not {short(value)}: the arguments are obs, reward, state.")
    return array


def flags(value: Any, batch: int, name: str) -> np.ndarray:
    """One bool for each episode of a batch."""
    array = as_array(value)
    if array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
        raise UserError(f"{name} must be True or False, not {short(value)}.")
    return each(array.astype(bool), batch, name)


def each(array: np.ndarray, batch: int, name: str) -> np.ndarray:
    """One entry for each episode of a batch."""
    if array.shape not in ((), (batch,)):
        raise UserError(f"{name} has the shape {array.shape}: it must be one number or ({batch},).")
    return np.broadcast_to(array, (batch,))


def fitting(state: Any, like: State) -> State:
    """The state, after a check that it has the shapes and types of `like`, and finite numbers."""
    wanted = [(leaf.shape, leaf.dtype) for leaf in like]
    leaves = list(state) if isinstance(state, tuple | list) else []
    if [(np.shape(leaf), getattr(leaf, "dtype", None)) for leaf in leaves] != wanted:
        batch = len(like[0])
        raise UserError(
            f"state is not one of this policy for {batch} episode{'' if batch == 1 else 's'}: give the second result "
            "of `predict`, or None at the start of all episodes."
        )
    for leaf in leaves:
        if np.issubdtype(leaf.dtype, np.floating) and not np.isfinite(leaf).all():
            raise UserError("state holds a number that is not finite: give the second result of `predict`.")
    return tuple(leaves)


def check_finite(array: np.ndarray, name: str) -> None:
    """Raise a UserError that names the first entry which is not finite as float32."""
    with np.errstate(over="ignore"):
        wrong = ~np.isfinite(array.astype(np.float32))
    for index in map(tuple, np.argwhere(wrong).tolist()):
        raise UserError(f"{_place(name, index)} is {array[index]}: give finite numbers, within float32.")


def _place(name: str, index: tuple[int, ...]) -> str:
    """The position of an entry as text; `index` is (entry,) or (episode, entry) of obs, () or (episode,) of reward."""
    *episode, entry = index if name == "obs" and index else (*index, None)
    which = name if entry is None else f"entry {entry} of {name}"
    return f"{which} of episode {episode[0]}" if episode else which
