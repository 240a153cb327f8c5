"""The replay that a training starts with, if it comes from another run (the option init_replay).

Its timesteps are copied to initial-replay.safetensors in the new run's folder, in order, so the other run is not needed
again.
"""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl import tasks
from beliefrl.agents import Agent
from beliefrl.agents.hyperparameters import named_by, values_before
from beliefrl.errors import UserError
from beliefrl.runs import arrays, segments
from beliefrl.runs.checkpoint import stored_timesteps
from beliefrl.runs.options import Options
from beliefrl.runs.run import Run
from beliefrl.training import rollout
from beliefrl.training.checks import about_task, decisive
from beliefrl.training.replay import Replay
from beliefrl.training.restore import check_interface
from beliefrl.types import Spec, plain

FILE = "initial-replay.safetensors"
ADDED = "added"  # the number of timesteps of each ring, among the arrays of the file


def taken(
    source: Run, options: Options, agent: Agent, task: Any, seeds: list[int]
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """The timesteps of all rings by their names, and what config.json says of them.

    The arrays have the shape (seed, [env,] time, ...). A shorter ring is padded at its end. `seeds` has the index of
    the seed in the other run, `source`, for each seed of this training.

    Raises:
        UserError: the other run was trained on another task, with other bounds of the actions, other `envs` or other
            notes, it has no undamaged checkpoint, or its timesteps are not finite.
    """
    _same(source, agent, task, options.envs)
    check_interface(source, task)
    step, files = stored_timesteps(source.folder)
    rings = (len(source.seeds),) if options.envs == 1 else (len(source.seeds), options.envs)
    shapes, room = _timestep(agent, task.spec), max(files[-1].stop)  # for all, so `segments.read` keeps their order
    like = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*rings, room, *leaf.shape), leaf.dtype), shapes)
    timesteps, missing = segments.read(source.folder / "checkpoints" / "replay", like, files, len(rings))
    count = (np.array(files[-1].stop).reshape(rings) - missing)[seeds]
    kept = np.minimum(count, options.replay_capacity // options.envs)
    named = jax.tree_util.tree_leaves_with_path(timesteps)
    newest = {jax.tree_util.keystr(where): _newest(ring, seeds, count, kept) for where, ring in named}
    if not all(np.isfinite(ring).all() for ring in newest.values()):
        raise UserError(
            f"init_replay is impossible: the replay of {source.shown} has numbers that are not finite, because a seed "
            "diverged. Take other seeds, or leave init_replay out."
        )
    return newest | {ADDED: kept.astype(np.int32)}, {"replay_step": step, "timesteps": int(kept.max())}


def started(folder: pathlib.Path, replay: Replay) -> Replay:
    """The first replay of a training, leaves (seed, ...), with the timesteps in a run's folder.

    Raises:
        UserError: the file is damaged or missing, or does not fit the replay.
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


def _same(source: Run, agent: Agent, task: Any, envs: int) -> None:
    """Refuse timesteps of another task, or with other notes. The arguments of a Gymnasium environment may differ."""
    there = values_before(agent) | source.config["hyperparameters"]
    there |= about_task(source.config) | {"envs": source.options.envs}
    here = about_task(tasks.describe(task)) | {"envs": envs}
    names = (*decisive(task), "observe", "envs")
    for name, value in ({name: here[name] for name in names} | named_by(agent, "note_settings")).items():
        if plain(there.get(name, value)) != plain(value):
            raise UserError(
                f"init_replay is impossible: {source.shown} was trained with {name}={there[name]}, and this training "
                f"has {value}. Use the same, or leave init_replay out."
            )


def _timestep(agent: Agent, spec: Spec) -> Any:
    """The shapes of one timestep in the replay."""
    return jax.eval_shape(lambda: rollout.stored(agent, rollout.first(agent, spec, (), jnp.zeros(spec.obs_dim))))


def _newest(rings: np.ndarray, seeds: list[int], count: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The last `kept` of the `count` timesteps of the rings of `seeds`, (*rings, time, ...), at the beginning."""
    axes = count.ndim
    newest = np.zeros((*count.shape, kept.max(), *rings.shape[axes + 1 :]), rings.dtype)
    for where in np.ndindex(count.shape):
        ring = rings[(seeds[where[0]], *where[1:])]
        newest[where][: kept[where]] = ring[count[where] - kept[where] : count[where]]
    return newest
