"""The same task with fewer entries of its observation, with faults, or with an action repeat."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium

from beliefrl.tasks.faults import NONE, Faults, Faulty, faults_of, is_bare
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.observed import Observed
from beliefrl.tasks.repeat import LONGEST, Repeated
from beliefrl.types import UserError, check_indices, check_whole, short


def as_task(task: Any) -> Any:
    """The task itself, or one that makes environments of this Gymnasium class.

    Raises:
        UserError: it is an environment, another class, or no task at all.
    """
    if isinstance(task, type) and issubclass(task, gymnasium.Env):
        return GymnasiumTask(task)
    if isinstance(task, gymnasium.Env):
        raise UserError(_not_one(task))
    if isinstance(task, gymnasium.vector.VectorEnv):
        raise UserError("A vector environment is not needed: give the class or name of one environment, and envs=N.")
    if isinstance(task, GymnasiumTask):  # its spec would make an environment
        return task
    lacks = [name for name in ("spec", "reset", "step") if not hasattr(task, name)]
    if isinstance(task, type) and not lacks:
        raise UserError(f"{task.__name__} is a class: give a task, {task.__name__}().")
    if isinstance(task, type) or lacks:
        raise UserError(
            f"{short(task)} is no task: give a task (make_task makes one from its name), a GymnasiumTask, or a class "
            "of Gymnasium environments."
        )
    return task


def _not_one(environment: Any) -> str:
    """Why a Gymnasium environment is no task, and what is."""
    kind, name = type(environment.unwrapped).__name__, getattr(getattr(environment, "spec", None), "id", None)
    give = f"its class, {kind}" if name is None else f"its name, 'gym:{name}'"
    return (
        f"{kind} is given as one environment, but several are needed: give {give}, or a function that makes a new one, "
        f"GymnasiumTask(lambda: {kind}(...))."
    )


def observe(task: Any, indices: tuple[int, ...]) -> Any:
    """The same task with only the entries `indices` of its observation.

    `task` may also be a class of Gymnasium environments.

    Raises:
        UserError: an index is outside the observation or occurs twice, there is no index, the task has faults, or
            `task` is no task.
    """
    task = as_task(task)
    if faults_of(task) != NONE:
        raise UserError("The task has faults already: select the entries first, then add the faults (with_faults).")
    if isinstance(task, GymnasiumTask):
        return _observe_host(task, indices)
    check_indices(indices, task.spec.obs_dim)
    if isinstance(task, Observed):  # one selection: `describe` records one
        return Observed(task.task, tuple(task.indices[i] for i in indices))
    return Observed(task, tuple(indices))


def _observe_host(task: GymnasiumTask, indices: tuple[int, ...]) -> GymnasiumTask:
    if isinstance(indices, str) or not isinstance(indices, Iterable):
        check_indices(indices, 0)  # says what is wrong
    if task.indices is not None:
        check_indices(indices, len(task.indices))
        indices = tuple(task.indices[i] for i in indices)
    chosen = dataclasses.replace(task, indices=tuple(indices))
    _ = chosen.spec  # checks them, in the only environment that is made: it may be a robot
    return chosen


def with_faults(task: Any, faults: Faults | Mapping[str, Any] | None) -> Any:
    """The same task with missing and faulty sensors; without any faults, the task itself.

    `task` may also be a class of Gymnasium environments, and `faults` a dictionary, such as {"noise": 0.1}.

    Raises:
        UserError: the task has faults already, there is no such fault, the noise does not fit its observation, or
            `task` is no task.
    """
    task, faults = as_task(task), Faults.of(faults)
    if faults == NONE:
        return task
    if faults_of(task) != NONE:
        raise UserError("The task has faults already: give all faults at once.")
    return Faulty(task, faults) if is_bare(task) else dataclasses.replace(task, faults=faults)


def with_action_repeat(task: Any, steps_per_action: int) -> Any:
    """The same task, in which each action is applied for `steps_per_action` steps, unless the episode ends before.

    For the agent they are one step. It observes the last observation, and its reward is the sum of their rewards.
    Faults apply to the agent's steps. `task` may also be a class of Gymnasium environments.

    Raises:
        UserError: `steps_per_action` is not a whole number from 1 to 10,000, or `task` is no task.
    """
    check_whole("steps_per_action", steps_per_action, 1, LONGEST)
    task, times = as_task(task), int(steps_per_action)
    if isinstance(task, GymnasiumTask):
        return dataclasses.replace(task, steps_per_action=times)
    if isinstance(task, Faulty | Observed):
        return dataclasses.replace(task, task=with_action_repeat(task.task, times))
    task = task.task if isinstance(task, Repeated) else task
    return task if times == 1 else Repeated(task, times)


def steps_per_action(task: Any) -> int:
    """The number of the task's steps for which an action is applied."""
    if isinstance(task, GymnasiumTask):
        return task.steps_per_action
    if isinstance(task, Faulty | Observed):
        return steps_per_action(task.task)
    return task.times if isinstance(task, Repeated) else 1
