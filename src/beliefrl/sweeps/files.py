"""The files of a sweep: a user's Python file with experiments, and sweep.json in the sweep's folder."""

import dataclasses
import importlib.util
import json
import os
import pathlib
from collections.abc import Sequence

from beliefrl.runs.arrays import write_whole
from beliefrl.sweeps.plan import Experiment, Training
from beliefrl.types import UserError, said

PLAN = "sweep.json"


def load(path: str | os.PathLike[str]) -> list[Experiment]:
    """The list `experiments` that a Python file defines.

    Raises:
        UserError: there is no such file, it raises an exception, or it does not define such a list.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise UserError(f"There is no file {path}: give a Python file that defines a list `experiments`.")
    spec = importlib.util.spec_from_file_location("beliefrl_sweep", path)
    if spec is None or spec.loader is None:
        raise UserError(f"{path} is not a Python file: its name must end in .py.")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except UserError:
        raise
    except Exception as error:  # a user's file may raise anything
        raise UserError(f"{path} cannot be run: {said(error)}.") from None
    found = getattr(module, "experiments", None)
    if not isinstance(found, list | tuple) or not all(isinstance(each, Experiment) for each in found):
        raise UserError(
            f"{path} does not define a list `experiments` of beliefrl.Experiment: beliefrl.grid(...) returns one."
        )
    return list(found)


def read(sweep: pathlib.Path) -> list[Training]:
    """The trainings of the sweep in a folder; an empty list if there is no sweep yet.

    Raises:
        UserError: its sweep.json is damaged.
    """
    path = sweep / PLAN
    try:
        written = json.loads(path.read_text())["trainings"]
        return [Training(**{**each, "observe": tuple(map(str, each["observe"]))}) for each in written]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path} is damaged: restore it, or remove it and define the sweep again.") from None


def write(sweep: pathlib.Path, trainings: Sequence[Training]) -> None:
    """Write the trainings of a sweep to its sweep.json."""
    content = {"format": 1, "trainings": [dataclasses.asdict(training) for training in trainings]}
    write_whole(sweep / PLAN, (json.dumps(content, indent=1, default=str) + "\n").encode())
