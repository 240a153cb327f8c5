"""The entries that a training writes to the log of each seed, for its events."""

from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from beliefrl.runs import best
from beliefrl.runs.recorder import Recorder
from beliefrl.training.rollout import Episode
from beliefrl.training.schedule import Event
from beliefrl.training.summary import MODES, summary


@jax.jit
def finite(states: Any) -> Bool[Array, " seed"]:
    """Whether all numbers of each seed's agent are finite."""
    checks = [
        jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim)))
        for leaf in jax.tree.leaves(states)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    return jnp.all(jnp.stack(checks), axis=0)


def without(event: Event, lost: Collection[int]) -> Event:
    """The same event without the `lost` seeds (indices): NaN in their evaluations, and no ends of their episodes."""
    if event.episodes is not None:
        event = event._replace(episodes=event.episodes._replace(done=_with(event.episodes.done, lost, False)))
    if event.evaluation is not None:
        event = event._replace(evaluation=unknown(event.evaluation, lost))
    return event


def unknown(evaluation: Episode, lost: Collection[int]) -> Episode:
    """The same evaluation with NaN as the returns and measures of the `lost` seeds (indices)."""
    known = (evaluation.episode_return, evaluation.measures)
    returns, measures = jax.tree.map(lambda leaf: _with(leaf, lost, np.nan), known)
    return evaluation._replace(episode_return=returns, measures=measures)


def _with(leaf: Any, lost: Collection[int], value: Any) -> np.ndarray:
    leaf = np.array(leaf)
    leaf[sorted(lost)] = value
    return leaf


def record(recorder: Recorder, event: Event, lost: Collection[int]) -> dict[str, Any] | None:
    """Log an event for every seed that is not lost; returns the summary of an evaluation."""
    metrics = {name: np.asarray(values) for name, values in event.metrics.items()}
    for index, seed in enumerate(recorder.seeds):
        if index in lost:
            continue
        if metrics and event.part:
            recorder.log(seed, "pretrain", event.part[0], _row(metrics, index))
        elif metrics:
            recorder.log(seed, "update", event.step, _row(metrics, index))
        if event.episodes is not None:
            episodes = jax.tree.map(lambda leaf, index=index: np.asarray(leaf[index]), event.episodes)
            for end in np.flatnonzero(episodes.done):
                recorder.log(seed, "episode", event.step, _episode(episodes, end))
        if event.evaluation is not None:
            result = jax.tree.map(lambda leaf, index=index: np.asarray(leaf[index]), event.evaluation)
            recorder.log(seed, "evaluation", event.step, _evaluated(result))
    if event.states is not None:
        recorder.flush()
        recorder.save(event.states, lost, event.step)
    if event.evaluation is None:
        return None
    returns = np.asarray(event.evaluation.episode_return)[:, MODES.index("sampled")].mean(axis=-1).tolist()
    best.save(recorder.folder, event.states, event.step, returns)  # an evaluation comes with the states
    return {"step": event.step} | summary(event.evaluation)


def _row(metrics: dict[str, np.ndarray], index: int) -> dict[str, float]:
    """The metrics of one seed that are finite: JSON has no other numbers."""
    return {name: float(values[index]) for name, values in metrics.items() if np.isfinite(values[index])}


def _episode(episodes: Episode, end: Any) -> dict[str, Any]:
    measures = {name: float(values[end]) for name, values in episodes.measures.items()}
    return {"return": float(episodes.episode_return[end]), "length": int(episodes.length[end])} | measures


def _evaluated(result: Episode) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for index, mode in enumerate(MODES):
        values[mode] = [float(value) for value in result.episode_return[index]]
        values |= {f"{mode}_{name}": list(map(float, column[index])) for name, column in result.measures.items()}
    return values
