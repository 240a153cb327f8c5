"""The cache of compiled programs, so that the second start of a training does not compile again.

This is JAX's compilation cache. This file defines its folder and its maximum size. Nothing happens on import. The
user's own setting, JAX_COMPILATION_CACHE_DIR or `jax.config`, has priority.
"""

import os
import pathlib
import platform
import sys
import tempfile
import warnings
from collections.abc import Callable
from typing import Any

import filelock
import jax

VARIABLE = "BELIEFRL_CACHE"  # `off`, or a folder
LARGEST_BYTES = 2**30
SHORTEST_SECONDS = 0.1  # programs that compile faster are not stored
LOCK_SECONDS = 10.0


def keep_compiled(note: Callable[[str], None] = warnings.warn) -> None:
    """From now on, let JAX store compiled programs in `cache_folder()`.

    If the folder cannot be written, `note` is called with a sentence, and everything is compiled without the cache.
    """
    settings: Any = jax.config  # its options are made at import, unknown to pyright
    if settings.jax_compilation_cache_dir or os.environ.get(VARIABLE, "").lower() == "off":
        return
    try:
        folder = cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(2**20))
        with filelock.FileLock(folder / ".lockfile", LOCK_SECONDS):  # JAX's own
            _remove_unfinished(folder)
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home folder
        reason = getattr(error, "strerror", None) or error
        note(f"compiled programs are not kept ({reason}): set {VARIABLE} to a folder that can be written, or to off.")
        return
    if settings.jax_compilation_cache_max_size == -1:
        jax.config.update("jax_compilation_cache_max_size", LARGEST_BYTES)
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST_SECONDS)
    jax.config.update("jax_compilation_cache_dir", str(folder))


def cache_folder() -> pathlib.Path:
    """The folder of this machine: another machine may not be able to run its programs.

    Raises:
        RuntimeError: the user has no home folder.
    """
    given = os.environ.get(VARIABLE)
    return (pathlib.Path(given).expanduser().absolute() if given else _user_folder() / "beliefrl") / platform.node()


def _user_folder() -> pathlib.Path:
    """The folder of this platform for a user's caches."""
    if sys.platform == "win32":
        return pathlib.Path(os.environ.get("LOCALAPPDATA") or pathlib.Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return pathlib.Path.home() / "Library" / "Caches"
    return pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")


def _remove_unfinished(folder: pathlib.Path) -> None:
    """Remove incomplete entries. JAX writes a file with the time after each entry, and fails if it is missing."""
    for entry in folder.glob("*-cache"):
        if not entry.with_name(entry.name.removesuffix("-cache") + "-atime").exists():
            entry.unlink()
