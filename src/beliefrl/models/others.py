"""Controllers with other discounts, which act in some of the training's episodes and are never evaluated.

A controller with a small discount learns early what pays in the next steps. One with a large discount learns to avoid
distant failures. All learn from the same transitions, so each also learns from what the others do. Fedus et al. 2019
("Hyperbolic Discounting and Learning over Multiple Horizons") also learn critics with several discounts, but for one
policy. Here each critic has its own policy.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from beliefrl.models import double_q
from beliefrl.models.double_q import DoubleQController, OneTrunkActor, Policy, Samples
from beliefrl.models.soft_actor_critic import Optimisers, OptimiserState


class Other(NamedTuple):
    """A controller and the states of its optimisers."""

    controller: DoubleQController
    optimiser: OptimiserState


def init(made: DoubleQController, actor: OneTrunkActor, optimisers: Optimisers) -> Other:
    """A new controller that starts with this actor.

    So the exploration has one policy, whichever controller acts.
    """
    controller = made._replace(actor=jax.tree.map(jnp.copy, actor))
    return Other(controller, double_q.init_optimisers(optimisers, controller))


def who_acts(
    key: Key[Array, ""], others: tuple[Other, ...], is_first: Bool[Array, ""], before: Int[Array, ""]
) -> Int[Array, ""]:
    """The number of the controller that acts: drawn uniformly at the first timestep of an episode, then the same.

    0 is the controller that is evaluated; the others follow.
    """
    return jnp.where(is_first, jax.random.randint(key, (), 0, 1 + len(others)), before)


def policy_of(
    who: Int[Array, ""], policy: Policy, others: tuple[Other, ...], belief: Float[Array, " belief"]
) -> Policy:
    """π(a|s) of the controller with this number; `policy` is that of controller 0."""
    policies = policy, *(other.controller.actor(belief) for other in others)
    return jax.tree.map(lambda *each: jnp.stack(each)[who], *policies)


def update(
    others: tuple[Other, ...],
    optimisers: Optimisers,
    batch: Samples,
    key: Key[Array, ""],
    tau: float,
    regulariser: float,
    target_entropy: float | None = None,
) -> tuple[Other, ...]:
    """One update of each with its own targets, as in `double_q.update`."""
    updated = []
    for (controller, optimiser), target in zip(others, batch.other_targets, strict=True):
        own = batch._replace(target=target, other_targets=())
        controller, optimiser, _ = double_q.update(
            optimisers, optimiser, controller, own, key, tau, regulariser, target_entropy
        )
        updated.append(Other(controller, optimiser))
    return tuple(updated)
