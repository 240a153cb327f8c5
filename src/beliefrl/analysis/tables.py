"""Tables as files, Markdown for reading and LaTeX for print: final results, and the cost of training (Appendix G).

No file is left half written.
"""

import math
import pathlib
from collections.abc import Sequence
from datetime import datetime
from typing import NamedTuple

import numpy as np

from beliefrl.analysis.aggregate import known_bounds
from beliefrl.analysis.figures import mean_of, standard_error
from beliefrl.analysis.groups import Curve, Group, last_step
from beliefrl.analysis.panels import numbers
from beliefrl.errors import UserError, one_line
from beliefrl.runs import arrays
from beliefrl.runs.given_files import check_folder, write_given
from beliefrl.runs.records import sessions
from beliefrl.runs.run import Run

SOLVED = 0.95  # score (`aggregate`): a return of -203 on the pendulum, 951 on CartPole, 133 on target reaching
TIMED_STEPS = 100_000  # as in the paper's table
IN_LATEX = str.maketrans(
    {each: f"\\{each}" for each in "_%#&${}"} | {"\\": r"\textbackslash{}", "^": r"\^{}", "~": r"\~{}", "±": r"$\pm$"}
)


class Column(NamedTuple):
    heading: str
    is_number: bool = False  # aligned right


Cells = Sequence[str]


def measure_text(name: str, value: float | None) -> str:
    """A measure of episodes as text; success is a rate. None: there is no number, for example of a diverged seed."""
    if value is None:
        return "-"
    return f"{value:.0%}" if name == "success" else f"{value:.4g}"


def markdown(columns: Sequence[Column], rows: Sequence[Cells]) -> str:
    """The table in Markdown."""
    cells = [[cell.replace("|", r"\|") for cell in row] for row in rows]
    lines = [[column.heading for column in columns], ["---:" if column.is_number else "---" for column in columns]]
    return "".join(f"| {' | '.join(line)} |\n" for line in (*lines, *cells))


def latex(columns: Sequence[Column], rows: Sequence[Cells]) -> str:
    """The table in LaTeX; it needs the package booktabs."""

    def line(cells: Cells) -> str:
        return "    " + " & ".join(cell.translate(IN_LATEX) for cell in cells) + r" \\"

    alignment = "".join("r" if column.is_number else "l" for column in columns)
    head = [rf"\begin{{tabular}}{{{alignment}}}", r"    \toprule", line([column.heading for column in columns])]
    foot = [r"    \bottomrule", r"\end{tabular}"]
    return "\n".join([*head, r"    \midrule", *map(line, rows), *foot]) + "\n"


def write_table(columns: Sequence[Column], rows: Sequence[Cells], out: pathlib.Path) -> pathlib.Path:
    """Write the table as .md and .tex; returns the path of the first.

    Raises:
        UserError: the files cannot be written.
    """
    if out.suffix.lower() not in ("", ".md", ".tex"):
        kinds = "a table is written as .md and .tex"
        raise UserError(f"{out} is impossible: {kinds}, so its name must end in one of them.")
    if not rows:
        raise UserError("The table would be empty: none of these runs has an evaluation there.")
    check_folder(out)
    rows = [[one_line(cell) for cell in row] for row in rows]  # names in a config.json may have terminal escapes
    write_given(out.with_suffix(".tex"), latex(columns, rows).encode())
    write_given(out.with_suffix(".md"), markdown(columns, rows).encode())
    return out.with_suffix(".md")


FINAL = (
    Column("task"),
    Column("agent"),
    Column("seeds"),
    Column("steps", True),
    Column("sampled actions", True),
    Column("mode actions", True),
    Column("solved at", True),
    Column("wall-clock per seed", True),
)


def final_rows(groups: Sequence[Group]) -> list[tuple[str, ...]]:
    """One row per agent and task: returns at the last evaluation, mean ± S.E.M. over seeds.

    A task is solved at the first evaluation whose mean over seeds has a score of 0.95, with sampled or mode actions.
    """
    table: list[tuple[str, ...]] = []
    for group in groups:
        sampled, mode = group.curve("sampled"), group.curve("mode")
        if not (sampled.steps.size or group.diverged.all()):
            continue  # `left_out` names it
        spans = [wall_clock(run) for run in group.runs]
        known = [span for span in spans if span is not None]
        seconds = sum(known) / sum(len(run.seeds) for run in group.runs) if len(known) == len(spans) else None
        table.append(
            (
                group.task,
                group.label,
                numbers([seed for _, seed in group.seeds]),
                f"{sampled.steps[-1]:,}" if sampled.steps.size else "-",
                _final(group, "sampled") + _measures(group, "sampled"),
                _final(group, "mode") + _measures(group, "mode"),
                "no" if group.diverged.all() else _solved(group.task, sampled, mode),
                "unknown" if seconds is None else hours(seconds),
            )
        )
    return table


def _final(group: Group, mode: str) -> str:
    """Mean ± S.E.M. of the seeds with a finite return, how many have diverged, and how many returns are not finite."""
    if group.diverged.all():
        return "diverged"
    going = group.final(mode)[~group.diverged]
    values = going[np.isfinite(going)]
    without = {"diverged": group.diverged.sum(), "not finite": going.size - values.size}
    lost = "".join(f" ({count} of {len(group.seeds)} {why})" for why, count in without.items() if count)
    if not values.size:
        return f"-{lost}"
    error = f" ± {standard_error(values):.1f}" if values.size > 1 else ""
    return f"{values.mean():.1f}{error}{lost}"


def _measures(group: Group, mode: str) -> str:
    last = {name: group.final(f"{mode}_{name}") for name in group.measures}
    known = {name: float(np.nanmean(values)) for name, values in last.items() if np.isfinite(values).any()}
    return "".join(f"; {name} {measure_text(name, value)}" for name, value in known.items())


def _solved(task: str, *curves: Curve) -> str:
    """The first step at which the mean of one of the curves is solved; "-" for a task without known bounds."""
    known = known_bounds(task)
    if known is None:
        return "-"
    low, high = known
    enough = np.any([mean_of(curve.seeds) >= low + SOLVED * (high - low) for curve in curves], axis=0)
    return f"{curves[0].steps[np.argmax(enough)]:,}" if enough.any() else "no"


def write_final(groups: Sequence[Group], out: pathlib.Path) -> pathlib.Path:
    """Write the table as .md and .tex; returns the path of the first.

    Raises:
        UserError: the files cannot be written.
    """
    return write_table(FINAL, final_rows(groups), out)


class Cost(NamedTuple):
    label: str
    task: str
    seconds: float | None  # TIMED_STEPS environment steps of one seed, with pre-training and compilation; None: unknown
    parameters: int | None  # of the networks of one seed; None: no agent was saved
    steps: int  # environment steps that were timed


def wall_clock(run: Run) -> float | None:
    """Total seconds of a run's sessions; None if a session was killed, so that its end is unknown."""
    total = 0.0
    for session in sessions(run.config):
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
        seconds = float(np.median(timed)) * TIMED_STEPS if timed else None
        steps = max((steps for _, steps, _ in spans), default=0)
        table.append(Cost(group.label, group.task, seconds, sizes[0] if sizes else None, steps))
    return table


COSTS = (
    Column("agent"),
    Column("task"),
    Column(f"wall-clock time ({TIMED_STEPS:,} steps)", True),
    Column("parameters", True),
    Column("steps timed", True),
)


def cost_row(cost: Cost) -> tuple[str, ...]:
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
    return write_table(COSTS, [cost_row(cost) for cost in costs(groups)], out)
