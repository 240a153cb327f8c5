"""A run's folder: what a training leaves behind. Knows files, no reinforcement learning.

    config.json           agent, task, options, versions, git commit, command line
    metrics/seed-0.jsonl  a line for every entry: {"step", "kind": "update" | "episode" | "evaluation", ...}
    tensorboard/seed-0/   the same as TensorBoard events
    agent.safetensors     the agents of all seeds at the last evaluation (leading axis: seed); plain arrays, no code
    results.json          the returns of the last evaluation
    curve.png             the learning curve

Lines are written out one by one, so a killed training loses at most the line it was writing, which `rows` skips.
"""

import json
import os
import pathlib
import re
import shutil
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np

from beliefrl import arrays, trackers
from beliefrl.arrays import write_whole
from beliefrl.provenance import now
from beliefrl.trackers import Tracker
from beliefrl.types import UserError

Row = dict[str, Any]


class Run:
    """A run's folder, to be read."""

    def __init__(self, folder: str | os.PathLike[str]):
        """Open a folder that a training made.

        Raises:
            UserError: it does not exist, no training made it, or it is no path.
        """
        if not isinstance(folder, str | os.PathLike):
            raise UserError(f"{folder!r} is not a run: give a run, or the path of its folder.")
        self.folder = pathlib.Path(folder)
        if not os.path.isdir(self.folder):  # noqa: PTH112 - pathlib's raises where a name is too long
            raise UserError(f"There is no run folder {self.folder}: give the --out of a training.")
        path = self.folder / "config.json"
        try:
            self.config: dict[str, Any] = json.loads(path.read_text())
        except FileNotFoundError:
            raise UserError(
                f"{self.folder} is not a run: it has no config.json; give the --out of a training."
            ) from None
        except (OSError, ValueError):
            raise UserError(f"{path} cannot be read as JSON: restore it, or train again.") from None
        if not _is_complete(self.config):
            raise UserError(f"{path} lacks what a training writes there: restore it, or train again.")

    @property
    def seeds(self) -> list[int]:
        """The numbers of the run's seeds."""
        first, count = self.config["options"]["seed"], self.config["options"]["seeds"]
        return list(range(first, first + count))

    def rows(self, seed: int, kind: str | None = None) -> Iterator[Row]:
        """The log of a seed in the order it was written; of one kind, if given.

        Raises:
            UserError: a line is not what a training writes.
        """
        path = self._metrics(seed)
        if not path.exists():
            return
        with path.open(errors="replace") as lines:
            for number, line in enumerate(lines, 1):
                if line.endswith("\n"):
                    row = _parsed(line, f"Line {number} of {path}", ("step", "kind"))
                    if kind in (None, row["kind"]):
                        yield row

    def last_rows(self, seed: int, size: int = 32_768) -> list[Row]:
        """The entries in the last `size` bytes of a seed's log, of a run that may be going on."""
        path = self._metrics(seed)
        if not path.exists():
            return []
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - size))
            lines = file.read().decode(errors="replace").split("\n")
        whole = lines[:-1] if path.stat().st_size <= size else lines[1:-1]
        return [_parsed(line, str(path), ("step", "kind")) for line in whole]

    def _metrics(self, seed: int) -> pathlib.Path:
        return self.folder / "metrics" / f"seed-{seed}.jsonl"

    def results(self) -> Row | None:
        """The summary of the last evaluation; None before there was one.

        Raises:
            UserError: it is not what a training writes.
        """
        path = self.folder / "results.json"
        return _parsed(path.read_text(errors="replace"), str(path), ()) if path.exists() else None

    def load(self, like: Any) -> Any:
        """The saved agents, in a tree of the structure, shapes and types of `like`.

        Raises:
            UserError: nothing was saved yet, or what was saved is damaged or of another shape.
        """
        path = self.folder / "agent.safetensors"
        if not path.exists():
            raise UserError(f"{self.folder} has no trained agent yet: it is saved at the first evaluation.")
        return arrays.read(path, like)


class Recorder(Run):
    """A run's folder, to be written by this process alone."""

    def __init__(self, folder: str | os.PathLike[str], config: dict[str, Any] | None):
        """Make the folder; without a config, go on with one that exists.

        Raises:
            UserError: it exists already, or cannot be made; or does not exist, or another process writes it.
        """
        folder = pathlib.Path(folder)
        if config is not None:
            _make(folder, config)
        super().__init__(folder)
        self._lock = locked(folder, "is being trained")
        self._lines: dict[int, Any] = {}
        self._trackers: dict[int, list[Tracker]] = {}
        if config is not None:
            self._open()

    def _open(self) -> None:
        self._lines = {seed: self._metrics(seed).open("a", buffering=1) for seed in self.seeds}
        track = self.config["options"].get("track", ("tensorboard",))
        self._trackers = {seed: trackers.open_all(track, self.folder, seed, self.config) for seed in self.seeds}

    def note_end(self) -> None:
        """Write down when this process has ended with the run."""
        session = self.config["resumed"][-1] if self.config.get("resumed") else self.config
        session["ended"] = now()
        _write_config(self.folder, self.config)

    def amend(self, changes: dict[str, Any], session: dict[str, Any]) -> None:
        """Change the config, and add what goes on with the run to its `resumed`."""
        self.config |= changes
        self.config["resumed"] = [*self.config.get("resumed", ()), session]
        _write_config(self.folder, self.config)

    def lengths(self) -> dict[int, int]:
        """Bytes in the log of each seed, which are on the disk then."""
        for lines in self._lines.values():
            lines.flush()
            os.fsync(lines.fileno())
        return {seed: self._metrics(seed).stat().st_size for seed in self.seeds}

    def rewind(self, lengths: dict[int, int]) -> None:
        """Cut the log of each seed back to so many bytes, and go on from there.

        Raises:
            UserError: a log is shorter.
        """
        for seed, length in lengths.items():
            path = self._metrics(seed)
            if not path.exists() or path.stat().st_size < length:
                raise UserError(f"{path} is shorter than when the checkpoint was written: restore it from a copy.")
            os.truncate(path, length)
        self._open()
        for seed in self.seeds:
            whole = [tracker for tracker in self._trackers[seed] if tracker.is_whole]
            for row in self.rows(seed) if whole else ():
                _tell(whole, row["kind"], row["step"], row)

    def log(self, seed: int, kind: str, step: int, values: Row) -> None:
        """Write one entry of a seed; numbers go to its trackers as well, of lists their mean."""
        self._lines[seed].write(json.dumps({"step": step, "kind": kind, **values}) + "\n")
        _tell(self._trackers[seed], kind, step, values)

    def flush(self) -> None:
        """Bring everything logged so far onto the disk."""
        for of_seed in self._trackers.values():
            for tracker in of_seed:
                tracker.flush()

    def save(self, agents: Any, but: Collection[int] = ()) -> None:
        """Save the agents of all seeds but some, of which what was saved before stays; whole or not at all."""
        path, saved = self.folder / "agent.safetensors", arrays.copied(agents)
        before = arrays.load(path) if but and path.exists() else {}
        for name, kept in before.items():
            saved[name][sorted(but)] = kept[sorted(but)]
        write_whole(path, arrays.packed(saved))

    def finish(self, results: Row) -> None:
        """Write the summary of the last evaluation."""
        write_whole(self.folder / "results.json", (json.dumps(results, indent=2) + "\n").encode())

    def close(self) -> None:
        """Close the logs, and let others write the folder."""
        for writer in (*self._lines.values(), *(each for of_seed in self._trackers.values() for each in of_seed)):
            writer.close()
        self._lock.close()


def _tell(told: list[Tracker], kind: str, step: int, values: Row) -> None:
    numbers = {
        f"{kind}/{name}": float(np.mean(value))
        for name, value in values.items()
        if name not in ("step", "kind") and isinstance(value, int | float | list)
    }
    for tracker in told:
        tracker.log(step, numbers)


def _parsed(text: str, what: str, keys: tuple[str, ...]) -> Row:
    """An object of JSON with these keys; an empty one will do."""
    try:
        row = json.loads(text)
    except ValueError:
        row = None
    if not isinstance(row, dict) or (row and not all(key in row for key in keys)):
        raise UserError(f"{what} is damaged: restore it from a copy, or remove it.")
    return row


def _make(folder: pathlib.Path, config: dict[str, Any]) -> None:
    try:
        folder.mkdir(parents=True)
        (folder / "metrics").mkdir()
        _write_config(folder, config)
    except FileExistsError:
        raise UserError(f"{folder} exists already: choose another --out, or `beliefrl resume {folder}`.") from None
    except OSError as error:
        raise UserError(f"The run folder {folder} cannot be made ({error.strerror}): choose another --out.") from None


def _write_config(folder: pathlib.Path, config: dict[str, Any]) -> None:
    write_whole(folder / "config.json", (json.dumps(config, indent=2, default=str) + "\n").encode())


def clear(folder: pathlib.Path) -> None:
    """Remove what a training left that was killed before its first checkpoint, so that it can begin anew.

    Raises:
        UserError: another process writes it, it holds results, or no training made it.
    """
    begun = (folder / "config.json").exists() and not (folder / "results.json").exists()
    bare = all(path.name in ("metrics", ".config.json.tmp") for path in folder.rglob("*"))
    if not (begun or bare):
        raise UserError(f"{folder} exists already, with nothing to go on from: choose another --out.")
    with locked(folder, "is being trained"):
        shutil.rmtree(folder)


def locked(folder: pathlib.Path, doing: str) -> Any:
    """An open file that no other process can lock; the system lets go of it when this one ends, however it ends.

    Raises:
        UserError: the folder cannot be written, or another process is doing something with it.
    """
    try:
        file = (folder / "lock").open("a+")
    except OSError as error:
        raise UserError(f"{folder} cannot be written ({error.strerror}): make it writable, or copy it.") from None
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:  # not on this system
        return file
    except OSError:
        file.seek(0)
        who = file.read().strip() or "another"
        file.close()
        raise UserError(f"{folder} {doing} by process {who}: stop it, or wait until it has ended.") from None
    file.truncate(0)
    file.write(str(os.getpid()))
    file.flush()
    return file


def _is_complete(config: Any) -> bool:
    """Whether a config.json holds what is read from it."""
    kinds = {"agent": str, "hyperparameters": dict, "task": str, "constants": dict, "options": dict}
    if not isinstance(config, dict) or not all(isinstance(config.get(key), kind) for key, kind in kinds.items()):
        return False
    return all(isinstance(config["options"].get(key), int) for key in ("seed", "seeds"))


def free_folder(name: str, parent: str = "runs") -> pathlib.Path:
    """The first of runs/NAME-1, runs/NAME-2, ... that does not exist; what no file is called becomes a dash."""
    number, name = 1, re.sub(r"[^\w.-]+", "-", name)
    while (folder := pathlib.Path(parent) / f"{name}-{number}").exists():
        number += 1
    return folder
