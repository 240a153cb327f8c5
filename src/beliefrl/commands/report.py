"""`beliefrl report`."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Annotated

import tyro

from beliefrl.commands.arguments import UsageError, parse


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Write a report on runs as one HTML page: curves, final returns, settings, time. It needs no network."""

    runs: Annotated[
        tyro.conf.Positional[tuple[pathlib.Path, ...]], tyro.conf.arg(metavar="RUNS", help_behavior_hint="(required)")
    ]
    """Folders of runs, folders that contain runs (such as a sweep's), or files of results, NAME.json.gz."""
    out: Annotated[pathlib.Path, tyro.conf.arg(aliases=["-o"])] = pathlib.Path("report.html")
    """The page to write. An existing file is replaced. Links to videos are relative to the page's folder."""
    unfinished: bool = False
    """Include unfinished runs in curves and tables, up to their last evaluation. Otherwise they are only listed."""


def report(argv: Sequence[str]) -> None:
    """`beliefrl report RUNS -o report.html`."""
    options = parse(ReportOptions, argv, "beliefrl report")
    if not options.runs:
        raise UsageError("RUNS is missing: give runs, folders that contain runs, or files of results.")
    from beliefrl.report import write_report

    path = write_report(options.runs, options.out, options.unfinished, lambda sentence: print(f"damaged: {sentence}"))
    print(f"written to {path}: open it in a browser")
