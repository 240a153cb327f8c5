"""Learning curves of many agents on many tasks: one panel per task, one line per agent (Section 5, Appendices C, F).
Return and loss of the model on two axes (Section 5.4).

An agent has the same colour in every figure and report. Lines of one agent with different settings have different
dashes, too. Colour-blind readers can distinguish the agents' colours (simulated after Machado et al. 2009). Their
contrast to white is at least 3 to 1.
"""

import pathlib
import textwrap
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from beliefrl.analysis.figures import axis_label, figure, mean_of, save, standard_error
from beliefrl.analysis.groups import Curve, Group, RunSeed
from beliefrl.analysis.results import MODEL_LOSSES, means_between
from beliefrl.errors import UserError

COLUMNS = 3
PANEL = (3.5, 2.7)  # inches
TITLE = 44  # letters in a line of a panel's title
HANDLE, LETTER = 0.6, 0.072  # inches: of a legend entry without its label, of a letter
DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (7, 2, 1.5, 2)), (0, (3, 1, 1, 1, 1, 1)))  # lengths in line widths
AGENTS = {  # colours
    "vrm": "#0072b2",
    "sac-mlp": "#d55e00",
    "sac-lstm": "#009e73",
    "slac": "#cc79a7",
    "predictive-sac": "#9a8700",
    "vrm-single": "#332288",
    "vrm-first": "#aa3377",
    "vrm-keep": "#661100",
    "vrm-deterministic": "#117733",
}
GREY = "#444444"  # the loss of a model
OTHERS = ("#777777", "#8f8f1f", "#3c8fc0", "#b37700", "#5e4fa2", "#0f8b8d")


def draw_curves(groups: Sequence[Group], out: pathlib.Path, mode: str = "sampled") -> pathlib.Path:
    """Draw returns over steps, mean and S.E.M. over seeds. Each measure of a task, such as success, has another panel.

    Args:
        groups: the lines; groups of the same task share a panel.
        out: path of the figure, which is written as .png and .pdf.
        mode: which actions, "sampled" (as in the paper) or "mode".

    Returns:
        The path of the PNG.

    Raises:
        UserError: no group has an evaluation of all its seeds, or the files cannot be written.
    """
    groups = with_curve(groups, mode)
    entries = [(task, "") for task in tasks_of(groups)]
    for name in dict.fromkeys(name for group in groups for name in group.measures):
        entries += [(task, name) for task in tasks_of([group for group in groups if name in group.measures])]
    labels = list(dict.fromkeys(group.label for group in groups))
    colour = colours(labels)
    style = {label: DASHES[number % len(DASHES)] for label, number in dashes(labels).items()}
    made, axes = panels(len(entries), labels)
    for axis, (task, measure) in zip(axes, entries, strict=True):
        shown = [group for group in groups if group.task == task and (not measure or measure in group.measures)]
        for group in shown:
            label, name = group.label, f"{mode}_{measure}" if measure else mode
            draw_line(axis, group.curve(name), colour[label], label, linestyle=style[label])
        finish(axis, task, shown[0].axis, axis_label(measure))
    add_legend(made, {label: colour[label] for label in labels}, spread(groups, mode), style)
    return save(made, out)


def with_curve(groups: Sequence[Group], mode: str) -> list[Group]:
    """The groups that have an evaluation of all their seeds.

    Raises:
        UserError: there is no such group.
    """
    chosen = [group for group in groups if group.curve(mode).steps.size]
    if not chosen:
        raise UserError("No run has an evaluation of all its seeds yet, so there is no curve to draw.")
    return chosen


def tasks_of(groups: Sequence[Group]) -> list[str]:
    return list(dict.fromkeys(group.task for group in groups))


def panels(count: int, labels: Sequence[str]) -> tuple[Any, list[Any]]:
    """A figure with `count` panels, and space for a legend of these labels below them."""
    columns = min(COLUMNS, count)
    rows = -(-count // columns)
    width = max(columns * PANEL[0], 4.5)
    made = figure(width, rows * PANEL[1] + legend_height(labels, width) + 0.2)
    axes = list(made.subplots(rows, columns, squeeze=False).flat)
    for unused in axes[count:]:
        unused.remove()
    return made, axes[:count]


def draw_line(axis: Any, curve: Curve, colour: str, label: str, **style: Any) -> None:
    """Draw the mean of a curve over its seeds, and its S.E.M. as a band; a single evaluation is a dot."""
    mean, error = mean_of(curve.seeds), standard_error(curve.seeds)
    marker = "o" if len(curve.steps) == 1 else ""
    axis.plot(curve.steps, mean, color=colour, linewidth=1.6, marker=marker, markersize=4, label=label, **style)
    axis.fill_between(curve.steps, mean - error, mean + error, color=colour, alpha=0.2, linewidth=0)


def finish(axis: Any, title: str, abscissa: str, ordinate: str) -> None:
    """Add the title, the labels and the grid."""
    axis.set_title(textwrap.fill(title, TITLE, break_on_hyphens=False), fontsize=10)
    axis.set_xlabel(abscissa, fontsize=9)
    axis.set_ylabel(ordinate, fontsize=9)
    axis.tick_params(labelsize=8)
    axis.xaxis.set_major_formatter(thousands)
    axis.xaxis.set_major_locator(_locator())
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)


def thousands(value: float, _: Any = None) -> str:
    """A tick label: 20000 as "20k"."""
    return f"{value / 1000:g}k" if value else "0"


def _locator() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(5)


def legend_columns(labels: Sequence[str], width: float) -> int:
    """The number of legend columns in a figure of this width (inches)."""
    return max(1, int(width / max(2.1, HANDLE + LETTER * max(map(len, labels)))))


def wrapped(labels: Sequence[str], width: float) -> list[str]:
    """The labels, broken into lines that fit the width of the figure (inches)."""
    return [textwrap.fill(label, int((width - HANDLE) / LETTER)) for label in labels]


def legend_height(labels: Sequence[str], width: float) -> float:
    """The height of the legend in inches, in a figure of this width (inches)."""
    lines = sum(label.count("\n") + 1 for label in wrapped(labels, width))
    return 0.25 * -(-lines // legend_columns(labels, width))


def add_legend(made: Any, colour: dict[str, str], title: str, style: dict[str, Any] | None = None) -> None:
    """Add one legend below all panels. Lines are solid unless `style` has another line style for their label."""
    from matplotlib.lines import Line2D

    dash, width = style or {}, made.get_figwidth()
    lines = [
        Line2D([], [], color=each, linewidth=2, label=text, linestyle=dash.get(label, "-"))
        for (label, each), text in zip(colour.items(), wrapped([*colour], width), strict=True)
    ]
    columns = legend_columns([*colour], width)
    made.legend(
        handles=lines,
        loc="outside lower center",
        ncols=min(columns, len(lines)),
        frameon=False,
        fontsize=9,
        title=title,
        title_fontsize=8,
    )


def spread(groups: Sequence[Group], mode: str = "sampled") -> str:
    """The legend's title: the number of seeds in the means, and what is not usual about them."""
    seeds = {len(group.seeds) for group in groups}
    lost = sum(int(group.diverged.sum()) for group in groups)
    after = f"; {lost} diverged, and {'is' if lost == 1 else 'are'} not in the later means" if lost else ""
    held = sum(int((group.stopped & ~group.diverged).sum()) for group in groups)
    after += f"; {held} ended at stop_at, and {'keeps its' if held == 1 else 'keep their'} last return" if held else ""
    after += "; mode actions" if mode == "mode" else ""
    return ("1 seed each" if seeds == {1} else f"mean and S.E.M. of {counts(seeds)} seeds") + after


def counts(numbers: Collection[int]) -> str:
    """The range of the numbers as text: "3", or "2 to 5"."""
    low, high = min(numbers), max(numbers)
    return str(low) if low == high else f"{low} to {high}"


def numbers(seeds: Collection[int]) -> str:
    """Seeds as text: "0 to 4", or "0 7" if some between them are missing."""
    return counts(seeds) if len(set(seeds)) > max(seeds) - min(seeds) else " ".join(map(str, sorted(seeds)))


def pooled(groups: Sequence[Group], drawn: Callable[[int], dict[str, Any]], papers: dict[str, Any]) -> list[Group]:
    """Two groups per task: VRM with the paper's settings, and with settings drawn for each seed (Appendix F).

    Args:
        groups: runs of VRM.
        drawn: gives the drawn settings of a seed.
        papers: the paper's settings of all hyperparameters.

    Raises:
        UserError: no task has both a run with the paper's settings and a run with drawn settings.
    """

    def of(seeds: Sequence[RunSeed], settings: Callable[[int], dict[str, Any]]) -> list[RunSeed]:
        """Those with exactly these settings, each seed number once."""
        return [
            *{
                seed: (run, seed) for run, seed in seeds if papers | run.config["hyperparameters"] == settings(seed)
            }.values()
        ]

    made = []
    for task in tasks_of(groups):
        seeds = [seed for group in groups if group.task == task and group.agent == "vrm" for seed in group.seeds]
        usual, other = of(seeds, lambda seed: papers), of(seeds, lambda seed: papers | drawn(seed))
        if usual and other:
            made += [Group(task, "vrm, the paper's settings", usual), Group(task, "vrm, drawn settings", other)]
    if not made:
        raise UserError("These runs are not a sensitivity study: `beliefrl sweep --preset sensitivity` makes one.")
    return made


def _plain_first(labels: Sequence[str]) -> list[str]:
    """The labels without duplicates; names without settings come first."""
    return sorted(dict.fromkeys(labels), key=lambda label: " " in label)


def colours(labels: Sequence[str]) -> dict[str, str]:
    """A colour "#rrggbb" for each label, whose first word is the agent's name.

    The first label of a known agent has the agent's colour. All others take the colours of OTHERS in turn, in the order
    of the labels, names without settings first.
    """
    chosen: dict[str, str] = {}
    others = 0
    for label in _plain_first(labels):
        own = AGENTS.get(label.partition(" ")[0])
        if own is None or own in chosen.values():
            own, others = OTHERS[others % len(OTHERS)], others + 1
        chosen[label] = own
    return {label: chosen[label] for label in labels}


def dashes(labels: Sequence[str]) -> dict[str, int]:
    """The index of each label's dash pattern: its position among the labels of its agent, the plain name first."""
    before: dict[str, int] = {}
    chosen = {}
    for label in _plain_first(labels):
        agent = label.partition(" ")[0]
        chosen[label] = before.get(agent, 0)
        before[agent] = chosen[label] + 1
    return {label: chosen[label] for label in labels}


def model_loss(group: Group) -> Curve | None:
    """The model's loss, averaged over the updates between evaluations; None if no model keeps learning.

    A seed without updates, which diverged before, is NaN.
    """
    steps = group.curve().steps
    updates = [list(run.rows(seed, "update")) for run, seed in group.seeds]
    found = [name for name in MODEL_LOSSES if any(rows and name in rows[-1] for rows in updates)]
    if not found:
        return None
    table = np.array([means_between(rows, found[0], steps.tolist()) for rows in updates])
    for seed in np.flatnonzero(group.stopped & ~group.diverged):  # as in `Group.curve`
        known = np.flatnonzero(np.isfinite(table[seed]))
        if known.size:
            table[seed, known[-1] :] = table[seed, known[-1]]
    return Curve(steps, table).only(~np.all(np.isnan(table), axis=0))


def draw_elbo(groups: Sequence[Group], out: pathlib.Path, mode: str = "sampled") -> pathlib.Path:
    """Draw return and model loss, mean and S.E.M. over seeds, a panel per agent and task; returns the path of the PNG.

    For VRM the loss is the negative ELBO of the keep-learning model.

    Raises:
        UserError: no run has a model that keeps learning, or the files cannot be written.
    """
    shown = [(group, loss) for group in with_curve(groups, mode) if (loss := model_loss(group)) is not None]
    if not shown:
        raise UserError("None of these runs has a model that keeps learning: give runs of vrm, slac or predictive-sac.")
    colour = colours([group.label for group, _ in shown])
    dashed = "loss of the model (dashed)"
    lines = {group.label: colour[group.label] for group, _ in shown} | {dashed: GREY}
    made, axes = panels(len(shown), [*lines])
    for axis, (group, loss) in zip(axes, shown, strict=True):
        draw_line(axis, group.curve(mode), colour[group.label], "return")
        finish(axis, f"{group.label} on {group.task}", group.axis, "return")
        right = axis.twinx()
        draw_line(right, loss, GREY, "loss of the model", linestyle="--")
        right.set_ylabel(dashed, fontsize=9)
        right.tick_params(labelsize=8)
        right.spines["top"].set_visible(False)
    add_legend(made, lines, spread([group for group, _ in shown], mode), {dashed: "--"})
    return save(made, out)
