"""Names of the entries of a Gymnasium environment's observation and action, as far as the environment offers them.

The sources, in this order: an attribute `entry_names` of the environment; MuJoCo's model, for environments that have an
`observation_structure` (version 5); the joints of PyBullet's robots; the catalogue; the keys of Dict and Tuple spaces.
A unit follows a name in brackets.
"""

import contextlib
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from beliefrl.catalogue import KNOWN, PREFIX
from beliefrl.tasks.spaces import leaves

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
        lambda: bare.entry_names,
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
