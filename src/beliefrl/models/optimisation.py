"""How weights change: the mean of a loss, steps of optimisers, target networks, averages.

The running average of weights changes more slowly than the weights (Polyak and Juditsky 1992):

    w̄ = w̄ + ρ (w - w̄),   ρ = max(rate, 10 / (n + 9)),   n is the number of the update

At first it is an average over about the last tenth of the updates (polynomial-decay averaging with η = 9, Shamir and
Zhang 2013). After 10 / rate updates it is an exponential average.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

PARTS = 10  # at first an average is over about the last 1 / PARTS of the updates

Params = TypeVar("Params")


def valid_mean(x: Float[Array, "*batch"], valid: Bool[Array, "*batch"]) -> Float[Array, ""]:
    """The mean of the valid entries; 0 where none is valid."""
    x, valid = x.ravel(), valid.ravel()  # a sum over several axes would be rounded differently
    return jnp.sum(jnp.where(valid, x, 0.0)) / jnp.maximum(jnp.sum(valid), 1)


def falling_rate(first: float, updates: int, least: float) -> optax.Schedule:
    """A learning rate that is `first` for a number of updates, and then first · updates / n, but at least `least`.

    If `least` is larger than `first`, the rate is constant.
    """

    def rate(n: ArrayLike) -> Float[Array, ""]:
        return jnp.maximum(first * updates / jnp.maximum(n, updates), min(first, least))

    return rate


def descend(
    optimiser: optax.GradientTransformation, gradient: Params, state: optax.OptState, params: Params
) -> tuple[Params, optax.OptState]:
    """One step of an optimiser; returns the new parameters and its new state."""
    tree: Any = params  # optax's types accept only its own trees
    updates, state = optimiser.update(gradient, state, tree)  # pyright: ignore[reportArgumentType]
    return optax.apply_updates(tree, updates), state  # pyright: ignore[reportReturnType]


class Optimisers(NamedTuple):
    """Adam for each group that has a learning rate of its own in Table 1."""

    actor: optax.GradientTransformation
    critic: optax.GradientTransformation  # Q_1, Q_2, and V if there is one
    alpha: optax.GradientTransformation


class OptimiserState(NamedTuple):
    actor: optax.OptState
    critic: optax.OptState
    alpha: optax.OptState


def init_optimisers(optimisers: Optimisers, trained: tuple[Any, ...]) -> OptimiserState:
    """Fresh states for the parameters of each optimiser."""
    return OptimiserState(*(optimiser.init(each) for optimiser, each in zip(optimisers, trained, strict=True)))


def step_all(
    optimisers: Optimisers, state: OptimiserState, trained: tuple[Any, ...], gradient: tuple[Any, ...]
) -> tuple[tuple[Any, ...], OptimiserState]:
    """One step of every optimiser; returns the new parameters of each and the new states."""
    steps = [descend(*each) for each in zip(optimisers, gradient, state, trained, strict=True)]
    after, states = zip(*steps, strict=True)
    return after, OptimiserState(*states)


def soft_update(target: Params, newest: Params, tau: float | Float[Array, ""]) -> Params:
    """Move a target network, such as V̄, or an average of weights by the fraction τ towards the trained network."""
    return jax.tree.map(lambda old, new: old + tau * (new - old), target, newest)


class Average(NamedTuple):
    """w̄; it has no meaning before the first update."""

    weights: Any
    updates: Int[Array, "*seed"]

    @classmethod
    def begin(cls, weights: Any) -> "Average":
        """An average before the first update, for weights of these shapes."""
        return cls(jax.tree.map(jnp.copy, weights), jnp.zeros((), int))

    def follow(self, newest: Any, rate: float) -> "Average":
        """The average after one more update of the weights."""
        updates = self.updates + 1
        rho = jnp.maximum(rate, PARTS / (updates + PARTS - 1))
        return Average(soft_update(self.weights, newest, rho), updates)

    def or_newest(self, newest: Any) -> Any:
        """The averaged weights, or the newest ones before the first update. Leaves may have leading axes."""
        begun = self.updates > 0

        def choose(mean: Array, weight: Array) -> Array:
            return jnp.where(begun.reshape(begun.shape + (1,) * (weight.ndim - begun.ndim)), mean, weight)

        return jax.tree.map(choose, self.weights, newest)
