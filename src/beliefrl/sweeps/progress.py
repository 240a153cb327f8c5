"""The state and the progress of a sweep (from the ends of its logs), the time left, and the display of these."""

import copy
import dataclasses
import pathlib
import statistics
import time
from shlex import quote
from typing import NamedTuple

from rich.console import Group
from rich.table import Table
from rich.text import Text

from beliefrl.errors import UserError
from beliefrl.runs.folder import is_locked
from beliefrl.runs.run import Run
from beliefrl.sweeps.plan import Training
from beliefrl.training.screen import Screen, duration


class Pace(NamedTuple):
    """The measured speed of an agent's training."""

    before: float  # seconds before learning begins: start, compilation, exploration, pre-training
    per_step: float  # seconds per environment step of all its seeds, while it learns


@dataclasses.dataclass
class SweepStatus:
    """The state of a sweep: each training is finished, waiting, running, failed, or pruned (`beliefrl.tune`)."""

    finished: list[Training]
    waiting: list[Training]
    running: dict[str, Training] = dataclasses.field(default_factory=dict)
    failed: dict[str, str] = dataclasses.field(default_factory=dict)  # name: the last error message of the training
    pruned: list[Training] = dataclasses.field(default_factory=list)
    notes: dict[str, str] = dataclasses.field(default_factory=dict)  # name: what the display adds to its lines
    held: set[str] = dataclasses.field(default_factory=set)  # names of those that waited for another process

    @property
    def count(self) -> int:
        return len(self.finished) + len(self.waiting) + len(self.running) + len(self.failed) + len(self.pruned)


def take(status: SweepStatus, folder: pathlib.Path) -> Training | None:
    """Take the first waiting training whose run in `folder` no other process trains; None if there is none.

    Trainings of a sweep that was killed take a while to end, after the sweep has been started again.
    """
    for index, training in enumerate(status.waiting):
        if not is_locked(folder / training.name):
            return status.waiting.pop(index)
        status.held.add(training.name)
    return None


class SweepProgress:
    """The progress of one running training."""

    def __init__(self, folder: pathlib.Path, training: Training):
        """`folder` is the folder of the sweep."""
        self.training, self._path = training, folder / training.name
        self.step, self.doing, self.last_return = 0, "starting", None
        self._began, self._learns_since = time.monotonic(), None
        self._first_step: int | None = None  # the last update at the first look: a continued training has some

    def read(self) -> None:
        """Read the new rows of the log."""
        try:
            rows = Run(self._path).last_rows(self.training.seeds[0])
        except UserError:
            self._first_step = self._first_step or 0
            return  # its folder does not exist yet
        updates = [row["step"] for row in rows if row["kind"] == "update"]
        last = max(updates, default=0)
        first = self._first_step = last if self._first_step is None else self._first_step
        for row in rows:
            if row["kind"] == "pretrain":
                self.doing = self.doing if first else f"pre-training, {row['step']:,} updates"
                continue
            self.step = max(self.step, row["step"])
            if row["kind"] == "evaluation":
                self.last_return = statistics.fmean(row["sampled"])
        if last > first:
            self.doing = "learning"
            self._learns_since = self._learns_since or (time.monotonic(), self.step)

    @property
    def pace(self) -> Pace | None:
        """The speed so far; None until learning has advanced. A continued training begins without pre-training."""
        if self._learns_since is None or self.step <= self._learns_since[1]:
            return None
        since, first_step = self._learns_since
        return Pace(since - self._began, (time.monotonic() - since) / (self.step - first_step))


class Forecast:
    """Watches a sweep, and estimates the time left."""

    def __init__(self, folder: pathlib.Path):
        self.folder = folder
        self.going: dict[str, SweepProgress] = {}
        self._seen: dict[str, Pace] = {}  # the latest pace of each agent

    def watch(self, status: SweepStatus) -> None:
        """Read the progress of every running training."""
        for name in self.going.keys() - status.running.keys():
            del self.going[name]
        for name, training in status.running.items():
            progress = self.going.setdefault(name, SweepProgress(self.folder, training))
            progress.read()
            if progress.pace is not None:
                self._seen[training.agent] = progress.pace

    def seconds_left(self, status: SweepStatus) -> float | None:
        """Seconds until the sweep is finished, at the pace so far; None before a pace is known."""
        if not self._seen:
            return None
        usual = Pace(*map(statistics.fmean, zip(*self._seen.values(), strict=True)))

        def seconds(training: Training, done: int, learns: bool) -> float:
            pace = self._seen.get(training.agent, usual)
            return max(training.steps - done, 0) * pace.per_step + (0.0 if learns else pace.before)

        running = [seconds(each.training, each.step, each.doing == "learning") for each in self.going.values()]
        waiting = sum(seconds(training, 0, False) for training in status.waiting)
        return max((waiting + sum(running)) / max(len(running), 1), *running, 0.0)


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
            self.screen.line(f"{done}; `beliefrl report {quote(str(self.folder))} -o report.html` shows them")

    def __call__(self, status: SweepStatus) -> None:
        """Show the state of a sweep."""
        self.forecast.watch(status)
        self._say_changes(status)
        self.screen.status(self._summary(status), self._table(status))

    def _say_changes(self, status: SweepStatus) -> None:
        if self.before is None:
            already = f", {len(status.finished)} of them finished already" if status.finished else ""
            together = f", {len(status.running)} at a time" if status.running else ""
            self.screen.line(f"{status.count} trainings{already}{together}")
            self.before = SweepStatus([*status.finished], [], pruned=[*status.pruned])
        for name in sorted(status.held - self.before.held):
            self.screen.line(f"waits: {name}, which another process still trains")
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
        self.before = copy.deepcopy(status)

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
