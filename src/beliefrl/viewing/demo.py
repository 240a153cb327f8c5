"""Small trained agents that come with the package, for `beliefrl demo`.

Each is a zip file with the folder of a run: its settings, log, evaluation and agent. `benchmarks/results/keep.py`
makes these files.
"""

import os
import pathlib
import shutil
import zipfile

from beliefrl.errors import UserError, cause, short
from beliefrl.runs.given_files import as_path
from beliefrl.runs.run import Run

FOLDER = pathlib.Path(__file__).parent / "demos"


def names() -> list[str]:
    """The tasks for which there is a trained agent."""
    return sorted(path.stem for path in FOLDER.glob("*.zip"))


def demo(task: str, folder: str | os.PathLike[str]) -> Run:
    """Copy a trained agent that comes with the package into a new folder; returns its run.

    `evaluate`, `load`, `video` and the other functions take this run as they take one of your own trainings.

    Args:
        task: cartpole-v, pendulum-v or target-reaching.
        folder: the run's folder, which must not exist yet. Missing parent folders are made.

    Raises:
        UserError: there is no trained agent for the task, or the folder exists already or cannot be made.
    """
    if task not in names():
        raise UserError(f"There is no trained agent for {short(task)}: there is one for {', '.join(names())}.")
    folder = as_path(folder)
    try:
        folder.mkdir(parents=True)
        _unpack(FOLDER / f"{task}.zip", folder)
    except FileExistsError:
        raise UserError(f"{folder} exists already: choose another folder.") from None
    except OSError as error:
        raise UserError(f"{folder} cannot be made ({cause(error)}): choose another folder.") from None
    return Run(folder)


def _unpack(path: pathlib.Path, folder: pathlib.Path) -> None:
    """Unpack a zip file into a new folder, or remove the folder."""
    try:
        with zipfile.ZipFile(path) as packed:
            packed.extractall(folder)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
