"""The task that a user means: a name, a class of Gymnasium environments, or a task."""

from typing import Any

from beliefrl import tasks
from beliefrl.tasks.variants import as_task


def given(task: Any) -> Any:
    """The task itself, the one with this name, or one that makes environments of this Gymnasium class.

    Raises:
        UserError: there is no such name, or it is an environment, another class, or no task at all.
    """
    return tasks.make(task) if isinstance(task, str) else as_task(task)
