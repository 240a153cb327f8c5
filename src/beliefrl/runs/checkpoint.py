"""Checkpoints: the whole state of a training, written atomically. This file handles trees of arrays only.

    checkpoints/
      000004-step-12000/     renamed to this name once all of its files are on the disk
        manifest.json        {"content": {"format", "step", "progress", "files", "replay"}, "sha256": of the content}
        state.safetensors    every array of the training except the replay's timesteps
      replay/000003.safetensors   the timesteps added between two checkpoints; later checkpoints use it too

Timesteps are only added at the end of a replay. So a checkpoint writes only the new ones, and its cost does not grow.
The manifest has the size and SHA-256 of each file: a damaged checkpoint is detected, and the one before it is used.
Files are plain numbers and JSON: reading them runs no code.
"""

import hashlib
import itertools
import json
import math
import operator
import os
import pathlib
import re
import shutil
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np

from beliefrl.runs import arrays
from beliefrl.runs.arrays import Damaged, sync_folder, write_whole
from beliefrl.types import UserError

FORMAT = 1
NUMBER = "[0-9][0-9][0-9][0-9][0-9][0-9]"


class Found(NamedTuple):
    """A checkpoint that was read."""

    step: int
    progress: dict[str, Any]
    tree: Any
    timesteps: Any  # numpy, leaves (*rings, capacity, ...)
    missing: (
        np.ndarray
    )  # (*rings,), how many of the first timesteps ever added are in no file; the rings do without them
    passed_over: list[str]  # one sentence for each newer checkpoint, which is damaged


class Segment(NamedTuple):
    """A file with timesteps `start` to `stop` of every ring, counted from the first that was ever added."""

    file: str
    start: list[int]
    stop: list[int]
    size: int
    sha256: str


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
        state, new = arrays.copied(tree), self._new_timesteps(timesteps, added)
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

    def _new_timesteps(
        self, timesteps: Any, added: np.ndarray
    ) -> tuple[list[int], list[int], int, dict[str, np.ndarray]]:
        """Start, stop, capacity and the timesteps that are in no file yet, (ring, new). Shorter rings are padded."""
        capacity = jax.tree.leaves(timesteps)[0].shape[added.ndim]
        stop = [int(number) for number in added.flat]
        written = self._segments[-1].stop if self._segments else [0] * len(stop)
        start = [max(old, new - capacity) for old, new in zip(written, stop, strict=True)]
        longest = max(new - old for old, new in zip(start, stop, strict=True))
        index = (np.array(start)[:, None] + np.arange(longest)) % capacity
        rings = (axis[:, None] for axis in np.unravel_index(np.arange(len(stop)), added.shape))
        where = (*rings, index)
        return start, stop, capacity, arrays.copied(jax.tree.map(lambda leaf: _on_host(leaf)[where], timesteps))

    def _write(self, step: int, progress: dict[str, Any], state: dict[str, np.ndarray], new: Any) -> None:
        start, stop, capacity, timesteps = new
        replay = self.folder / "replay"
        replay.mkdir(parents=True, exist_ok=True)
        if stop != (self._segments[-1].stop if self._segments else None):
            path, content = replay / f"{_next_number(replay):06d}.safetensors", arrays.packed(timesteps)
            write_whole(path, content)
            self._segments.append(Segment(path.name, start, stop, len(content), _sha256(content)))
            oldest = [number - capacity for number in stop]
            alive = (any(map(operator.gt, segment.stop, oldest)) for segment in self._segments)
            self._segments = list(itertools.compress(self._segments, alive))
        final = self.folder / f"{_next_number(self.folder):06d}-step-{step}"
        temporary = self.folder / f".{final.name}.tmp"
        for left in self.folder.glob(".*.tmp"):  # left by a process that was killed
            shutil.rmtree(left)
        temporary.mkdir()
        content = arrays.packed(state)
        write_whole(temporary / "state.safetensors", content)
        files = {"state.safetensors": {"size": len(content), "sha256": _sha256(content)}}
        segments = [segment._asdict() for segment in self._segments]
        manifest = {"format": FORMAT, "step": step, "progress": progress, "files": files, "replay": segments}
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
        except Damaged:  # nobody knows which files it needs
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
        passed_over = []
        for path in self._listed():
            try:
                content = self._checked(path)
            except Damaged as error:
                passed_over.append(str(error))
                path.rename(path.with_name(f"damaged-{path.name}"))
                continue
            tree = arrays.read(path / "state.safetensors", like, renamed)
            self._segments = [Segment(**segment) for segment in content["replay"]]
            rings, missing = self._timesteps(timesteps, self._segments, axes)
            if missing.any():  # the rings are numbered anew, so the files do not continue them
                self._segments = []
            return Found(content["step"], content["progress"], tree, rings, missing, passed_over)
        why = f": {passed_over[0]}" if passed_over else "."
        raise UserError(f"{self.folder.parent} has no checkpoint to continue from{why}")

    def _checked(self, path: pathlib.Path) -> dict[str, Any]:
        """The manifest. Every file that it names has been checked."""
        content = _content(path)
        if content.get("format") != FORMAT:
            raise UserError(
                f"{path} was written in format {content.get('format')}, and this version of BeliefRL reads {FORMAT}: "
                "resume with the version that config.json names."
            )
        for name, file in content["files"].items():
            _check(path / name, file["size"], file["sha256"])
        for segment in content["replay"]:
            _check(self.folder / "replay" / segment["file"], segment["size"], segment["sha256"])
        return content

    def _timesteps(self, like: Any, segments: list[Segment], axes: int) -> tuple[Any, np.ndarray]:
        """The rings, and how many timesteps each has lost at its beginning.

        A ring that has become larger may ask for timesteps that were overwritten before they were saved. It is numbered
        from its first saved timestep on.
        """
        shape = jax.tree.leaves(like)[0].shape[: axes + 1]
        begin = np.array(segments[0].start if segments else np.zeros(math.prod(shape[:-1]), int))
        stop = np.array(segments[-1].stop) if segments else begin
        missing = np.where((begin > np.maximum(stop - shape[-1], 0)).any(), begin, 0)
        rings = jax.tree.map(
            lambda leaf: np.zeros((math.prod(leaf.shape[:axes]), *leaf.shape[axes:]), leaf.dtype), like
        )
        for segment in segments:
            path = self.folder / "replay" / segment.file
            saved = arrays.load(path)
            for where, ring in jax.tree_util.tree_leaves_with_path(rings):
                name = jax.tree_util.keystr(where)
                if name not in saved or saved[name].shape[2:] != ring.shape[2:]:
                    raise arrays.misfit(path, name)
                for number, (start, stop) in enumerate(zip(segment.start, segment.stop, strict=True)):
                    index = (np.arange(start, stop) - missing[number]) % ring.shape[1]
                    ring[number, index] = saved[name][number, : stop - start]
        return jax.tree.map(lambda ring, leaf: ring.reshape(leaf.shape), rings, like), missing.reshape(shape[:-1])


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


def _on_host(leaf: Any) -> Any:
    """On a CPU a view of JAX's memory, without a copy. On other devices the array itself, which is indexed there."""
    return np.asarray(leaf) if jax.default_backend() == "cpu" else leaf


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _canonical(content: dict[str, Any]) -> bytes:
    return json.dumps(content, sort_keys=True).encode()


def _signed(content: dict[str, Any]) -> bytes:
    return json.dumps({"content": content, "sha256": _sha256(_canonical(content))}, indent=1).encode()


def _content(path: pathlib.Path) -> dict[str, Any]:
    """The content of a checkpoint's manifest."""
    try:
        signed = json.loads((path / "manifest.json").read_bytes())
        if _sha256(_canonical(signed["content"])) == signed["sha256"]:
            return signed["content"]
    except (OSError, ValueError, KeyError, TypeError):
        pass
    raise Damaged(f"{path / 'manifest.json'} is damaged.")


def _check(path: pathlib.Path, size: int, sha256: str) -> None:
    try:
        content = path.read_bytes()
    except OSError:
        content = b""
    if len(content) != size or _sha256(content) != sha256:
        raise Damaged(f"{path} is damaged.")
