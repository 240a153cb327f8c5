"""The search for hyperparameters: trials of an agent on a task, each a training with settings that Optuna chooses.

This process asks Optuna for settings and starts trainings as a sweep does. It reads their logs, reports the returns to
Optuna, and stops the trials that Optuna prunes. A tune's folder:

    study.journal         the trials, as Optuna records them
    trial-NNN/            the folder of each run (`runs`)
    logs/, compiled/      as in a sweep's folder
    history.png, importance.png
"""

import dataclasses
import os
import pathlib
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, get_args

from beliefrl.agents.hyperparameters import Ranges
from beliefrl.errors import UserError, short
from beliefrl.runs.cached import CachedRun
from beliefrl.runs.folder import folder_name
from beliefrl.runs.given_files import as_path
from beliefrl.runs.options import Options
from beliefrl.sweeps import places, ranges, study
from beliefrl.sweeps.experiments import Experiment
from beliefrl.sweeps.plan import Training
from beliefrl.sweeps.progress import SweepStatus, take
from beliefrl.sweeps.run import confirm, lock, loop, reason, reporting, writing
from beliefrl.sweeps.study import Actions, Objective, Search, Trial
from beliefrl.training.stop import Requests
from beliefrl.types import check_whole

LOOK_EVERY = 1.0  # seconds
PATIENCE = 3  # trainings that fail one after the other, after which tuning ends
STOPPED = (130, 143, -2, -15)  # exit codes of a training that was asked to stop, the last two before it began


@dataclasses.dataclass(frozen=True)
class Tuned:
    """The result of `tune`."""

    settings: dict[str, Any]
    """The hyperparameters of the best trial: fixed and tuned ones."""
    value: float
    """The objective of the best trial, in units of the return."""
    command: str
    """A command line that trains the agent with these settings, with seeds that no trial has used."""
    run: pathlib.Path
    """The folder of the best trial's run."""
    study: pathlib.Path
    """Optuna's record of the trials, a journal file."""
    trials: tuple[Trial, ...]
    """All trials: complete ones, the best first, then the others."""


def tune(
    agent: str,
    task: str,
    ranges: Ranges | None = None,
    trials: int = 40,
    seeds: int = 3,
    seed: int = 0,
    only: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
    observe: Sequence[int | str] = (),
    constants: Mapping[str, Any] | None = None,
    objective: Objective = "last",
    actions: Actions = "sampled",
    prune: bool = True,
    out: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> Tuned:
    """Search for good hyperparameters of an agent on a task, with Optuna (the extra `tune`).

    Each trial is a training with settings that Optuna's TPE sampler chooses. The first has the agent's own settings.
    A trial whose seed diverges counts as pruned.

    Args:
        agent, task: names, as in `make_agent` and `make_task`.
        ranges: {name: Range, or a list of values}. They replace or extend the agent's own (its attribute `ranges`).
        trials: the number of trials, with those that the folder already has.
        seeds: seeds of each trial, side by side in one program.
        seed: the first seed of each trial, and the seed of the sampler.
        only: the hyperparameters to tune. Empty: all that have a range.
        settings: fixed hyperparameters, training options (`beliefrl.Options`) such as steps, and faults of the sensors.
        observe, constants: as in `make_task`.
        objective: what is maximised, the mean return over the seeds: "last", over the last 3 evaluations; "area", over
            all evaluations (the area under the learning curve, divided by its length).
        actions: whether these are returns with sampled actions or with mode actions.
        prune: stop a trial if its best objective so far is below the median of the complete trials at the same
            evaluation. It is done after 5 complete trials and after a quarter of the training.
        out: the folder. None: runs/tune-AGENT-TASK. A study in it continues.
        workers: most trials at a time, one per core or GPU. None: as many as there are cores or GPUs.
        progress: show the running trials: live in a terminal or a notebook, otherwise as lines.

    Raises:
        UserError: Optuna is not installed, a name, range or value is impossible, the folder has another study, another
            process uses it, or no trial was complete.
        Stopped: Ctrl-C or SIGTERM, after every trial has written a checkpoint. It is a KeyboardInterrupt.
    """
    _check(trials, seeds, seed, workers, objective, actions)
    _check_names(ranges, only)
    experiment = Experiment(agent, task, settings or {}, range(seed, seed + seeds), observe, constants or {})
    search = Search(experiment, ranges or {}, only, objective, actions)
    study.optuna()  # raises an error if it is not installed
    folder = as_path(out or pathlib.Path("runs") / folder_name(f"tune-{agent}-{task}"))
    with writing(folder):
        _check_folder(folder)
        return _run(folder, search, trials, prune, workers, progress)


def _run(folder: pathlib.Path, search: Search, trials: int, prune: bool, workers: int | None, progress: bool) -> Tuned:
    """Run the trials that are missing."""
    with lock(folder), study.quiet():
        recorded = study.open_study(folder, search, prune)
        stopped = study.running(recorded)
        status = _status(recorded, search.base, trials)
        launcher = places.Local(folder, places.slots(workers))
        with reporting(folder, None, progress) as listen, Requests(confirm) as requests:
            try:
                begun = _Trials(folder, recorded, search, launcher, status, stopped)
                loop(status, begun.step, listen, requests, begun.stop, LOOK_EVERY)
            finally:
                launcher.stop()
        study.draw(recorded, folder)
    return _result(folder, search, study.read(recorded))


def _check(trials: int, seeds: int, seed: int, workers: int | None, objective: str, actions: str) -> None:
    check_whole("trials", trials, 1)
    check_whole("workers", workers, 1, optional=True)
    Options(seeds=seeds, seed=seed)
    for name, value, known in (("objective", objective, Objective), ("actions", actions, Actions)):
        if value not in get_args(known):
            raise UserError(f"{name}={value} is impossible: it must be {' or '.join(get_args(known))}.")


def _check_names(ranges: Any, only: Any) -> None:
    """Raise a UserError if the hyperparameters to search have no names."""
    if not isinstance(ranges, Mapping | None):
        raise UserError(f"ranges={short(ranges)} is impossible: give a dictionary from names to ranges.")
    if isinstance(only, str) or not isinstance(only, Iterable):
        raise UserError(f"only={short(only)} is impossible: give a list of names.")


def _check_folder(folder: pathlib.Path) -> None:
    """Raise a UserError if the folder has files of something else than a study."""
    is_there = os.path.isdir(folder)  # noqa: PTH112 - pathlib's version raises if a name is too long
    others = {path.name for path in folder.iterdir()} - {"lock", "logs"} if is_there else set()
    if others and study.JOURNAL not in others:
        raise UserError(f"{folder} exists already and has no study: choose another --out, in Python out=.")


def _status(recorded: Any, base: Training, trials: int) -> SweepStatus:
    """The state of a study: stopped trials wait to continue, and then as many new ones as are missing."""
    begun = study.read(recorded)

    def those(state: str) -> list[Training]:
        return [dataclasses.replace(base, name=trial.name) for trial in begun if trial.state == state]

    new = [dataclasses.replace(base, name=study.name_of(number)) for number in range(len(begun), trials)]
    failed = {trial.name: trial.why for trial in begun if trial.state == "failed"}
    return SweepStatus(those("complete"), those("running") + new, failed=failed, pruned=those("pruned"))


def _result(folder: pathlib.Path, search: Search, begun: Sequence[Trial]) -> Tuned:
    complete = sorted((each for each in begun if each.state == "complete"), key=lambda each: each.value, reverse=True)
    if not complete:
        why = next((f" ({trial.why.rstrip('.')})" for trial in begun if trial.why), "")
        raise UserError(
            f"No trial in {folder} is complete{why}: give more trials; {folder}/logs has what they printed."
        )
    best = search.training(complete[0].name, complete[0].settings)
    fresh = best.options | {"seed": best.options["seed"] + best.options["seeds"]}
    return Tuned(
        settings=best.settings,
        value=complete[0].value,
        command=shlex.join(["beliefrl", *dataclasses.replace(best, options=fresh).arguments()]),
        run=folder / best.name,
        study=folder / study.JOURNAL,
        trials=(*complete, *(trial for trial in begun if trial.state != "complete")),
    )


class _Trials:
    """Starts trials, reports their evaluations to Optuna, and records how they end."""

    def __init__(
        self,
        folder: pathlib.Path,
        recorded: Any,
        search: Search,
        launcher: places.Local,
        status: SweepStatus,
        stopped: dict[str, tuple[Any, dict[str, Any]]],
    ):
        """`stopped` are the trials to continue, with their settings, by name; they wait in `status`."""
        self.folder, self.study, self.search, self.launcher = folder, recorded, search, launcher
        self.status, self.stopped = status, stopped
        self.trials: dict[str, Any] = {}  # the running ones
        self.reported: dict[str, set[int]] = {}  # their evaluations that Optuna knows
        self.is_poor: set[str] = set()  # names of the trials that are pruned
        self.failures = 0  # since the last trial that did not fail

    def step(self) -> None:
        """Start what there is room for, and look after the running trials."""
        while self.launcher.room > 0 and (waiting := take(self.status, self.folder)):
            self._begin(waiting.name)
        self.collect()
        for name in self.status.running:
            self._watch(name)

    def _begin(self, name: str) -> None:
        """Continue a trial that was stopped, or begin a new one."""
        if name in self.stopped:
            trial, settings = self.stopped.pop(name)
        else:
            trial = self.study.ask()
            settings = ranges.draw(trial, self.search.ranges)
            trial.set_user_attr("settings", settings)
        assert name == study.name_of(trial.number)
        self.status.notes[name] = " ".join(f"{field}={value}" for field, value in settings.items())
        try:
            training = self.search.training(name, settings)
        except UserError as error:  # a combination that the agent refuses
            self._failed(name, trial, str(error))
            return
        self.trials[name], self.status.running[name] = trial, training
        self.reported[name] = set(self.study.trials[trial.number].intermediate_values)
        self.launcher.start(training)

    def _watch(self, name: str) -> None:
        """Report the new evaluations of a trial; stop it if Optuna prunes it, or if a seed has diverged."""
        trial, steps = self.trials[name], self.status.running[name].steps
        if name in self.is_poor or not (self.folder / name / "config.json").exists():
            return
        run = CachedRun(self.folder / name)
        if any(map(run.has_diverged, run.seeds)):
            self.is_poor.add(name)
            self.launcher.interrupt(name)
            return
        returns = self.search.returns(run)
        for step in [each for each in returns if self.search.agent.step_start_rl < each < steps]:
            number = step // self.search.every
            if number not in self.reported[name]:
                self.reported[name].add(number)
                trial.report(self.search.value([value for at, value in returns.items() if at <= step]), number)
                if trial.should_prune():
                    self.is_poor.add(name)
                    self.launcher.interrupt(name)
                    return

    def collect(self, all_stopped: bool = False) -> None:
        """Record the trials that have ended. `all_stopped`: all were asked to stop, and can be continued."""
        states = study.optuna().trial.TrialState
        for name, code in self.launcher.ended().items():
            training, trial = self.status.running.pop(name), self.trials.pop(name)
            run = CachedRun(self.folder / name) if (self.folder / name / "config.json").exists() else None
            diverged = run is not None and any(map(run.has_diverged, run.seeds))
            returns = [] if run is None else list(self.search.returns(run).values())
            if diverged or (code and name in self.is_poor):
                self.failures = 0
                self.study.tell(trial, state=states.PRUNED)
                self.status.notes[name] = "a seed diverged" if diverged else "its return was low"
                self.status.pruned.append(training)
            elif code == 0 and returns:
                self.failures, value = 0, self.search.value(returns)
                self.study.tell(trial, value)
                self.status.notes[name] = f"objective {value:.1f}"
                self.status.finished.append(training)
            elif all_stopped or code in STOPPED:  # if only this trial was stopped, it continues now
                self.status.waiting.insert(len(self.stopped), training)
                self.stopped[name] = trial, trial.user_attrs["settings"]
            else:
                why = reason(self.folder / "logs" / f"{name}.log", code)
                self._failed(name, trial, why)
                self.failures += 1
                if self.failures >= PATIENCE:
                    logs = f"fix the cause; {self.folder}/logs has the output of each"
                    raise UserError(f"The last {self.failures} trials failed ({why.rstrip('.')}): {logs}.")

    def stop(self) -> str:
        """Stop all running trials; returns a sentence about it."""
        self.launcher.stop()
        self.collect(all_stopped=True)
        done = f"{len(self.status.finished) + len(self.status.pruned)} of {self.status.count}"
        return f"stopped with {done} trials done in {self.folder}; the same command continues."

    def _failed(self, name: str, trial: Any, why: str) -> None:
        trial.set_user_attr("why", why)
        self.study.tell(trial, state=study.optuna().trial.TrialState.FAIL)
        self.status.failed[name] = why
