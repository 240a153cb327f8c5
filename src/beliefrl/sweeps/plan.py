"""Which trainings a sweep consists of: agents x tasks x settings x seeds, each with a name and a command line.

A sweep's folder:

    sweep.json            the trainings
    NAME/                 a run's folder each (`runs`), NAME as AGENT-TASK-SETTINGS-seedN
    logs/NAME.log         what each training printed
    compiled/             programs that XLA has compiled, which the seeds of an experiment share
"""

import dataclasses
import hashlib
import itertools
import json
import pathlib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from beliefrl import agents, tasks
from beliefrl.runs.options import Options
from beliefrl.runs.run import Run
from beliefrl.training.schedule import capacity
from beliefrl.types import UserError

OPTIONS = tuple(field.name for field in dataclasses.fields(Options))
SHRINKS = ("step_start_rl", "train_times_fivrm", "pretrain_updates")  # hyperparameters that count steps or updates
LONGEST_NAME = 120  # of a folder


@dataclasses.dataclass(frozen=True)
class Experiment:
    """An agent with some settings on a task, with some seeds: a line of a figure."""

    agent: str
    """Its name."""
    task: str
    """Its name, such as pendulum-v or gym:MountainCarContinuous-v0."""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Hyperparameters of the agent, and options of a training (`beliefrl.Options`) such as steps."""
    seeds: Sequence[int] = (0, 1, 2, 3, 4)
    """Numbers of the seeds; the paper has 5 (Appendix B)."""
    observe: Sequence[int | str] = ()
    """Entries of the observation that the agent sees, as in `make_task`; none: all."""
    constants: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The task's constants, as in `make_task`."""


@dataclasses.dataclass(frozen=True)
class Training:
    """One run of a sweep."""

    name: str
    agent: str
    task: str
    settings: dict[str, Any]  # hyperparameters
    options: dict[str, Any]  # with seed and seeds, and steps
    observe: tuple[int | str, ...] = ()
    constants: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def steps(self) -> int:
        return self.options["steps"]

    @property
    def seeds(self) -> list[int]:
        return list(range(self.options["seed"], self.options["seed"] + self.options["seeds"]))

    def command(self, sweep: pathlib.Path) -> list[str]:
        """What follows `beliefrl` on the command line that does this training, or goes on with it."""
        given = [*self.settings.items(), *self.options.items()]
        flags = [part for name, value in given for part in _flag(name, value)]
        seen = ["--observe", *map(str, self.observe)] if self.observe else []
        made = ["--constants", *(f"{name}={json.dumps(value)}" for name, value in self.constants.items())]
        return [
            *("train", self.agent, self.task, *flags, *seen, *(made if self.constants else [])),
            *("--out", str(sweep / self.name), "--resume"),
        ]

    def is_finished(self, sweep: pathlib.Path) -> bool:
        """Whether its run has been evaluated at its last step."""
        folder = sweep / self.name
        if not (folder / "results.json").exists():
            return False
        return ((Run(folder).results() or {}).get("step") or 0) >= self.steps


def grid(
    agents: Sequence[str],
    tasks: Sequence[str],
    settings: Mapping[str, Sequence[Any]] | None = None,
    seeds: int | Sequence[int] = 5,
    **fixed: Any,
) -> list[Experiment]:
    """Every agent on every task with every combination of settings.

        beliefrl.grid(["vrm", "sac-mlp"], ["pendulum-v"], {"lr_critic": [3e-4, 1e-3]}, seeds=3, steps=15_000)

    Args:
        agents, tasks: names.
        settings: for each hyperparameter of the agents, or option of a training, its values.
        seeds: how many, from 0 on, or their numbers.
        fixed: settings with one value.
    """
    names, values = list(settings or {}), list((settings or {}).values())
    numbers = range(seeds) if isinstance(seeds, int) else seeds
    return [
        Experiment(agent, task, {**fixed, **dict(zip(names, combination, strict=True))}, tuple(numbers))
        for task in tasks
        for agent in agents
        for combination in itertools.product(*values)
    ]


def shrunk(experiment: Experiment, scale: float) -> Experiment:
    """The same with `scale` times the steps, the exploration, the pre-training and the steps between evaluations."""
    hyperparameters, options = _split(experiment.settings)
    agent: Any = _agent(experiment.agent, hyperparameters)
    counts = {name: value for name, value in dataclasses.asdict(agent).items() if name in SHRINKS}
    counts |= {name: options.get(name, getattr(Options, name)) for name in ("steps", "eval_every")}
    smaller = {name: max(10, round(count * scale)) if count else 0 for name, count in counts.items()}
    return dataclasses.replace(experiment, settings={**experiment.settings, **smaller})


def plan(experiments: Iterable[Experiment], seeds_per_run: int | None = None) -> list[Training]:
    """The trainings that experiments consist of, the first seed of every experiment before the second of any.

    Args:
        seeds_per_run: how many seeds are trained side by side in one program; None: one, but all that follow each other
            of an agent that gains from it on a CPU.

    Raises:
        UserError: there is no such agent, task or setting, or a value is impossible.
    """
    planned: dict[str, Training] = {}
    turns = {}
    for experiment in experiments:
        for turn, (first, count) in enumerate(_stretches(experiment, seeds_per_run)):
            training = _training(experiment, first, count)
            if planned.setdefault(training.name, training) != training:
                raise UserError(f"Two trainings would be called {training.name}: only hyperparameters can be varied.")
            turns[training.name] = turn
    _check(planned.values())
    return sorted(planned.values(), key=lambda training: turns[training.name])


def extended(
    before: Sequence[Training], experiments: Iterable[Experiment], seeds_per_run: int | None = None
) -> list[Training]:
    """The trainings of a sweep to which experiments are added; seeds that it has already stay in the runs they are in.

    These take over what is new in their options, such as more steps. Arguments and errors are those of `plan`.
    """
    trainings, fresh = {training.name: training for training in before}, []
    for experiment in experiments:
        like, there = _training(experiment, 0, 1), set()
        for training in [each for each in trainings.values() if _line(each) == _line(like)]:
            if set(training.seeds) & set(experiment.seeds):
                own = {name: training.options[name] for name in ("seed", "seeds")}
                trainings[training.name] = dataclasses.replace(training, options=like.options | own)
                there |= set(training.seeds)
        fresh.append(dataclasses.replace(experiment, seeds=tuple(set(experiment.seeds) - there)))
    _check(trainings.values())
    return [*trainings.values(), *plan(fresh, seeds_per_run)]


def _line(training: Training) -> tuple[Any, ...]:
    """What trainings have in common that differ in their seeds only."""
    settings = json.dumps([training.settings, training.constants], sort_keys=True, default=str)
    return training.agent, training.task, settings, training.observe


# Measured on two cores: two seeds of SAC-MLP in one program take 17 % less time than one after the other, and share
# one compilation; the recurrent agents gain nothing.
GAIN_SIDE_BY_SIDE = ("sac-mlp",)


def _stretches(experiment: Experiment, seeds_per_run: int | None) -> list[tuple[int, int]]:
    """The experiment's seeds cut into runs: (first, how many), no more than `seeds_per_run` and without a gap."""
    compiled = experiment.task.removesuffix("-v").removesuffix("-p") in tasks.TASKS
    gains = compiled and experiment.agent in GAIN_SIDE_BY_SIDE
    most = seeds_per_run or (len(experiment.seeds) if gains else 1)
    cut: list[tuple[int, int]] = []
    for seed in sorted(experiment.seeds):
        if cut and sum(cut[-1]) == seed and cut[-1][1] < most:
            cut[-1] = (cut[-1][0], cut[-1][1] + 1)
        else:
            cut.append((seed, 1))
    return cut


def _training(experiment: Experiment, first: int, count: int) -> Training:
    settings, options = _split(experiment.settings)
    told = [f"{name}={_words(value)}" for name, value in {**settings, **dict(experiment.constants)}.items()]
    seen = [f"observe={_words(experiment.observe)}"] if experiment.observe else []
    seeds = f"seed{first}" + (f"to{first + count - 1}" if count > 1 else "")
    name = re.sub(r"[^\w.=,-]+", "-", "-".join([experiment.agent, experiment.task, *told, *seen]))
    if len(name) > LONGEST_NAME:
        name = f"{name[: LONGEST_NAME - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    options = {"steps": Options.steps} | options | {"seed": first, "seeds": count}
    return Training(
        f"{name}-{seeds}",
        experiment.agent,
        experiment.task,
        settings,
        options,
        tuple(experiment.observe),
        dict(experiment.constants),
    )


def _words(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _split(settings: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Hyperparameters, and options of a training."""
    for name in ("seed", "seeds"):
        if name in settings:
            raise UserError(f"{name} cannot be a setting of a sweep: give its seeds apart.")
    options = {name: value for name, value in settings.items() if name in OPTIONS}
    return {name: value for name, value in settings.items() if name not in OPTIONS}, options


def _check(trainings: Iterable[Training]) -> None:
    """Find every mistake before anything begins."""
    made: dict[str, Any] = {}
    for training in trainings:
        agent = _agent(training.agent, training.settings)
        capacity(agent, Options(**_typed(training.options, Options)))
        key = json.dumps([training.task, training.observe, training.constants], sort_keys=True, default=str)
        if key not in made:
            made[key] = tasks.make(training.task, training.observe or None, **training.constants).spec


def _agent(name: str, hyperparameters: dict[str, Any]) -> Any:
    return agents.make(name, **_typed(hyperparameters, agents.find(name)))


def _typed(values: dict[str, Any], like: Any) -> dict[str, Any]:
    """JSON's lists as the tuples they stand for, and whole numbers as floats where `like` has a float."""

    def typed(name: str, value: Any) -> Any:
        if isinstance(value, int) and not isinstance(value, bool) and isinstance(getattr(like, name, None), float):
            return float(value)
        return tuple(value) if isinstance(value, list) else value

    return {name: typed(name, value) for name, value in values.items()}


def _flag(name: str, value: Any) -> list[str]:
    option = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{option}" if value else f"--no-{option}"]
    return [f"--{option}", *(map(str, value) if isinstance(value, list | tuple) else [str(value)])]
