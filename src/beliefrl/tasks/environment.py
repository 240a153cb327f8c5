"""Gymnasium environments of the JAX tasks, for use with other libraries.

    import beliefrl, gymnasium

    env = gymnasium.make("BeliefRL/PendulumV-v0", render_mode="rgb_array", mass=2.0)

Stepping a single task is slower on a GPU than on a CPU, and JAX reserves most of the GPU's memory. If another library
learns on the GPU, set the environment variable JAX_PLATFORMS=cpu.
"""

import functools
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, UInt8

from beliefrl import tasks
from beliefrl.errors import UserError
from beliefrl.tasks import Task
from beliefrl.tasks.drawing import Picture, Viewer, paint
from beliefrl.tasks.variants import FaultyState
from beliefrl.types import LARGEST

# The task is a static argument, so environments of equal tasks share one compiled program.


@functools.partial(jax.jit, static_argnums=0)
def _reset(task: Task, seed: Any) -> tuple[Key[Array, ""], Any, Float[Array, " obs"]]:
    key, now = jax.random.split(jax.random.key(seed))
    return key, *task.reset(now)


@functools.partial(jax.jit, static_argnums=0)
def _step(
    task: Task, key: Key[Array, ""], state: Any, action: Float[Array, " action"]
) -> tuple[Key[Array, ""], Any, Float[Array, " obs"], Float[Array, ""], Bool[Array, ""], dict[str, Any]]:
    """The next key and state, then the observation, reward, terminated and the task's measures."""
    key, now = jax.random.split(key)
    # Gaussian policies of other libraries may exceed [-1, 1], but a Task expects actions in this range.
    state, obs, reward, terminated = task.step(state, jnp.clip(action, -1.0, 1.0), now)
    measures: Any = task.measures(state) if task.spec.measures else {}  # pyright: ignore[reportAttributeAccessIssue]
    return key, state, obs, reward, terminated, measures


class TaskEnvironment(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task as a Gymnasium environment.

    Observations are (obs_dim,) float32. Actions (action_dim,) are clipped to [-1, 1]. `info` has the
    measures of the task (`spec.measures`) after each step; success is called `is_success` there.

    The environment has no time limit. `gymnasium.make` adds one: the task's `max_steps`, or the argument
    `max_episode_steps`. For a task of your own, use
    `gymnasium.wrappers.TimeLimit(TaskEnvironment(task), task.spec.max_steps)`.

    To be rendered, a task needs a method `draw(states) -> drawing.Picture`. `states` are the episode's states, the
    newest last.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 10}

    def __init__(self, task: str | Task, render_mode: str | None = None, **constants: Any):
        """Make the environment of a task.

        Args:
            task: the name of a JAX task, or any hashable `Task`, such as a frozen dataclass.
            render_mode: "rgb_array": `render` returns pictures; "human": a window shows them; None: no pictures.
            constants: physical constants to change, if `task` is a name (`tasks.make`).

        Raises:
            UserError: there is no such task, constant or render mode, or the task is not a JAX task or not hashable.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(f"render_mode={render_mode!r} is impossible: it must be rgb_array, human or None.")
        if "max_steps" in constants:
            raise UserError("max_steps cannot be given here: use the argument max_episode_steps of gymnasium.make.")
        if "steps_per_action" in constants:  # gymnasium.make adds a time limit, which counts actions
            raise UserError(
                "steps_per_action cannot be given here: give it to make_task, and the task to TaskEnvironment."
            )
        if constants and not isinstance(task, str):
            raise UserError(f"An existing task takes no constants: make the task itself with {', '.join(constants)}.")
        self.task = tasks.make(task, **constants) if isinstance(task, str) else task
        if not isinstance(self.task, Task):
            raise UserError(f"{task} is not a JAX task: use gymnasium.make for it, or give a JAX task.")
        try:
            hash(self.task)
        except TypeError:
            raise UserError(f"{type(task).__name__} is not hashable: make it a frozen dataclass of numbers.") from None
        self.render_mode = render_mode
        spec = self.task.spec
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (spec.action_dim,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (spec.obs_dim,), np.float32)
        # Pictures also show what is hidden from the agent.
        self._drawn: Any = tasks.with_action_repeat(tasks.full(self.task), 1)
        if hasattr(self._drawn, "dt"):
            repeat = tasks.steps_per_action(self.task)
            self.metadata = self.metadata | {"render_fps": max(1, round(1 / (repeat * self._drawn.dt)))}
        self._states: list[Any] = []
        self._window: Viewer | None = None

    @property
    def states(self) -> list[Any]:
        """The task's true states in this episode, the newest last. Without a render mode there is only the newest.

        Raises:
            UserError: `reset` has not been called.
        """
        if not self._states:
            raise UserError("The environment has no state yet: call reset first.")
        return [state.task for state in self._states] if isinstance(self._states[0], FaultyState) else self._states

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; returns its first observation (obs,) and an empty info. `options` are ignored.

        The same seed gives the same sequence of episodes.
        """
        super().reset(seed=seed)
        self._key, state, obs = _reset(self.task, self.np_random.integers(LARGEST))
        self._states = [state]
        self._show()
        return np.array(obs, np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply an action (action,); returns observation (obs,), reward, terminated, truncated (always False), info.

        Raises:
            UserError: the action has the wrong shape, or `reset` has not been called.
        """
        action = np.asarray(action, np.float32)
        if action.shape != self.action_space.shape:
            raise UserError(f"The action has the shape {action.shape}: it must be {self.action_space.shape}.")
        _ = self.states  # raises an error before the first reset
        self._key, state, *outcome = _step(self.task, self._key, self._states[-1], action)
        self._states = [*self._states, state] if self.render_mode else [state]
        self._show()
        obs, reward, terminated, measures = jax.device_get(outcome)
        info = {name: float(value) for name, value in measures.items() if name != "success"}
        info |= {"is_success": bool(measures["success"])} if "success" in measures else {}
        return np.array(obs, np.float32), float(reward), bool(terminated), False, info

    def _picture(self) -> Picture:
        if not hasattr(self._drawn, "draw"):
            name = type(self._drawn).__name__
            raise UserError(f"{name} cannot be rendered: give it a method draw(states) that returns a drawing.Picture.")
        return self._drawn.draw(self.states)

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The current picture if `render_mode` is "rgb_array". With "human" the window is updated without this call.

        Raises:
            UserError: the task has no method `draw`, or `reset` has not been called.
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
