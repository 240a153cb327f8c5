"""Play one episode of a trained agent on any task, record every timestep, and render it.

    trajectory = beliefrl.play("runs/first", at=range(0, 200, 20))
    trajectory.total, trajectory.steps.obs, trajectory.frames[20]

A JAX task is wrapped as a Gymnasium environment (`environment.TaskEnvironment`), so one loop serves all tasks.

Every task can be rendered without a display: Pillow draws JAX tasks (`drawing`), PyBullet renders in software, and
MuJoCo renders through EGL. Any other Gymnasium environment must have a render mode rgb_array.
"""

import dataclasses
import os
import sys
import warnings
from collections.abc import Callable, Container
from typing import Any, NamedTuple, cast

import gymnasium
import jax
import numpy as np
from gymnasium.wrappers import TimeLimit
from jaxtyping import Int, UInt8

from beliefrl import tasks
from beliefrl.agents import Agent
from beliefrl.analysis.tables import measure_text
from beliefrl.errors import UserError, said
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.environment import TaskEnvironment
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.interface import measure_of
from beliefrl.tasks.seen_environment import Environment
from beliefrl.training.restore import check_interface, restore_seed, task_of
from beliefrl.types import LARGEST, Timestep, check_whole

Pixels = UInt8[np.ndarray, "height width 3"]
PACE = 10  # steps per second of a task whose steps have no known duration
MUJOCO = "MuJoCo renders through EGL, on Debian: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"


class Trajectory(NamedTuple):
    """A recorded episode. After T actions it has T + 1 timesteps, from the first observation to the last."""

    steps: Timestep  # numpy, leaves (time, ...); prev_action[t] led to reward[t] and obs[t]
    total: float  # undiscounted return
    measures: dict[str, float | None]  # of the task, such as "success": the last reported; None if not finite
    frames: dict[int, Pixels]  # the requested frames, by timestep

    @property
    def summary(self) -> str:
        """The return and the measures as text."""
        texts = [f"{name} {measure_text(name, value)}" for name, value in self.measures.items() if value is not None]
        return ", ".join([f"return {self.total:.1f}", *texts])


class Frame(NamedTuple):
    """The rendered picture of one timestep."""

    time: int  # actions before it
    total: float  # sum of the rewards up to it
    pixels: Pixels


class Player:
    """Plays episodes with a trained agent in one environment; a context manager that closes the environment."""

    def __init__(
        self,
        agent: Agent,
        task: Task | GymnasiumTask,
        state: Any,
        precision: str = "float32",
        rendered: bool = False,
    ):
        """`precision` is for matrix products. `rendered` must be true if frames will be requested.

        Raises:
            UserError: the environment cannot be made, or cannot be rendered although it must.
        """
        self.agent, self.task = agent, task
        self.environment = playable(task, rendered)
        self._state = jax.device_put(state)

        def act(state, memory, step, key, time, explore):
            with jax.default_matmul_precision(precision):
                return agent.act(state, memory, step, jax.random.fold_in(key, time), explore)

        self._act = jax.jit(act)

    def __enter__(self) -> "Player":
        return self

    def __exit__(self, *_: Any) -> None:
        self.environment.close()

    def play(
        self,
        seed: int = 0,
        sampled: bool = False,
        steps: int | None = None,
        at: Container[int] = (),
        watch: Callable[[Frame], None] | None = None,
    ) -> Trajectory:
        """Play an episode. The arguments are those of the function `play`.

        With `watch`, each frame is passed to it, and the trajectory keeps no frames.
        """
        spec, key, frames = self.task.spec, jax.random.key(seed), {}
        limit = min(steps or LARGEST, spec.max_steps)
        obs, _ = self.environment.reset(seed=seed)
        played = [_timestep(obs, 0.0, np.zeros(spec.action_dim), is_first=True)]
        memory, total, done, info = self.agent.reset(spec), 0.0, False, {}
        while True:
            time = len(played) - 1
            done = done or time >= limit
            if time in at or (done and at):
                frame = Frame(time, total, pixels(self.environment))
                frames |= {} if watch else {time: frame.pixels}
                if watch:
                    watch(frame)
            if done:
                break
            action, memory = self._act(self._state, memory, played[-1], key, time, sampled)
            obs, reward, terminated, truncated, info = self.environment.step(np.asarray(action))
            total, done = total + reward, terminated or truncated
            played.append(_timestep(obs, reward, action, terminated=terminated))
        steps_played = jax.tree.map(lambda *leaves: np.stack(leaves), *played)
        measures = {name: measure_of(info, name) for name in spec.measures}
        return Trajectory(steps_played, total, measures, frames)


def _timestep(obs: Any, reward: float, action: Any, is_first: bool = False, terminated: bool = False) -> Timestep:
    """A timestep in numpy."""
    numbers: Any = np.asarray(obs, np.float32), np.float32(reward), np.asarray(action, np.float32)
    flags: Any = np.bool_(is_first), np.bool_(terminated)
    return Timestep(*numbers, *flags)


def play(
    run: Run | str | os.PathLike[str],
    seed: int | None = None,
    episode_seed: int = 0,
    sampled: bool = False,
    steps: int | None = None,
    at: Container[int] | Int[np.ndarray, " _"] = (),
    task: Task | GymnasiumTask | type | None = None,
    agent: Agent | type | None = None,
    best: bool = False,
) -> Trajectory:
    """Play an episode with the trained agent of a run.

    Args:
        run: a run, or its folder.
        seed: one of the run's seeds; None: its first.
        episode_seed: random seed of the episode and its actions. The same seed gives the same episode.
        sampled: sample the actions, instead of taking the policy's mode.
        steps: stop after this many steps; None: play until the task ends the episode.
        at: timesteps whose frames are kept, such as range(0, 1000, 10). The last timestep is added, unless `at` is
            empty.
        task: needed only if the run was trained on a task of your own: that task, or the class of its environments.
        agent: needed only if the run was trained by an agent of your own: its class, or an instance.
        best: take the seed's best agent, not its last one; see `evaluate`.

    Raises:
        UserError: there is no such run or seed, a number is impossible, or the task fails or cannot be rendered.
    """
    check_episode(episode_seed, steps)
    at = at.tolist() if isinstance(at, np.ndarray) else at
    with Player(*restore_seed(run, seed, task, agent, best), rendered=bool(at)) as player:
        return player.play(episode_seed, sampled, steps, at)


def check_episode(episode_seed: int, steps: int | None = None) -> None:
    """Raise a UserError if one of the arguments is out of range."""
    check_whole("episode_seed", episode_seed, 0)
    check_whole("steps", steps, 1, optional=True)


def make_env(of: Run | str | os.PathLike[str] | Task | GymnasiumTask | type) -> gymnasium.Env[Any, Any]:
    """Make a Gymnasium environment in which a trained agent can act: as the agent sees it, with its time limit.

    Observations are the entries that the agent sees, (obs_dim,) float32; actions are in [-1, 1].

    Args:
        of: a run or its folder, or a task: its name, the task itself, or a class of environments. For a run on a task
            of your own, give the task.

    Raises:
        UserError: there is no such run or task, or the environment cannot be made, or has other entries than in the
            training.
    """
    is_folder = isinstance(of, str) and os.path.exists(os.path.join(of, "config.json"))  # noqa: PTH110, PTH118 - as in `train`
    if isinstance(of, Run | os.PathLike) or is_folder:
        run = of if isinstance(of, Run) else Run(cast(Any, of))
        if not tasks.knows(run.config["task"]):
            raise UserError(
                f"{run.shown} was trained on {run.config['task']}, a task of your own: give make_env the task."
            )
        task = task_of(run)
        check_interface(run, task)
    else:
        task = tasks.given(of)
    environment = playable(task)
    return TimeLimit(environment, task.spec.max_steps) if isinstance(environment, TaskEnvironment) else environment


def playable(task: Task | GymnasiumTask, rendered: bool = False) -> TaskEnvironment | Environment:
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


def pace_of(environment: TaskEnvironment | Environment) -> float:
    """Steps of the agent per second of the task's simulated time; PACE if the duration of a step is not known."""
    on_host = isinstance(environment, Environment)
    inner, repeat = (environment.inner, environment.task.steps_per_action) if on_host else (environment, 1)
    pace = getattr(inner, "metadata", {}).get("render_fps")
    return float(pace) / repeat if pace else PACE
