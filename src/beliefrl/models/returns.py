"""The targets of the critics: transitions over one step (the paper) or over n steps, and λ-returns.

With n steps the critics are trained towards

    r_t + γ r_{t+1} + ... + γ^{m-1} r_{t+m-1} + γ^m V̄(s_{t+m}),    m ≤ n

where m is n, or the number of steps that are left of the episode or the window. Information in V̄ then reaches Q in n
times fewer updates. The actions in between were chosen by older policies, and their entropy is not counted. So the
target is biased. The bias grows with n.

A λ-return is a weighted mean of the returns of 1, 2, 3, ... steps, to the end of the episode or the window. Here each
timestep has a λ of its own, the trace c:

    y_t = r_t + γ (1 - terminated) ((1 - c_{t+1}) V̄(s_{t+1}) + c_{t+1} y_{t+1})

c is 0 at the last timestep of the episode or the window. With c = λ it is Peng's Q(λ) (Kozuno et al. 2021).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from beliefrl.models.soft_actor_critic import Batch
from beliefrl.types import Timestep


class Returns(NamedTuple):
    """Results of the transitions that start at each timestep of windows (time-major)."""

    end: Int[Array, "length batch"]  # index of s_{t+m} among the windows' timesteps
    reward: Float[Array, "length batch"]  # discounted sum of the m rewards
    terminated: Bool[Array, "length batch"]  # s_{t+m} is terminal
    discount: Float[Array, "length batch"]  # γ^m


def n_step_returns(step: Timestep, valid: Bool[Array, "length batch"], n: int, gamma: float) -> Returns:
    """The returns of `length` transitions between length + 1 timesteps.

    `valid` marks the pairs of neighbours that are transitions. For other pairs the returned values have no meaning.
    """
    length = valid.shape[0]
    first = jnp.broadcast_to(jnp.arange(length)[:, None], valid.shape)
    end, total, terminated = first + 1, step.reward[1:], step.terminated[1:]
    discount, goes_on = jnp.full(total.shape, gamma), valid & ~terminated
    for ahead in range(1, min(n, length)):
        reward, ends, follows = (_shifted(leaf, ahead) for leaf in (step.reward[1:], step.terminated[1:], valid))
        goes_on = goes_on & follows
        end, total = end + goes_on, total + jnp.where(goes_on, gamma**ahead * reward, 0.0)
        discount = jnp.where(goes_on, gamma ** (ahead + 1), discount)
        terminated = terminated | (goes_on & ends)
        goes_on = goes_on & ~ends
    return Returns(end, total, terminated, discount)


def _shifted(leaf: Array, ahead: int) -> Array:
    """The values `ahead` steps later; zero (or False) where the window has ended."""
    return jnp.concatenate([leaf[ahead:], jnp.zeros_like(leaf[:ahead])])


def transition_batch(
    step: Timestep,
    valid: Bool[Array, "length batch"],
    belief: Float[Array, "time batch belief"],
    next_belief: Float[Array, "time batch belief"],
    n: int,
    gamma: float,
    actor_input: Float[Array, "time batch actor_input"] | None = None,
) -> Batch:
    """The transitions between length + 1 timesteps of windows (time-major), leaves (length, batch, ...).

    `next_belief` has the inputs of V̄ at the same timesteps. `actor_input` has those of the actor, if not `belief`.
    """
    returns = n_step_returns(step, valid, n, gamma)
    after = next_belief[1:] if n == 1 else jnp.take_along_axis(next_belief, returns.end[..., None], axis=0)
    return Batch(
        belief=belief[:-1],
        next_belief=after,
        action=step.prev_action[1:],
        reward=returns.reward,
        terminated=returns.terminated,
        valid=valid,
        actor_input=None if actor_input is None else actor_input[:-1],
        discount=returns.discount,
    )


def lambda_returns(
    step: Timestep,
    valid: Bool[Array, "length batch"],
    value: Float[Array, "time batch"],
    trace: Float[Array, "length batch"],
    gamma: float,
) -> Float[Array, "length batch"]:
    """y_t of `length` transitions between length + 1 timesteps.

    Args:
        step: the timesteps.
        valid: which pairs of neighbours are transitions. For the others y_t has no meaning.
        value: V̄(s_t) at every timestep.
        trace: c_t; only those of valid transitions are used.
        gamma: γ.
    """

    def backwards(ahead: Float[Array, " batch"], now: tuple) -> tuple[Float[Array, " batch"], Float[Array, " batch"]]:
        """`ahead` is (1 - c_{t+1}) V̄(s_{t+1}) + c_{t+1} y_{t+1}."""
        reward, terminated, value, trace = now
        y = reward + gamma * jnp.where(terminated, 0.0, ahead)
        return value + trace * (y - value), y

    inputs = step.reward[1:], step.terminated[1:], value[:-1], jnp.where(valid, trace, 0.0)
    return jax.lax.scan(backwards, value[-1], inputs, reverse=True)[1]
