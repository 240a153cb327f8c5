"""`beliefrl figure` and `beliefrl report`: many runs in figures, tables and one page."""

import dataclasses
import fnmatch
import pathlib
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import tyro

from beliefrl.commands.arguments import Out, RunFolders, parse, refuse_empty
from beliefrl.errors import UserError, one_line

KINDS = ("curves", "run", "ablation", "sensitivity", "elbo", "aggregate", "scalability", "table")
TABLES = ("scalability", "table")
HELP = """usage: beliefrl figure KIND RUNS ... [--out FILE]

  curves        learning curves: mean and S.E.M. over seeds, one line per agent, one panel per task (Section 5)
  run           one run, as in its curve.png: sampled and mode actions, with a thin line for each seed
  ablation      learning curves of VRM and its ablations (Appendix C)
  sensitivity   VRM with the paper's settings and with drawn ones (Appendix F; runs of `sweep --preset sensitivity`)
  elbo          return, and negative ELBO of the keep-learning model (Section 5.4)
  aggregate     interquartile means and performance profiles over tasks, with bootstrap intervals
  scalability   a table of wall-clock time and parameters, as Markdown and LaTeX (Appendix G)
  table         a table of final returns, solved tasks and wall-clock time, as Markdown and LaTeX

RUNS are folders of runs, folders that contain runs (such as a sweep's), or files of results, NAME.json.gz.
`beliefrl figure KIND --help` shows the options.
"""


@dataclasses.dataclass(frozen=True)
class FigureOptions:
    """Draw a figure from finished runs, as PNG and PDF."""

    runs: RunFolders
    out: Out = None
    """The file to write, with or without the suffix. None: KIND in the current folder. Figures are written as .png and
    .pdf, tables as .md and .tex."""
    actions: Literal["sampled", "mode"] = "sampled"
    """Show returns with sampled actions (as the paper does), or with the policy's mode."""
    tasks: tuple[str, ...] = ()
    """Include only these tasks. Empty: all."""
    agents: tuple[str, ...] = ()
    """Include only these agents. Empty: all."""
    names: tuple[str, ...] = ()
    """Include only runs with these folder names. Wildcards are * and ?, as in 'vrm-*-seed0'."""
    until: int | None = None
    """Include only evaluations up to this number of environment steps. None: all."""
    unfinished: bool = False
    """Include unfinished runs. A curve ends at the last step that all its seeds have reached."""


def figure(argv: Sequence[str]) -> None:
    """`beliefrl figure KIND RUNS ...`."""
    if argv and argv[0] in ("-h", "--help"):
        print(HELP, end="")
        return
    if not argv or argv[0] not in KINDS:
        given = f"There is no figure {argv[0]!r}" if argv else "No figure is given"
        raise UserError(f"{given}: write beliefrl figure KIND RUNS, where KIND is {', '.join(KINDS)}.")
    kind = argv[0]
    options = parse(FigureOptions, argv[1:], f"beliefrl figure {kind}")
    refuse_empty(argv, "--tasks", "--agents", "--names")
    runs, notes = _runs(options, kind)
    out = options.out or pathlib.Path(kind)
    path, more = _draw(kind, runs, out, options.actions)
    if kind in TABLES:
        print(path.read_text(encoding="utf-8"), end="")
    for note in notes + more:
        print(one_line(note))
    print(f"written to {path} and {path.with_suffix('.tex' if kind in TABLES else '.pdf').name}")


def _draw(kind: str, runs: Sequence[Any], out: pathlib.Path, actions: str) -> tuple[pathlib.Path, list[str]]:
    """Write the figure or table; returns the path of the PNG or of the Markdown file, and what is left out."""
    from beliefrl import agents
    from beliefrl.analysis import aggregate, panels, tables
    from beliefrl.analysis.figures import curve_figure, save
    from beliefrl.analysis.groups import groups, left_out
    from beliefrl.sweeps import sources

    if kind == "run":
        if len(runs) > 1:
            raise UserError(
                f"This figure shows one run: choose one of these {len(runs)} by --names, --agents or --tasks."
            )
        return save(curve_figure(runs[0]), out), []
    lines = groups(runs, agents.defaults(), agents.before())
    notes = left_out(runs, lines)
    if kind in TABLES:
        return (tables.write_costs if kind == "scalability" else tables.write_final)(lines, out), notes
    if kind == "elbo":
        return panels.draw_elbo(lines, out, actions), notes
    if kind == "aggregate":
        return aggregate.draw_aggregate(lines, out, actions), notes + aggregate.notes(lines, actions)
    if kind == "sensitivity":
        lines = panels.pooled(lines, sources.drawn, agents.defaults()["vrm"] | sources.PAPERS)
    return panels.draw_curves(lines, out, actions), notes


def _runs(options: FigureOptions, kind: str) -> tuple[list[Any], list[str]]:
    """The selected runs, and one sentence for each damaged file and each run that is left out."""
    from beliefrl.analysis import groups, results
    from beliefrl.runs.cached import CachedRun

    if not options.runs:
        raise UserError("RUNS is missing: give runs, folders that contain runs, or files of results.")
    found = groups.find(options.runs, CachedRun)
    chosen = [run for run in found.runs if _is_chosen(run, options, kind)]
    begun = [run for run in chosen if groups.has_begun(run)]
    drawn = begun if options.unfinished else [run for run in begun if groups.is_finished(run)]
    if not drawn:
        needed, advice = ("finished", ", or add --unfinished") if begun else ("evaluated with every seed", "")
        raise UserError(f"None of the {len(found.runs)} runs is both selected and {needed}: select others{advice}.")
    notes = [f"damaged: {why}" for why in found.damage]
    notes += [f"left out: {run.shown} {_why_not(run in begun)}" for run in chosen if run not in drawn]
    return drawn if options.until is None else [results.cut(run, options.until) for run in drawn], notes


def _why_not(has_begun: bool) -> str:
    return "is not finished (--unfinished includes it)" if has_begun else "has no evaluation of every seed yet"


def _is_chosen(run: Any, options: FigureOptions, kind: str) -> bool:
    """Whether the options select a run, and the figure can show it."""
    agent, task, name = run.config["agent"], run.config["task"], run.folder.name
    return (
        (not options.tasks or task in options.tasks)
        and (not options.agents or agent in options.agents)
        and (not options.names or any(fnmatch.fnmatchcase(name, pattern) for pattern in options.names))
        and (kind != "ablation" or agent.startswith("vrm"))
    )


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Write a report on runs as one HTML page: curves, final returns, settings, time. It needs no network."""

    runs: RunFolders
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])] = pathlib.Path("report.html")
    """The page to write. An existing file is replaced. Links to videos are relative to the page's folder."""
    unfinished: bool = False
    """Include unfinished runs in curves and tables, up to their last evaluation. Otherwise they are only listed."""


def report(argv: Sequence[str]) -> None:
    """`beliefrl report RUNS -o report.html`."""
    options = parse(ReportOptions, argv, "beliefrl report")
    if not options.runs:
        raise UserError("RUNS is missing: give runs, folders that contain runs, or files of results.")
    from beliefrl.report import write_report

    path = write_report(
        options.runs, options.out, options.unfinished, lambda sentence: print(one_line(f"damaged: {sentence}"))
    )
    print(f"written to {path}: open it in a browser")
