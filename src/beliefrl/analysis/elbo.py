"""Figure of the return and the loss of the model, on two axes (Section 5.4).

For VRM the loss is the negative ELBO of the keep-learning model.
"""

import pathlib
from collections.abc import Sequence

import numpy as np

from beliefrl.analysis.figures import save
from beliefrl.analysis.groups import Curve, Group
from beliefrl.analysis.panels import add_legend, colours, draw_line, finish, panels, spread, with_curve
from beliefrl.analysis.results import MODEL_LOSSES, means_between
from beliefrl.types import UserError

GREY = "#444444"


def model_loss(group: Group) -> Curve | None:
    """The model's loss, averaged over the updates between evaluations; None if no model keeps learning."""
    steps = group.curve().steps
    table = []
    for run, seed in group.seeds:
        rows = list(run.rows(seed, "update"))
        found = [name for name in MODEL_LOSSES if rows and name in rows[-1]]
        if not found:
            return None
        table.append(means_between(rows, found[0], steps.tolist()))
    return Curve(steps, np.array(table)).only(~np.all(np.isnan(table), axis=0))


def draw_elbo(groups: Sequence[Group], out: pathlib.Path, mode: str = "sampled") -> pathlib.Path:
    """Draw return and model loss, mean and S.E.M. over seeds, a panel per agent and task; returns the path of the PNG.

    Raises:
        UserError: no run has a model that keeps learning, or the files cannot be written.
    """
    shown = [(group, loss) for group in with_curve(groups, mode) if (loss := model_loss(group)) is not None]
    if not shown:
        raise UserError("None of these runs has a model that keeps learning: give runs of vrm, slac or predictive-sac.")
    colour = colours([group.label for group, _ in shown])
    lines = {group.label: colour[group.label] for group, _ in shown} | {"loss of the model (dashed)": GREY}
    made, axes = panels(len(shown), [*lines])
    for axis, (group, loss) in zip(axes, shown, strict=True):
        draw_line(axis, group.curve(mode), colour[group.label], "return")
        finish(axis, f"{group.label} on {group.task}", "return")
        right = axis.twinx()
        draw_line(right, loss, GREY, "loss of the model", linestyle="--")
        right.set_ylabel("loss of the model (dashed)", fontsize=9)
        right.tick_params(labelsize=8)
        right.spines["top"].set_visible(False)
    add_legend(made, lines, spread([group for group, _ in shown]))
    return save(made, out)
