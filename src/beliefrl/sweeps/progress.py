"""How far the trainings of a sweep are, read off the ends of their logs, and when the sweep will end."""

import pathlib
import statistics
import time

from beliefrl.runs import Run
from beliefrl.sweeps.plan import Training
from beliefrl.sweeps.run import SweepStatus
from beliefrl.types import UserError


class Progress:
    """What a training has reached that is going on."""

    def __init__(self, folder: pathlib.Path, training: Training):
        """`folder` is the sweep's."""
        self.training, self._path = training, folder / training.name
        self.step, self.doing, self.last_return = 0, "starting", None
        self.read()
        self.began, self._first_step = time.monotonic(), self.step  # of a training that goes on, where it was

    def read(self) -> None:
        """Look again at what is new."""
        try:
            rows = Run(self._path).last_rows(self.training.seeds[0])
        except UserError:
            return  # its folder is not there yet
        for row in rows:
            if row["kind"] == "pretrain":
                self.doing = f"pre-training, {row['step']:,} updates"
                continue
            self.step = max(self.step, row["step"])
            if row["kind"] == "update":
                self.doing = "learning"
            elif row["kind"] == "evaluation":
                self.last_return = statistics.fmean(row["sampled"])

    @property
    def seconds_per_step(self) -> float | None:
        """Of all its seeds together since it was started; None before a tenth of it is done."""
        done = self.step - self._first_step
        return (time.monotonic() - self.began) / done if done >= self.training.steps / 10 else None


class Forecast:
    """Watches a sweep, and tells when it will end."""

    def __init__(self, folder: pathlib.Path):
        self.folder = folder
        self.going: dict[str, Progress] = {}
        self._seen: dict[str, float] = {}  # seconds per step of each agent

    def watch(self, status: SweepStatus) -> None:
        """Look at every training that is going on."""
        for name in self.going.keys() - status.running.keys():
            del self.going[name]
        for name, training in status.running.items():
            progress = self.going.setdefault(name, Progress(self.folder, training))
            progress.read()
            if progress.seconds_per_step is not None:
                self._seen[training.agent] = progress.seconds_per_step

    def seconds_left(self, status: SweepStatus) -> float | None:
        """Until all of the sweep is done, at the pace seen so far; None before there was any."""
        if not self._seen:
            return None
        usual = statistics.fmean(self._seen.values())

        def seconds(training: Training, steps: int) -> float:
            return max(steps, 0) * self._seen.get(training.agent, usual)

        going = [seconds(each.training, each.training.steps - each.step) for each in self.going.values()]
        waiting = sum(seconds(training, training.steps) for training in status.waiting)
        return max((waiting + sum(going)) / max(len(going), 1), *going, 0.0)
