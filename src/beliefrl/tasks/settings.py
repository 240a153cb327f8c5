"""Settings of this process that a Gymnasium environment may change."""

import contextlib
import os
from collections.abc import Iterator

import jax


@contextlib.contextmanager
def settings_kept() -> Iterator[None]:
    """Put back JAX's number of bits and the working directory at the end, also after an error."""
    wide, folder = jax.config.read("jax_enable_x64"), _working_directory()
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", wide)
        if folder is not None:
            with contextlib.suppress(OSError):
                os.chdir(folder)


def _working_directory() -> str | None:
    try:
        return os.getcwd()  # noqa: PTH109 - pathlib's version raises as well
    except OSError:  # it was removed
        return None
