"""Soft actor-critic on a belief: two Q networks, V, its target network, and a learned temperature.

Source: Section 3.3 of the paper (after Haarnoja et al. 2018, 2019), where s is the belief:

    J_V = E ½ (V(s) - (min_i Q_i(s, ã) - α log π(ã|s)))²
    J_Q = E ½ (Q_i(s, a) - (r + γ (1 - terminated) V̄(s')))²,  summed over i
    J_π = E α log π(ã|s) - min_i Q_i(s, ã)  +  regulariser · ½ E (μ² + σ²)
    J_α = E -log α (log π(ã|s) + H_target)

ã is one sample, used in all losses that need a sampled action. Departures, both from the authors' code: the actor is
regularised, and J_α is written in log α and not in α. The gradient has the same sign. A time limit is not a
termination. In each loss the differentiated argument comes first, and means are over valid transitions.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.models.nets import MLP, draw, tanh_gaussian
from beliefrl.models.optimisation import Optimisers, OptimiserState, soft_update, step_all, valid_mean

LOG_SIGMA_MIN, LOG_SIGMA_MAX = -20.0, 2.0


class Actor(eqx.Module):
    """π(a|s): a Gaussian squashed by tanh, with separate networks for its mean and log σ."""

    mean: MLP
    log_sigma: MLP

    def __init__(self, belief: int, action: int, layers: tuple[int, ...]):
        self.mean = MLP((belief, *layers, action), jax.nn.relu)
        self.log_sigma = MLP((belief, *layers, action), jax.nn.relu)

    def __call__(self, belief: Float[Array, " belief"]) -> tuple[Float[Array, " action"], Float[Array, " action"]]:
        """μ and log σ before the tanh, log σ clipped to [-20, 2]."""
        return self.mean(belief), jnp.clip(self.log_sigma(belief), LOG_SIGMA_MIN, LOG_SIGMA_MAX)


def q_value(
    critic: MLP, belief: Float[Array, "batch belief"], action: Float[Array, "batch action"]
) -> Float[Array, " batch"]:
    """Q(s, a)."""
    return q_outputs(critic, belief, action)[:, 0]


def q_outputs(
    critic: MLP, belief: Float[Array, "batch belief"], action: Float[Array, "batch action"]
) -> Float[Array, "batch output"]:
    """All outputs of a critic. The first layer is split, so that one product W_s s serves (s, a) and (s, ã)."""
    first, size = critic.layers[0], belief.shape[-1]
    projected = belief @ first.weight[:, :size].T
    return jax.vmap(lambda s, a: critic.rest(s + a @ first.weight[:, size:].T + first.bias))(projected, action)


def state_value(value: MLP, belief: Float[Array, "batch belief"]) -> Float[Array, " batch"]:
    """V(s)."""
    return jax.vmap(value)(belief)[:, 0]


class Controller(NamedTuple):
    """Everything that J_V, J_Q, J_π and J_α train."""

    actor: Actor
    critics: tuple[MLP, MLP]  # Q_1, Q_2
    value: MLP
    target_value: MLP
    log_alpha: Float[Array, ""]

    @property
    def trained(self) -> tuple[Actor, tuple[tuple[MLP, MLP], MLP], Float[Array, ""]]:
        """The parameters of each optimiser, in the order of `Optimisers`."""
        return self.actor, (self.critics, self.value), self.log_alpha

    def q(self, belief: Float[Array, "batch belief"], action: Float[Array, "batch action"]) -> Float[Array, " batch"]:
        """min_i Q_i(s, a)."""
        return jnp.minimum(*(q_value(critic, belief, action) for critic in self.critics))


class Batch(NamedTuple):
    """Transitions; the losses take one axis `batch`."""

    belief: Float[Array, "*batch belief"]  # s_t
    next_belief: Float[Array, "*batch belief"]  # s_{t+1}; s_{t+m} with returns of m steps (`returns`)
    action: Float[Array, "*batch action"]  # a_t
    reward: Float[Array, "*batch"]  # r_t, or the discounted sum of m of them
    terminated: Bool[Array, "*batch"]  # `next_belief` is terminal
    discount: Float[Array, "*batch"]  # γ^m of the value at `next_belief`
    valid: Bool[Array, "*batch"]  # mask: False entries are ignored
    actor_input: Float[Array, "*batch actor_input"] | None = None  # the actor's input if it is not s_t (SLAC)


def init_controller(
    key: Key[Array, ""],
    belief: int,
    action: int,
    policy_layers: tuple[int, ...],
    value_layers: tuple[int, ...],
    actor_size: int | None = None,
    value_start: float = 0.0,
) -> Controller:
    """A new controller for beliefs and actions of these sizes; V̄ starts as V, log α at 0.

    `actor_size` is the size of the actor's input if it is not the belief; `value_start` is added to V and Q.
    """
    actor = Actor(belief if actor_size is None else actor_size, action, policy_layers)
    critic = MLP((belief + action, *value_layers, 1), jax.nn.relu)
    value = MLP((belief, *value_layers, 1), jax.nn.relu)
    controller = draw(key, Controller(actor, (critic, critic), value, value, jnp.zeros(())))
    controller = eqx.tree_at(_last_biases, controller, replace_fn=lambda bias: bias + value_start)
    return controller._replace(target_value=jax.tree.map(jnp.copy, controller.value))


def _last_biases(controller: Controller) -> list[Any]:
    return [network.layers[-1].bias for network in (*controller.critics, controller.value)]


def value_loss(
    value: MLP, belief: Float[Array, "batch belief"], target: Float[Array, " batch"], valid: Bool[Array, " batch"]
) -> Float[Array, ""]:
    """J_V, given the target min_i Q_i(s, ã) - α log π(ã|s)."""
    return valid_mean(0.5 * (state_value(value, belief) - target) ** 2, valid)


def q_loss(critics: tuple[MLP, MLP], target_value: MLP, batch: Batch) -> Float[Array, ""]:
    """J_Q of both critics, summed."""
    next_value = jnp.where(batch.terminated, 0.0, state_value(target_value, batch.next_belief))
    target = jax.lax.stop_gradient(batch.reward + batch.discount * next_value)
    errors = [q_value(critic, batch.belief, batch.action) - target for critic in critics]
    return valid_mean(0.5 * errors[0] ** 2 + 0.5 * errors[1] ** 2, batch.valid)


def actor_loss(
    actor: Actor, controller: Controller, batch: Batch, noise: Float[Array, "batch action"], regulariser: float
) -> tuple[Float[Array, ""], tuple[Float[Array, " batch"], Float[Array, " batch"]]]:
    """J_π; also returns min_i Q_i(s, ã) and log π(ã|s). No gradient reaches the belief through Q."""
    mean, log_sigma = jax.vmap(actor)(batch.belief if batch.actor_input is None else batch.actor_input)
    action, log_prob = jax.vmap(tanh_gaussian)(mean, log_sigma, noise)
    q = controller.q(jax.lax.stop_gradient(batch.belief), action)
    size = jnp.mean(mean**2, axis=-1) + jnp.mean(jnp.exp(2 * log_sigma), axis=-1)
    alpha = jnp.exp(controller.log_alpha)
    return valid_mean(alpha * log_prob - q + 0.5 * regulariser * size, batch.valid), (q, log_prob)


def alpha_loss(
    log_alpha: Float[Array, ""], log_prob: Float[Array, " batch"], valid: Bool[Array, " batch"], target_entropy: float
) -> Float[Array, ""]:
    """J_α."""
    return -log_alpha * valid_mean(log_prob + target_entropy, valid)


def wanted_entropy(action: Float[Array, "batch action"], given: float | None) -> float:
    """H_target: `given`, or minus the number of action dimensions."""
    return -float(action.shape[-1]) if given is None else given


def loss(
    controller: Controller,
    batch: Batch,
    noise: Float[Array, "batch action"],
    regulariser: float,
    target_entropy: float | None = None,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """J_π + J_V + J_Q + J_α, with stop_gradient on everything that a loss does not train; and the metrics.

    So its gradient is that of the four losses at the same parameters (that of V̄ is zero). If a learning network forms
    the beliefs (`sac-lstm`), this network gets the gradient of J_π, J_V and J_Q. `noise` is standard normal, one vector
    per transition, for the sample ã. `target_entropy` None is minus the number of action dimensions.
    """
    fixed = jax.lax.stop_gradient(controller)
    j_pi, extras = actor_loss(controller.actor, fixed, batch, noise, regulariser)
    q, log_prob = jax.lax.stop_gradient(extras)
    alpha = jnp.exp(fixed.log_alpha)
    j_v = value_loss(controller.value, batch.belief, q - alpha * log_prob, batch.valid)
    j_q = q_loss(controller.critics, fixed.target_value, batch)
    j_alpha = alpha_loss(controller.log_alpha, log_prob, batch.valid, wanted_entropy(batch.action, target_entropy))
    metrics = {
        "loss_value": j_v,
        "loss_q": j_q,
        "loss_actor": j_pi,
        "alpha": alpha,
        "entropy": -valid_mean(log_prob, batch.valid),
        "q": valid_mean(q, batch.valid),
    }
    return j_pi + j_v + j_q + j_alpha, metrics


def update(
    optimisers: Optimisers, state: OptimiserState, controller: Controller, gradient: Controller, tau: float
) -> tuple[Controller, OptimiserState]:
    """One step of every optimiser, then a soft update of V̄."""
    (actor, (critics, value), log_alpha), state = step_all(optimisers, state, controller.trained, gradient.trained)
    target = soft_update(controller.target_value, value, tau)
    return Controller(actor, critics, value, target, log_alpha), state
