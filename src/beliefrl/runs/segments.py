"""The files with a replay's timesteps. Each has those that were added between two checkpoints."""

import itertools
import math
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from beliefrl.runs import arrays


class Segment(NamedTuple):
    """A file with timesteps `start` to `stop` of every ring, counted from the first that was ever added."""

    file: str
    start: list[int]
    stop: list[int]
    size: int
    sha256: str


class New(NamedTuple):
    """The timesteps that are in no file yet: `start` to `stop` of every ring."""

    start: list[int]
    stop: list[int]
    capacity: int
    timesteps: dict[str, np.ndarray]  # (ring, new, ...); shorter rings are padded


def new(timesteps: Any, added: np.ndarray, segments: list[Segment]) -> New:
    """A copy of the timesteps that are in no segment yet.

    Args:
        timesteps: leaves (*rings, capacity, ...): ring buffers.
        added: the number of timesteps that were ever added to each ring; its shape is *rings.
        segments: what has been written, the oldest first.
    """
    capacity = jax.tree.leaves(timesteps)[0].shape[added.ndim]
    stop = [int(number) for number in added.flat]
    written = segments[-1].stop if segments else [0] * len(stop)
    start = [max(old, end - capacity) for old, end in zip(written, stop, strict=True)]
    longest = max(end - begin for begin, end in zip(start, stop, strict=True))
    index = (np.array(start)[:, None] + np.arange(longest)) % capacity
    rings = (axis[:, None] for axis in np.unravel_index(np.arange(len(stop)), added.shape))
    where = (*rings, index)
    return New(start, stop, capacity, arrays.copied(jax.tree.map(lambda leaf: _on_host(leaf)[where], timesteps)))


def needed(segments: list[Segment], capacity: int) -> list[Segment]:
    """The segments with timesteps that the rings have not overwritten."""
    oldest = np.array(segments[-1].stop) - capacity
    return [segment for segment in segments if (np.array(segment.stop) > oldest).any()]


def read(folder: Path, like: Any, segments: list[Segment], axes: int) -> tuple[Any, np.ndarray]:
    """The rings, and how many timesteps each has lost at its beginning.

    A ring that has become larger may ask for timesteps that were overwritten before they were saved. It is numbered
    from its first saved timestep on.

    Args:
        folder: where the segments are.
        like: leaves (*rings, capacity, ...): the shapes and types of the rings.
        segments: the files, the oldest first.
        axes: the number of axes of *rings.

    Raises:
        UserError: a file does not have these arrays.
    """
    shape = jax.tree.leaves(like)[0].shape[: axes + 1]
    begin = np.array(segments[0].start if segments else np.zeros(math.prod(shape[:-1]), int))
    for before, segment in itertools.pairwise(segments):  # a ring has a gap if only another one needs a file
        begin = np.where(np.array(segment.start) > np.array(before.stop), segment.start, begin)
    stop = np.array(segments[-1].stop) if segments else begin
    missing = np.where((begin > np.maximum(stop - shape[-1], 0)).any(), begin, 0)
    rings = jax.tree.map(lambda leaf: np.zeros((math.prod(leaf.shape[:axes]), *leaf.shape[axes:]), leaf.dtype), like)
    for segment in segments:
        path = folder / segment.file
        saved = arrays.load(path)
        for where, ring in jax.tree_util.tree_leaves_with_path(rings):
            name = jax.tree_util.keystr(where)
            if name not in saved or saved[name].shape[2:] != ring.shape[2:]:
                raise arrays.misfit(path, name)
            _fill(ring, saved[name], segment, missing)
    return jax.tree.map(lambda ring, leaf: ring.reshape(leaf.shape), rings, like), missing.reshape(shape[:-1])


def _fill(rings: np.ndarray, saved: np.ndarray, segment: Segment, missing: np.ndarray) -> None:
    """Write a segment's timesteps into the rings, (ring, capacity, ...)."""
    for number, (start, stop) in enumerate(zip(segment.start, segment.stop, strict=True)):
        first = min(max(start, int(missing[number])), stop)
        index = (np.arange(first, stop) - missing[number]) % rings.shape[1]
        rings[number, index] = saved[number, first - start : stop - start]


def _on_host(leaf: Any) -> Any:
    """On a CPU a view of JAX's memory, without a copy. On other devices the array itself, which is indexed there."""
    return np.asarray(leaf) if jax.default_backend() == "cpu" else leaf


def are_there(folder: Path, segments: list[Segment]) -> bool:
    """Whether the files of all segments are in `folder`, each with its size."""
    paths = [(folder / segment.file, segment.size) for segment in segments]
    return all(path.exists() and path.stat().st_size == size for path, size in paths)
