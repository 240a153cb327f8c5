"""A pool with the transitions of the last cycles, from which the batches of `predictive-sac` are drawn."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from beliefrl.models.double_q import Samples


class Pool(NamedTuple):
    """The transitions of the last cycles, beliefs not standardised.

    A target is computed once, when its transition enters the pool.
    """

    transitions: Samples  # leaves (cycles that fit, transitions of a cycle, ...)
    cycles: Int[Array, ""]  # so far


def empty(room: tuple[int, int], belief: int, action: int) -> Pool:
    """A pool with room for so many cycles of so many transitions, given the sizes of beliefs and actions."""

    def zeros(*shape: int) -> Float[Array, "cycles transitions *shape"]:
        return jnp.zeros((*room, *shape))

    samples = Samples(zeros(belief), zeros(action), zeros(), zeros().astype(bool))
    return Pool(samples, jnp.zeros((), int))


def add(pool: Pool, samples: Samples) -> Pool:
    """The pool with the transitions (length, batch, ...) of one more cycle, which replace those of the oldest cycle."""
    index = pool.cycles % len(pool.transitions.target)

    def write(ring: Array, new: Array) -> Array:
        return ring.at[index].set(new.reshape(-1, *new.shape[2:]))

    return Pool(jax.tree.map(write, pool.transitions, samples), pool.cycles + 1)


def draw(pool: Pool, key: Key[Array, ""], shape: tuple[int, int]) -> Samples:
    """Transitions drawn uniformly, leaves (*shape, ...); they include transitions that are not `valid`."""
    cycles, count = pool.transitions.target.shape
    index = jax.random.randint(key, shape, 0, jnp.minimum(pool.cycles, cycles) * count)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[index], pool.transitions)
