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

import contextlib
import dataclasses
import json
import os
import pathlib
from collections.abc import Collection, Iterator
from statistics import fmean
from typing import Any

import numpy as np

from beliefrl.runs import arrays, records, trackers
from beliefrl.runs.arrays import write_whole
from beliefrl.runs.best import BEST
from beliefrl.runs.folder import locked, make, write_config
from beliefrl.runs.given_files import as_path
from beliefrl.runs.options import Options
from beliefrl.runs.records import Row, now
from beliefrl.runs.trackers import Tracker
from beliefrl.types import UserError, cause, one_line, tuples


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
        known = {field.name for field in dataclasses.fields(Options)}
        given = tuples(self.config["options"])
        return Options(**{name: value for name, value in given.items() if name in known})

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


class Recorder(Run):
    """A run's folder, for writing. Only this process can write it."""

    def __init__(self, folder: str | os.PathLike[str], config: dict[str, Any] | None):
        """Make the folder. Without a config, open an existing one.

        Raises:
            UserError: the folder exists already or cannot be made (with a config), does not exist (without), or is
                written by another process; or a tracker cannot be opened.
        """
        if config is not None:
            make(as_path(folder), config)
        super().__init__(folder)
        self._lock = locked(self.folder, "is being trained")
        self._lines: dict[int, Any] = {}
        self._trackers: dict[int, list[Tracker]] = {}
        if config is not None:
            with contextlib.ExitStack() as stack:
                stack.push(self)
                self._open()
                stack.pop_all()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except Exception:
            if kind is None:  # otherwise the first error is reported
                raise

    def _open(self) -> None:
        track = self.config["options"].get("track", ("tensorboard",))
        for seed in self.seeds:
            path = self._metrics(seed)
            try:
                self._lines[seed] = path.open("a", buffering=1)
            except OSError as error:
                raise UserError(f"{path} cannot be written ({cause(error)}): fix the cause, then try again.") from None
            self._trackers[seed] = trackers.open_all(track, self.folder, seed, self.config)

    def note_end(self) -> None:
        """Record the time at which this session ends. A full disk is ignored."""
        records.sessions(self.config)[-1]["ended"] = now()
        with contextlib.suppress(OSError):
            write_config(self.folder, self.config)

    def amend(self, changes: dict[str, Any], session: dict[str, Any]) -> None:
        """Change the config, and append a session to its `resumed`."""
        self.config |= changes
        self.config["resumed"] = [*self.config.get("resumed", ()), session]
        write_config(self.folder, self.config)

    def lengths(self) -> dict[int, int]:
        """Flush the log of each seed to the disk; returns the sizes of the logs in bytes."""
        for lines in self._lines.values():
            lines.flush()
            os.fsync(lines.fileno())
        return {seed: self._metrics(seed).stat().st_size for seed in self.seeds}

    def rewind(self, lengths: dict[int, int]) -> None:
        """Truncate the log of each seed to its length in bytes. New entries are appended there.

        Raises:
            UserError: a log is shorter than that.
        """
        for seed, length in lengths.items():
            path = self._metrics(seed)
            size = path.stat().st_size if path.exists() else 0
            if size < length:
                raise UserError(f"{path} is shorter than when the checkpoint was written: restore it from a copy.")
            if size > length:
                os.truncate(path, length)
        self._open()
        for seed in self.seeds:
            whole = [tracker for tracker in self._trackers[seed] if tracker.is_whole]
            for row in self.rows(seed) if whole else ():
                _track(whole, row["kind"], row["step"], row)

    def log(self, seed: int, kind: str, step: int, values: Row) -> None:
        """Write one entry of a seed. Its trackers receive the numbers, and the means of lists."""
        self._lines[seed].write(json.dumps({"step": step, "kind": kind, **values}) + "\n")
        _track(self._trackers[seed], kind, step, values)

    def flush(self) -> None:
        """Flush the trackers."""
        for tracker in (each for of_seed in self._trackers.values() for each in of_seed):
            tracker.flush()

    def save(self, agents: Any, but: Collection[int] = (), step: int | None = None) -> None:
        """Save the agents of all seeds at a step atomically; those of the seeds `but` (indices) are not changed."""
        path, saved = self.folder / "agent.safetensors", arrays.copied(agents)
        try:
            before = arrays.load(path) if but and path.exists() else {}
        except arrays.Damaged:  # moved aside
            path.replace(self.folder / f"damaged-{path.name}")
            before = {}
        for name, kept in before.items():
            saved[name][sorted(but)] = kept[sorted(but)]
        write_whole(path, arrays.packed(saved, None if step is None else {"step": str(step)}))

    def finish(self, results: Row) -> None:
        """Write the summary of the last evaluation."""
        write_whole(self.folder / "results.json", (json.dumps(results, indent=2) + "\n").encode())

    def close(self) -> None:
        """Close logs and trackers, and unlock the folder. All are closed, even if closing one of them fails."""
        with contextlib.ExitStack() as stack:
            stack.callback(self._lock.close)
            for writer in (*self._lines.values(), *(each for of_seed in self._trackers.values() for each in of_seed)):
                stack.callback(writer.close)


def _track(trackers: list[Tracker], kind: str, step: int, values: Row) -> None:
    numbers = {
        f"{kind}/{name}": float(np.mean(value))
        for name, value in values.items()
        if name not in ("step", "kind") and isinstance(value, int | float | list)
    }
    for tracker in trackers:
        tracker.log(step, numbers)
