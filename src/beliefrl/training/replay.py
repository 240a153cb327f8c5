"""The replay: a ring of timesteps, and windows drawn from it.

The ring has one record per timestep, including the last observation of an episode. So the value at a time limit can be
bootstrapped, and no observation is stored twice. Within a compiled step, additions come before draws, and a masked
addition writes out of bounds and does not branch. Otherwise XLA copies the whole ring.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from beliefrl.types import StoredTimestep, Timestep, Window, WindowShape


class Replay(NamedTuple):
    """A ring of timesteps. With several environments it is mapped: every leaf has a leading axis, one ring for each."""

    timesteps: StoredTimestep  # leaves (capacity, ...)
    added: Int[Array, "*rings"]  # timesteps ever added; the ring holds the last `capacity` of them


def init(timestep: StoredTimestep, capacity: int) -> Replay:
    """An empty ring for timesteps shaped as `timestep`."""
    return Replay(
        jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), timestep), jnp.zeros((), int)
    )


def capacity(replay: Replay) -> int:
    """How many timesteps a ring holds when full."""
    return replay.timesteps.step.reward.shape[-1]


def add(replay: Replay, timestep: StoredTimestep, keep: Bool[Array, ""] | bool = True) -> Replay:
    """Append a timestep if `keep`; it replaces the oldest one in a full ring."""
    size = capacity(replay)
    index = jnp.where(keep, replay.added % size, size)
    timesteps = jax.tree.map(lambda ring, leaf: ring.at[index].set(leaf, mode="drop"), replay.timesteps, timestep)
    return Replay(timesteps, replay.added + jnp.asarray(keep, replay.added.dtype))


def sample(replay: Replay, key: Key[Array, ""], batch: int, shape: WindowShape) -> Window:
    """Draw `batch` windows of burn_in + length + 1 timesteps, leaves (time, batch, ...).

    The first transition after the burn-in is uniform over all starts whose `length` transitions are stored, so
    every stored transition can be drawn. The burn-in overhangs where too little lies before it; with fewer timesteps
    than a window needs the rest overhangs as well. What overhangs is marked in `exists`. With several rings, the start
    is uniform over those of all rings.
    """
    oldest = jnp.maximum(replay.added - capacity(replay), 0)
    stored = replay.added - oldest
    starts = jnp.maximum(stored - shape.length, 1)
    if replay.added.ndim:
        after = jnp.cumsum(starts)
        start = jax.random.randint(key, (1, batch), 0, after[-1])
        ring = jnp.searchsorted(after, start, side="right")
        start, oldest, stored = start - (after - starts)[ring], oldest[ring], stored[ring]
    else:
        start, ring = jax.random.randint(key, (batch, 1), 0, starts).T, None
    position = start + jnp.arange(-shape.burn_in, shape.length + 1)[:, None]  # 0 is the oldest timestep
    timesteps = gather(replay, oldest + position, ring)
    step = timesteps.step._replace(is_first=timesteps.step.is_first | (position <= 0))
    return Window(step, timesteps.note, (position >= 0) & (position < stored))


def gather(replay: Replay, number: Int[Array, "*shape"], ring: Int[Array, "1 batch"] | None = None) -> StoredTimestep:
    """The timesteps of these running numbers (0 is the first ever added), leaves (*shape, ...).

    With several rings, `ring` has the index of the ring for each number; it broadcasts against `number`.
    """
    index = number % capacity(replay)
    return jax.tree.map(lambda leaf: leaf[index] if ring is None else leaf[ring, index], replay.timesteps)


def history(replay: Replay, length: int) -> tuple[Timestep, Bool[Array, " length"]]:
    """The first `length` timesteps ever added, and which of them exist, for use before the ring is full."""
    number = jnp.arange(length)
    return gather(replay, number).step, number < replay.added


def annotate(replay: Replay, notes: Any, length: int) -> Replay:
    """Replace the notes of the first `length` timesteps; leaves of `notes` (length, ...)."""
    note = jax.tree.map(lambda ring, new: ring.at[:length].set(new), replay.timesteps.note, notes)
    return replay._replace(timesteps=replay.timesteps._replace(note=note))
