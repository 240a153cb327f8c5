"""Figures as files: a PNG for the screen and a PDF for print. No file is left half written."""

import io
import pathlib
from typing import Any

from beliefrl.runs.arrays import write_whole
from beliefrl.types import UserError, cause

KINDS = (".png", ".pdf")


def figure(width: float, height: float, layout: Any = "constrained") -> Any:
    """A matplotlib figure, sizes in inches. It needs no display and does not touch pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(made)
    return made


def paths(path: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """The paths of a figure's PNG and PDF; `path` ends in .png or .pdf, or has no suffix.

    Call it before the computation, so that a mistake is reported at once.

    Raises:
        UserError: `path` has another suffix, or its folder does not exist.
    """
    if path.suffix.lower() not in ("", *KINDS):
        raise UserError(
            f"{path} is impossible: a figure is written as .png and .pdf, so its name must end in one of them."
        )
    check_folder(path)
    return path.with_suffix(KINDS[0]), path.with_suffix(KINDS[1])


def check_folder(path: pathlib.Path) -> None:
    """Raise a UserError if the folder of `path` does not exist, or if `path` itself is a folder."""
    if not path.parent.is_dir():
        raise UserError(f"{path} cannot be written (there is no folder {path.parent}): create it, or choose another.")
    if path.is_dir():
        raise UserError(f"{path} cannot be written (it is a folder): choose another name.")


def save(figure: Any, path: pathlib.Path) -> pathlib.Path:
    """Write a figure to both of its `paths`; returns the path of the PNG.

    Raises:
        UserError: the files cannot be written.
    """
    for name in paths(path):
        content = io.BytesIO()
        figure.savefig(content, format=name.suffix[1:], dpi=150)
        try:
            write_whole(name, content.getvalue())
        except OSError as error:
            raise UserError(f"{name} cannot be written ({cause(error)}): choose another file.") from None
    return paths(path)[0]
