"""A study of `tune`: the search space, the objective, and Optuna's record of the trials, in one file.

Optuna's journal is a file of JSON lines. Only the process that has locked the folder writes it.
"""

import contextlib
import dataclasses
import math
import os
import pathlib
import statistics
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from beliefrl.agents.hyperparameters import Ranges
from beliefrl.analysis import figures
from beliefrl.errors import UserError, short
from beliefrl.runs.options import Options
from beliefrl.runs.run import Run
from beliefrl.sweeps import ranges
from beliefrl.sweeps.experiments import Experiment
from beliefrl.sweeps.plan import Training, agent_of, plan
from beliefrl.types import plain

JOURNAL = "study.journal"
RECORD = "search"  # the attribute of a study with `Search.record`
STARTUP = 5  # finished trials before the first one is pruned
WARMUP = 0.25  # fraction of a training in which no trial is pruned
LAST = 3  # evaluations in the objective "last"
Objective = Literal["last", "area"]
Actions = Literal["sampled", "mode"]


class Trial(NamedTuple):
    """A trial of a study."""

    name: str  # of its run's folder
    state: str  # "complete", "pruned", "failed", or "running" if it continues
    value: float  # the objective; NaN unless it is complete
    settings: dict[str, Any]  # the hyperparameters that were drawn
    why: str = ""  # the cause, if it failed


def optuna() -> Any:
    """The package.

    Raises:
        UserError: it is not installed.
    """
    try:
        import optuna as package  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise UserError("tune needs Optuna: pip install 'beliefrl[tune]'.") from None
    return package


def name_of(number: int) -> str:
    """The name of a trial's run."""
    return f"trial-{number:03d}"


class Search:
    """A search: the training with its fixed settings, the ranges, and the objective."""

    def __init__(
        self, experiment: Experiment, given: Ranges, only: Sequence[str], objective: Objective, actions: Actions
    ):
        """Arguments are those of `tune`; `given` are its ranges."""
        self.experiment, self.objective, self.actions = experiment, objective, actions
        self.base = self.training("trial", {})
        if self.base.options.get("stop_at") is not None:
            raise UserError("stop_at is impossible in a search: trials are compared after the same steps.")
        self.agent = agent_of(experiment.agent, self.base.settings)
        self.ranges = ranges.chosen(self.agent, experiment.agent, given, only, list(self.base.settings))
        self.every: int = self.base.options.get("eval_every", Options.eval_every)

    def training(self, name: str, drawn: Mapping[str, Any]) -> Training:
        """The training of a trial with the settings that it has drawn.

        Raises:
            UserError: the agent refuses them.
        """
        settings = {**self.experiment.settings, **drawn}
        made = plan([dataclasses.replace(self.experiment, settings=settings)], len(self.experiment.seeds))
        return dataclasses.replace(made[0], name=name)

    @property
    def record(self) -> dict[str, Any]:
        """Everything that all trials of a study have in common, as JSON."""
        base = self.base
        common = {"agent": base.agent, "task": base.task, "observe": base.observe}
        common |= {"objective": self.objective, "actions": self.actions}
        common |= {**base.options, **base.settings, **base.faults, **base.constants}
        common |= {f"range of {name}": values for name, values in ranges.as_json(self.ranges).items()}
        return plain(common)

    def returns(self, run: Run) -> dict[int, float]:
        """The return at each evaluation that every seed has, mean over seeds and episodes: {step: return}."""
        seeds = [
            {row["step"]: statistics.fmean(row[self.actions]) for row in run.rows(seed, "evaluation")}
            for seed in run.seeds
        ]
        common = sorted(set.intersection(*map(set, seeds)))
        return {step: statistics.fmean(each[step] for each in seeds) for step in common}

    def value(self, returns: Sequence[float]) -> float:
        """The objective after these evaluations."""
        return statistics.fmean(returns[-LAST:] if self.objective == "last" else returns)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep Optuna's messages about single trials, and its warnings about experimental figures, off the screen."""
    logging = optuna().logging
    before = logging.get_verbosity()
    logging.set_verbosity(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="optuna")
            warnings.simplefilter("ignore", optuna().exceptions.ExperimentalWarning)
            yield
    finally:
        logging.set_verbosity(before)


def open_study(folder: pathlib.Path, search: Search, prune: bool) -> Any:
    """The study in a locked folder, or a new one. Its first trial has the agent's own settings.

    Raises:
        UserError: the journal is damaged, or belongs to another study.
    """
    package, path = optuna(), folder / JOURNAL
    _repair(path)
    journal = package.storages.journal
    evaluations = search.base.steps // search.every
    pruner = package.pruners.MedianPruner(STARTUP, n_warmup_steps=int(WARMUP * evaluations))
    try:
        storage = package.storages.JournalStorage(
            journal.JournalFileBackend(str(path), journal.JournalFileOpenLock(str(path)))
        )
        study = package.create_study(
            storage=storage,
            study_name="tune",
            direction="maximize",
            load_if_exists=True,
            pruner=pruner if prune else package.pruners.NopPruner(),
        )
        count = len(study.trials)
    except (ValueError, KeyError, TypeError, AssertionError):
        raise UserError(f"{path} is damaged: restore it from a copy, or choose another --out.") from None
    seed = search.base.options["seed"] + count  # a resumed study does not draw the same numbers again
    study.sampler = package.samplers.TPESampler(seed=seed)
    if RECORD in study.user_attrs:
        recorded = study.user_attrs[RECORD]
        as_text = {"observe": [str(entry) for entry in recorded.get("observe", ())]}  # older studies may have numbers
        _check_same(folder, recorded | as_text, search.record)
    else:
        study.set_user_attr(RECORD, search.record)
        own = {name: getattr(search.agent, name) for name in search.ranges}
        study.enqueue_trial(ranges.parameters(search.ranges, own))
    return study


def _repair(path: pathlib.Path) -> None:
    """Remove the remains of a process that was killed while it wrote: a part of a line, and Optuna's lock."""
    path.with_name(path.name + ".lock").unlink(missing_ok=True)
    if path.exists():
        content = path.read_bytes()
        if not content.endswith(b"\n"):
            os.truncate(path, content.rfind(b"\n") + 1)  # a full disk cannot lose the rest


def _check_same(folder: pathlib.Path, recorded: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise a UserError if a study was started with other settings than those that are asked for now."""
    for name in [*asked, *recorded]:
        before, now = recorded.get(name), asked.get(name)
        if before != now:
            shown = f"{name}: {short(before)}, not {short(now)}"
            raise UserError(f"The study in {folder} has another {shown}; choose another --out, in Python out=.")


def running(study: Any) -> dict[str, tuple[Any, dict[str, Any]]]:
    """The trials that were stopped, with their settings, by name. They can be continued.

    A trial without settings was stopped before its training began. It counts as failed.
    """
    package, found = optuna(), {}
    for trial in study.get_trials(states=(package.trial.TrialState.RUNNING,)):
        if "settings" in trial.user_attrs:
            going = package.trial.Trial(study, trial._trial_id)
            found[name_of(trial.number)] = going, trial.user_attrs["settings"]
        else:
            study.tell(trial.number, state=package.trial.TrialState.FAIL)
    return found


def read(study: Any) -> list[Trial]:
    """All trials that have begun, in their order."""
    states = {"COMPLETE": "complete", "PRUNED": "pruned", "FAIL": "failed", "RUNNING": "running"}
    return [
        Trial(
            name_of(trial.number),
            states[trial.state.name],
            trial.value if trial.state.name == "COMPLETE" else math.nan,
            trial.user_attrs.get("settings", {}),
            trial.user_attrs.get("why", ""),
        )
        for trial in study.get_trials(deepcopy=False)
        if trial.state.name in states
    ]


def draw(study: Any, folder: pathlib.Path) -> list[pathlib.Path]:
    """Optuna's figures of a study, as PNG and PDF; returns the paths of the PNGs.

    The importance of hyperparameters needs two complete trials with different objectives.
    """
    import matplotlib

    drawn = []
    with quiet(), matplotlib.rc_context():  # Optuna changes matplotlib's style
        from matplotlib import pyplot
        from optuna.visualization import matplotlib as plots  # pyright: ignore[reportMissingImports]

        values = {trial.value for trial in read(study) if trial.state == "complete"}
        for name, plot in (("history", plots.plot_optimization_history), ("importance", plots.plot_param_importances)):
            if len(values) >= (1 if name == "history" else 2):
                figure: Any = plot(study, target_name="objective").figure
                figure.tight_layout()  # its labels may be long
                drawn.append(figures.save(figure, folder / f"{name}.png"))
                pyplot.close(figure)
    return drawn
