"""What a training reads from a Gymnasium environment: the interface that its agent depends on, and measures.

A run records the interface, and is not opened with another one.
"""

import contextlib
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from beliefrl.errors import UserError, short
from beliefrl.tasks.spaces import check_names, observation_names

UNNAMED = "entry "
TAKEN = {"step", "kind", "return", "length"} | {"mean", "sem", "seeds", "returns", "lengths"}  # of the log, of results


class Interface(NamedTuple):
    """The entries that the agent sees, and the bounds of its actions."""

    entries: tuple[str, ...]  # their names; "entry 2" for one without a name
    low: list[float]  # of each action
    high: list[float]

    @classmethod
    def recorded(cls, value: Any) -> "Interface | None":
        """The interface that a run has recorded; None in a run from before there was one."""
        lists: list[Any] = [value.get(name) for name in cls._fields] if isinstance(value, dict) else []
        if len(lists) < len(cls._fields) or not all(isinstance(each, list | tuple) for each in lists):
            return None
        return cls(tuple(map(str, lists[0])), list(lists[1]), list(lists[2]))

    def check(self, before: Any, folder: str) -> None:
        """Raise a UserError if it differs from the one that a run has recorded. An entry without a name fits any."""
        old = Interface.recorded(before)
        if old is None:
            return
        known = zip(old.entries, self.entries, strict=False)
        named = [pair for pair in known if not any(str(name).startswith(UNNAMED) for name in pair)]
        for what, then, now in (
            ("number of observed entries", len(old.entries), len(self.entries)),
            ("observed entries", [then for then, _ in named], [now for _, now in named]),
            ("lower bounds of the actions", old.low, self.low),
            ("upper bounds of the actions", old.high, self.high),
        ):
            if then != now:
                raise UserError(
                    f"{folder} was trained in another environment: {what} before: {short(then)}, now: "
                    f"{short(now)}. Give the environment of the training, or train again."
                )


def interface_of(environment: Any, task: str) -> Interface:
    """The interface of an `Environment`; `task` is the name of its task.

    Raises:
        UserError: the environment has names for its entries, but not one for each.
    """
    check_names(environment.inner, environment.inner_observation_space, task)
    names = observation_names(environment.inner, environment.inner_observation_space, task)
    actions = environment.inner_action_space
    seen = tuple(names[index] for index in environment.indices)
    return Interface(seen, actions.low.ravel().tolist(), actions.high.ravel().tolist())


def check_measures(names: Iterable[str], task: str) -> None:
    """Raise a UserError if a measure of a task would replace a number of the log or of the results."""
    for name in names:
        if name in TAKEN or name.startswith("seeds_"):
            raise UserError(f"{task} has a measure {name!r}, which every run has: choose another name.")


def measure_of(info: Any, name: str) -> float | None:
    """A number in the info of a step, or None. Success may be called `is_success`."""
    found: dict[str, Any] = info if isinstance(info, dict) else {}
    for key in ("is_success", "success") if name == "success" else (name,):
        with contextlib.suppress(TypeError, ValueError):
            value: Any = found.get(key)
            number = float(np.max(value))
            if np.isfinite(number):
                return number
    return None
