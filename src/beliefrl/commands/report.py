"""`beliefrl report`."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Annotated

import tyro

from beliefrl.commands.arguments import UsageError, parse


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Put runs on one page for the browser: curves, final returns with intervals, settings, time; no network needed."""

    runs: Annotated[
        tyro.conf.Positional[tuple[pathlib.Path, ...]], tyro.conf.arg(metavar="RUNS", help_behavior_hint="(required)")
    ]
    """Folders that are runs or hold runs, such as a sweep's."""
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])] = pathlib.Path("report.html")
    """The page to write; one that is there is replaced. Its links to videos are relative to where it lies."""
    unfinished: bool = False
    """Let runs that are not finished count in curves and tables, as far as they are; else they are only listed."""


def report(argv: Sequence[str]) -> None:
    """`beliefrl report RUNS -o report.html`."""
    options = parse(ReportOptions, argv, "beliefrl report")
    if not options.runs:
        raise UsageError("RUNS is missing; `beliefrl report --help` shows what can be given.")
    from beliefrl.report import write_report

    path = write_report(options.runs, options.out, options.unfinished, lambda sentence: print(f"damaged: {sentence}"))
    print(f"written to {path}: open it in a browser")
