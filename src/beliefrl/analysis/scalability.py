"""What trainings cost: wall-clock time and parameters of each agent, as Markdown and as LaTeX (Appendix G)."""

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

STEPS = 100_000  # of the paper's table


class Cost(NamedTuple):
    label: str
    task: str
    seconds: float | None  # for STEPS environment steps of one seed, pre-training and compilation in it; None: unknown
    parameters: int | None  # numbers in the networks of one seed; None: no agent was saved
    steps: int  # that were timed


def wall_clock(run: Run) -> float | None:
    """Seconds that a run's sessions took together; None where one was killed, so that nobody knows its end."""
    total = 0.0
    for session in (run.config, *run.config.get("resumed", ())):
        try:
            began, ended = (datetime.fromisoformat(session[name]) for name in ("started", "ended"))
            total += (ended - began).total_seconds()
        except (KeyError, TypeError, ValueError):
            return None
    return total


def parameters(run: Run) -> int | None:
    """How many numbers the saved agent of one seed holds (`Agent.networks`)."""
    path = run.folder / "agent.safetensors"
    if not path.exists():
        return None
    return sum(values.size for values in arrays.load(path).values()) // len(run.seeds)


def costs(groups: Sequence[Group]) -> list[Cost]:
    """What each agent cost, the median over its runs."""
    made = []
    for group in groups:
        spans = [(wall_clock(run), max(last_step(run, seed) for seed in run.seeds), run) for run in group.runs]
        timed = [span / steps / len(run.seeds) for span, steps, run in spans if span is not None and steps]
        sizes = [size for run in group.runs if (size := parameters(run)) is not None]
        seconds = float(np.median(timed)) * STEPS if timed else None
        steps = max((steps for _, steps, _ in spans), default=0)
        made.append(Cost(group.label, group.task, seconds, sizes[0] if sizes else None, steps))
    return made


COLUMNS = (
    Column("agent"),
    Column("task"),
    Column(f"wall-clock time ({STEPS:,} steps)", True),
    Column("parameters", True),
    Column("steps timed", True),
)


def cells(cost: Cost) -> tuple[str, ...]:
    """A row of the table."""
    time = "unknown" if cost.seconds is None else hours(cost.seconds)
    size = "unknown" if cost.parameters is None else f"{cost.parameters / 1e6:.2f} M"
    return (cost.label, cost.task, time, size, f"{cost.steps:,}")


def hours(seconds: float) -> str:
    """A time in words."""
    return f"{seconds / 3600:.2f} h" if seconds >= 600 else f"{math.ceil(seconds / 6) / 10:.1f} min"


def write_costs(groups: Sequence[Group], out: pathlib.Path) -> pathlib.Path:
    """Write the table as .md and .tex; returns the path of the first.

    Raises:
        UserError: the files cannot be written.
    """
    return write_table(COLUMNS, [cells(cost) for cost in costs(groups)], out)
