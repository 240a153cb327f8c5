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
from beliefrl.types import UserError

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
    """The normalised final returns of each label, for the tasks that all labels have. A diverged seed scores 0.

    For a task without an entry in BOUNDS, a return of 0 scores 0, and the best mean return of these groups scores 1. If
    no mean is above 0, the lowest return of a seed scores 0.

    Raises:
        UserError: there is no task that all labels have, or no group has an evaluation of all its seeds.
    """
    usable = [group for group in groups if group.diverged.all() or group.curve(mode).steps.size]
    groups = usable or with_curve(groups, mode)  # raises an error if there is none
    labels = list(dict.fromkeys(group.label for group in groups))
    tasks = [task for task in tasks_of(groups) if {g.label for g in groups if g.task == task} == set(labels)]
    if not tasks:
        raise UserError("There is no task that all of these agents have: give runs on the same tasks.")
    final = {(group.task, group.label): group.final(mode) for group in groups}
    table: dict[str, Scores] = {}
    for label in labels:
        table[label] = [_normalised(final[task, label], bounds(task, final)) for task in tasks]
    return table


def bounds(task: str, final: dict[tuple[str, str], np.ndarray]) -> tuple[float, float]:
    """The returns that have the scores 0 and 1."""
    of_task = [values for (of, _), values in final.items() if of == task]
    best = max((float(np.nanmean(values)) for values in of_task if np.isfinite(values).any()), default=1.0)
    lowest = min((float(np.nanmin(values)) for values in of_task if np.isfinite(values).any()), default=0.0)
    return known_bounds(task) or ((0.0, best) if best > 0 else (min(lowest, float(np.nextafter(best, -np.inf))), best))


def known_bounds(task: str) -> tuple[float, float] | None:
    """The task's entry in BOUNDS, also for its masked versions, and with faults or other constants; None without one.

    `task` is the task's name in figures. Its first word is the name without faults and constants.
    """
    return BOUNDS.get(task.split()[0].removesuffix("-v").removesuffix("-p"))


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
        low, high = interval(interquartile_mean, values)
        left.barh(row, high - low, left=low, height=0.5, color=colour[label], alpha=0.35)
        left.plot([interquartile_mean(values)] * 2, [row - 0.25, row + 0.25], color=colour[label], linewidth=2)
        low, high = interval(lambda drawn: profile(drawn, thresholds), values)
        right.plot(thresholds, profile(values, thresholds), color=colour[label], linewidth=1.6)
        right.fill_between(thresholds, low, high, color=colour[label], alpha=0.15, linewidth=0)
    left.set_yticks(range(len(table)), list(reversed(table)))
    left.set_xlabel("interquartile mean of scores")
    right.set_xlabel("score τ")
    right.set_ylabel("fraction of runs with score > τ")
    for axis in (left, right):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    tasks, seeds = len(next(iter(table.values()))), sorted({len(task) for of in table.values() for task in of})
    counted = f"{tasks} {'task' if tasks == 1 else 'tasks'}, {counts(seeds)} seeds of each"
    add_legend(made, colour, f"{counted}; 95 % stratified bootstrap intervals")
    return save(made, out)
