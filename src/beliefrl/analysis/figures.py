"""Figures as files: a PNG to look at and a PDF to print, both there whole or not at all."""

import io
import pathlib
from typing import Any

from beliefrl.runs.arrays import write_whole
from beliefrl.types import UserError

KINDS = (".png", ".pdf")


def figure(width: float, height: float, layout: Any = "constrained") -> Any:
    """A figure of matplotlib, in inches, that needs no display and leaves no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(made)
    return made


def paths(path: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """Where a figure's PNG and PDF will be; `path` may end as either, or be without an ending.

    Raises:
        UserError: it ends otherwise, or its folder does not exist; told before anything is computed.
    """
    if path.suffix.lower() not in ("", *KINDS):
        raise UserError(f"{path} is impossible: a figure is written as .png and .pdf, so end its name as one of them.")
    check_folder(path)
    return path.with_suffix(KINDS[0]), path.with_suffix(KINDS[1])


def check_folder(path: pathlib.Path) -> None:
    """Raise a UserError where a file cannot be there, as there is no such folder or one of the file's own name."""
    if not path.parent.is_dir():
        raise UserError(f"{path} cannot be written (there is no folder {path.parent}): make it, or choose another.")
    if path.is_dir():
        raise UserError(f"{path} cannot be written (it is a folder): choose another name.")


def save(figure: Any, path: pathlib.Path) -> pathlib.Path:
    """Write a figure under both of its `paths`; returns the PNG's.

    Raises:
        UserError: they cannot be written.
    """
    for name in paths(path):
        content = io.BytesIO()
        figure.savefig(content, format=name.suffix[1:], dpi=150)
        try:
            write_whole(name, content.getvalue())
        except OSError as error:
            raise UserError(f"{name} cannot be written ({error.strerror}): choose another file.") from None
    return paths(path)[0]
