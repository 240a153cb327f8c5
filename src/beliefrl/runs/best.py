"""The best agent of each seed, in a file with the evaluations in which they were the best.

The file has the agents only, without optimisers and replay. It is replaced atomically, and only when a seed improves.
So resuming neither loses it nor replaces an agent by a worse one.
"""

import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from beliefrl.runs import arrays, records

BEST = "best.safetensors"


def evaluations(folder: pathlib.Path, seeds: int) -> list[dict[str, Any] | None]:
    """{"step", "return"} of the best evaluation of each of a run's `seeds` seeds; None if there is none.

    The return is the mean over the episodes with sampled actions.

    Raises:
        Damaged: the file cannot be read.
    """
    path = folder / BEST
    if not path.exists():
        return [None] * seeds
    found = records.best_evaluations(arrays.about(path).get("evaluations", ""), seeds)
    if found is None:
        raise arrays.damaged(path)
    return found


def save(folder: pathlib.Path, agents: Any, step: int, returns: Sequence[float]) -> None:
    """Save the agents of the seeds that have their highest return so far in the evaluation at `step`.

    Args:
        folder: the folder of the run.
        agents: the agents of all seeds, leaves (seed, ...).
        step: the step of the evaluation.
        returns: the mean return of each seed, NaN for one that has diverged.

    A damaged file is moved to damaged-best.safetensors.
    """
    path = folder / BEST
    try:
        found = evaluations(folder, len(returns))
        saved = arrays.load(path) if path.exists() else {}  # it may be cut off
    except arrays.Damaged:
        path.replace(folder / f"damaged-{BEST}")
        found, saved = evaluations(folder, len(returns)), {}
    pairs = enumerate(zip(returns, found, strict=True))
    better = [index for index, (new, old) in pairs if np.isfinite(new) and (old is None or new > old["return"])]
    if not better:
        return
    new = arrays.copied(agents)
    saved = saved or new
    for name, array in new.items():
        saved[name][better] = array[better]
    for index in better:
        found[index] = {"step": step, "return": float(returns[index])}
    arrays.write_whole(path, arrays.packed(saved, {"evaluations": json.dumps(found)}))
