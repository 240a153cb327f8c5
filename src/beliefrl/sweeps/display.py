"""The display of a sweep: its trainings and the time left."""

import pathlib

from rich.console import Group
from rich.table import Table
from rich.text import Text

from beliefrl.sweeps.progress import Forecast, SweepStatus
from beliefrl.training.screen import Screen, duration


class SweepDisplay:
    """A live table of the running trainings, with the time left, and a line for each training that begins or ends.

    On a screen that is not live only the lines are shown.
    """

    def __init__(self, screen: Screen, folder: pathlib.Path):
        """`folder` is the sweep's."""
        self.screen, self.folder = screen, folder
        self.forecast = Forecast(folder)
        self.before: SweepStatus | None = None

    def __enter__(self) -> "SweepDisplay":
        self.screen.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.screen.__exit__()
        if kind is None and self.before is not None:
            pruned = f" ({len(self.before.pruned)} pruned)" if self.before.pruned else ""
            done = f"{len(self.before.finished)} of {self.before.count} trainings finished{pruned} in {self.folder}"
            self.screen.line(f"{done}; `beliefrl report {self.folder} -o report.html` shows them")

    def __call__(self, status: SweepStatus) -> None:
        """Show the state of a sweep."""
        self.forecast.watch(status)
        self._say_changes(status)
        self.screen.status(self._summary(status), self._table(status))

    def _say_changes(self, status: SweepStatus) -> None:
        if self.before is None:
            already = f", {len(status.finished)} of them finished already" if status.finished else ""
            self.screen.line(f"{status.count} trainings{already}, {len(status.running)} at a time")
            self.before = SweepStatus([*status.finished], [], pruned=[*status.pruned])
        for name in status.running:
            if name not in self.before.running:
                self.screen.line(f"begins: {name}{_note(status, name)}")
        for training in status.finished[len(self.before.finished) :]:
            self.screen.line(f"finished: {training.name}{_note(status, training.name)} ({self._summary(status)})")
        for training in status.pruned[len(self.before.pruned) :]:
            self.screen.line(f"pruned: {training.name}{_note(status, training.name)} ({self._summary(status)})")
        for name, why in status.failed.items():
            if name not in self.before.failed:
                self.screen.line(f"failed: {name}: {why}")
        self.before = SweepStatus(
            [*status.finished], [*status.waiting], dict(status.running), dict(status.failed), [*status.pruned]
        )

    def _summary(self, status: SweepStatus) -> str:
        failed = f", {len(status.failed)} failed" if status.failed else ""
        pruned = f", {len(status.pruned)} pruned" if status.pruned else ""
        left = self.forecast.seconds_left(status)
        ends = "" if left is None else f", about {duration(left)} left"
        return f"{len(status.finished)} of {status.count} done{pruned}{failed}, {len(status.waiting)} waiting{ends}"

    def _table(self, status: SweepStatus) -> Group:
        table = Table(box=None, pad_edge=False)
        for heading in ("training", "step", "doing", "last return"):
            table.add_column(heading, justify="right" if heading in ("step", "last return") else "left")
        for name, progress in self.forecast.going.items():
            last = "" if progress.last_return is None else f"{progress.last_return:.1f}"
            table.add_row(name, f"{progress.step:,}/{progress.training.steps:,}", progress.doing, last)
        return Group(table, Text(self.screen.stamped(self._summary(status))))


def _note(status: SweepStatus, name: str) -> str:
    """The text that is added to a line about a training."""
    return f": {status.notes[name]}" if name in status.notes else ""
