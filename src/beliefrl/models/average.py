"""A running average of weights, which changes more slowly than the weights (Polyak and Juditsky 1992).

    w̄ = w̄ + ρ (w - w̄),   ρ = max(rate, 10 / (n + 9)),   n is the number of the update

At first it is an average over about the last tenth of the updates (polynomial-decay averaging with η = 9, Shamir and
Zhang 2013). After 10 / rate updates it is an exponential average.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from beliefrl.models.soft_actor_critic import soft_update

PARTS = 10  # at first the average is over about the last 1 / PARTS of the updates


class Average(NamedTuple):
    """w̄; it has no meaning before the first update."""

    weights: Any
    updates: Int[Array, "*seed"]


def begin(weights: Any) -> Average:
    """An average before the first update, for weights of these shapes."""
    return Average(jax.tree.map(jnp.copy, weights), jnp.zeros((), int))


def follow(average: Average, newest: Any, rate: float) -> Average:
    """The average after one more update of the weights."""
    updates = average.updates + 1
    rho = jnp.maximum(rate, PARTS / (updates + PARTS - 1))
    return Average(soft_update(average.weights, newest, rho), updates)


def averaged(average: Average, newest: Any) -> Any:
    """The averaged weights, or the newest ones before the first update. Leaves may have leading axes."""
    begun = average.updates > 0

    def choose(mean: Array, weight: Array) -> Array:
        return jnp.where(begun.reshape(begun.shape + (1,) * (weight.ndim - begun.ndim)), mean, weight)

    return jax.tree.map(choose, average.weights, newest)
