"""Figures as files, a PNG for the screen and a PDF for print; and the learning curve of one run (Figures 4 and 6).

No file is left half written.
"""

import io
import os
import pathlib
from typing import Any

import numpy as np

from beliefrl.analysis.groups import Group
from beliefrl.analysis.labels import task_label
from beliefrl.errors import UserError
from beliefrl.runs.given_files import check_folder, write_given
from beliefrl.runs.run import Run

COLOURS = {"sampled": "#1f6f8b", "mode": "#c8553d"}
KINDS = (".png", ".pdf")


def figure(width: float, height: float, layout: Any = "constrained") -> Any:
    """A matplotlib figure, sizes in inches. It needs no display and does not touch pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(made)
    return made


def paths(path: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """The paths of a figure's PNG and PDF; `path` ends in .png or .pdf, or has no suffix.

    Call it before the computation, so that a mistake is reported at once.

    Raises:
        UserError: `path` has another suffix, or its folder does not exist.
    """
    if path.suffix.lower() not in ("", *KINDS):
        raise UserError(
            f"{path} is impossible: a figure is written as .png and .pdf, so its name must end in one of them."
        )
    check_folder(path)
    return path.with_suffix(KINDS[0]), path.with_suffix(KINDS[1])


def save(figure: Any, path: pathlib.Path) -> pathlib.Path:
    """Write a figure to both of its `paths`; returns the path of the PNG.

    Raises:
        UserError: the files cannot be written.
    """
    for name in paths(path):
        _write(figure, name)
    return paths(path)[0]


def _write(figure: Any, path: pathlib.Path) -> None:
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix[1:].lower(), dpi=150)
    write_given(path, content.getvalue())


def axis_label(measure: str) -> str:
    """The label of an axis for a measure; "" is the return."""
    return {"": "return", "success": "success rate"}.get(measure, measure)


def mean_of(seeds: np.ndarray) -> np.ndarray:
    """The mean over the first axis, ignoring NaN; NaN without a value, where NumPy's would warn."""
    count = np.sum(~np.isnan(seeds), axis=0)
    return np.where(count, np.nansum(seeds, axis=0) / np.maximum(count, 1), np.nan)


def standard_error(seeds: np.ndarray) -> np.ndarray:
    """S.E.M. over the first axis, ignoring NaN; NaN if there is only one value."""
    count = np.sum(~np.isnan(seeds), axis=0)
    squares = np.nansum((seeds - mean_of(seeds)) ** 2, axis=0)
    return np.where(count > 1, np.sqrt(squares / np.maximum(count - 1, 1) / np.maximum(count, 1)), np.nan)


def draw_curve(run: Run | str | os.PathLike[str], path: str | os.PathLike[str] | None = None) -> pathlib.Path:
    """Draw a run's evaluation returns over its steps; returns the path of the picture.

    Each measure of the task, such as success, has another panel. Each seed is a thin line, the mean a thick
    line, and the S.E.M. a band.

    Args:
        run: a run, or its folder.
        path: the PNG or PDF; None: curve.png in the run's folder. An existing file is replaced.

    Raises:
        UserError: there is no such run, there is no evaluation yet, or the file cannot be written.
    """
    run = run if isinstance(run, Run) else Run(run)
    path = pathlib.Path(path or run.folder / "curve.png")
    if path.suffix.lower() not in KINDS:
        raise UserError(f"{path} is impossible: the name of a curve must end in .png or .pdf.")
    check_folder(path)
    _write(curve_figure(run), path)
    return path


def curve_figure(run: Run) -> Any:
    """The figure that `draw_curve` writes.

    Raises:
        UserError: there is no evaluation yet.
    """
    group = Group(task_label(run), run.config["agent"], [(run, seed) for seed in run.seeds])
    if not group.curve("sampled").steps.size:
        raise UserError(f"{run.shown} has no evaluation of every seed yet, so there is no curve to draw.")
    panels = ["", *group.measures]
    made = figure(5.6 * len(panels), 3.6)
    axes = made.subplots(1, len(panels), squeeze=False)[0]
    for axis, measure in zip(axes, panels, strict=True):
        for mode, colour in COLOURS.items():
            steps, seeds = group.curve(f"{mode}_{measure}" if measure else mode)
            mean, error = mean_of(seeds), standard_error(seeds)
            for seed in seeds if len(seeds) > 1 else []:
                axis.plot(steps, seed, color=colour, linewidth=0.6, alpha=0.4)
            axis.plot(steps, mean, color=colour, linewidth=2, label=f"{mode} actions", marker="o", markersize=3)
            axis.fill_between(steps, mean - error, mean + error, color=colour, alpha=0.2, linewidth=0)
        axis.set_xlabel(group.axis)
        axis.set_ylabel(axis_label(measure))
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    count = len(run.seeds)
    spread = f"mean and S.E.M. of {count} seeds" if count > 1 else "1 seed"
    lost = int(group.diverged.sum())
    spread += f", {lost} diverged" if lost else ""
    axes[0].set_title(f"{run.config['agent']} on {group.task}, {spread}", loc="left", fontsize=10)
    axes[0].legend(frameon=False, loc="best", fontsize=9)
    return made
