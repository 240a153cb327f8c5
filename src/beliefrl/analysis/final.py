"""Table of final results: returns with their S.E.M., the step at which a task was solved, and the wall-clock time."""

import pathlib
from collections.abc import Sequence

import numpy as np

from beliefrl.analysis.aggregate import known_bounds
from beliefrl.analysis.curves import standard_error
from beliefrl.analysis.groups import Curve, Group
from beliefrl.analysis.panels import counts
from beliefrl.analysis.scalability import hours, wall_clock
from beliefrl.analysis.tables import Column, measure_text, write_table

SOLVED = 0.95  # score (`aggregate`): a return of -203 on the pendulum, 951 on CartPole, 133 on target reaching

COLUMNS = (
    Column("task"),
    Column("agent"),
    Column("seeds"),
    Column("steps", True),
    Column("sampled actions", True),
    Column("mode actions", True),
    Column("solved at", True),
    Column("wall-clock per seed", True),
)


def rows(groups: Sequence[Group]) -> list[tuple[str, ...]]:
    """One row per agent and task: returns at the last evaluation, mean ± S.E.M. over seeds.

    A task is solved at the first evaluation whose mean over seeds has a score of 0.95, with sampled or mode actions.
    """
    table = []
    for group in groups:
        sampled, mode = group.curve("sampled"), group.curve("mode")
        if not sampled.steps.size:
            continue
        spans = [wall_clock(run) for run in group.runs]
        known = [span for span in spans if span is not None]
        seconds = sum(known) / sum(len(run.seeds) for run in group.runs) if len(known) == len(spans) else None
        table.append(
            (
                f"`{group.task}`",
                f"`{group.label}`",
                counts([seed for _, seed in group.seeds]),
                f"{sampled.steps[-1]:,}",
                _final(sampled) + _measures(group, "sampled"),
                _final(mode) + _measures(group, "mode"),
                _solved(group.task, sampled, mode),
                "unknown" if seconds is None else hours(seconds),
            )
        )
    return table


def _final(curve: Curve) -> str:
    error = f" ± {standard_error(curve.seeds[:, -1:])[0]:.1f}" if len(curve.seeds) > 1 else ""
    return f"{np.nanmean(curve.seeds[:, -1]):.1f}{error}"


def _measures(group: Group, mode: str) -> str:
    last = {name: float(np.nanmean(group.curve(f"{mode}_{name}").seeds[:, -1])) for name in group.measures}
    return "".join(f"; {name} {measure_text(name, value)}" for name, value in last.items())


def _solved(task: str, *curves: Curve) -> str:
    """The first step at which the mean of one of the curves is solved; "-" for a task without known bounds."""
    known = known_bounds(task)
    if known is None:
        return "-"
    low, high = known
    enough = np.any([np.nanmean(curve.seeds, axis=0) >= low + SOLVED * (high - low) for curve in curves], axis=0)
    return f"{curves[0].steps[np.argmax(enough)]:,}" if enough.any() else "no"


def write_final(groups: Sequence[Group], out: pathlib.Path) -> pathlib.Path:
    """Write the table as .md and .tex; returns the path of the first.

    Raises:
        UserError: the files cannot be written.
    """
    return write_table(COLUMNS, rows(groups), out)
