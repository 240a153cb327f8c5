"""Many runs put together: all seeds of one agent with the same settings on one task are one line of a figure."""

import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from beliefrl.analysis import results
from beliefrl.runs.run import Row, Run
from beliefrl.types import UserError

Seed = tuple[Run, int]  # a run and the number of one of its seeds


class Curve(NamedTuple):
    """Means over the episodes of each evaluation; NaN where a seed has diverged."""

    steps: np.ndarray  # (evaluation,)
    seeds: np.ndarray  # (seed, evaluation)

    def since(self, chosen: np.ndarray) -> "Curve":
        """Only the evaluations where `chosen` (evaluation,)."""
        return Curve(self.steps[chosen], self.seeds[:, chosen])


class Group:
    """All seeds of one agent with one set of settings on one task, out of any number of runs."""

    def __init__(self, task: str, label: str, seeds: Sequence[Seed]):
        """`label` is the agent's name, and those settings in which it differs from others beside it."""
        self.task, self.label, self.seeds = task, label, tuple(seeds)

    @property
    def runs(self) -> list[Run]:
        """The runs that its seeds are of, each once."""
        return list({run.folder: run for run, _ in self.seeds}.values())

    @property
    def agent(self) -> str:
        return self.seeds[0][0].config["agent"]

    @cached_property
    def evaluations(self) -> list[list[Row]]:
        """The evaluations of each seed, in the order of `seeds`."""
        return [list(run.rows(seed, "evaluation")) for run, seed in self.seeds]

    def curve(self, name: str = "sampled") -> Curve:
        """An entry of the evaluations (sampled, mode, sampled_success, mode_success), as far as all seeds have come."""
        table = [{row["step"]: float(np.mean(row[name])) for row in rows if name in row} for rows in self.evaluations]
        going = [means for means, (run, seed) in zip(table, self.seeds, strict=True) if not _diverged(run, seed)]
        steps = sorted(set.intersection(*map(set, going or table)))
        return Curve(np.array(steps), np.array([[seed.get(step, np.nan) for step in steps] for seed in table]))

    @property
    def has_success(self) -> bool:
        return any("sampled_success" in row for rows in self.evaluations for row in rows)


class Found(NamedTuple):
    """The runs in some folders, and what is wrong with others there."""

    runs: list[Run]
    damage: list[str]  # a sentence for each run that cannot be read, and for each log with damaged lines


def find(paths: Sequence[str | os.PathLike[str]], opened: Callable[[pathlib.Path], Run] = Run) -> Found:
    """The runs in these folders, which are runs or hold runs at any depth, and in these files of results.

    A run that cannot be read is left out. `opened` opens a run's folder.

    Raises:
        UserError: a folder or file does not exist, holds no run, or none of the runs can be read.
    """
    found: dict[pathlib.Path, Run] = {}
    unreadable: dict[pathlib.Path, str] = {}
    logs: list[str] = []
    for path in map(pathlib.Path, paths):
        if path.name.endswith(results.ENDING):
            found |= {run.folder: run for run in results.read(path)}
            continue
        if not os.path.isdir(path):  # noqa: PTH112 - pathlib's raises where a name is too long
            raise UserError(f"There is no folder {path}: give the --out of a training or of a sweep.")
        inside = sorted(config.parent for config in path.rglob("config.json") if (config.parent / "metrics").is_dir())
        if not (inside or (path / "config.json").exists()):
            raise UserError(f"There is no run in {path}: give the --out of a training or of a sweep.")
        for folder in inside or [path]:
            known = folder.resolve()
            if known in found or known in unreadable:
                continue
            try:
                run = opened(folder)
                logs += run.damage()
                found[known] = run
            except UserError as error:
                unreadable[known] = str(error)
    if unreadable and not found:
        raise UserError(next(iter(unreadable.values())))
    return Found(list(found.values()), [*unreadable.values(), *logs])


def is_finished(run: Run) -> bool:
    """Whether every seed has been evaluated at the last step, or has diverged."""
    return all(_diverged(run, seed) or last_step(run, seed) >= run.options.steps for seed in run.seeds)


def last_step(run: Run, seed: int) -> int:
    """Environment steps of a seed at its last evaluation; 0 before there was one."""
    return max((row["step"] for row in run.rows(seed, "evaluation")), default=0)


def _diverged(run: Run, seed: int) -> bool:
    return any(run.rows(seed, "diverged"))


def groups(runs: Sequence[Run], defaults: Mapping[str, Row] | None = None) -> list[Group]:
    """The runs' seeds put together, in the order in which tasks and agents first come.

    `defaults` are the settings of agents by name (`agents.defaults`): a run that lacks some, as it is older than they
    are, has those; and what is as usual is not in a label.

    Of a seed that was run twice with the same settings only the run that went furthest counts, and of those the latest:
    a seed's number decides everything, so it would count as two what is one.
    """
    usual = {run.config["agent"]: (defaults or {}).get(run.config["agent"], {}) for run in runs}
    settings = {run.folder: usual[run.config["agent"]] | run.config["hyperparameters"] for run in runs}
    seeds: dict[tuple[str, str], dict[int, Run]] = {}
    for run in runs:
        same_agent = [settings[other.folder] for other in runs if other.config["agent"] == run.config["agent"]]
        same_task = [other.config["constants"] for other in runs if task_of(other) == task_of(run)]
        task = " ".join([task_of(run), *_differences(run.config["constants"], same_task)])
        label = " ".join(
            [run.config["agent"], *_differences(settings[run.folder], same_agent, usual[run.config["agent"]])]
        )
        of = seeds.setdefault((task, label), {})
        for seed in run.seeds:
            if seed not in of or _precedence(run, seed) > _precedence(of[seed], seed):
                of[seed] = run
    tasks, labels = ([*dict.fromkeys(names)] for names in zip(*seeds, strict=True)) if seeds else ([], [])
    made = [Group(*names, [(of[seed], seed) for seed in sorted(of)]) for names, of in seeds.items()]
    return sorted(made, key=lambda group: (tasks.index(group.task), labels.index(group.label)))


def _precedence(run: Run, seed: int) -> tuple[int, str]:
    return last_step(run, seed), str(run.config.get("started", ""))


def task_of(run: Run) -> str:
    """A task as figures name it: with what is seen of it, where its name does not say so."""
    seen = run.config.get("observe")
    return run.config["task"] + (f" observe {' '.join(map(str, seen))}" if seen else "")


def _differences(settings: Row, beside: Sequence[Row], usual: Row | None = None) -> list[str]:
    """NAME=VALUE of what is not the same everywhere, nor as usual."""
    return [
        f"{name}={value}"
        for name, value in settings.items()
        if any(other.get(name) != value for other in beside) and (not usual or usual.get(name) != value)
    ]
