"""Which of Gymnasium's spaces are supported, and what an observation is when it is flat."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Int

from beliefrl.types import UserError, short

MOST_NUMBERS = 4_000  # in an observation: more are taken for an image
FAR = 100  # widths of its declared range by which an observation may leave that range


def check_actions(space: Any, name: str) -> None:
    """Raise a UserError where the actions of the environment of that name are not supported."""
    if not isinstance(space, spaces.Box):
        raise UserError(
            f"{name} has the actions {short(space)}: what is supported is a bounded Box of real numbers "
            "(continuous control), not discrete or composite actions."
        )
    if not np.issubdtype(space.dtype, np.floating):
        raise UserError(f"{name} has actions of type {space.dtype}: what is supported is a Box of real numbers.")
    if space.shape == () or 0 in space.shape:
        raise UserError(f"{name} has actions of shape {space.shape}: there must be at least one number in a row.")
    if not space.is_bounded():
        raise UserError(f"{name} has unbounded actions: [-1, 1] is scaled to the bounds, so give its Box finite ones.")
    for entry in np.flatnonzero(space.low >= space.high):
        bound = space.low.reshape(-1)[entry]
        raise UserError(
            f"{name} has an action that can only be {bound}, entry {entry} of its Box: give that entry a low below "
            "its high, or leave it out."
        )


def flat_size(space: Any, name: str) -> int:
    """Numbers in an observation of that space when flat.

    Raises:
        UserError: images, text, or what does not flatten to a fixed number of numbers, also within a Dict or Tuple.
    """
    for where, leaf in _leaves(space):
        if isinstance(leaf, spaces.Box) and _is_image(leaf):
            raise UserError(
                f"{name} observes images ({short(leaf)}{where}): what is supported are vectors of numbers, such as a "
                "robot's sensors."
            )
        if not isinstance(leaf, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
            raise UserError(
                f"{name} has the observations {short(leaf)}{where}: what is supported is a Box, or what flattens to "
                "one (Discrete, MultiDiscrete, MultiBinary, Dict and Tuple of these)."
            )
    size = spaces.flatdim(space)
    if not 1 <= size <= MOST_NUMBERS:
        has = f"of {size:,} numbers" if size else "without numbers"
        raise UserError(
            f"{name} has an observation {has} ({short(space)}): there must be at least one and at most "
            f"{MOST_NUMBERS:,}."
        )
    return size


def _leaves(space: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """The spaces that a space is composed of, each with its place in words; itself where it is not composed."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.items() if isinstance(space, spaces.Dict) else enumerate(space)
        for name, part in parts:
            yield from _leaves(part, f"{where or ' at '}[{name!r}]")
    else:
        yield where, space


def _is_image(space: spaces.Box) -> bool:
    return len(space.shape) >= 2 and (space.dtype == np.uint8 or len(space.shape) > 2)


def flat_bounds(space: Any) -> spaces.Box:
    """The space of the flat observation, one that `flat_size` has found to be supported."""
    flat = spaces.flatten_space(space)
    assert isinstance(flat, spaces.Box)
    return flat


def limits(space: Any, indices: Int[np.ndarray, " obs"]) -> tuple[Float[np.ndarray, " obs"], Float[np.ndarray, " obs"]]:
    """The least and the greatest values of these entries of the observation that are not far outside its space."""
    bounds = flat_bounds(space)
    low, high = bounds.low[indices].astype(np.float64), bounds.high[indices].astype(np.float64)
    with np.errstate(over="ignore"):
        room = FAR * np.maximum(high - low, 1.0)
    return low - room, high + room
