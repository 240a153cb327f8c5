"""Returns of trained agents over episodes and seeds, with sampled and with mode actions."""

import contextlib
import os
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from beliefrl.agents import Agent
from beliefrl.errors import UserError
from beliefrl.runs.options import MOST_EPISODES
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import log
from beliefrl.training.compilation import keep_compiled
from beliefrl.training.host_evaluation import Evaluation
from beliefrl.training.lockstep import Lockstep
from beliefrl.training.phases import evaluate as evaluate_seed
from beliefrl.training.restore import restore
from beliefrl.training.rollout import Episode
from beliefrl.training.summary import MODES, summary
from beliefrl.types import check_whole


def evaluate(
    run: Run | str | os.PathLike[str],
    episodes: int = 20,
    seed: int = 0,
    task: Task | GymnasiumTask | type | None = None,
    agent: Agent | type | None = None,
    progress: bool = True,
    best: bool = False,
    own_process: bool = False,
) -> dict[str, Any]:
    """Let the trained agents of a run play `episodes` new episodes, once with sampled and once with mode actions.

    Args:
        run: a run, or its folder.
        episodes: episodes for each seed of the run and each mode.
        seed: the random seed of these episodes: the same seed gives the same numbers.
        task: needed only if the run was trained on a task of your own: that task, or the class of its environments.
        agent: needed only if an agent of your own was trained: its class, or an instance.
        progress: show the progress while episodes are played: live in a terminal or a notebook; elsewhere a line after
            three seconds, and then once a minute.
        best: play with the best agent of each seed, not with its last one. It had the highest mean return, with sampled
            actions, of all evaluations during the training.
        own_process: as in `train`. Then each environment of a run with processes="always" has a process of its own.

    Returns:
        {"episodes", "diverged", "sampled": {"mean", "sem", "seeds", "returns", "lengths", "success", "seeds_success"},
        "mode": the same}. Returns are undiscounted; "sem" is over seeds and None with one. "returns" and "lengths" are
        those of all episodes, a list for each seed. "success" is a rate in [0, 1], None if the task does not define
        success. Other measures of the task have entries of the same kind, such as "distance" and "seeds_distance".
        "diverged" has the seeds that diverged in the training. They play with their last good agent; without one, their
        returns are NaN.

    Raises:
        UserError: there is no such run, nothing was saved in it, all seeds diverged before their first evaluation, or a
            number is impossible.
    """
    check_whole("episodes", episodes, 1, MOST_EPISODES)
    check_whole("seed", seed, 0)
    run = run if isinstance(run, Run) else Run(run)
    trained, found, states, precision = restore(run, task, agent, best)
    lost = np.flatnonzero(~np.asarray(log.finite(states))).tolist()
    if len(lost) == len(run.seeds):
        raise UserError(f"All seeds of {run.shown} diverged before their first evaluation, so it has no agent.")
    keep_compiled()
    keys = jax.random.split(jax.random.key(seed), len(run.seeds))
    with _showing(progress, 2 * episodes * len(run.seeds)) as ended, jax.default_matmul_precision(precision):
        if isinstance(found, GymnasiumTask):
            apart = own_process and run.options.processes == "always"  # an environment may need it
            result = _on_host(trained, found, states, keys, episodes, run, ended, apart)
        else:
            compiled = jax.jit(jax.vmap(lambda state, key: evaluate_seed(trained, found, state, key, episodes)))
            result = jax.block_until_ready(compiled(states, keys))
    result = log.unknown(result, lost)  # whatever a task did with actions that are NaN
    table = summary(result)
    for index, mode in enumerate(MODES):
        table[mode]["returns"] = np.asarray(result.episode_return)[:, index].tolist()
        table[mode]["lengths"] = np.asarray(result.length)[:, index].tolist()
    return {"episodes": episodes, "diverged": [seed for seed in run.seeds if run.has_diverged(seed)]} | table


def _showing(progress: bool, episodes: int) -> contextlib.AbstractContextManager[Callable[[int], None]]:
    """Yields a function to call with the number of finished episodes; with `progress` it is shown."""
    if not progress:
        return contextlib.nullcontext(lambda count: None)
    from beliefrl.training.screen import playing

    return playing(episodes)


def _on_host(
    agent: Agent,
    task: GymnasiumTask,
    states: Any,
    keys: Key[Array, " seed"],
    episodes: int,
    run: Run,
    ended: Callable[[int], None],
    apart: bool,
) -> Episode:
    how: dict[str, Any] = {"processes": "always", "timeout": run.options.step_timeout} if apart else {}
    make = partial(Lockstep, task, **how)
    shared = make([f"seed {seed}" for seed in run.seeds]) if run.options.share_env else None
    evaluation = Evaluation(agent, task, run.seeds, make, shared)
    try:
        return evaluation.play(states, keys, episodes, ended)
    finally:
        evaluation.close()
