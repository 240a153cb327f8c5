"""Groups of runs: all seeds of one agent with the same settings on one task are one line of a figure."""

import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from beliefrl.analysis import results
from beliefrl.analysis.labels import differences, options, task_labels
from beliefrl.errors import UserError
from beliefrl.runs.given_files import as_path
from beliefrl.runs.records import finite_mean, is_complete, parsed, steps_per_action
from beliefrl.runs.run import Row, Run

OF_RUN = ("checkpoints", "metrics", "tensorboard", "wandb")  # folders in a run's folder that contain no runs
RunSeed = tuple[Run, int]  # a run and one of its seed numbers


class Curve(NamedTuple):
    """Means over the episodes of each evaluation; NaN after a seed has diverged."""

    steps: np.ndarray  # (evaluation,)
    seeds: np.ndarray  # (seed, evaluation)

    def only(self, chosen: np.ndarray) -> "Curve":
        """The evaluations for which `chosen` (evaluation,) is true."""
        return Curve(self.steps[chosen], self.seeds[:, chosen])


class Group:
    """All seeds of one agent with the same settings on one task, from any number of runs."""

    def __init__(self, task: str, label: str, seeds: Sequence[RunSeed]):
        """`label` is the agent's name, followed by the settings in which this group differs from the others."""
        self.task, self.label, self.seeds = task, label, tuple(seeds)

    @property
    def runs(self) -> list[Run]:
        """The runs that contain the seeds, each once."""
        return list({run.folder: run for run, _ in self.seeds}.values())

    @property
    def agent(self) -> str:
        return self.seeds[0][0].config["agent"]

    @property
    def axis(self) -> str:
        """The label of the axis of steps. With action repeat a step of the agent is several of the environment."""
        return "environment steps" if steps_per_action(self.runs[0].config) == 1 else "steps of the agent"

    @cached_property
    def evaluations(self) -> list[list[Row]]:
        """The evaluations of each seed, in the order of `seeds`."""
        return [list(run.rows(seed, "evaluation")) for run, seed in self.seeds]

    @cached_property
    def diverged(self) -> np.ndarray:
        """Which seeds have diverged, (seed,)."""
        return np.array([run.has_diverged(seed) for run, seed in self.seeds])

    @cached_property
    def stopped(self) -> np.ndarray:
        """Which seeds have ended at their `stop_at`, (seed,)."""
        return np.array([_has_stopped(run) for run, _ in self.seeds])

    def curve(self, name: str = "sampled") -> Curve:
        """An entry of the evaluations (sampled, mode, sampled_success, ...), at steps that all seeds have.

        A seed that has ended at its `stop_at` keeps its last value at the later steps of the others.
        """
        table = [{row["step"]: finite_mean(row[name]) for row in rows if name in row} for rows in self.evaluations]
        every = {step for means in table for step in means}
        for means in (table[seed] for seed in np.flatnonzero(self.stopped & ~self.diverged) if table[seed]):
            last = max(means)
            means |= {step: means[last] for step in every if step > last}
        healthy = [means for means, diverged in zip(table, self.diverged, strict=True) if not diverged]
        steps = sorted(set.intersection(*map(set, healthy or table)))
        return Curve(np.array(steps), np.array([[seed.get(step, np.nan) for step in steps] for seed in table]))

    def final(self, name: str = "sampled", step: int | None = None) -> np.ndarray:
        """The last values of a curve, or those at a step, (seed,). NaN: the seed has diverged, or there are none."""
        curve = self.curve(name)
        at = curve if step is None else curve.only(curve.steps == step)
        last = at.seeds[:, -1] if at.steps.size else np.full(len(self.seeds), np.nan)
        return np.where(self.diverged, np.nan, last)

    @property
    def why_no_curve(self) -> str | None:
        """Why there is no curve; None if there is one."""
        if self.curve().steps.size:
            return None
        return "all seeds have diverged" if self.diverged.all() else "its seeds have no evaluation at the same step"

    @property
    def measures(self) -> list[str]:
        """The numbers that are recorded for an episode besides return and length, such as "success"."""
        names = dict.fromkeys(name for rows in self.evaluations for row in rows for name in row)
        return [name.removeprefix("sampled_") for name in names if name.startswith("sampled_")]


class FoundRuns(NamedTuple):
    """The runs in some folders, and the damage that was found there."""

    runs: list[Run]
    damage: list[str]  # one sentence for each unreadable run and for each log with damaged lines


def find(
    paths: Sequence[str | os.PathLike[str]] | str | os.PathLike[str], read: Callable[[pathlib.Path], Run] = Run
) -> FoundRuns:
    """The runs at these paths: a path is a run, a folder with runs at any depth, or a file of results.

    A run that cannot be read is left out. `read` makes a run from its folder.

    Raises:
        UserError: a path does not exist or contains no run, or none of the runs can be read.
    """
    found: dict[pathlib.Path, Run] = {}
    unreadable: dict[pathlib.Path, str] = {}
    logs: list[str] = []
    given = paths if isinstance(paths, Iterable) and not isinstance(paths, str) else [paths]
    for path in map(as_path, given):
        if path.name.endswith(results.ENDING):
            found |= {run.folder: run for run in results.read(path)}
            continue
        if not os.path.isdir(path):  # noqa: PTH112 - pathlib's version raises if a name is too long
            raise UserError(f"There is no folder {path}: give the folder of a run or of a sweep.")
        inside = sorted(filter(_is_run, _folders(path)))
        if not (inside or os.path.exists(path / "config.json")):  # noqa: PTH110
            raise UserError(f"There is no run in {path}: give the folder of a run or of a sweep.")
        for folder in inside or [path]:
            known = folder.resolve()
            if known in found or known in unreadable:
                continue
            try:
                run = read(folder)
                logs += run.damage()
                found[known] = run
            except UserError as error:
                unreadable[known] = str(error)
    if unreadable and not found:
        raise UserError(next(iter(unreadable.values())))
    return FoundRuns(list(found.values()), [*unreadable.values(), *logs])


def _folders(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """The folder and all folders inside, also through links, each once."""
    seen = set()
    for folder, inside, _ in os.walk(path, followlinks=True):
        real = os.path.realpath(folder)
        if real in seen:
            inside.clear()  # a link to a folder above
        else:
            if os.path.exists(os.path.join(folder, "config.json")):  # noqa: PTH110, PTH118
                inside[:] = [name for name in inside if name not in OF_RUN]
            seen.add(real)
            yield pathlib.Path(folder)


def _is_run(folder: pathlib.Path) -> bool:
    """Whether there is a config.json of a training; where it is damaged, the folder of the logs tells."""
    config = folder / "config.json"
    has_logs = os.path.isdir(folder / "metrics")  # noqa: PTH112 - pathlib's version raises if a name is too long
    return os.path.exists(config) and (has_logs or is_complete(parsed(config)))  # noqa: PTH110


def is_finished(run: Run) -> bool:
    """Whether every seed has been evaluated at the last step, or has diverged, or all have reached `stop_at`."""
    if _has_stopped(run):
        return True
    return all(run.has_diverged(seed) or last_step(run, seed) >= run.options.steps for seed in run.seeds)


def has_begun(run: Run) -> bool:
    """Whether every seed has been evaluated, or has diverged."""
    return all(last_step(run, seed) > 0 or run.has_diverged(seed) for seed in run.seeds)


def _has_stopped(run: Run) -> bool:
    return run.reached(run.options.stop_at, run.options.stop_patience)


def last_step(run: Run, seed: int) -> int:
    """Environment steps of a seed at its last evaluation; 0 if there is none."""
    return max((row["step"] for row in run.rows(seed, "evaluation")), default=0)


def groups(
    runs: Sequence[Run], defaults: Mapping[str, Row] | None = None, before: Mapping[str, Row] | None = None
) -> list[Group]:
    """The runs' seeds, grouped; tasks and agents keep the order in which they first occur.

    `defaults` are the default settings of each agent by name (`agents.defaults`). A setting with its default value is
    not shown in a label. If a run is older than a setting, the setting has its value in `before` (`agents.before`), or
    else its default.

    If a seed was trained several times with the same settings, only the run with the most steps counts, and among equal
    ones the latest, because such trainings are no independent samples. `left_out` has the others.
    """
    usual = {run.config["agent"]: (defaults or {}).get(run.config["agent"], {}) for run in runs}
    filled = {agent: usual[agent] | (before or {}).get(agent, {}) for agent in usual}
    settings = {run.folder: filled[run.config["agent"]] | run.config["hyperparameters"] for run in runs}
    seeds: dict[tuple[str, str], dict[int, Run]] = {}
    names = dict(zip([run.folder for run in runs], task_labels(runs), strict=True))
    for run in runs:
        same_agent = [settings[other.folder] for other in runs if other.config["agent"] == run.config["agent"]]
        same_task = [other.config["constants"] for other in runs if names[other.folder] == names[run.folder]]
        task = " ".join([names[run.folder], *sorted(differences(run.config["constants"], same_task))])
        own = results.changed(settings[run.folder], usual[run.config["agent"]])
        label = " ".join([run.config["agent"], *differences(own, same_agent), *options(run)])
        of = seeds.setdefault((task, label), {})
        for seed in run.seeds:
            if seed not in of or _precedence(run, seed) > _precedence(of[seed], seed):
                of[seed] = run
    tasks, labels = ([*dict.fromkeys(each)] for each in zip(*seeds, strict=True)) if seeds else ([], [])
    merged = [Group(*each, [(of[seed], seed) for seed in sorted(of)]) for each, of in seeds.items()]
    return sorted(merged, key=lambda group: (tasks.index(group.task), labels.index(group.label)))


def left_out(runs: Sequence[Run], shown: Sequence[Group]) -> list[str]:
    """A sentence for each run with seeds that are counted from another run, each group without a curve, and each group
    whose curve ends before the last evaluation of its longest seed.
    """
    counted = {(run.folder, seed) for group in shown for run, seed in group.seeds}
    missing = [(run, [seed for seed in run.seeds if (run.folder, seed) not in counted]) for run in runs]
    twice = [_counted_elsewhere(run, seeds) for run, seeds in missing if seeds]
    without = [
        f"left out: {group.label} on {group.task}: {group.why_no_curve}" for group in shown if group.why_no_curve
    ]
    return twice + without + [why for group in shown if (why := shortened_by(group))]


def _counted_elsewhere(run: Run, seeds: Sequence[int]) -> str:
    shown, lost = (" ".join(map(str, some)) for some in (seeds, filter(run.has_diverged, seeds)))
    also = f". In {run.shown}, seed {lost} diverged" if lost else ""  # the failure is not hidden
    return f"left out: {run.shown}, seed {shown}: another run has the same settings and seed{also}"


def shortened_by(group: Group) -> str | None:
    """A sentence if the curve of a group ends early, because one of its runs does; None if not."""
    going = [group.seeds[index] for index in np.flatnonzero(~group.diverged)]
    ends = [group.seeds[index] for index in np.flatnonzero(~group.diverged & ~group.stopped)] or going
    steps = group.curve().steps
    if not (going and steps.size):
        return None
    (run, seed), longest = min(ends, key=lambda pair: last_step(*pair)), max(last_step(*pair) for pair in going)
    if steps[-1] >= longest:
        return None
    return (
        f"{group.label} on {group.task} ends at step {steps[-1]:,}, the last that all of its seeds have: {run.shown}, "
        f"seed {seed}, ends at {last_step(run, seed):,}, and another seed at {longest:,}"
    )


def _precedence(run: Run, seed: int) -> tuple[int, str]:
    return last_step(run, seed), str(run.config.get("started", ""))
