"""Trees of arrays as files of plain numbers (safetensors), and files that are written atomically.

The name of an array is its place in the tree. A random key is stored as its numbers. Reading a file runs no code.
"""

import contextlib
import os
import pathlib
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from beliefrl.errors import UserError, cause


class Damaged(UserError):
    """A file is damaged."""


def copied(tree: Any) -> dict[str, np.ndarray]:
    """Every array of a tree by its name, copied to the host."""
    return {name: np.array(_numbers(leaf), order="C") for name, leaf in _named(tree)}


def packed(arrays: dict[str, np.ndarray], about: dict[str, str] | None = None) -> bytes:
    """The content of a safetensors file with these arrays."""
    return safetensors.numpy.save(arrays, about)


def read(path: pathlib.Path, like: Any, renamed: Mapping[str, str] = MappingProxyType({})) -> Any:
    """A tree of the structure, shapes and types of `like`; `renamed` has the names of arrays in older files.

    Raises:
        Damaged: the file cannot be read.
        UserError: an array is missing, or has another shape or type.
    """
    saved = load(path)
    leaves = []
    for name, leaf in _named(like):
        numbers = jax.eval_shape(_numbers, leaf)
        found = saved.get(name, saved.get(renamed.get(name, "")))
        if found is None or found.shape != numbers.shape or found.dtype != numbers.dtype:
            raise misfit(path, name)
        leaves.append(jax.random.wrap_key_data(jnp.asarray(found)) if _is_key(leaf) else found)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def shapes(tree: Any) -> dict[str, Any]:
    """The shape and type of every array of a tree in a file, by its name."""
    return {name: jax.eval_shape(_numbers, leaf) for name, leaf in _named(tree)}


def about(path: pathlib.Path) -> dict[str, str]:
    """The words that were written with the arrays of a file (`packed`).

    Raises:
        Damaged: the file cannot be read.
    """
    try:
        with safetensors.safe_open(path, "numpy") as file:
            return file.metadata() or {}
    except safetensors.SafetensorError:
        raise damaged(path) from None
    except OSError as error:
        raise unreadable(path, error) if path.exists() else damaged(path) from None


def misfit(path: pathlib.Path, name: str) -> UserError:
    """The error that an array of a file is missing, or of another shape or type."""
    return UserError(
        f"{path} does not fit the agent in config.json (at {name}): they belong to different trainings, or the task is "
        "another one."
    )


def load(path: pathlib.Path) -> dict[str, np.ndarray]:
    """The arrays of a file, by name.

    Raises:
        Damaged: the file cannot be read.
    """
    try:
        return safetensors.numpy.load_file(path)
    except safetensors.SafetensorError:
        raise damaged(path) from None
    except OSError as error:
        raise unreadable(path, error) if path.exists() else damaged(path) from None


def damaged(path: pathlib.Path) -> Damaged:
    """The error that a file has another content than was written, or is missing."""
    return Damaged(f"{path} is damaged: restore it from a copy, or train again.")


def unreadable(path: pathlib.Path, error: OSError) -> UserError:
    """The error that the system cannot read a file now. Its content may be right."""
    return UserError(f"{path} cannot be read ({cause(error)}): make it readable, then try again.")


def _named(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(where), leaf) for where, leaf in jax.tree_util.tree_leaves_with_path(tree)]


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _numbers(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def write_whole(path: pathlib.Path, content: bytes) -> None:
    """Write a file atomically: at any time the path holds the old content or the new one."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(content)


@contextlib.contextmanager
def replacing(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """A temporary path for writing a file. The file then replaces `path`, or is removed if writing failed."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: pathlib.Path) -> None:
    """Flush the entries of a folder to the disk."""
    if os.name != "posix":
        return
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
