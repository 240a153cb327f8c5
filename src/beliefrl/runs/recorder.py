"""Writing a run's folder while it is trained (`run` describes the files). Only one process can write it."""

import contextlib
import json
import os
from collections.abc import Collection
from typing import Any

import numpy as np

from beliefrl.errors import UserError, cause
from beliefrl.runs import arrays, records, trackers
from beliefrl.runs.arrays import write_whole
from beliefrl.runs.folder import locked, make, write_config
from beliefrl.runs.given_files import as_path
from beliefrl.runs.records import Row, now
from beliefrl.runs.run import Run
from beliefrl.runs.trackers import Tracker


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
        self.has_begun = config is not None  # otherwise `rewind` begins the session
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
        """Record the time at which this session ends, if it has begun. A full disk is ignored."""
        if not self.has_begun:
            return
        records.sessions(self.config)[-1]["ended"] = now()
        with contextlib.suppress(OSError):
            write_config(self.folder, self.config)

    def amend(self, changes: dict[str, Any], session: dict[str, Any]) -> None:
        """Change the config, and append a session to its `resumed`. `rewind` writes it, when this session begins."""
        self.config |= changes
        self.config["resumed"] = [*self.config.get("resumed", ()), session]

    def lengths(self) -> dict[int, int]:
        """Flush the log of each seed to the disk; returns the sizes of the logs in bytes."""
        for lines in self._lines.values():
            lines.flush()
            os.fsync(lines.fileno())
        return {seed: self._metrics(seed).stat().st_size for seed in self.seeds}

    def rewind(self, lengths: dict[int, int]) -> None:
        """Begin a session: truncate the log of each seed to its length in bytes, and write the config.

        New entries are appended there.

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
        write_config(self.folder, self.config)
        self.has_begun = True
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
