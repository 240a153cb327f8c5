"""Table of the cost of training: wall-clock time and parameters of each agent (Appendix G)."""

import math
import pathlib
from collections.abc import Sequence
from datetime import datetime
from typing import NamedTuple

import numpy as np

from beliefrl.analysis.groups import Group, last_step
from beliefrl.analysis.tables import Column, write_table
from beliefrl.runs import arrays
from beliefrl.runs.run import Run

STEPS = 100_000  # as in the paper's table


class Cost(NamedTuple):
    label: str
    task: str
    seconds: float | None  # STEPS environment steps of one seed, with pre-training and compilation; None: unknown
    parameters: int | None  # of the networks of one seed; None: no agent was saved
    steps: int  # environment steps that were timed


def wall_clock(run: Run) -> float | None:
    """Total seconds of a run's sessions; None if a session was killed, so that its end is unknown."""
    total = 0.0
    for session in (run.config, *run.config.get("resumed", ())):
        try:
            began, ended = (datetime.fromisoformat(session[name]) for name in ("started", "ended"))
            total += (ended - began).total_seconds()
        except (KeyError, TypeError, ValueError):
            return None
    return total


def parameters(run: Run) -> int | None:
    """The number of parameters in the saved networks of one seed (`Agent.networks`); None if no agent was saved."""
    path = run.folder / "agent.safetensors"
    if not path.exists():
        return None
    return sum(values.size for values in arrays.load(path).values()) // len(run.seeds)


def costs(groups: Sequence[Group]) -> list[Cost]:
    """The cost of each group; the time is the median over its runs."""
    table = []
    for group in groups:
        spans = [(wall_clock(run), max(last_step(run, seed) for seed in run.seeds), run) for run in group.runs]
        timed = [span / steps / len(run.seeds) for span, steps, run in spans if span is not None and steps]
        sizes = [size for run in group.runs if (size := parameters(run)) is not None]
        seconds = float(np.median(timed)) * STEPS if timed else None
        steps = max((steps for _, steps, _ in spans), default=0)
        table.append(Cost(group.label, group.task, seconds, sizes[0] if sizes else None, steps))
    return table


COLUMNS = (
    Column("agent"),
    Column("task"),
    Column(f"wall-clock time ({STEPS:,} steps)", True),
    Column("parameters", True),
    Column("steps timed", True),
)


def cells(cost: Cost) -> tuple[str, ...]:
    """The row of the table, as text."""
    time = "unknown" if cost.seconds is None else hours(cost.seconds)
    size = "unknown" if cost.parameters is None else f"{cost.parameters / 1e6:.2f} M"
    return (cost.label, cost.task, time, size, f"{cost.steps:,}")


def hours(seconds: float) -> str:
    """A time as text: "1.25 h", or "3.2 min"."""
    return f"{seconds / 3600:.2f} h" if seconds >= 600 else f"{math.ceil(seconds / 6) / 10:.1f} min"


def write_costs(groups: Sequence[Group], out: pathlib.Path) -> pathlib.Path:
    """Write the table as .md and .tex; returns the path of the first.

    Raises:
        UserError: the files cannot be written.
    """
    return write_table(COLUMNS, [cells(cost) for cost in costs(groups)], out)
