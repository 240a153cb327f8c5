"""The replay: a ring of moments, and windows drawn from it.

One record a moment, an episode's last observation included, so a truncated episode keeps what its value is
bootstrapped from, and no observation is stored twice. Additions come before draws within a compiled step, and a
masked addition writes out of bounds instead of branching: either mistake makes XLA copy the whole ring.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from beliefrl.types import StoredTimestep, Timestep, Window, WindowShape


class Replay(NamedTuple):
    moments: StoredTimestep  # leaves (capacity, ...)
    added: Int[Array, ""]  # moments ever added; the ring holds the last `capacity` of them


def init(moment: StoredTimestep, capacity: int) -> Replay:
    """An empty ring for moments shaped as `moment`."""
    return Replay(jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), moment), jnp.zeros((), int))


def capacity(replay: Replay) -> int:
    """How many moments the ring holds when full."""
    return replay.moments.step.reward.shape[0]


def add(replay: Replay, moment: StoredTimestep, keep: Bool[Array, ""] | bool = True) -> Replay:
    """Append a moment where `keep`; the oldest makes room."""
    size = capacity(replay)
    index = jnp.where(keep, replay.added % size, size)
    moments = jax.tree.map(lambda ring, leaf: ring.at[index].set(leaf, mode="drop"), replay.moments, moment)
    return Replay(moments, replay.added + jnp.asarray(keep, replay.added.dtype))


def sample(replay: Replay, key: Key[Array, ""], batch: int, shape: WindowShape) -> Window:
    """Draw `batch` windows of burn_in + length + 1 moments, leaves (time, batch, ...).

    The first transition after the burn-in is uniform over all starts whose `length` transitions are stored, so
    every stored transition can be drawn. The burn-in overhangs where too little lies before it; with fewer moments
    than a window needs the rest overhangs as well. What overhangs is marked in `exists`.
    """
    oldest = jnp.maximum(replay.added - capacity(replay), 0)
    stored = replay.added - oldest
    start = jax.random.randint(key, (batch, 1), 0, jnp.maximum(stored - shape.length, 1)).T
    position = start + jnp.arange(-shape.burn_in, shape.length + 1)[:, None]  # 0 is the oldest moment
    moments = gather(replay, oldest + position)
    step = moments.step._replace(is_first=moments.step.is_first | (position <= 0))
    return Window(step, moments.note, (position >= 0) & (position < stored))


def gather(replay: Replay, number: Int[Array, "*shape"]) -> StoredTimestep:
    """The moments of these running numbers (0 is the first ever added), leaves (*shape, ...)."""
    index = number % capacity(replay)
    return jax.tree.map(lambda leaf: leaf[index], replay.moments)


def history(replay: Replay, length: int) -> tuple[Timestep, Bool[Array, " length"]]:
    """The first `length` moments ever added, and which of them exist; meant for before the ring is full."""
    number = jnp.arange(length)
    return gather(replay, number).step, number < replay.added


def annotate(replay: Replay, notes: Any, length: int) -> Replay:
    """Replace the notes of the first `length` moments; leaves of `notes` (length, ...)."""
    note = jax.tree.map(lambda ring, new: ring.at[:length].set(new), replay.moments.note, notes)
    return replay._replace(moments=replay.moments._replace(note=note))
