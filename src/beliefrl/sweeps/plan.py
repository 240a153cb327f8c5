"""The list of trainings in a sweep: agents x tasks x settings x seeds, each with a name and a command line.

A sweep's folder:

    sweep.json            the trainings
    NAME/                 the folder of each run (`runs`); NAME is AGENT-TASK-SETTINGS-seedN
    logs/NAME.log         the output of each training
    compiled/             the cache of compiled programs, which the seeds of an experiment share
"""

import dataclasses
import hashlib
import json
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from beliefrl import agents, tasks
from beliefrl.catalogue import split_mask
from beliefrl.errors import UserError
from beliefrl.runs.folder import folder_name
from beliefrl.runs.options import OPTION_NAMES, Options
from beliefrl.runs.run import Run
from beliefrl.sweeps.experiments import Experiment
from beliefrl.tasks.faults import Faults
from beliefrl.training.schedule import capacity
from beliefrl.types import plain, tuples

FAULTS = tuple(field.name for field in dataclasses.fields(Faults))
SHRINKS = ("step_start_rl", "train_times_fivrm", "pretrain_updates")  # they count what comes before learning
LONGEST_NAME = 120  # characters of a folder's name, without the seeds


@dataclasses.dataclass(frozen=True)
class Training:
    """One run of a sweep."""

    name: str
    agent: str
    task: str
    settings: dict[str, Any]  # hyperparameters
    options: dict[str, Any]  # training options; seed, seeds and steps are always present
    observe: tuple[str, ...] = ()  # as text, which is the form of the command line
    constants: dict[str, Any] = dataclasses.field(default_factory=dict)
    faults: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def steps(self) -> int:
        return self.options["steps"]

    @property
    def seeds(self) -> list[int]:
        return list(range(self.options["seed"], self.options["seed"] + self.options["seeds"]))

    def arguments(self) -> list[str]:
        """The arguments of `beliefrl` that train this, without a folder."""
        given = [*self.settings.items(), *self.options.items(), *self.faults.items()]
        flags = [part for name, value in given for part in _flag(name, value)]
        seen = ["--observe", *self.observe] if self.observe else []
        made = ["--constants", *(f"{name}={json.dumps(value)}" for name, value in self.constants.items())]
        return ["train", self.agent, self.task, *flags, *seen, *(made if self.constants else [])]

    def command(self, sweep: pathlib.Path) -> list[str]:
        """The arguments of `beliefrl` that start this training in the sweep's folder, or continue it."""
        return [*self.arguments(), "--out", str(sweep / self.name), "--resume"]

    def is_finished(self, sweep: pathlib.Path) -> bool:
        """Whether the run was evaluated at its last step, has reached `stop_at`, or all its seeds have diverged."""
        folder = sweep / self.name
        if not (folder / "config.json").exists():
            return False
        try:
            run = Run(folder)
            return run.is_complete(options_of(self)) or all(map(run.has_diverged, run.seeds))
        except UserError:
            return False  # it is damaged, and the training says so


def shrunk(experiment: Experiment, scale: float) -> Experiment:
    """A copy with all step counts scaled: training, exploration, pre-training, and the interval of evaluations."""
    hyperparameters, options, _ = _split(experiment.settings)
    agent: Any = agent_of(experiment.agent, hyperparameters)
    counts = {name: value for name, value in dataclasses.asdict(agent).items() if name in SHRINKS}
    counts |= {name: options.get(name, getattr(Options, name)) for name in ("steps", "eval_every")}
    smaller = {name: max(10, round(count * scale)) if count else 0 for name, count in counts.items()}
    return dataclasses.replace(experiment, settings={**experiment.settings, **smaller})


def plan(experiments: Iterable[Experiment], seeds_per_run: int | None = None) -> list[Training]:
    """The trainings of these experiments: the first seed of every experiment, then the second, and so on.

    Args:
        experiments: what to train.
        seeds_per_run: most seeds side by side in one program. None: one seed, or all consecutive seeds of an agent that
            is faster that way on a CPU.

    Raises:
        UserError: there is no such agent, task or setting, or a value is impossible.
    """
    planned: dict[str, Training] = {}
    order = {}  # of a training among those of its experiment
    for experiment in experiments:
        for index, (first, count) in enumerate(_seed_ranges(experiment, seeds_per_run)):
            training = _training(experiment, first, count)
            if planned.setdefault(training.name, training) != training:
                raise UserError(
                    f"Two trainings would be called {training.name}: an option of the training can have only one value."
                )
            order[training.name] = index
    _check(planned.values())
    return sorted(planned.values(), key=lambda training: order[training.name])


def extended(
    before: Sequence[Training], experiments: Iterable[Experiment], seeds_per_run: int | None = None
) -> list[Training]:
    """The trainings of a sweep after adding experiments. Seeds that the sweep already has stay in their runs.

    These runs take over changed options, such as more steps. Arguments and errors are those of `plan`.
    """
    trainings, added = {training.name: training for training in before}, []
    for experiment in experiments:
        like, present = _training(experiment, 0, 1), set()
        for training in [each for each in trainings.values() if _line(each) == _line(like)]:
            if set(training.seeds) & set(experiment.seeds):
                own = {name: training.options[name] for name in ("seed", "seeds")}
                trainings[training.name] = dataclasses.replace(training, options=like.options | own)
                present |= set(training.seeds)
        if left := set(experiment.seeds) - present:
            added.append(dataclasses.replace(experiment, seeds=tuple(left)))
    _check(trainings.values())
    new = plan(added, seeds_per_run)
    for name in (each.name for each in new if each.name in trainings):
        raise UserError(f"The sweep has a training {name} with other settings: choose another --out, in Python out=.")
    return [*trainings.values(), *new]


def _line(training: Training) -> tuple[Any, ...]:
    """A key that is equal for trainings that differ only in seeds and options."""
    settings = json.dumps(plain([training.settings, training.constants, training.faults]), sort_keys=True)
    return training.agent, training.task, settings, training.observe


# Measured on two cores: training two seeds of SAC-MLP in one program takes 17 % less time than one after the other, and
# needs only one compilation. The recurrent agents gain nothing.
GAIN_SIDE_BY_SIDE = ("sac-mlp",)


def _seed_ranges(experiment: Experiment, seeds_per_run: int | None) -> list[tuple[int, int]]:
    """The experiment's seeds, split into runs of consecutive seeds: (first seed, number of seeds)."""
    compiled = split_mask(experiment.task)[0] in tasks.TASKS
    gains = compiled and experiment.agent in GAIN_SIDE_BY_SIDE
    most = seeds_per_run or (len(experiment.seeds) if gains else 1)
    ranges: list[tuple[int, int]] = []
    for seed in sorted(set(experiment.seeds)):
        if ranges and sum(ranges[-1]) == seed and ranges[-1][1] < most:
            ranges[-1] = (ranges[-1][0], ranges[-1][1] + 1)
        else:
            ranges.append((seed, 1))
    return ranges


def _training(experiment: Experiment, first: int, count: int) -> Training:
    settings, options, faults = _split(experiment.settings)
    named = [*settings.items(), *experiment.constants.items(), *faults.items()]
    changed = [f"{name}={_as_text(value)}" for name, value in named]
    given = () if experiment.observe is None else experiment.observe
    observe = (given,) if isinstance(given, int | str) else tuple(given)
    seen = [f"observe={_as_text(observe)}"] if observe else []
    seeds = f"seed{first}" + (f"to{first + count - 1}" if count > 1 else "")
    name = folder_name("-".join([experiment.agent, experiment.task, *changed, *seen]))
    if len(name) > LONGEST_NAME:
        name = f"{name[: LONGEST_NAME - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    options = {"steps": Options.steps} | options | {"seed": first, "seeds": count}
    return Training(
        f"{name}-{seeds}",
        experiment.agent,
        experiment.task,
        settings,
        options,
        tuple(map(str, observe)),
        dict(experiment.constants),
        faults,
    )


def _as_text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _split(settings: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """The hyperparameters, the training options and the faults among `settings`."""
    for name in ("seed", "seeds"):
        if name in settings:
            raise UserError(f"{name} cannot be a setting of a sweep: use the argument or option for seeds.")
    options = {name: value for name, value in settings.items() if name in OPTION_NAMES}
    faults = {name: value for name, value in settings.items() if name in FAULTS}
    return {name: value for name, value in settings.items() if name not in options | faults}, options, faults


def _check(trainings: Iterable[Training]) -> None:
    """Raise a UserError for any invalid training, before the first one starts."""
    known: set[str] = set()
    for training in trainings:
        agent = agent_of(training.agent, training.settings)
        capacity(agent, options_of(training))
        task = [training.task, training.observe or None, training.faults, training.constants]
        key = json.dumps(plain(task), sort_keys=True)
        if key not in known:
            known.add(key)
            _ = tasks.make(*task[:3], **training.constants).spec  # making an environment may fail


def options_of(training: Training) -> Options:
    """The options of a training, with their types."""
    return Options(**_typed(training.options, Options))


def agent_of(name: str, hyperparameters: dict[str, Any]) -> Any:
    """The agent of that name with hyperparameters as JSON has them."""
    return agents.make(name, **_typed(hyperparameters, agents.make(name)))


def _typed(values: dict[str, Any], like: Any) -> dict[str, Any]:
    """Values from JSON with their original types: tuples for lists, floats for integers where `like` has a float."""

    def typed(name: str, value: Any) -> Any:
        if isinstance(value, int) and not isinstance(value, bool) and isinstance(getattr(like, name, None), float):
            return float(value)
        return value

    return {name: typed(name, value) for name, value in tuples(values).items()}


def _flag(name: str, value: Any) -> list[str]:
    option = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{option}" if value else f"--no-{option}"]
    return [f"--{option}", *(map(str, value) if isinstance(value, list | tuple) else [str(value)])]
