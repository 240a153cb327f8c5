"""What an agent's model predicts of what it perceives, beside the truth (Appendix "Model Accuracy").

An episode is played, and its x_t = (o_t, r_{t-1}) are predicted in two ways, always with the actions that were done:

    open loop     z_t is inferred from x_t itself, then x_t is decoded: how well the model takes in what it perceives
    closed loop   x_t is perceived for t < start; from there on z_t is drawn from the prior and x_t from the decoder,
                  and the model goes on from its own draws: what it knows of the future

Each is the mean of many draws. σ is that of the mixture they are: σ² = mean of the decoder's σ² + variance of its μ.
"""

import os
import pathlib
import textwrap
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from beliefrl import tasks
from beliefrl.agents import Agent, Predictive
from beliefrl.analysis import figures
from beliefrl.models.nets import Gaussian
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.evaluation import restore_seed
from beliefrl.types import LARGEST, Timestep, UserError, perception
from beliefrl.viewing.episodes import Player, check_episode

START = 50  # moments that the closed loop sees by default
TRUTH, OPEN, CLOSED = "#a9a79e", "#1f6f8b", "#c8553d"


class Predictions(NamedTuple):
    """Predictions of one episode; an entry at time t is of x_t, which is the observation's entries and the reward."""

    title: str
    entries: tuple[int, ...]  # of the task's full observation: what x is of, but for the reward
    names: tuple[str, ...]  # of the columns of x: the task's names of the entries, or "entry 2"; then "reward"
    start: int  # the first moment that the closed loop does not see
    truth: Float[np.ndarray, "time x"]
    open_loop: Gaussian  # leaves (time, x); NaN where nothing is predicted; σ = 0 of a deterministic model
    closed_loop: Gaussian  # the same; before `start` it is the open loop

    def errors(self) -> tuple[Float[np.ndarray, " x"], Float[np.ndarray, " x"]]:
        """The root mean squared error of the open and of the closed loop, both from `start` on."""
        after = slice(self.start, None)
        loops = (self.open_loop, self.closed_loop)
        return tuple(np.sqrt(np.mean((loop.mean - self.truth)[after] ** 2, axis=0)) for loop in loops)


def predict(
    agent: Any,
    state: Any,
    model: str,
    steps: Timestep,
    seen: Bool[Array, " time"],
    samples: int,
    key: Key[Array, ""],
) -> Gaussian:
    """Mean and σ of `samples` draws of a `Predictive` agent's predictions, leaves (time, x)."""
    draw = jax.vmap(lambda key: agent.predict(state, model, steps, seen, key))
    mean, sigma = draw(jax.random.split(key, samples))
    return Gaussian(jnp.mean(mean, axis=0), jnp.sqrt(jnp.mean(sigma**2, axis=0) + jnp.var(mean, axis=0)))


def predictions(
    run: Run | str | os.PathLike[str],
    seed: int | None = None,
    model: str | None = None,
    start: int | None = None,
    horizon: int = 100,
    samples: int = 32,
    episode_seed: int = 0,
    sampled: bool = False,
    task: Task | GymnasiumTask | None = None,
    agent: Agent | type | None = None,
) -> Predictions:
    """Play an episode with what a run has learned, and predict it.

    Args:
        run: a run, or its folder.
        seed: which of the run's seeds; None is its first.
        model: "keep" or "first" of vrm, "latent" of slac; None is the first of these that the agent has.
        start: moments that the closed loop sees; None: 50, or half of a shorter episode.
        horizon: moments that it predicts then, as far as the episode goes.
        samples: draws whose mean each prediction is.
        episode_seed: of the episode, its actions and these draws.
        sampled: whether actions are sampled; else they are the policy's mode.
        task: needed only where the run was trained on a task of your own.
        agent: needed only where an agent of your own was trained: its class, or one of them.

    Raises:
        UserError: the agent has no such model or none at all, or a number is impossible.
    """
    check_episode(episode_seed)
    _check_sizes(start, horizon, samples)
    run = run if isinstance(run, Run) else Run(run)
    trained, found, state, precision = restore_seed(run, seed, task, agent)
    name = _model(run, trained, model)
    with Player(trained, found, state, precision) as player:
        steps = player.play(episode_seed, sampled, (START if start is None else start) + horizon - 1).steps
    moments = len(steps.reward)
    start = min(START, moments // 2) if start is None else start
    if start >= moments:
        raise UserError(
            f"start={start} is impossible: the episode has {moments} moments, so give {moments - 1} or less."
        )
    steps = jax.tree.map(lambda leaf: leaf[: start + horizon], steps)

    time, key = np.arange(len(steps.reward)), jax.random.key(episode_seed)
    compiled = jax.jit(partial(predict, trained), static_argnames=("model", "samples"))
    with jax.default_matmul_precision(precision):
        loops = [compiled(state, name, steps, seen, samples, key) for seen in (time >= 0, time < start)]
    seed = run.seeds[0] if seed is None else seed
    title = f"{run.config['agent']} on {run.config['task']}, seed {seed}: {name} model"
    names = (*tasks.entry_names(found), "reward")
    truth, loops = np.asarray(perception(steps)), jax.device_get(tuple(loops))
    return Predictions(title, tasks.entries(found), names, start, truth, *loops)


def _check_sizes(start: int | None, horizon: int, samples: int) -> None:
    for name, value, most in (("start", start, LARGEST), ("horizon", horizon, LARGEST), ("samples", samples, 10_000)):
        if value is not None and not 1 <= value <= most:
            raise UserError(f"{name}={value} is impossible: it must be a whole number from 1 to {most}.")


def _model(run: Run, agent: Any, model: str | None) -> str:
    """Which of the agent's models to ask."""
    if not isinstance(agent, Predictive):
        raise UserError(
            f"{run.folder} is of {run.config['agent']}, which has no model to predict with: vrm and slac have one."
        )
    if model is not None and model not in agent.predictors:
        has = ", ".join(agent.predictors)
        raise UserError(f"{run.config['agent']} has no model {model!r}: it has {has}.")
    return model or agent.predictors[0]


def draw_predictions(
    predicted: Predictions, path: pathlib.Path | str, entries: Sequence[int] | None = None
) -> pathlib.Path:
    """Draw predictions beside the truth, a row for each entry of the observation and one for the reward.

    A row has the task's name of the entry and its unit, or "entry 2", its index in the full observation.
    Bands are ± σ, and the numbers root mean squared errors from `start` on. Writes a PNG and a PDF, returns the first.

    Args:
        predicted: what `predictions` returns.
        path: of the PNG or the PDF.
        entries: of the observation, in the numbers of `predicted.entries`; None: the first six of them.

    Raises:
        UserError: the agent sees no such entry, or the files cannot be written.
    """
    path = pathlib.Path(path)
    figures.paths(path)
    entries = predicted.entries[:6] if entries is None else tuple(entries)
    for entry in entries:
        if entry not in predicted.entries:
            seen = ", ".join(map(str, predicted.entries))
            raise UserError(f"entries={entry} is impossible: the agent sees {seen} of the observation.")
    rows = [*(predicted.entries.index(entry) for entry in entries), len(predicted.entries)]
    figure = figures.figure(8.0, 1.0 + 1.3 * len(rows))
    axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    for axis, index in zip(axes, rows, strict=True):
        _draw_row(axis, predicted, index)
        axis.set_ylabel(textwrap.fill(predicted.names[index], 15))  # what a row is high enough for
    figure.align_ylabels(axes)
    figure.suptitle(predicted.title, x=0.01, ha="left", fontsize=10)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False, fontsize=8)
    axes[-1].set_xlabel("step")
    return figures.save(figure, path)


def _draw_row(axis: Any, predicted: Predictions, index: int) -> None:
    """The truth of one entry of x, and both loops."""
    time, start = np.arange(len(predicted.truth)), predicted.start
    axis.axvline(start - 0.5, color=TRUTH, linewidth=0.8, linestyle=":")
    axis.plot(time, predicted.truth[:, index], color=TRUTH, linewidth=2.8, label="truth")
    for loop, first, colour, label in (
        (predicted.open_loop, 0, OPEN, "open loop"),
        (predicted.closed_loop, start, CLOSED, f"closed loop from step {start} on"),
    ):
        mean, sigma = loop.mean[first:, index], loop.sigma[first:, index]
        axis.plot(time[first:], mean, color=colour, linewidth=1.2, label=label)
        axis.fill_between(time[first:], mean - sigma, mean + sigma, color=colour, alpha=0.2, linewidth=0)
    errors = [error[index] for error in predicted.errors()]
    axis.set_title("RMSE {:.2g} open, {:.2g} closed".format(*errors), loc="right", fontsize=7, pad=2)
    axis.margins(x=0.01)
    axis.spines[["top", "right"]].set_visible(False)
