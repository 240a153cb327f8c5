"""The replay: a ring of timesteps, and windows drawn from it or read in order.

The ring has one record per timestep, including the last observation of an episode. So the value at a time limit can be
bootstrapped, and no observation is stored twice. Within a compiled step, additions come before draws, and a masked
addition writes out of bounds and does not branch. Otherwise XLA copies the whole ring.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from beliefrl.errors import UserError
from beliefrl.types import Reading, StoredTimestep, Timestep, Window, WindowShape


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


NOWHERE = -1  # a reader there jumps


class Readers(NamedTuple):
    """Where each reader reads next."""

    number: Int[Array, " reader"]  # running number of a timestep; NOWHERE before the first window
    ring: Int[Array, " reader"]
    turn: Int[Array, ""]  # the reader whose turn is next


def init_readers(shape: WindowShape) -> Readers | None:
    """Readers before their first window; None if the windows are drawn at random.

    Raises:
        UserError: the windows have both readers and a burn-in.
    """
    if not shape.readers:
        return None
    if shape.burn_in:
        raise UserError(f"burn_in={shape.burn_in} is impossible with readers: their windows have no burn-in.")
    return Readers(jnp.full(shape.readers, NOWHERE, int), jnp.zeros(shape.readers, int), jnp.zeros((), int))


def windows(
    replay: Replay, readers: Readers | None, key: Key[Array, ""], batch: int, shape: WindowShape
) -> tuple[Window, Readers | None]:
    """`batch` windows, read by the next readers or drawn at random; also the readers after these windows."""
    if readers is None:
        return sample(replay, key, batch, shape), None
    return read(replay, readers, key, batch, shape)


def read(
    replay: Replay, readers: Readers, key: Key[Array, ""], batch: int, shape: WindowShape
) -> tuple[Window, Readers]:
    """The windows of the next `batch` readers, leaves (time, batch, ...), and the readers after these windows.

    A reader continues where its last window ended. The last timestep of a window is the first of the next one, so no
    transition between two windows is left out. With the probability `shape.jump` the reader jumps to a random place,
    from which two windows are stored if a ring has so many. It must jump if its next window is not complete, or was
    overwritten. So the oldest and the newest timesteps of a ring are read less often than the others.

    Nothing is learned from the first window after a jump until an episode begins in it. So a jump into the first
    window of a ring goes to its oldest timestep, if an episode begins there. If a ring has at most three windows,
    a reader also reads the rest after its last complete one.

    Raises:
        UserError: there are fewer readers than windows to read.
    """
    if batch > shape.readers:
        raise UserError(f"readers={shape.readers} is impossible: the agent reads {batch} windows at a time.")
    reader = (readers.turn + jnp.arange(batch)) % shape.readers
    key_place, key_jump = jax.random.split(key)
    number, of_ring = readers.number[reader], readers.ring[reader]
    oldest, added = span(replay, of_ring)
    needed = jnp.where(added - oldest <= 3 * shape.length, 1, shape.length)  # transitions from the reader's place on
    stored = (number >= oldest) & (number + needed < added)
    continues = stored & ~jax.random.bernoulli(key_jump, shape.jump, (batch,))
    place, ring = places(replay, key_place, batch, 2 * shape.length)
    first, _ = span(replay, ring)
    begins = gather(replay, first[None], ring[None]).step.is_first[0]
    place = jnp.where(begins & (place < first + shape.length), first, place)
    number, of_ring = jnp.where(continues, number, place), jnp.where(continues, of_ring, ring)
    numbers = number[None] + jnp.arange(shape.length + 1)[:, None]
    timesteps, exists = gather(replay, numbers, of_ring[None]), numbers < span(replay, of_ring)[1][None]
    after = Readers(
        readers.number.at[reader].set(jnp.where(exists[-1], numbers[-1], NOWHERE)),
        readers.ring.at[reader].set(of_ring),
        (readers.turn + batch) % shape.readers,
    )
    return Window(timesteps.step, timesteps.note, exists, Reading(reader, continues)), after


def renumbered(readers: Readers, missing: Int[Array, "*rings"]) -> Readers:
    """The readers at the same timesteps, after each ring has lost its first `missing` timesteps and counts anew.

    A reader of a lost timestep then has a negative number, so it jumps.
    """
    return readers._replace(number=readers.number - jnp.atleast_1d(missing)[readers.ring])


def sample(replay: Replay, key: Key[Array, ""], batch: int, shape: WindowShape) -> Window:
    """Draw `batch` windows of burn_in + length + 1 timesteps, leaves (time, batch, ...).

    The first transition after the burn-in is uniform over all starts whose `length` transitions (or `least`) are
    stored, so every stored transition can be drawn. If too little lies before it, the burn-in
    overhangs. If a window needs more timesteps than there are, the rest does, too. `exists` marks what is there. With
    several rings, the start is uniform over those of all rings.
    """
    start, ring = places(replay, key, batch, shape.length if shape.least is None else shape.least)
    oldest, added = (bound[None] for bound in span(replay, ring))
    numbers = start[None] + jnp.arange(-shape.burn_in, shape.length + 1)[:, None]
    timesteps = gather(replay, numbers, ring[None])
    step = timesteps.step._replace(is_first=timesteps.step.is_first | (numbers <= oldest))
    return Window(step, timesteps.note, (numbers >= oldest) & (numbers < added))


def places(
    replay: Replay, key: Key[Array, ""], batch: int, length: int
) -> tuple[Int[Array, " batch"], Int[Array, " batch"]]:
    """Running numbers of timesteps from which `length` transitions are stored, uniform over all, and their rings."""
    oldest, added = span(replay, jnp.arange(replay.added.size))
    starts = jnp.maximum(added - oldest - length, 1)
    after = jnp.cumsum(starts)
    start = jax.random.randint(key, (batch,), 0, after[-1])
    ring = jnp.searchsorted(after, start, side="right")
    return oldest[ring] + start - (after - starts)[ring], ring


def span(replay: Replay, ring: Int[Array, " batch"]) -> tuple[Int[Array, " batch"], Int[Array, " batch"]]:
    """The running number of the oldest timestep in these rings, and the number after the newest."""
    added = jnp.atleast_1d(replay.added)[ring]
    return jnp.maximum(added - capacity(replay), 0), added


def gather(replay: Replay, number: Int[Array, "*shape"], ring: Int[Array, "1 batch"] | None = None) -> StoredTimestep:
    """The timesteps of these running numbers (0 is the first ever added), leaves (*shape, ...).

    `ring` has the index of the ring for each number; it broadcasts against `number`. A lone ring needs none.
    """
    index = number % capacity(replay)
    several = replay.added.ndim > 0
    return jax.tree.map(lambda leaf: leaf[ring, index] if several else leaf[index], replay.timesteps)


def history(replay: Replay, length: int) -> tuple[Timestep, Bool[Array, " length"]]:
    """The first `length` timesteps ever added, and which of them exist, for use before the ring is full."""
    number = jnp.arange(length)
    return gather(replay, number).step, number < replay.added


def annotate(replay: Replay, notes: Any, length: int) -> Replay:
    """Replace the notes of the first `length` timesteps; leaves of `notes` (length, ...)."""
    note = jax.tree.map(lambda ring, new: ring.at[:length].set(new), replay.timesteps.note, notes)
    return replay._replace(timesteps=replay.timesteps._replace(note=note))
