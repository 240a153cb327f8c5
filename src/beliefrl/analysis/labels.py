"""Labels in figures: the name of a task or an agent, and the settings in which it differs."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

from beliefrl.catalogue import usual_constants
from beliefrl.runs.options import Options
from beliefrl.runs.run import Row, Run

# Options that can change a return.
OPTIONS = (
    *("envs", "overlap", "share_env", "init_from", "init_best", "init_replay", "precision", "replay_capacity"),
    *("stop_at", "stop_patience"),
)


def options(run: Run) -> list[str]:
    """NAME=VALUE of these options, if they differ from their defaults."""
    given = {name: value for name, value in run.config["options"].items() if name in OPTIONS}
    if given.get("init_from"):
        given["init_from"] = os.path.normpath(given["init_from"])  # without a slash at its end
    return [f"{name}={as_text(value)}" for name, value in given.items() if value != getattr(Options, name)]


def task_label(run: Run) -> str:
    """The name of a task in figures, with selected entries, faults, action repeat and changed constants, if any.

    The default constants of a task of another package are not known, so they do not count as changed.
    """
    seen = run.config.get("observe")
    observed = ["observe", *map(str, seen)] if seen else []
    faults = [f"{name}={as_text(value)}" for name, value in run.config.get("faults", {}).items()]
    constants = run.config["constants"]
    known = usual_constants(run.config["task"])
    usual = (constants if known is None else known) | {"steps_per_action": 1, "measures": constants.get("measures")}
    changed = [
        f"{name}={as_text(value)}"
        for name, value in sorted(constants.items())
        if name not in usual or value != usual[name]
    ]
    return " ".join([run.config["task"], *observed, *faults, *changed])


def task_labels(runs: Sequence[Run]) -> list[str]:
    """The `task_label` of each run, with the time limit where runs of one task record several.

    Only runs on Gymnasium environments record it besides their constants; older ones have none.
    """
    names, limits = [task_label(run) for run in runs], [run.config.get("max_steps") for run in runs]
    known = {each for each in zip(names, limits, strict=True) if each[1] is not None}
    of_task = Counter(name for name, _ in known)
    return [
        f"{name} max_steps={limit}" if of_task[name] > 1 and limit is not None else name
        for name, limit in zip(names, limits, strict=True)
    ]


def differences(settings: Row, others: Sequence[Row]) -> list[str]:
    """NAME=VALUE of the settings that differ from some of `others`."""
    texts = {name: as_text(value) for name, value in settings.items()}
    return [
        f"{name}={text}" for name, text in texts.items() if any(as_text(other.get(name)) != text for other in others)
    ]


def as_text(value: Any) -> str:
    """A setting as text. Equal numbers have the same text, 2 and 2.0, and a function has no address."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(as_text, value))}]"
    if isinstance(value, float):
        return str(value).removesuffix(".0")
    return re.sub(" at 0x[0-9a-fA-F]+", "", str(value))  # it differs in every process
