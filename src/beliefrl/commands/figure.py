"""`beliefrl figure`."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Annotated, Literal

import tyro

from beliefrl.arguments import UsageError, parse

KINDS = ("curves", "ablation", "sensitivity", "elbo", "aggregate", "scalability", "table")
TABLES = ("scalability", "table")
HELP = """usage: beliefrl figure KIND RUNS ... [--out FILE]

  curves        learning curves: mean and S.E.M. over seeds, a line an agent, a panel a task (Section 5)
  ablation      the same of VRM and its ablations (Appendix C)
  sensitivity   VRM with the paper's and with drawn settings (Appendix F; runs of `sweep --preset sensitivity`)
  elbo          return beside the negative ELBO of the keep-learning model (Section 5.4)
  aggregate     interquartile means and performance profiles over tasks, with bootstrap intervals
  scalability   wall-clock time and parameters, as Markdown and LaTeX (Appendix G)
  table         returns at the end, when a task was solved, wall-clock time: as Markdown and LaTeX

RUNS are runs, or folders that hold runs, such as a sweep's. `beliefrl figure KIND --help` shows the options.
"""


@dataclasses.dataclass(frozen=True)
class FigureOptions:
    """Draw a figure from finished runs, as PNG and PDF."""

    runs: Annotated[
        tyro.conf.Positional[tuple[pathlib.Path, ...]], tyro.conf.arg(metavar="RUNS", help_behavior_hint="(required)")
    ]
    """Runs, or folders that hold runs, such as a sweep's."""
    out: Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """The file, without an ending or with .png or .pdf (scalability, table: .md or .tex). None: KIND in this folder."""
    actions: Literal["sampled", "mode"] = "sampled"
    """Returns with sampled actions (the paper) or with the policy's mode."""
    tasks: tuple[str, ...] = ()
    """Only these tasks."""
    agents: tuple[str, ...] = ()
    """Only these agents."""
    unfinished: bool = False
    """Also runs that have not come to their end, as far as all seeds of an agent have come."""


def figure(argv: Sequence[str]) -> None:
    """`beliefrl figure KIND RUNS ...`."""
    if argv and argv[0] in ("-h", "--help"):
        print(HELP, end="")
        return
    if not argv or argv[0] not in KINDS:
        given = f"There is no figure {argv[0]!r}" if argv else "No figure is named"
        raise UsageError(f"{given}: write beliefrl figure KIND RUNS, where KIND is {', '.join(KINDS)}.")
    kind = argv[0]
    options = parse(FigureOptions, argv[1:], f"beliefrl figure {kind}")
    groups, notes = _groups(options, kind)
    out = options.out or pathlib.Path(kind)

    from beliefrl.analysis import aggregate, elbo, final, panels, scalability
    from beliefrl.sweeps import presets

    if kind in TABLES:
        path = (scalability.write_costs if kind == "scalability" else final.write_final)(groups, out)
        print(path.read_text(), end="")
    elif kind == "elbo":
        path = elbo.draw_elbo(groups, out, options.actions)
    elif kind == "aggregate":
        path = aggregate.draw_aggregate(groups, out, options.actions)
    elif kind == "sensitivity":
        path = panels.draw_curves(panels.pooled(groups, presets.drawn, presets.PAPERS), out, options.actions)
    else:
        path = panels.draw_curves(groups, out, options.actions)
    for note in notes:
        print(note)
    print(f"written to {path} and {path.with_suffix('.tex' if kind in TABLES else '.pdf').name}")


def _groups(options: FigureOptions, kind: str) -> tuple[list, list[str]]:
    """The chosen runs' lines, and a sentence for each file that is damaged and each run that is left out."""
    from beliefrl import agents
    from beliefrl.analysis import groups
    from beliefrl.types import UserError

    if not options.runs:
        raise UsageError("RUNS is missing: give runs, or folders that hold runs, such as a sweep's.")
    found = groups.find(options.runs)
    chosen = [run for run in found.runs if not options.tasks or run.config["task"] in options.tasks]
    chosen = [run for run in chosen if not options.agents or run.config["agent"] in options.agents]
    if kind == "ablation":
        chosen = [run for run in chosen if run.config["agent"].startswith("vrm")]
    drawn = [run for run in chosen if options.unfinished or groups.is_finished(run)]
    if not drawn:
        raise UserError(f"None of the {len(found.runs)} runs can be drawn: none that was asked for is finished.")
    unfinished = [
        f"left out: {run.folder} is not finished (--unfinished draws it as far as it has come)"
        for run in chosen
        if run not in drawn
    ]
    return groups.groups(drawn, agents.defaults()), [f"damaged: {why}" for why in found.damage] + unfinished
