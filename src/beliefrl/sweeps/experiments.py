"""What to train: agents with settings, on tasks, with seeds."""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from beliefrl.errors import UserError, short
from beliefrl.types import LAST_SEED, check_whole, plain

NAMED = Mapping, "a dictionary from names to values"
KINDS = (
    ("agent", str, "its name"),
    ("task", str, "its name"),
    ("settings", *NAMED),
    ("constants", *NAMED),
    ("observe", Sequence | int | None, "entries of the observation"),
)


@dataclasses.dataclass(frozen=True)
class Experiment:
    """An agent with its settings on a task, and the seeds to train: one line of a figure.

    Settings, constants and seeds are kept as JSON has them, so they may be NumPy's numbers.
    """

    agent: str
    """The agent's name."""
    task: str
    """The task's name, such as pendulum-v or gym:MountainCarContinuous-v0."""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Hyperparameters of the agent, training options (`beliefrl.Options`) such as steps, and faults of the sensors
    (`beliefrl.Faults`) such as noise."""
    seeds: Sequence[int] = (0, 1, 2, 3, 4)
    """The seed numbers; the paper uses 5 seeds (Appendix B)."""
    observe: Sequence[int | str] | int | str | None = None
    """Entries of the observation that the agent sees, as in `make_task`; empty: all."""
    constants: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The task's constants, as in `make_task`."""

    def __post_init__(self) -> None:
        """Raise a UserError if a type is impossible, or a seed. Make the values plain."""
        for name, kinds, what in KINDS:
            value = getattr(self, name)
            if not isinstance(value, kinds):
                raise UserError(f"{name}={short(value)} is impossible: give {what}.")
        object.__setattr__(self, "seeds", _numbers(self.seeds))
        for name in ("settings", "constants"):
            if not all(isinstance(key, str) for key in getattr(self, name)):
                raise UserError(f"{name}={short(getattr(self, name))} is impossible: its names must be texts.")
            object.__setattr__(self, name, plain(dict(getattr(self, name))))


def _numbers(seeds: Any) -> tuple[int, ...]:
    """The numbers of seeds as a tuple. Raise a UserError if they are none."""
    if isinstance(seeds, str) or not isinstance(seeds, Iterable):
        given = short(seeds)
        raise UserError(f"seeds={given} is impossible: give the seed numbers, such as (0, 1, 2), or use grid.")
    numbers = tuple(seeds)
    if not numbers:
        raise UserError("seeds has no seed number: give one or more, such as (0, 1, 2).")
    for number in numbers:
        check_whole("seed", number, 0, LAST_SEED)
    return tuple(map(int, numbers))


def grid(
    agents: Sequence[str],
    tasks: Sequence[str],
    settings: Mapping[str, Sequence[Any]] | None = None,
    seeds: int | Sequence[int] = 5,
    **fixed: Any,
) -> list[Experiment]:
    """Experiments: every agent on every task with every combination of settings.

        beliefrl.grid(["vrm", "sac-mlp"], ["pendulum-v"], {"lr_critic": [3e-4, 1e-3]}, seeds=3, steps=15_000)

    Args:
        agents, tasks: names.
        settings: the values to try, for each hyperparameter or fault of the sensors.
        seeds: the number of seeds, counted from 0, or a list of seed numbers.
        fixed: settings with one value.

    Raises:
        UserError: the values of a setting are not a list, or the seeds are impossible.
    """
    agents, tasks = ([names] if isinstance(names, str) else names for names in (agents, tasks))
    if not isinstance(settings, Mapping | None):
        raise UserError(f"settings={short(settings)} is impossible: give a dictionary from names to lists of values.")
    for name, value in (settings or {}).items():
        if isinstance(value, str) or not isinstance(value, Iterable):
            raise UserError(f"{name}={value} is not a list of values: give [{value!r}], or {name}= as an argument.")
    names, values = list(settings or {}), list((settings or {}).values())
    numbers: Any = seeds
    if np.ndim(numbers) == 0:
        check_whole("seeds", numbers, 1)
        numbers = range(int(numbers))
    return [
        Experiment(agent, task, {**fixed, **dict(zip(names, combination, strict=True))}, numbers)
        for task in tasks
        for agent in agents
        for combination in itertools.product(*values)
    ]
