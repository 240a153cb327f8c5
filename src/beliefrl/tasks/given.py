"""The task that a user means: a name, a class of Gymnasium environments, or a task."""

from typing import Any

import gymnasium

from beliefrl import tasks
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.types import UserError, short


def given(task: Any) -> Any:
    """The task itself, the one with this name, or one that makes environments of this Gymnasium class.

    Raises:
        UserError: there is no such name, or it is an environment, another class, or no task at all.
    """
    if isinstance(task, str):
        return tasks.make(task)
    if isinstance(task, GymnasiumTask):
        return task
    if isinstance(task, type) and issubclass(task, gymnasium.Env):
        return GymnasiumTask(task)
    if isinstance(task, gymnasium.Env):
        kind = type(task).__name__
        raise UserError(f"{kind} is given as one environment, but several are needed: give its class.")
    if isinstance(task, type) or not hasattr(task, "spec"):
        raise UserError(
            f"{short(task)} is no task: give the name of a task, a task, or a class of Gymnasium environments."
        )
    return task
