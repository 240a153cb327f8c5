"""Our tasks for others: every JAX task as a Gymnasium environment.

    import beliefrl, gymnasium

    env = gymnasium.make("BeliefRL/PendulumV-v0", render_mode="rgb_array", mass=2.0)

Stepping one task on a GPU is slower than on the CPU, and JAX would reserve most of the GPU's memory: where another
library learns on the GPU, set the environment variable JAX_PLATFORMS=cpu.
"""

import functools
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, UInt8

from beliefrl import tasks
from beliefrl.tasks import Observed, Task
from beliefrl.tasks.drawing import Picture, Viewer, paint
from beliefrl.types import LARGEST, UserError

# The task is static, so environments of equal tasks share what was compiled for the first of them.


@functools.partial(jax.jit, static_argnums=0)
def _reset(task: Task, seed: Any) -> tuple[Key[Array, ""], Any, Float[Array, " obs"]]:
    key, now = jax.random.split(jax.random.key(seed))
    return key, *task.reset(now)


@functools.partial(jax.jit, static_argnums=0)
def _step(
    task: Task, key: Key[Array, ""], state: Any, action: Float[Array, " action"]
) -> tuple[Key[Array, ""], Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """The next key and state; then observation, reward, whether that is terminal, and whether it is a success."""
    key, now = jax.random.split(key)
    # Others' Gaussian policies overshoot, and a Task is promised actions in [-1, 1].
    state, obs, reward, terminated = task.step(state, jnp.clip(action, -1.0, 1.0), now)
    return key, state, obs, reward, terminated, task.success(state)


class TaskEnvironment(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task as a Gymnasium environment.

    Observations are (obs_dim,) float32, as the task gives them; actions (action_dim,) in [-1, 1], clipped to it.
    `info["is_success"]` tells after each step whether the episode has reached its aim, where `spec.has_success`.

    The time limit is Gymnasium's: `gymnasium.make` sets it to the task's `max_steps`, or to `max_episode_steps`.
    For a task of your own: `gymnasium.wrappers.TimeLimit(TaskEnvironment(task), task.spec.max_steps)`.

    To be rendered, a task has a method `draw(states) -> drawing.Picture`, given the episode's states, the newest last.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 10}

    def __init__(self, task: str | Task, render_mode: str | None = None, **constants: Any):
        """Of a task's name or of a task of your own.

        Args:
            task: one of `tasks.names()`, or any `Task` that is hashable, as frozen dataclasses are.
            render_mode: "rgb_array" for `render` to return pictures, "human" for a window, None for neither.
            constants: replace the physical constants of the task of that name, as in `tasks.make`.

        Raises:
            UserError: no task has that name, it has no such constant, it is not a task in JAX or not hashable, or
                there is no such render mode.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(f"render_mode={render_mode!r} is impossible: it must be rgb_array, human or None.")
        if "max_steps" in constants:
            raise UserError("max_steps is Gymnasium's to set: give gymnasium.make max_episode_steps instead.")
        if constants and not isinstance(task, str):
            raise UserError(f"A task that is made already takes no constants: make it with {', '.join(constants)}.")
        self.task = tasks.make(task, **constants) if isinstance(task, str) else task
        if not isinstance(self.task, Task):
            raise UserError(f"{task} is not written in JAX: use gymnasium.make for it, or give a task in JAX.")
        try:
            hash(self.task)
        except TypeError:
            raise UserError(f"{type(task).__name__} is not hashable: make it a frozen dataclass of numbers.") from None
        self.render_mode = render_mode
        spec = self.task.spec
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (spec.action_dim,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (spec.obs_dim,), np.float32)
        # What is hidden from the agent is drawn all the same.
        self._drawn: Any = self.task
        while isinstance(self._drawn, Observed):
            self._drawn = self._drawn.task
        if hasattr(self._drawn, "dt"):
            self.metadata = self.metadata | {"render_fps": max(1, round(1 / self._drawn.dt))}
        self._states: list[Any] = []
        self._window: Viewer | None = None

    @property
    def states(self) -> list[Any]:
        """The task's states in this episode, the newest last; only that one where nothing is rendered.

        Raises:
            UserError: there are none before the first reset.
        """
        if not self._states:
            raise UserError("The environment has no state yet: call reset first.")
        return self._states

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; returns its first observation (obs,) and no info. `options` are of no account.

        The same seed gives the same episodes, from here on.
        """
        super().reset(seed=seed)
        self._key, state, obs = _reset(self.task, self.np_random.integers(LARGEST))
        self._states = [state]
        self._show()
        return np.array(obs), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Do an action (action,); returns observation (obs,), reward, terminated, truncated (never here), info.

        Raises:
            UserError: an action of another shape, or a step before the first reset.
        """
        action = np.asarray(action, np.float32)
        if action.shape != self.action_space.shape:
            raise UserError(f"The action has the shape {action.shape}: it must be {self.action_space.shape}.")
        before = self.states
        self._key, state, *outcome = _step(self.task, self._key, before[-1], action)
        self._states = [*before, state] if self.render_mode else [state]
        self._show()
        obs, reward, terminated, success = jax.device_get(outcome)
        info = {"is_success": bool(success)} if self.task.spec.has_success else {}
        return np.array(obs), float(reward), bool(terminated), False, info

    def _picture(self) -> Picture:
        if not hasattr(self._drawn, "draw"):
            name = type(self._drawn).__name__
            raise UserError(f"{name} cannot be rendered: give it a method draw(states) that returns a drawing.Picture.")
        return self._drawn.draw(self.states)

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The picture of this moment where `render_mode` is "rgb_array"; the window of "human" shows it by itself.

        Raises:
            UserError: the task has no method `draw`, or there is no state before the first reset.
        """
        return paint(self._picture()) if self.render_mode == "rgb_array" else None

    def _show(self) -> None:
        if self.render_mode == "human":
            self._window = self._window or Viewer(type(self._drawn).__name__)
            self._window.show(paint(self._picture()), self.metadata["render_fps"])

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None


def ids() -> dict[str, str]:
    """Gymnasium's id for each task that this library brings, with the task's name; "pendulum-v" is PendulumV-v0."""
    return {
        f"BeliefRL/{task.__name__}{mask[1:].upper()}-v0": name + mask
        for name, task in tasks.TASKS.items()
        for mask in ("", *(tasks.MASKS if hasattr(task, "VELOCITIES") else ()))
    }


def register() -> None:
    """Make all tasks of this library known to `gymnasium.make`; once is enough, more do no harm."""
    for identifier, name in ids().items():
        if identifier not in gymnasium.registry:
            gymnasium.register(
                identifier,
                entry_point="beliefrl.tasks.environment:TaskEnvironment",
                max_episode_steps=tasks.make(name).spec.max_steps,
                kwargs={"task": name},
            )
