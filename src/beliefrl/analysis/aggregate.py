"""Aggregate results of agents over many tasks, with confidence intervals (Agarwal et al. 2021, Sections 4.1 to 4.3).

A score is a normalised final return: 0 is the return of a random policy, 1 is the return of a good policy (`BOUNDS`).
The interquartile mean is the mean of the middle half of the scores of all seeds on all tasks. The performance profile
is the fraction of these scores above a threshold τ, as a function of τ. The 95 % intervals come from a stratified
bootstrap, which resamples the seeds within each task.
"""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from beliefrl.analysis.figures import figure, save
from beliefrl.analysis.groups import Group
from beliefrl.analysis.panels import add_legend, colours, counts, legend_height, tasks_of, with_curve
from beliefrl.catalogue import split_mask, usual_constants
from beliefrl.errors import UserError

Scores = Sequence[Float[np.ndarray, " seed"]]  # one array for each task

BOUNDS = {  # measured return of a random policy (uniform actions, 1,000 episodes); return of a good policy
    "pendulum": (-1_214.4, -150.0),
    "cartpole": (17.4, 1_000.0),
    "target-reaching": (0.7, 140.0),
}
RESAMPLES = 2_000
WIDTH = 8.0  # inches
LEVEL = 0.95


def interquartile_mean(scores: Scores) -> float:
    """The mean of the middle half of all scores."""
    from scipy.stats import trim_mean

    return float(trim_mean(np.concatenate(scores), 0.25))


def profile(scores: Scores, thresholds: Float[np.ndarray, " threshold"]) -> Float[np.ndarray, " threshold"]:
    """The fraction of all scores above each threshold."""
    return np.mean(np.concatenate(scores)[:, None] > thresholds, axis=0)


def interval(
    statistic: Callable[[Scores], Any], scores: Scores, resamples: int = RESAMPLES, seed: int = 0
) -> tuple[Any, Any]:
    """The lower and upper end of a statistic's 95 % interval, by a bootstrap within each task."""
    random = np.random.default_rng(seed)
    drawn = [statistic([random.choice(task, task.size) for task in scores]) for _ in range(resamples)]
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return low, high


def scores(groups: Sequence[Group], mode: str = "sampled") -> dict[str, Scores]:
    """The normalised returns of each label, for the tasks that all labels have. A diverged seed scores 0.

    They are returns at the last step that all labels have on the task. For a task without an entry in BOUNDS, a return
    of 0 scores 0, and the best mean return of these groups scores 1. If no mean is above 0, the lowest return of a seed
    scores 0.

    Raises:
        UserError: there is no task on which all labels have an evaluation at the same step, or no group has an
            evaluation of all its seeds.
    """
    groups = _usable(groups, mode) or with_curve(groups, mode)  # raises an error if there is none
    labels = list(dict.fromkeys(group.label for group in groups))
    steps = common_steps(groups, mode)
    if not steps:
        raise UserError(
            "There is no task on which all of these agents have an evaluation at the same step: give runs on the same "
            "tasks, with the same --eval-every."
        )
    of = {(group.task, group.label): group.final(mode, steps[group.task]) for group in groups if group.task in steps}
    return {label: [_normalised(of[task, label], bounds(task, of)) for task in steps] for label in labels}


def _usable(groups: Sequence[Group], mode: str) -> list[Group]:
    return [group for group in groups if group.diverged.all() or group.curve(mode).steps.size]


def common_steps(groups: Sequence[Group], mode: str = "sampled") -> dict[str, int]:
    """For each task that all labels have, the last step at which all of them have an evaluation."""
    labels = {group.label for group in groups}
    found = {}
    for task in tasks_of(groups):
        there = [group for group in groups if group.task == task]
        steps = [set(group.curve(mode).steps.tolist()) for group in there if not group.diverged.all()]
        common = set.intersection(*steps) if steps else {0}
        if {group.label for group in there} == labels and common:
            found[task] = max(common)
    return found


def notes(groups: Sequence[Group], mode: str = "sampled") -> list[str]:
    """A sentence for each task left out or compared before an agent's last step; one if tasks count unequally."""
    usable = _usable(groups, mode)
    steps, said = common_steps(usable, mode), []
    for task in tasks_of(groups):
        there = [group for group in usable if group.task == task and not group.diverged.all()]
        last = max((max(group.curve(mode).steps, default=0) for group in there), default=0)
        if task not in steps:
            said.append(f"left out: {task}: not all agents have an evaluation at the same step there")
        elif steps[task] < last:
            said.append(f"{task} is compared at step {steps[task]:,}, the last that all agents have; one has {last:,}")
    counted = [(group.label, len(group.seeds)) for group in usable if group.task in steps]
    if len(set(counted)) > len(dict(counted)):
        said.append("an agent with more seeds on one task than on another counts that task more")
    return said


def bounds(task: str, final: dict[tuple[str, str], np.ndarray]) -> tuple[float, float]:
    """The returns that have the scores 0 and 1."""
    of_task = [values for (of, _), values in final.items() if of == task]
    best = max((float(np.nanmean(values)) for values in of_task if np.isfinite(values).any()), default=1.0)
    lowest = min((float(np.nanmin(values)) for values in of_task if np.isfinite(values).any()), default=0.0)
    return known_bounds(task) or ((0.0, best) if best > 0 else (min(lowest, float(np.nextafter(best, -np.inf))), best))


def known_bounds(task: str) -> tuple[float, float] | None:
    """The task's entry in BOUNDS, also for its masked versions and with faults; None without one.

    `task` is the task's name in figures (`labels.task_label`). With other constants the returns have other bounds.
    """
    name, *changed = task.split()
    if (usual_constants(name) or {}).keys() & {word.partition("=")[0] for word in changed}:
        return None
    return BOUNDS.get(split_mask(name)[0])


def _normalised(returns: np.ndarray, ends: tuple[float, float]) -> np.ndarray:
    low, high = ends
    return np.nan_to_num((returns - low) / (high - low), nan=0.0)


def draw_aggregate(groups: Sequence[Group], out: pathlib.Path, mode: str = "sampled") -> pathlib.Path:
    """Draw interquartile means with intervals, and performance profiles; returns the path of the PNG.

    Raises:
        UserError: there is no task that all agents have, or the files cannot be written.
    """
    table = scores(groups, mode)
    colour = colours(list(table))
    made = figure(WIDTH, 2.95 + legend_height([*table], WIDTH))
    left, right = made.subplots(1, 2, width_ratios=(1, 1.3))
    thresholds = np.linspace(0.0, 1.0, 101)
    for row, (label, values) in enumerate(reversed(table.items())):
        left.plot([interquartile_mean(values)] * 2, [row - 0.25, row + 0.25], color=colour[label], linewidth=2)
        right.plot(thresholds, profile(values, thresholds), color=colour[label], linewidth=1.6)
        if min(map(len, values)) == 1:  # a bootstrap of one seed has no width
            continue
        low, high = interval(interquartile_mean, values)
        left.barh(row, high - low, left=low, height=0.5, color=colour[label], alpha=0.35)
        low, high = interval(lambda drawn: profile(drawn, thresholds), values)
        right.fill_between(thresholds, low, high, color=colour[label], alpha=0.15, linewidth=0)
    left.set_yticks(range(len(table)), list(reversed(table)))
    left.set_xlabel("interquartile mean of scores")
    right.set_xlabel("score τ")
    right.set_ylabel("fraction of runs with score > τ")
    for axis in (left, right):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    add_legend(made, colour, _legend(table, groups, mode))
    return save(made, out)


def _legend(table: dict[str, Scores], groups: Sequence[Group], mode: str) -> str:
    """The legend's title: tasks, seeds, actions, diverged seeds and intervals."""
    tasks, seeds = len(next(iter(table.values()))), {len(task) for of in table.values() for task in of}
    usable = _usable(groups, mode)
    steps = common_steps(usable, mode)
    lost = sum(int(group.diverged.sum()) for group in usable if group.task in steps)
    return "; ".join(
        [
            f"{tasks} task{'s' * (tasks > 1)}, {counts(seeds)} seed{'s' * (max(seeds) > 1)} of each",
            *(["mode actions"] if mode == "mode" else []),
            *([f"{lost} diverged, with score 0"] if lost else []),
            "95 % stratified bootstrap intervals" + (", none with one seed on a task" if min(seeds) == 1 else ""),
        ]
    )
