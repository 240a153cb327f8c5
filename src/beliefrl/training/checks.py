"""Checks of `train` and `resume`, before anything is changed. Each raises a UserError."""

import dataclasses
import shlex
from typing import Any

from beliefrl import tasks
from beliefrl.errors import UserError, short
from beliefrl.runs import trackers
from beliefrl.runs.options import Options
from beliefrl.runs.records import steps_per_action
from beliefrl.runs.run import Run
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.traced import check_traced
from beliefrl.types import LARGEST, plain

RECORDING = ("processes", "checkpoint_steps", "checkpoint_minutes", "keep_checkpoints", "track")
CHANGEABLE = ("steps", "stop_at", "stop_patience", "step_timeout", *RECORDING)  # may differ when a training continues


def patience(options: Options) -> None:
    """Raise a UserError if `stop_patience` is given without `stop_at`."""
    if options.stop_patience != 1 and options.stop_at is None:
        raise UserError(f"stop_patience={options.stop_patience} needs stop_at: give the return, too.")


def callback(function: Any) -> None:
    """Raise a UserError if a callback cannot be called."""
    if function is not None and not callable(function):
        raise UserError(f"callback={short(function)} is impossible: give a function of an Event.")


def possible(options: Options, task: Any, own_process: bool) -> None:
    """Raise a UserError if a task in JAX does not work, or if options need what is not available.

    That can be a package, a kind of task, or processes.
    """
    trackers.check(options.track)
    if not isinstance(task, GymnasiumTask):
        check_traced(tasks.full(task), tasks.describe(task)["task"])
    if options.overlap and not isinstance(task, GymnasiumTask):
        raise UserError(
            "overlap needs a Gymnasium environment: a task in JAX is compiled together with the updates. Leave the "
            "option out."
        )
    if options.share_env and not isinstance(task, GymnasiumTask):
        raise UserError(
            "share_env needs a Gymnasium environment: a task in JAX is only a function. Leave the option out."
        )
    if options.step_timeout and isinstance(task, GymnasiumTask) and options.processes == "auto" and not own_process:
        raise UserError(
            "step_timeout needs a process for each environment: from Python, give own_process=True, and guard the "
            'script\'s main code with `if __name__ == "__main__":`.'
        )


def same(run: Run, config: dict[str, Any], older: dict[str, Any]) -> None:
    """Raise a UserError if a run was trained with other settings than those of `config`, except CHANGEABLE options.

    `older` are the values of hyperparameters that the run does not record (`hyperparameters.values_before`).
    """
    asked = {name: config.get(name) for name in ("agent", "task", "constants", "observe", "faults")}
    asked["constants"] = _with_functions_of(run.config["constants"], asked["constants"])
    asked |= config["options"] | _with_functions_of(run.config["hyperparameters"], config["hyperparameters"])
    before = {"faults": None} | dataclasses.asdict(Options())  # what an older version did not record, it did not have
    asked, before = plain([asked, before | older])  # tuples are lists in the run's config
    there = before | run.config | run.config["options"] | run.config["hyperparameters"]
    there |= {name: asked[name] for name in CHANGEABLE}
    asked["max_steps"] = time_limit(config)
    there["max_steps"] = time_limit(run.config) or asked["max_steps"]  # episodes that never ended need one
    for name, value in asked.items():
        if there.get(name, value) != value:
            raise UserError(
                f"{run.shown} was trained with {name}={there[name]}, not {value}: choose another --out, in Python "
                f"out=. `beliefrl resume {shlex.quote(run.shown)}` continues it with its own settings."
            )


def same_task(run: Run, task: Any) -> None:
    """Raise a UserError if a run was trained on another task, with other faults or another action repeat, or, in JAX,
    with other constants.

    A class may be imported from another module, and the arguments of a Gymnasium environment may differ.
    """
    asked, there = map(about_task, (tasks.describe(task), run.config))
    for name in decisive(task):
        ours, theirs = (plain(each[name]) for each in (asked, there))
        if name == "task":
            ours, theirs = (each.rpartition(":")[2] for each in (ours, theirs))
        if ours != theirs:
            raise UserError(f"{run.shown} was trained with {name}={there[name]}, not {asked[name]}: give that task.")


def time_limit(config: dict[str, Any]) -> int | None:
    """The time limit of a Gymnasium environment that a run's config records, in steps of the agent, if it has one."""
    limit = config.get("max_steps", LARGEST)
    return None if limit == LARGEST else limit


def about_task(config: dict[str, Any]) -> dict[str, Any]:
    """A run's config, or the description of a task, with the settings that are recorded only if they are unusual."""
    return {"faults": None, "observe": None, "steps_per_action": steps_per_action(config)} | config


def decisive(task: Any) -> tuple[str, ...]:
    """Names in `about_task` that must agree for two tasks to be the same, apart from the observed entries."""
    return "task", "faults", "steps_per_action" if isinstance(task, GymnasiumTask) else "constants"


def _with_functions_of(there: Any, asked: Any) -> Any:
    """The settings `asked`, with functions and objects as they are recorded `there`: as text with an address."""
    if isinstance(asked, dict):
        known = there if isinstance(there, dict) else {}
        return {name: _with_functions_of(known.get(name), value) for name, value in asked.items()}
    has_address = (callable(asked) and not isinstance(asked, type)) or " at 0x" in str(plain(asked))
    return there if has_address else asked


def higher(run: Run, options: Options) -> None:
    """Raise a UserError if a training that has reached its `stop_at` is given a lower one."""
    before = run.options
    lower = before.stop_at is not None and options.stop_at is not None and options.stop_at < before.stop_at
    if lower and run.reached(before.stop_at, before.stop_patience):
        raise UserError(
            f"stop_at={options.stop_at:g} is impossible: {run.shown} has reached {before.stop_at:g} already. Give a "
            "higher return, or None."
        )
