"""The Gymnasium spaces that are supported, their flat observations, and the names of entries.

Names come from these sources, in this order: an attribute `entry_names` of the environment or of a wrapper; MuJoCo's
model, for environments that have an `observation_structure` (version 5); the joints of PyBullet's robots; the
catalogue; the keys of Dict and Tuple spaces. A unit follows a name in brackets.
"""

import contextlib
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Float, Int

from beliefrl.catalogue import KNOWN, PREFIX
from beliefrl.errors import UserError, short
from beliefrl.types import as_array

FREE_JOINT, BALL_JOINT, SLIDE_JOINT = 0, 1, 2  # types of MuJoCo's joints; a hinge is 3
AXES = ("x", "y", "z")
BODY = (
    "height above the start (m)",
    "sin of angle to target",
    "cos of angle to target",
    *(f"0.3 v_{axis} (m/s)" for axis in AXES),
    "roll (rad)",
    "pitch (rad)",
)  # of PyBullet's walkers
MOST_NUMBERS = 4_000  # in an observation: a larger one is considered an image
FAR = 100  # an observation may leave its declared range by this many times the range's width


def check_actions(space: Any, name: str) -> None:
    """Raise a UserError if the action space of the environment `name` is not supported."""
    _check_package(space, name)
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
    with np.errstate(over="ignore", invalid="ignore"):
        width = space.high.astype(np.float64) - space.low
    if not (space.is_bounded() and np.isfinite(width).all()):
        raise UserError(f"{name} has unbounded actions: give its Box finite bounds, to which [-1, 1] is scaled.")
    for entry in np.flatnonzero(space.low >= space.high):
        bound = space.low.reshape(-1)[entry]
        raise UserError(
            f"{name} has an action that can only be {bound}, entry {entry} of its Box: make its low smaller than its "
            "high, or leave the entry out."
        )


def _check_package(space: Any, name: str) -> None:
    """Raise a UserError for a space of the old package gym."""
    if type(space).__module__.partition(".")[0] == "gym":
        raise UserError(f"{name} has spaces of the old package gym: write `import gymnasium as gym` in its module.")


def flat_size(space: Any, name: str) -> int:
    """The number of entries in a flat observation of a space.

    Raises:
        UserError: the space contains images, text, or anything else that does not flatten to a fixed number of entries.
    """
    _check_package(space, name)
    for path, leaf in leaves(space):
        where = f" at {''.join(f'[{key!r}]' for key in path)}" if path else ""
        if isinstance(leaf, spaces.Box) and _is_image(leaf):
            raise UserError(
                f"{name} observes images ({short(leaf)}{where}): only vectors of numbers are supported, such as a "
                "robot's sensors. If they are small matrices, flatten them (gymnasium's FlattenObservation)."
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


def misfit(space: Any, obs: Any, path: str = "") -> str | None:
    """The first part of an observation, such as "['imu']", that does not fit its space; None if all of them do.

    A part must have the size of its space, and integers where this has integers. `flatten` checks neither, and casts
    numbers to the type of the space. "" is the whole observation.
    """
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        return None if _leaf_fits(space, obs) else path
    parts = dict(space.items()) if isinstance(space, spaces.Dict) else dict(enumerate(space))
    if isinstance(space, spaces.Tuple) and len(obs) != len(parts):
        return path
    for key, part in parts.items():
        where = f"{path}[{key!r}]"
        try:
            found = misfit(part, obs[key], where)
        except (KeyError, IndexError, TypeError):
            return where
        if found is not None:
            return found
    return None


def _leaf_fits(space: Any, obs: Any) -> bool:
    """Whether a value fits an elementary space."""
    if isinstance(space, spaces.Box):
        part = as_array(obs)
        if part.dtype.kind not in "biuf" or part.size != np.prod(space.shape, dtype=int):
            return False
        with np.errstate(invalid="ignore"):
            return np.issubdtype(space.dtype, np.floating) or np.array_equal(part.astype(space.dtype), part)
    value, start = as_array(obs), getattr(space, "start", 0)
    if value.size != np.prod(space.shape, dtype=int):
        return False
    sizes = getattr(space, "nvec", getattr(space, "n", None)) if not isinstance(space, spaces.MultiBinary) else 2
    if value.dtype.kind not in "biuf" or sizes is None:
        return False
    return bool(np.all((value >= start) & (value < start + sizes) & (value == np.floor(value))))


def limits(space: Any, indices: Int[np.ndarray, " obs"]) -> tuple[Float[np.ndarray, " obs"], Float[np.ndarray, " obs"]]:
    """The smallest and largest accepted values of these entries of the observation: its space, with a wide margin."""
    bounds = flat_bounds(space)
    low, high = bounds.low[indices].astype(np.float64), bounds.high[indices].astype(np.float64)
    with np.errstate(over="ignore"):
        margin = FAR * np.maximum(high - low, 1.0)
    return low - margin, high + margin


def scale(space: spaces.Box, action: Float[np.ndarray, " action"]) -> np.ndarray:
    """The action, scaled from [-1, 1] to the bounds and the shape of the space."""
    unit = np.clip(np.asarray(action, np.float64).reshape(space.shape), -1.0, 1.0) / 2 + 0.5
    scaled = space.low + unit * (space.high.astype(np.float64) - space.low)
    return np.clip(scaled.astype(space.dtype), space.low, space.high)  # rounding may exceed the bounds


def observation_names(environment: Any, space: Any, task: str) -> tuple[str, ...]:
    """A name for each entry of the flat observation; "entry 2" for entries without a name.

    Args:
        environment: the Gymnasium environment.
        space: its observation space, which must be supported.
        task: name of the task, such as "gym:Pendulum-v1".
    """
    size, bare = spaces.flatdim(space), getattr(environment, "unwrapped", environment)
    known = KNOWN.get(task.removeprefix(PREFIX))
    sources: tuple[Callable[[], Any], ...] = (
        lambda: _own_names(environment),
        lambda: _of_mujoco(bare),
        lambda: _of_walker(bare),
        lambda: known.names if known else (),
        lambda: _of_space(space),
    )
    for source in sources:
        with contextlib.suppress(Exception):  # an environment may have anything under these names
            names = tuple(map(str, source()))
            if len(names) == size:
                return names
    return tuple(f"entry {index}" for index in range(size))


def check_names(environment: Any, space: Any, name: str) -> None:
    """Raise a UserError if the environment `name` has `entry_names`, but not one for each entry of its observation.

    If a wrapper has changed the size of the observation, the names of the environment do not fit, and are ignored.
    """
    size, names, inside = spaces.flatdim(space), _own_names(environment), None
    with contextlib.suppress(Exception):
        inside = spaces.flatdim(environment.unwrapped.observation_space)
    if names and len(names) != size == inside:
        raise UserError(
            f"{name} has {len(names)} entry_names for an observation of {size}: give one name for each entry."
        )


def _own_names(environment: Any) -> tuple[str, ...]:
    """The attribute `entry_names` of the outermost wrapper that has it, or of the environment; () without it."""
    with contextlib.suppress(Exception):  # it may be anything
        names = environment.get_wrapper_attr("entry_names")
        return () if isinstance(names, str) else tuple(map(str, names))
    return ()


def action_names(environment: Any, size: int) -> tuple[str, ...]:
    """A name for each entry of the action: the joint that a robot's motor moves, or "" where it is not known."""
    bare = getattr(environment, "unwrapped", environment)
    names: tuple[str, ...] = ()
    with contextlib.suppress(Exception):
        if hasattr(bare, "observation_structure"):
            names = tuple(_joint_name(bare.model, int(joint)) for joint in bare.model.actuator_trnid[:, 0])
        else:
            names = tuple(joint.joint_name for joint in bare.robot.ordered_joints)
    return names if len(names) == size else ("",) * size


def _of_mujoco(bare: Any) -> tuple[str, ...]:
    """The parts of a MuJoCo environment's observation; positions and velocities have the names of the joints."""
    parts = bare.observation_structure
    positions, velocities = _joint_entries(bare.model)
    named = {"qpos": positions[parts.get("skipped_qpos", 0) :], "qvel": velocities}
    names: list[str] = []
    for part, size in parts.items():
        if part != "skipped_qpos":
            known = named.get(part, ())
            names += known if len(known) == size else [f"{part} {index}" for index in range(size)]
    return tuple(names)


def _joint_entries(model: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of all entries of qpos and qvel of a MuJoCo model."""
    positions, velocities = [], []
    for joint, kind in enumerate(model.jnt_type):
        name, slides = _joint_name(model, joint), kind == SLIDE_JOINT
        turns = [f"{name} angular velocity {axis} (rad/s)" for axis in AXES]
        if kind == FREE_JOINT:
            positions += [f"{name} {axis} (m)" for axis in AXES]
            velocities += [f"{name} velocity {axis} (m/s)" for axis in AXES]
        if kind in (FREE_JOINT, BALL_JOINT):
            positions += [f"{name} quaternion {part}" for part in ("w", *AXES)]
            velocities += turns
        else:
            positions.append(f"{name} ({'m' if slides else 'rad'})")
            velocities.append(f"{name} velocity ({'m/s' if slides else 'rad/s'})")
    return tuple(positions), tuple(velocities)


def _joint_name(model: Any, joint: int) -> str:
    return model.joint(joint).name or f"joint {joint}"


def _of_walker(bare: Any) -> tuple[str, ...]:
    """The observation of PyBullet's walkers: the body, angle and speed of each joint, and the contacts of the feet."""
    names = list(BODY)
    for joint in bare.robot.ordered_joints:  # there since the first reset
        names += [f"{joint.joint_name} in its range", f"0.1 {joint.joint_name} velocity (rad/s)"]
    return (*names, *(f"contact of {foot}" for foot in bare.robot.foot_list))


def _of_space(space: Any) -> tuple[str, ...]:
    """Names from the keys of Dict and Tuple, and from the values of Discrete and MultiDiscrete; () for a Box."""
    if isinstance(space, spaces.Box):
        return ()
    named = ([f"{'.'.join(map(str, path))} {part}".strip() for part in _parts(leaf)] for path, leaf in leaves(space))
    return tuple(itertools.chain.from_iterable(named))


def _parts(leaf: Any) -> list[str]:
    """What distinguishes the entries of an elementary space; one entry needs no number."""
    if isinstance(leaf, spaces.Discrete):
        return [f"= {leaf.start + value}" for value in range(leaf.n)]
    if isinstance(leaf, spaces.MultiDiscrete):
        counts, starts = leaf.nvec.ravel(), leaf.start.ravel()
        return [f"{i} = {starts[i] + value}" for i, count in enumerate(counts) for value in range(count)]
    size = int(np.prod(leaf.shape))
    return [""] if size == 1 else [str(index) for index in range(size)]
