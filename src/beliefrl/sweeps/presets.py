"""The paper's experiments as sweeps: its agents, tasks, seeds and settings (Section 5, Appendices B to G).

The paper does not state the number of training steps; `STEPS` is our choice.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from beliefrl.sweeps.plan import Experiment, grid
from beliefrl.types import UserError

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
REPEATS = 20
PAPERS = {"lr_model": 8e-4, "seq_len": 64, "batch_size": 4}  # Table 2


@dataclasses.dataclass(frozen=True)
class Preset:
    """A set of experiments of the paper."""

    about: str
    tasks: Sequence[str]
    agents: Sequence[str]
    make: Callable[[Sequence[str], Sequence[str], Sequence[int] | None], list[Experiment]]  # tasks, agents, seeds
    alone: bool = False  # one training at a time, because the trainings are timed


def steps(task: str) -> int:
    """The number of environment steps to train on a task."""
    return next((count for name, count in STEPS.items() if task.startswith(name)), ROBOT_STEPS)


def _compared(tasks: Sequence[str], agents: Sequence[str], seeds: Sequence[int] | None) -> list[Experiment]:
    """Every agent on every task, with 5 seeds unless `seeds` is given (Appendix B)."""
    numbers = range(5) if seeds is None else seeds
    return [each for task in tasks for each in grid(agents, [task], seeds=numbers, steps=steps(task))]


def drawn(seed: int) -> dict[str, float]:
    """The settings that the sensitivity study draws for a seed; a batch has 256 timesteps (Appendix F)."""
    random = np.random.default_rng(seed)
    length = int(random.choice(LENGTHS))
    return {"lr_model": float(random.choice(LEARNING_RATES)), "seq_len": length, "batch_size": TIMESTEPS // length}


def _sensitivity(tasks: Sequence[str], agents: Sequence[str], seeds: Sequence[int] | None) -> list[Experiment]:
    """20 seeds with the paper's settings, and 20 seeds with settings drawn for each seed (Appendix F)."""
    numbers = range(REPEATS) if seeds is None else seeds
    experiments = []
    for each in _compared(tasks, agents, numbers):
        experiments.append(each)
        for seed in numbers:
            if drawn(seed) != PAPERS:  # otherwise the experiment above is the same
                settings = {**each.settings, **drawn(seed)}
                experiments.append(dataclasses.replace(each, settings=settings, seeds=(seed,)))
    return experiments


def _scalability(tasks: Sequence[str], agents: Sequence[str], seeds: Sequence[int] | None) -> list[Experiment]:
    return grid(agents, tasks, seeds=[0] if seeds is None else seeds, steps=SCALABILITY_STEPS)


PRESETS = {
    "classic": Preset("Pendulum and CartPole, four agents, 5 seeds (Section 5.1)", CLASSIC, COMPARED, _compared),
    "robots": Preset("Hopper, Walker2d, Ant, four agents, 5 seeds (Section 5.2)", ROBOTS, COMPARED, _compared),
    "memory": Preset("target reaching, four agents, 5 seeds (Section 5.3)", MEMORY, COMPARED, _compared),
    "ablation": Preset("VRM and its ablations on all tasks, 5 seeds (Appendix C)", EVERY, ABLATIONS, _compared),
    "sensitivity": Preset(
        "VRM with the paper's settings and with drawn settings, 20 seeds each (Appendix F)",
        EVERY,
        ("vrm",),
        _sensitivity,
    ),
    "scalability": Preset(
        "four agents on velocities-only Hopper, 100,000 steps, timed (Appendix G)",
        ("hopper-v",),
        COMPARED,
        _scalability,
        True,
    ),
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
    return chosen.make(tasks or chosen.tasks, agents or chosen.agents, seeds)
