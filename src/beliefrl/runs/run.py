"""A run's folder, which a training writes.

    config.json           agent, task, options, versions, git commit, command line
    lock                  the process that trains; it has locked this file (`folder`)
    metrics/seed-0.jsonl  a line for each entry, of the kind pretrain, update, episode, evaluation or diverged
    tensorboard/, wandb/  the same entries for trackers (`trackers`)
    checkpoints/          everything that a training needs to continue (`checkpoint`)
    agent.safetensors     the agents of all seeds (leading axis) at the last evaluation, or where an environment failed
    best.safetensors      the same at the evaluation with the highest return of each seed
    initial.safetensors   the networks of all seeds before the first step, if they come from another run
    initial-replay.safetensors   the replays before the first step, if they come from another run
    results.json          the returns of the last evaluation
    curve.png             the learning curve
    before-1/, ...        logs, agents and results of a training that began again (`folder.set_aside`)
    damaged-NAME          a damaged file that was moved aside

Lines are flushed one by one, so a killed training loses at most the line that it was writing, and `rows` skips it. The
content of files is checked when it is read (`records`), so callers need not check it again.
"""

import os
import pathlib
from collections.abc import Iterator
from statistics import fmean
from typing import Any

from beliefrl.errors import UserError, one_line
from beliefrl.runs import arrays, records
from beliefrl.runs.best import BEST
from beliefrl.runs.options import OPTION_NAMES, Options
from beliefrl.runs.records import Row
from beliefrl.types import tuples


class Run:
    """A run's folder, for reading."""

    def __init__(self, folder: str | os.PathLike[str]):
        """Open the folder of a training.

        Raises:
            UserError: the folder does not exist, is not a run, its config.json is damaged, or `folder` is no path.
        """
        if not isinstance(folder, str | os.PathLike):
            raise UserError(f"{folder!r} is not a run: give a run, or the path of its folder.")
        self.given = pathlib.Path(folder)  # for messages
        self.folder = self.given.absolute()  # an environment may change the working directory
        if not os.path.isdir(self.folder):  # noqa: PTH112 - pathlib's version raises if a name is too long
            raise UserError(f"There is no run folder {self.shown}: give the --out of a training.")
        path, named = self.folder / "config.json", self.given / "config.json"
        if not os.path.exists(path):  # noqa: PTH110
            raise UserError(f"{self.shown} is not a run: it has no config.json; give the --out of a training.")
        self.config: dict[str, Any] = records.parsed(path)
        if self.config is None:
            raise UserError(f"{named} cannot be read as JSON: restore it, or train again.")
        if not records.is_complete(self.config):
            raise UserError(f"{named} lacks entries that every training writes: restore it, or train again.")
        try:
            _ = self.options
        except UserError as error:
            raise UserError(f"{named} cannot be used: {error}") from None

    @property
    def shown(self) -> str:
        """The folder as it was given, for messages."""
        return str(self.given)

    @property
    def options(self) -> Options:
        """The options of the training. Options that only other versions have are left out."""
        given = tuples(self.config["options"])
        return Options(**{name: value for name, value in given.items() if name in OPTION_NAMES})

    def __repr__(self) -> str:
        """The folder, the agent and the task: `<Run runs/first: vrm on pendulum-v>`."""
        agent, task = one_line(str(self.config["agent"])), one_line(str(self.config["task"]))
        return f"<Run {self.shown}: {agent} on {task}>"

    @property
    def seeds(self) -> list[int]:
        """The numbers of the run's seeds."""
        first, count = self.config["options"]["seed"], self.config["options"]["seeds"]
        return list(range(first, first + count))

    def rows(self, seed: int, kind: str | None = None) -> Iterator[Row]:
        """The entries of a seed's log in order, or those of one `kind`. Damaged lines are left out.

        Raises:
            UserError: the log cannot be read.
        """
        rows = (row for _, row in records.lines(self._metrics(seed)))
        return (row for row in rows if row is not None and kind in (None, row["kind"]))

    def damage(self) -> list[str]:
        """One sentence for each log with damaged lines, and one if logs are missing."""
        logs = map(self._metrics, self.seeds)
        found = [records.damage(log, self.given / "metrics" / log.name) for log in logs]
        missing = [seed for seed in self.seeds if not self._metrics(seed).exists()]
        if missing:
            which = f"the log of seed {missing[0]}" if len(missing) == 1 else f"the logs of {len(missing)} seeds"
            found.append(f"{self.given / 'metrics'} lacks {which}: a seed without a log counts as not started.")
        return [sentence for sentence in found if sentence is not None]

    def last_rows(self, seed: int) -> list[Row]:
        """The last entries of a seed's log. The run may still be training.

        Raises:
            UserError: the log cannot be read.
        """
        return records.last_rows(self._metrics(seed))

    def _metrics(self, seed: int) -> pathlib.Path:
        return self.folder / "metrics" / f"seed-{seed}.jsonl"

    def has_diverged(self, seed: int) -> bool:
        """Whether a seed has diverged."""
        return any(self.rows(seed, "diverged"))

    def results(self) -> Row | None:
        """The summary of the last evaluation before the training ended or was stopped; None before that.

        Raises:
            UserError: results.json is damaged.
        """
        path = self.folder / "results.json"
        if not path.exists():
            return None
        results = records.parsed(path)
        if not records.is_summary(results, len(self.seeds)):
            raise UserError(f"{self.given / path.name} is damaged: restore it from a copy, or remove it.")
        return results

    def reached(self, line: float | None, patience: int) -> bool:
        """Whether the mean returns of every seed (sampled actions) are at least `line` in the last evaluations.

        These are the last `patience` evaluations. Seeds that have diverged do not count. False without a line.

        Raises:
            UserError: a log cannot be read.
        """
        if line is None:
            return False
        going = [seed for seed in self.seeds if not self.has_diverged(seed)]
        returns = [[fmean(row["sampled"]) for row in self.rows(seed, "evaluation")][-patience:] for seed in going]
        return bool(going) and all(len(last) == patience and min(last) >= line for last in returns)

    def is_complete(self, options: Options) -> bool:
        """Whether the training ended at the last step of `options`, or reached their `stop_at`, and wrote its results.

        A log alone is not enough: the run may have been killed before it wrote its checkpoint.

        Raises:
            UserError: results.json is damaged, or a log cannot be read.
        """
        results = self.results()
        if results is None:
            return False
        return (results.get("step") or 0) >= options.steps or self.reached(options.stop_at, options.stop_patience)

    def load(self, like: Any, best: bool = False) -> Any:
        """The agents of the last evaluation, or the best ones, in a tree of the structure, shapes and types of `like`.

        Raises:
            UserError: no agent was saved yet, or the file is damaged or does not fit `like`.
        """
        return arrays.read(self.agents(best), like)

    def agents(self, best: bool = False) -> pathlib.Path:
        """The file of the agents of the last evaluation, or of the best ones.

        Raises:
            UserError: it does not exist.
        """
        path = self.folder / (BEST if best else "agent.safetensors")
        if path.exists():
            return path
        if best and any(row for seed in self.seeds for row in self.rows(seed, "evaluation")):
            raise UserError(f"{self.shown} has only its last agent: leave out --best, in Python best=.")
        which = "best" if best else "trained"
        raise UserError(f"{self.shown} has no {which} agent yet: it is saved at the first evaluation.")
