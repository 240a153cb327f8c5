"""One episode of a trained agent on any task, moment by moment.

    trajectory = beliefrl.play("runs/first", at=range(0, 200, 20))
    trajectory.total, trajectory.steps.obs, trajectory.frames[20]

A JAX task is played as a Gymnasium environment too (`environment.TaskEnvironment`), so there is one loop for all.
"""

import os
from collections.abc import Callable, Container
from typing import Any, NamedTuple

import jax
import numpy as np

from beliefrl.agents import Agent
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.gymnasium import GymnasiumTask, success_of
from beliefrl.training.evaluation import restore_seed
from beliefrl.types import LARGEST, Timestep, UserError
from beliefrl.viewing import rendering
from beliefrl.viewing.rendering import Pixels


class Trajectory(NamedTuple):
    """An episode as it was played. It has one moment more than steps: the last observation is a moment too."""

    steps: Timestep  # numpy, leaves (time, ...); reward[t] and prev_action[t] came before obs[t]
    total: float  # undiscounted return
    success: bool | None  # whether it reached its aim; None where the task has none
    frames: dict[int, Pixels]  # those that were asked for, by the moment they show


class Frame(NamedTuple):
    """A moment as it looks."""

    time: int  # steps before it
    total: float  # rewards before it
    pixels: Pixels


class Player:
    """Plays episodes with one trained state of an agent in one environment; a context that closes it."""

    def __init__(
        self,
        agent: Agent,
        task: Task | GymnasiumTask,
        state: Any,
        precision: str = "float32",
        rendered: bool = False,
    ):
        """`precision`: of matrix products (`Run.precision`). `rendered`: whether frames will be asked for.

        Raises:
            UserError: the environment cannot be made, or not so that it can be rendered.
        """
        self.agent, self.task = agent, task
        self.environment = rendering.environment(task, rendered)
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
        """Play an episode; `play` below tells the arguments.

        With `watch` the frames are given to it, one by one, and the trajectory keeps none.
        """
        spec, key, frames = self.task.spec, jax.random.key(seed), {}
        limit = min(steps or LARGEST, spec.max_steps)
        obs, _ = self.environment.reset(seed=seed)
        moments = [_moment(obs, 0.0, np.zeros(spec.action_dim), is_first=True)]
        memory, total, done, success = self.agent.reset(spec), 0.0, False, False
        while True:
            time = len(moments) - 1
            done = done or time >= limit
            if time in at or (done and at):
                frame = Frame(time, total, rendering.pixels(self.environment))
                frames |= {} if watch else {time: frame.pixels}
                if watch:
                    watch(frame)
            if done:
                break
            action, memory = self._act(self._state, memory, moments[-1], key, time, sampled)
            obs, reward, terminated, truncated, info = self.environment.step(np.asarray(action))
            total, done, success = total + reward, terminated or truncated, success_of(info)
            moments.append(_moment(obs, reward, action, terminated=terminated))
        steps_played = jax.tree.map(lambda *leaves: np.stack(leaves), *moments)
        return Trajectory(steps_played, total, success if spec.has_success else None, frames)


def _moment(obs: Any, reward: float, action: Any, is_first: bool = False, terminated: bool = False) -> Timestep:
    """A moment in numpy."""
    numbers: Any = np.asarray(obs, np.float32), np.float32(reward), np.asarray(action, np.float32)
    flags: Any = np.bool_(is_first), np.bool_(terminated)
    return Timestep(*numbers, *flags)


def play(
    run: Run | str | os.PathLike[str],
    seed: int | None = None,
    episode_seed: int = 0,
    sampled: bool = False,
    steps: int | None = None,
    at: Container[int] = (),
    task: Task | GymnasiumTask | None = None,
    agent: Agent | type | None = None,
) -> Trajectory:
    """Play an episode with what a run has learned.

    Args:
        run: a run, or its folder.
        seed: which of the run's seeds; None is its first.
        episode_seed: of the episode and its actions: the same one gives the same episode.
        sampled: whether actions are sampled; else they are the policy's mode.
        steps: end it after so many; None: when the task does.
        at: the moments of which a frame is kept, and with them the last one; range(0, 1000, 10) is every tenth.
        task: needed only where the run was trained on a task of your own.
        agent: needed only where an agent of your own was trained: its class, or one of them.

    Raises:
        UserError: there is no such run or seed, a number is impossible, or the task fails or cannot be rendered.
    """
    check_episode(episode_seed, steps)
    with Player(*restore_seed(run, seed, task, agent), rendered=bool(at)) as player:
        return player.play(episode_seed, sampled, steps, at)


def check_episode(episode_seed: int, steps: int | None = None) -> None:
    """Raise a UserError where one of them is impossible."""
    if not 0 <= episode_seed <= LARGEST:
        raise UserError(f"episode_seed={episode_seed} is impossible: it must be from 0 to {LARGEST}.")
    if steps is not None and not 1 <= steps <= LARGEST:
        raise UserError(f"steps={steps} is impossible: it must be a whole number from 1 to {LARGEST}.")
