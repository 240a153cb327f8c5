"""The summary of an evaluation: means over its episodes, and over the seeds."""

from typing import Any

import numpy as np

from beliefrl.runs.records import finite_mean, finite_or_none
from beliefrl.training.rollout import Episode

MODES = ("sampled", "mode")  # how actions are chosen; the second axis of an evaluation's leaves, after that of seeds


def summary(result: Episode) -> dict[str, Any]:
    """For each mode: the mean return of every seed, their mean, its standard error (None with one seed), the measures.

    Leaves of `result` are (seed, mode, episodes).
    """
    returns = np.asarray(result.episode_return)
    table = {}
    for index, mode in enumerate(MODES):
        seeds = returns[:, index].mean(axis=-1)
        finite = seeds[np.isfinite(seeds)]  # a diverged seed has no returns
        table[mode] = {
            "mean": float(finite.mean()),
            "sem": float(finite.std(ddof=1) / np.sqrt(finite.size)) if finite.size > 1 else None,
            "seeds": list(map(finite_or_none, seeds)),
            "success": None,
            "seeds_success": None,
        }
        for name, values in result.measures.items():
            of_seeds = [finite_mean(episodes) for episodes in np.asarray(values)[:, index]]
            table[mode][name] = finite_or_none(finite_mean(of_seeds))
            table[mode][f"seeds_{name}"] = list(map(finite_or_none, of_seeds))
    return table
