"""Where the experiments of a sweep come from: the paper's presets, a user's Python file, or an existing sweep.

The presets are the paper's experiments: its agents, tasks, seeds and settings (Section 5, Appendices B to G). The paper
does not state the number of training steps; `STEPS` is our choice.
"""

import dataclasses
import importlib.util
import json
import os
import pathlib
import sys
from collections.abc import Callable, Sequence

import numpy as np

from beliefrl.errors import UserError, said
from beliefrl.runs.arrays import write_whole
from beliefrl.runs.options import OPTION_NAMES
from beliefrl.sweeps.experiments import Experiment, grid
from beliefrl.sweeps.plan import Training
from beliefrl.types import plain

PLAN = "sweep.json"  # in the folder of a sweep
FORMAT = 1

COMPARED = ("vrm", "sac-mlp", "sac-lstm", "slac")
ABLATIONS = ("vrm", "vrm-single", "vrm-first", "vrm-keep", "vrm-deterministic")
CLASSIC = tuple(task + mask for task in ("pendulum", "cartpole") for mask in ("", "-v", "-p"))
ROBOTS = tuple(task + mask for task in ("hopper", "walker2d", "ant") for mask in ("", "-v", "-p"))
MEMORY = ("target-reaching",)
EVERY = (*CLASSIC, *ROBOTS, *MEMORY)

STEPS = {"pendulum": 20_000, "cartpole": 30_000, "target-reaching": 80_000}
ROBOT_STEPS = 500_000
SCALABILITY_STEPS = 100_000  # the paper's table (Appendix G)

LEARNING_RATES = (4e-4, 6e-4, 8e-4, 1e-3)  # Appendix F
LENGTHS = (16, 32, 64)
TIMESTEPS = 256  # timesteps in a batch, for every sequence length
PAPERS = {"lr_model": 8e-4, "seq_len": 64, "batch_size": 4}  # Table 2


@dataclasses.dataclass(frozen=True)
class Preset:
    """A set of experiments of the paper."""

    tasks: Sequence[str]
    agents: Sequence[str]
    make: Callable[[Sequence[str], Sequence[str], Sequence[int]], list[Experiment]]  # tasks, agents, seeds
    seeds: int = 5  # per experiment (Appendix B)


def steps(task: str) -> int:
    """The number of environment steps to train on a task."""
    return next((count for name, count in STEPS.items() if task.startswith(name)), ROBOT_STEPS)


def _compared(tasks: Sequence[str], agents: Sequence[str], seeds: Sequence[int]) -> list[Experiment]:
    """Every agent on every task."""
    return [each for task in tasks for each in grid(agents, [task], seeds=seeds, steps=steps(task))]


def drawn(seed: int) -> dict[str, float]:
    """The settings that the sensitivity study draws for a seed; a batch has 256 timesteps (Appendix F)."""
    random = np.random.default_rng(seed)
    length = int(random.choice(LENGTHS))
    return {"lr_model": float(random.choice(LEARNING_RATES)), "seq_len": length, "batch_size": TIMESTEPS // length}


def _sensitivity(tasks: Sequence[str], agents: Sequence[str], seeds: Sequence[int]) -> list[Experiment]:
    """The seeds with the paper's settings, and with settings drawn for each seed (Appendix F)."""
    experiments = []
    for each in _compared(tasks, agents, seeds):
        experiments.append(each)
        for seed in seeds:
            if drawn(seed) != PAPERS:  # otherwise the experiment above is the same
                settings = {**each.settings, **drawn(seed)}
                experiments.append(dataclasses.replace(each, settings=settings, seeds=(seed,)))
    return experiments


def _scalability(tasks: Sequence[str], agents: Sequence[str], seeds: Sequence[int]) -> list[Experiment]:
    return grid(agents, tasks, seeds=seeds, steps=SCALABILITY_STEPS)


PRESETS = {
    "classic": Preset(CLASSIC, COMPARED, _compared),  # Section 5.1
    "robots": Preset(ROBOTS, COMPARED, _compared),  # Section 5.2
    "memory": Preset(MEMORY, COMPARED, _compared),  # Section 5.3
    "ablation": Preset(EVERY, ABLATIONS, _compared),  # Appendix C
    "sensitivity": Preset(EVERY, ("vrm",), _sensitivity, seeds=20),  # Appendix F
    "scalability": Preset(("hopper-v",), COMPARED, _scalability, seeds=1),  # Appendix G; timed, one training at a time
}


def preset(
    name: str,
    tasks: Sequence[str] = (),
    agents: Sequence[str] = (),
    seeds: Sequence[int] | None = None,
) -> list[Experiment]:
    """The experiments of a preset; `tasks`, `agents` and `seeds` replace those of the paper.

    Raises:
        UserError: there is no such preset.
    """
    if name not in PRESETS:
        raise UserError(f"There is no preset {name!r}: give one of {', '.join(PRESETS)}.")
    chosen = PRESETS[name]
    numbers = range(chosen.seeds) if seeds is None else seeds
    return chosen.make(tasks or chosen.tasks, agents or chosen.agents, numbers)


def load(path: str | os.PathLike[str]) -> list[Experiment]:
    """The list `experiments` that a Python file defines.

    Raises:
        UserError: there is no such file, it raises an exception, or it does not define such a list.
    """
    path = pathlib.Path(path)
    if not os.path.isfile(path):  # noqa: PTH113 - pathlib's version raises if a name is too long
        raise UserError(f"There is no file {path}: give a Python file that defines a list `experiments`.")
    spec = importlib.util.spec_from_file_location("beliefrl_sweep", path)
    if spec is None or spec.loader is None:
        raise UserError(f"{path} is not a Python file: its name must end in .py.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look for their module there
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        del sys.modules[spec.name]
        if isinstance(error, UserError):
            raise
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
        UserError: its sweep.json is damaged, or of another version.
    """
    path = sweep / PLAN
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise UserError(f"{path} has format {content['format']}, which this version cannot read: update beliefrl.")
        written = content["trainings"]
        trainings = [Training(**{**each, "observe": tuple(map(str, each["observe"]))}) for each in written]
        for name in (name for each in trainings for name in each.options if name not in OPTION_NAMES):
            raise UserError(f"{path} was written by another version: this one has no option {name!r}.")
        return trainings
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path} is damaged: restore it, or remove it and define the sweep again.") from None


def write(sweep: pathlib.Path, trainings: Sequence[Training]) -> None:
    """Write the trainings of a sweep to its sweep.json."""
    content = {"format": FORMAT, "trainings": [dataclasses.asdict(training) for training in trainings]}
    write_whole(sweep / PLAN, (json.dumps(plain(content), indent=1) + "\n").encode())
