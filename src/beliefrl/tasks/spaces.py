"""The Gymnasium spaces that are supported, and their flat observations."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Int

from beliefrl.types import UserError, short

MOST_NUMBERS = 4_000  # in an observation: a larger one is considered an image
FAR = 100  # an observation may leave its declared range by this many times the range's width


def check_actions(space: Any, name: str) -> None:
    """Raise a UserError if the action space of the environment `name` is not supported."""
    if not isinstance(space, spaces.Box):
        raise UserError(
            f"{name} has the actions {short(space)}: only a bounded Box of real numbers is supported "
            "(continuous control), not discrete or composite actions."
        )
    if not np.issubdtype(space.dtype, np.floating):
        raise UserError(f"{name} has actions of type {space.dtype}: only a Box of real numbers is supported.")
    if space.shape == () or 0 in space.shape:
        raise UserError(
            f"{name} has actions of shape {space.shape}: give the Box at least one dimension and at least one number."
        )
    if not space.is_bounded():
        raise UserError(f"{name} has unbounded actions: give its Box finite bounds, to which [-1, 1] is scaled.")
    for entry in np.flatnonzero(space.low >= space.high):
        bound = space.low.reshape(-1)[entry]
        raise UserError(
            f"{name} has an action that can only be {bound}, entry {entry} of its Box: make its low smaller than its "
            "high, or leave the entry out."
        )


def flat_size(space: Any, name: str) -> int:
    """The number of entries in a flat observation of a space.

    Raises:
        UserError: the space contains images, text, or anything else that does not flatten to a fixed number of entries.
    """
    for path, leaf in leaves(space):
        where = f" at {''.join(f'[{key!r}]' for key in path)}" if path else ""
        if isinstance(leaf, spaces.Box) and _is_image(leaf):
            raise UserError(
                f"{name} observes images ({short(leaf)}{where}): only vectors of numbers are supported, such as a "
                "robot's sensors."
            )
        if not isinstance(leaf, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
            raise UserError(
                f"{name} has the observations {short(leaf)}{where}: only Box, Discrete, MultiDiscrete, MultiBinary, "
                "and Dict and Tuple of these are supported."
            )
    size = spaces.flatdim(space)
    if not 1 <= size <= MOST_NUMBERS:
        has = f"of {size:,} numbers" if size else "without numbers"
        raise UserError(
            f"{name} has an observation {has} ({short(space)}): there must be at least one and at most "
            f"{MOST_NUMBERS:,}."
        )
    return size


def leaves(space: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """The elementary spaces in a space, in the order of the flat observation, each with its keys: ("arm", 0)."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.items() if isinstance(space, spaces.Dict) else enumerate(space)
        for key, part in parts:
            yield from leaves(part, (*path, key))
    else:
        yield path, space


def _is_image(space: spaces.Box) -> bool:
    return len(space.shape) >= 2 and (space.dtype == np.uint8 or len(space.shape) > 2)


def flat_bounds(space: Any) -> spaces.Box:
    """The space of the flat observation. `flat_size` must have accepted the original space."""
    flat = spaces.flatten_space(space)
    assert isinstance(flat, spaces.Box)
    return flat


def limits(space: Any, indices: Int[np.ndarray, " obs"]) -> tuple[Float[np.ndarray, " obs"], Float[np.ndarray, " obs"]]:
    """The smallest and largest accepted values of these entries of the observation: its space, with a wide margin."""
    bounds = flat_bounds(space)
    low, high = bounds.low[indices].astype(np.float64), bounds.high[indices].astype(np.float64)
    with np.errstate(over="ignore"):
        margin = FAR * np.maximum(high - low, 1.0)
    return low - margin, high + margin
