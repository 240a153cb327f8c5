"""What a sweep is read from and written to: a user's Python file, and sweep.json in its folder."""

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
    """The `experiments` of a Python file.

    Raises:
        UserError: there is no such file, it raises, or has no such list.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise UserError(f"There is no file {path}: give a Python file that makes a list `experiments`.")
    spec = importlib.util.spec_from_file_location("beliefrl_sweep", path)
    if spec is None or spec.loader is None:
        raise UserError(f"{path} is no Python file: its name must end with .py.")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except UserError:
        raise
    except Exception as error:  # whatever a user's file may raise
        raise UserError(f"{path} cannot be run: {said(error)}.") from None
    found = getattr(module, "experiments", None)
    if not isinstance(found, list | tuple) or not all(isinstance(each, Experiment) for each in found):
        raise UserError(f"{path} makes no list `experiments` of beliefrl.Experiment: beliefrl.grid(...) gives one.")
    return list(found)


def read(sweep: pathlib.Path) -> list[Training]:
    """The trainings in a sweep's folder; none, if there is no sweep yet.

    Raises:
        UserError: its sweep.json is damaged.
    """
    path = sweep / PLAN
    try:
        written = json.loads(path.read_text())["trainings"]
        return [Training(**{**each, "observe": tuple(each["observe"])}) for each in written]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path} is damaged: restore it, or remove it and give the sweep anew.") from None


def write(sweep: pathlib.Path, trainings: Sequence[Training]) -> None:
    """Write down the trainings of a sweep."""
    content = {"format": 1, "trainings": [dataclasses.asdict(training) for training in trainings]}
    write_whole(sweep / PLAN, (json.dumps(content, indent=1, default=str) + "\n").encode())
