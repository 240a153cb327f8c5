"""Checkpoints: the whole state of a training, written atomically. This module handles trees of arrays only.

    checkpoints/
      000004-step-12000/     renamed to this name once all of its files are on the disk
        manifest.json        {"content": {"format", "step", "progress", "files", "replay"}, "sha256": of the content}
        state.safetensors    every array of the training except the replay's timesteps
      replay/000003.safetensors   the timesteps added between two checkpoints; later checkpoints use it too

Timesteps are only added at the end of a replay. So a checkpoint writes only the new ones, and its cost does not grow.
The manifest has the size and SHA-256 of each file: a damaged checkpoint is detected, and the one before it is used.
Files are plain numbers and JSON: reading them runs no code.
"""

import contextlib
import hashlib
import json
import os
import pathlib
import re
import shutil
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from beliefrl.errors import UserError
from beliefrl.runs import arrays, segments
from beliefrl.runs.arrays import Damaged, sync_folder, write_whole
from beliefrl.runs.segments import New, Segment

FORMAT = 1
NUMBER = "[0-9][0-9][0-9][0-9][0-9][0-9]"


class Found(NamedTuple):
    """A checkpoint that was read."""

    step: int
    progress: dict[str, Any]
    tree: Any
    timesteps: Any  # numpy, leaves (*rings, capacity, ...)
    missing: np.ndarray  # (*rings,), how many of the first timesteps are lost: in no file and not in the rings
    passed_over: list[str]  # one sentence for each newer checkpoint, which is damaged


class Checkpoints:
    """The checkpoints of one run, written by a thread while the training continues."""

    def __init__(self, folder: pathlib.Path, keep: int):
        """The checkpoints are in `folder`/checkpoints. The last `keep` of them are kept."""
        self.folder, self.keep = folder / "checkpoints", keep
        self._segments: list[Segment] = []
        self._thread = ThreadPoolExecutor(1, "checkpoint")
        self._writing: Future[None] | None = None

    def save(self, step: int, progress: dict[str, Any], tree: Any, timesteps: Any, added: np.ndarray) -> None:
        """Copy everything, and start to write it in the thread.

        Args:
            step: the environment step, part of the checkpoint's name.
            progress: everything else that is needed to continue, as values for JSON.
            tree: all arrays except the timesteps.
            timesteps: leaves (*rings, capacity, ...): ring buffers.
            added: the number of timesteps that were ever added to each ring; its shape is *rings.

        Raises:
            OSError: the previous checkpoint could not be written.
        """
        self.wait()
        if not segments.are_there(self.folder / "replay", self._segments):  # someone has removed files
            self._segments = []
        state, new = arrays.copied(tree), segments.new(timesteps, added, self._segments)
        self._writing = self._thread.submit(self._write, step, progress, state, new)

    def forget_timesteps(self) -> None:
        """Make the next checkpoint write all timesteps again, because they have changed."""
        self.wait()
        self._segments = []

    def wait(self) -> None:
        """Wait until the last `save` is written.

        Raises:
            OSError: it could not be written.
        """
        writing, self._writing = self._writing, None
        if writing is not None:
            writing.result()

    def close(self) -> None:
        """Wait for the last `save`, and end the thread."""
        try:
            self.wait()
        finally:
            self._thread.shutdown()

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()

    def keep_for(self, name: str) -> pathlib.Path | None:
        """Keep a copy of the last checkpoint permanently; returns its folder, or None if there is no checkpoint."""
        self.wait()
        found = self._listed()
        if not found:
            return None
        kept = self.folder / f"kept-for-{name}"
        temporary = self.folder / f".{kept.name}.tmp"
        for old in (temporary, kept):  # left by a kill; of an earlier time
            shutil.rmtree(old, ignore_errors=True)
        shutil.copytree(found[0], temporary, copy_function=_linked)
        temporary.rename(kept)
        return kept

    def abandon(self) -> None:
        """End the thread after the last `save`, and ignore errors of writing it."""
        self._thread.shutdown()

    # Writing

    def _write(self, step: int, progress: dict[str, Any], state: dict[str, np.ndarray], new: New) -> None:
        replay = self.folder / "replay"
        replay.mkdir(parents=True, exist_ok=True)
        if new.stop != (self._segments[-1].stop if self._segments else None):
            path, content = replay / f"{_next_number(replay):06d}.safetensors", arrays.packed(new.timesteps)
            write_whole(path, content)
            written = Segment(path.name, new.start, new.stop, len(content), _sha256(content))
            self._segments = segments.needed([*self._segments, written], new.capacity)
        final = self.folder / f"{_next_number(self.folder):06d}-step-{step}"
        temporary = self.folder / f".{final.name}.tmp"
        for left in self.folder.glob(".*.tmp"):  # left by a process that was killed
            shutil.rmtree(left)
        temporary.mkdir()
        content = arrays.packed(state)
        write_whole(temporary / "state.safetensors", content)
        files = {"state.safetensors": {"size": len(content), "sha256": _sha256(content)}}
        named = [segment._asdict() for segment in self._segments]
        manifest = {"format": FORMAT, "step": step, "progress": progress, "files": files, "replay": named}
        write_whole(temporary / "manifest.json", _signed(manifest))
        temporary.rename(final)
        sync_folder(self.folder)
        self._prune()

    def _prune(self) -> None:
        """Remove all but the last checkpoints, and files of timesteps that none of these uses."""
        kept = self._listed()[: self.keep]
        for path in self._listed()[self.keep :]:
            shutil.rmtree(path)
        kept += self.folder.glob("kept-*")
        try:
            named = {segment["file"] for path in kept for segment in _content(path)["replay"]}
        except UserError:  # nobody knows which files it needs
            return
        for path in (self.folder / "replay").iterdir():
            if path.name not in named:
                path.unlink()

    # Reading

    def _listed(self) -> list[pathlib.Path]:
        """The checkpoints, the newest first."""
        return sorted(listed(self.folder.parent), reverse=True)

    def restore(
        self, like: Any, timesteps: Any, renamed: Mapping[str, str] = MappingProxyType({}), axes: int = 1
    ) -> Found:
        """Read the newest undamaged checkpoint. The next `save` writes only what is newer.

        Args:
            like: a tree with the structure, shapes and types of the saved one.
            timesteps: the same for the ring buffers, whose capacity may have changed.
            renamed: names of arrays in checkpoints of older versions, by their present names.
            axes: the number of axes of *rings, before that of the capacity.

        Raises:
            UserError: there is no undamaged checkpoint, or it is from another training or version.
        """
        passed_over: dict[pathlib.Path, str] = {}
        for path in self._listed():
            try:
                content = checked(path)
            except Damaged as error:
                passed_over[path] = str(error)
                continue
            tree = arrays.read(path / "state.safetensors", like, renamed)
            self._segments = [Segment(**segment) for segment in content["replay"]]
            rings, missing = segments.read(self.folder / "replay", timesteps, self._segments, axes)
            if missing.any():  # the rings are numbered anew, so the files do not continue them
                self._segments = []
            for damaged in passed_over:  # only now: if there is none to go on from, a missing file may come back
                damaged.rename(damaged.with_name(f"damaged-{damaged.name}"))
            return Found(content["step"], content["progress"], tree, rings, missing, list(passed_over.values()))
        why = f": {next(iter(passed_over.values()))}" if passed_over else "."
        raise UserError(f"{self.folder.parent} has no checkpoint to continue from{why}")


def stored_timesteps(folder: pathlib.Path) -> tuple[int, list[Segment]]:
    """The step of a run's newest undamaged checkpoint, and its files of timesteps. Nothing in `folder` changes.

    Raises:
        UserError: there is no checkpoint, all are damaged, or the newest is from another version.
    """
    found = listed(folder)
    for path in reversed(found):
        with contextlib.suppress(Damaged):
            content = checked(path)
            return content["step"], [Segment(**segment) for segment in content["replay"]]
    which = "undamaged checkpoint" if found else "checkpoint yet"
    raise UserError(f"{folder} has no {which}, so it cannot give its replay: leave init_replay out.")


def listed(folder: pathlib.Path) -> list[pathlib.Path]:
    """The checkpoints in a run's folder, damaged or not."""
    return sorted((folder / "checkpoints").glob(f"{NUMBER}-step-*"))


def was_ever_written(folder: pathlib.Path) -> bool:
    """Whether a run's folder has or had a checkpoint; an incomplete first one does not count."""
    inside = (path.name for path in (folder / "checkpoints").glob("*"))
    return any(name != "replay" and not name.startswith(".") for name in inside)


def _next_number(folder: pathlib.Path) -> int:
    """One more than the largest number of a file here, so that no file is ever replaced."""
    found = (re.match(r"(?:damaged-)?(\d{6})[-.]", path.name) for path in folder.iterdir())
    return max((int(number[1]) for number in found if number), default=0) + 1


def _linked(source: str, target: str) -> None:
    """A hard link to a file; a copy where the file system has none."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _canonical(content: dict[str, Any]) -> bytes:
    return json.dumps(content, sort_keys=True).encode()


def _signed(content: dict[str, Any]) -> bytes:
    content = json.loads(json.dumps(content))  # all keys are text, so they have the same order when they are read
    return json.dumps({"content": content, "sha256": _sha256(_canonical(content))}, indent=1).encode()


def checked(path: pathlib.Path) -> dict[str, Any]:
    """The content of a checkpoint's manifest. Every file that it names has been checked."""
    content = _content(path)
    if content.get("format") != FORMAT:
        raise UserError(
            f"{path} was written in format {content.get('format')}, and this version of BeliefRL reads {FORMAT}: "
            "use the version that config.json names."
        )
    for name, file in content["files"].items():
        _check(path / name, file["size"], file["sha256"])
    for segment in content["replay"]:
        _check(path.parent / "replay" / segment["file"], segment["size"], segment["sha256"])
    return content


def _content(path: pathlib.Path) -> dict[str, Any]:
    """The content of a checkpoint's manifest."""
    try:
        signed = json.loads((path / "manifest.json").read_bytes())
        content, signature = signed["content"], signed["sha256"]
        if _sha256(_canonical(content)) == signature or _sha256(_canonical(_until_0_3(content))) == signature:
            return content
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
        pass
    except OSError as error:
        raise arrays.unreadable(path / "manifest.json", error) from None
    raise Damaged(f"{path / 'manifest.json'} is damaged.")


def _until_0_3(content: dict[str, Any]) -> dict[str, Any]:
    """The content as version 0.3.0 signed it: seeds were numbers, so 9 came before 10."""
    metrics = {int(seed): length for seed, length in content["progress"].get("metrics", {}).items()}
    return content | {"progress": content["progress"] | {"metrics": metrics}}


def _check(path: pathlib.Path, size: int, sha256: str) -> None:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise Damaged(f"{path} is missing.") from None
    except OSError as error:
        raise arrays.unreadable(path, error) from None
    if len(content) != size or _sha256(content) != sha256:
        raise Damaged(f"{path} is damaged.")
