"""The state of a sweep, the progress of its trainings, read from the ends of their logs, and the time left."""

import dataclasses
import pathlib
import statistics
import time
from typing import NamedTuple

from beliefrl.runs.run import Run
from beliefrl.sweeps.plan import Training
from beliefrl.types import UserError


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

    @property
    def count(self) -> int:
        return len(self.finished) + len(self.waiting) + len(self.running) + len(self.failed) + len(self.pruned)


class SweepProgress:
    """The progress of one running training."""

    def __init__(self, folder: pathlib.Path, training: Training):
        """`folder` is the folder of the sweep."""
        self.training, self._path = training, folder / training.name
        self.step, self.doing, self.last_return = 0, "starting", None
        self._began, self._learns_since = time.monotonic(), None

    def read(self) -> None:
        """Read the new rows of the log."""
        try:
            rows = Run(self._path).last_rows(self.training.seeds[0])
        except UserError:
            return  # its folder does not exist yet
        for row in rows:
            if row["kind"] == "pretrain":
                self.doing = f"pre-training, {row['step']:,} updates"
                continue
            self.step = max(self.step, row["step"])
            if row["kind"] == "update":
                self.doing = "learning"
            elif row["kind"] == "evaluation":
                self.last_return = statistics.fmean(row["sampled"])
        if self.doing == "learning" and self._learns_since is None:
            self._learns_since = time.monotonic(), self.step

    @property
    def pace(self) -> Pace | None:
        """The speed so far; None until learning has advanced."""
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
