"""Render any task as pixels, without a display.

Pillow draws JAX tasks (`drawing`), PyBullet renders in software, and MuJoCo renders through EGL. Any other Gymnasium
environment must have a render mode rgb_array.
"""

import dataclasses
import os
import sys
import warnings
from typing import Any

import numpy as np
from jaxtyping import UInt8

from beliefrl.tasks import Task
from beliefrl.tasks.environment import TaskEnvironment
from beliefrl.tasks.gymnasium import Environment, GymnasiumTask
from beliefrl.types import UserError, said

Pixels = UInt8[np.ndarray, "height width 3"]
PACE = 10  # steps per second of a task whose steps have no known duration
MUJOCO = "MuJoCo renders through EGL, on Debian: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"


def environment(task: Task | GymnasiumTask, rendered: bool = False) -> TaskEnvironment | Environment:
    """An environment of a task in which an agent can act. `rendered` must be true if `pixels` will be called.

    Raises:
        UserError: it cannot be made, or has no mode rgb_array.
    """
    if not isinstance(task, GymnasiumTask):
        return TaskEnvironment(task, "rgb_array" if rendered else None)
    if not rendered:
        return task.environment()
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")  # read at the first frame
    task = dataclasses.replace(task, arguments={**task.arguments, "render_mode": "rgb_array"})
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium warns if the render mode is missing
            made = task.environment()
    except UserError as error:
        reason = str(error).rstrip(".")
        raise UserError(f"{task.name} cannot be rendered: give it a render_mode='rgb_array' ({reason}).") from None
    _move_camera(made.inner.unwrapped)
    return made


def _move_camera(robot: Any) -> None:
    """Move PyBullet's camera closer, and enlarge its picture: by default the robot is small, in 320 x 240 pixels."""
    if hasattr(robot, "_cam_dist"):
        robot._cam_dist, robot._cam_pitch = 2.2, -15
        robot._render_width, robot._render_height = 480, 360


def pixels(environment: TaskEnvironment | Environment) -> Pixels:
    """The current picture of an environment that was made with `rendered`.

    Raises:
        UserError: it cannot be rendered on this machine, or not at all.
    """
    name = environment.task.name if isinstance(environment, Environment) else type(environment.task).__name__
    try:
        image = np.asarray(environment.render())
    except UserError:
        raise
    except Exception as error:  # an environment may raise anything
        bare = environment.inner.unwrapped if isinstance(environment, Environment) else environment
        hint = f"; {MUJOCO}" if hasattr(bare, "mujoco_renderer") else ""
        raise UserError(f"{name} cannot be rendered here: {said(error)}{hint}.") from None
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
        given = f"{image.dtype} of shape {image.shape}"
        raise UserError(
            f"{name} renders {given}, but rgb_array must be uint8 of shape (height, width, 3): fix the environment."
        )
    return np.ascontiguousarray(image[..., :3])


def pace(environment: TaskEnvironment | Environment) -> float:
    """Steps per second of the task's simulated time."""
    inner = environment.inner if isinstance(environment, Environment) else environment
    return float(getattr(inner, "metadata", {}).get("render_fps") or PACE)
