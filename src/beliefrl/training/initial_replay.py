"""The replay that a training starts with, if it comes from another run (the option init_replay).

Its timesteps are copied to initial-replay.safetensors in the new run's folder, in order, so the other run is not needed
again. The networks come from the same run (`initial`), so the agent's notes on the timesteps stay right.
"""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl import tasks
from beliefrl.agents import Agent
from beliefrl.runs import arrays, segments
from beliefrl.runs.checkpoint import stored_timesteps
from beliefrl.runs.options import Options
from beliefrl.runs.run import Run
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import rollout
from beliefrl.training.replay import Replay
from beliefrl.types import Spec, UserError, plain

FILE = "initial-replay.safetensors"
ADDED = "added"  # the number of timesteps of each ring, among the arrays of the file


def taken(options: Options, agent: Agent, task: Any, seeds: list[int]) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """The timesteps of all rings by their names, and what config.json says of them.

    The arrays have the shape (seed, [env,] time, ...). A shorter ring is padded at its end. `seeds` has the index of
    the seed in the other run, for each seed of this training.

    Raises:
        UserError: that run was trained on another task or with other `envs`, or has no undamaged checkpoint.
    """
    source = Run(options.init_from or "")
    _same(source, task, options.envs)
    step, files = stored_timesteps(source.folder)
    several = () if options.envs == 1 else (options.envs,)
    rings = len(source.seeds), *several
    like = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((*rings, _last(files), *leaf.shape), leaf.dtype), _timestep(agent, task.spec)
    )
    timesteps, missing = segments.read(source.folder / "checkpoints" / "replay", like, files, len(rings))
    count = np.array(files[-1].stop if files else np.zeros(missing.size, int)).reshape(rings) - missing
    kept = np.minimum(count, options.replay_capacity // options.envs)
    newest = jax.tree.map(lambda ring: _newest(ring, count, kept)[seeds], timesteps)
    added = {ADDED: kept[seeds].astype(np.int32)}
    return arrays.copied(newest) | added, {"replay_step": step, "timesteps": int(kept[seeds].max(initial=0))}


def started(folder: pathlib.Path, replay: Replay) -> Replay:
    """The first replay of a training, leaves (seed, ...), with the timesteps in a run's folder.

    Raises:
        UserError: the file is damaged, or does not fit the replay.
    """
    path = folder / FILE
    saved, axes = arrays.load(path), replay.added.ndim

    def filled(where: Any, ring: jax.Array) -> jax.Array:
        name = jax.tree_util.keystr(where)
        if name not in saved or saved[name].shape[axes + 1 :] != ring.shape[axes + 1 :]:
            raise arrays.misfit(path, name)
        there = (*(slice(None) for _ in range(axes)), slice(saved[name].shape[axes]))
        return ring.at[there].set(saved[name])

    timesteps = jax.tree_util.tree_map_with_path(filled, replay.timesteps)
    return Replay(timesteps, jnp.asarray(saved[ADDED], replay.added.dtype))


def _same(source: Run, task: Any, envs: int) -> None:
    """Refuse timesteps of another task. The arguments of a Gymnasium environment may differ."""
    asked, there = ({"faults": None} | each for each in (tasks.describe(task), source.config))
    names = ("task", "observe", "faults", *(() if isinstance(task, GymnasiumTask) else ("constants",)))
    asked, there = ({name: plain(each[name]) for name in names} for each in (asked, there))
    asked["envs"], there["envs"] = envs, source.options.envs
    for name, value in asked.items():
        if there[name] != value:
            raise UserError(
                f"init_replay is impossible: {source.folder} was trained with {name}={there[name]}, and this training "
                f"has {value}."
            )


def _timestep(agent: Agent, spec: Spec) -> Any:
    """The shapes of one timestep in the replay."""
    return jax.eval_shape(lambda: rollout.stored(agent, rollout.first(agent, spec, (), jnp.zeros(spec.obs_dim))))


def _last(files: list[segments.Segment]) -> int:
    """Room for all timesteps that were ever added to a ring, so that `segments.read` keeps them in order."""
    return max(files[-1].stop) if files else 1


def _newest(ring: np.ndarray, count: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The last `kept` of the `count` timesteps of each ring, (*rings, time, ...), moved to the beginning."""
    newest = np.zeros((*ring.shape[: count.ndim], kept.max(initial=0), *ring.shape[count.ndim + 1 :]), ring.dtype)
    for where in np.ndindex(count.shape):
        newest[where][: kept[where]] = ring[where][count[where] - kept[where] : count[where]]
    return newest
