"""Compare the predictions of an agent's model with the true observations and rewards (Appendix "Model Accuracy").

The agent plays an episode. Its model predicts each x_t = (o_t, r_{t-1}) in two ways, given the actions of the episode:

    open loop     z_t is inferred from x_t, then x_t is decoded. This measures how well the model encodes its input.
    closed loop   For t < start as in the open loop. From `start` on, z_t is sampled from the prior and x_t from the
                  decoder, and the model continues from its own samples. This measures how well it predicts the future.

The model of `predictive-sac` has no latent variables. Its open loop predicts x_t from all earlier timesteps, one step
ahead. In its closed loop the predictions take the place of the timesteps from `start` on.

A prediction is the mean of many samples. σ is that of their mixture: σ² = mean of the decoder's σ² + variance of its μ.
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
from beliefrl.errors import UserError
from beliefrl.models.nets import Gaussian
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.restore import restore_seed
from beliefrl.types import Timestep, check_whole, perception
from beliefrl.viewing.episodes import Player, check_episode

START = 50  # default number of timesteps that the closed loop observes
TRUTH, OPEN, CLOSED = "#a9a79e", "#1f6f8b", "#c8553d"


class Predictions(NamedTuple):
    """Predictions of one episode. The columns are the entries of x_t: the observed entries, then the reward."""

    title: str
    entries: tuple[int, ...]  # indices of the observed entries in the task's full observation
    names: tuple[str, ...]  # names of the columns: entries of the task, or "entry 2"; then "reward"
    start: int  # the first timestep that the closed loop does not observe
    truth: Float[np.ndarray, "time x"]
    open_loop: Gaussian  # leaves (time, x); NaN where nothing is predicted; σ = 0 for a deterministic model
    closed_loop: Gaussian  # the same; equal to the open loop before `start`

    def errors(self) -> tuple[Float[np.ndarray, " x"], Float[np.ndarray, " x"]]:
        """The root mean squared errors of the open loop and the closed loop, from `start` on."""
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
    """Mean and σ of `samples` sampled predictions of a `Predictive` agent, leaves (time, x).

    `seen` (time,) says which timesteps the model observes.
    """
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
    task: Task | GymnasiumTask | type | None = None,
    agent: Agent | type | None = None,
    best: bool = False,
) -> Predictions:
    """Play an episode with the trained agent of a run, and predict it with the agent's model.

    Args:
        run: a run, or its folder.
        seed: one of the run's seeds; None: its first.
        model: "lstm" for predictive-sac, "keep" or "first" for vrm, "latent" for slac; None: the first of these that
            the agent has.
        start: number of timesteps that the closed loop observes; None: 50, or half of an episode with
            fewer than 100.
        horizon: number of timesteps that it predicts after that, at most to the end of the episode.
        samples: number of samples in the mean of each prediction.
        episode_seed: random seed of the episode, its actions and the samples.
        sampled: sample the actions, instead of taking the policy's mode.
        task: needed only if the run was trained on a task of your own: that task, or the class of its environments.
        agent: needed only if the run was trained by an agent of your own: its class, or an instance.
        best: take the seed's best agent, not its last one; see `evaluate`.

    Raises:
        UserError: the agent has no such model, or no model, or a number is out of range.
    """
    check_episode(episode_seed)
    _check_sizes(start, horizon, samples)
    run = run if isinstance(run, Run) else Run(run)
    trained, found, state, precision = restore_seed(run, seed, task, agent, best)
    name = _model(run, trained, model)
    with Player(trained, found, state, precision) as player:
        longest = max(2 * START, START + horizon) if start is None else start + horizon
        steps = player.play(episode_seed, sampled, longest - 1).steps
    length = len(steps.reward)
    start = min(START, length // 2) if start is None else start
    if start >= length:
        raise UserError(
            f"start={start} is impossible: the episode has {length} timesteps, so give {length - 1} or less."
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
    check_whole("start", start, 1, optional=True)
    check_whole("horizon", horizon, 1)
    check_whole("samples", samples, 1, 10_000)


def _model(run: Run, agent: Any, model: str | None) -> str:
    """The name of the model to predict with."""
    if not isinstance(agent, Predictive):
        raise UserError(
            f"{run.shown} is a run of {run.config['agent']}, which offers no predictions: "
            "use predictive-sac, vrm or slac."
        )
    if model is not None and model not in agent.predictors:
        has = ", ".join(agent.predictors)
        raise UserError(f"{run.config['agent']} has no model {model!r}: it has {has}.")
    return model or agent.predictors[0]


def draw_predictions(
    predicted: Predictions, path: pathlib.Path | str, entries: Sequence[int] | None = None
) -> pathlib.Path:
    """Draw predictions and truth, one row for each entry of the observation and one for the reward.

    A row is labelled with the task's name of the entry and its unit, or with its index in the full observation:
    "entry 2". Bands are ± σ. Numbers are root mean squared errors from `start` on. Writes a PNG and a PDF; returns the
    path of the PNG.

    Args:
        predicted: what `predictions` returns.
        path: the PNG or the PDF.
        entries: entries of the observation, a subset of `predicted.entries`; None: the first six of them.

    Raises:
        UserError: the agent does not see an entry, or the files cannot be written.
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
        axis.set_ylabel(textwrap.fill(predicted.names[index], 15))  # narrow enough for the height of a row
    figure.align_ylabels(axes)
    figure.suptitle(predicted.title, x=0.01, ha="left", fontsize=10)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False, fontsize=8)
    axes[-1].set_xlabel("step")
    return figures.save(figure, path)


def _draw_row(axis: Any, predicted: Predictions, index: int) -> None:
    """Draw the truth, the open loop and the closed loop of one entry of x."""
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
