"""Files that a user names: figures, tables, reports, exported policies."""

import os
import pathlib
from typing import Any

from beliefrl.errors import UserError, cause, short
from beliefrl.runs.arrays import write_whole


def as_path(value: Any) -> pathlib.Path:
    """The value as a path. Raise a UserError if it is none."""
    if not isinstance(value, str | os.PathLike):
        raise UserError(f"{short(value)} is no path: give a text or a pathlib.Path.")
    return pathlib.Path(value)


def check_folder(path: pathlib.Path) -> None:
    """Raise a UserError if the folder of `path` does not exist, or if `path` itself is a folder."""
    if not os.path.isdir(path.parent):  # noqa: PTH112 - pathlib's version raises if a name is too long
        raise UserError(f"{path} cannot be written (there is no folder {path.parent}): create it, or choose another.")
    if os.path.isdir(path):  # noqa: PTH112
        raise UserError(f"{path} cannot be written (it is a folder): choose another name.")


def write_given(path: pathlib.Path, content: bytes) -> None:
    """Write a whole file, or nothing. Raise a UserError if it cannot be written."""
    try:
        write_whole(path, content)
    except OSError as error:
        raise UserError(f"{path} cannot be written ({cause(error)}): choose another file.") from None
