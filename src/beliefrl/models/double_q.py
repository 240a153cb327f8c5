"""Soft actor-critic without V, in units of its own returns: the controller of `predictive-sac`.

Source: Haarnoja et al. 2019, Algorithm 1, with λ-returns as the targets (`returns`), where s is the belief:

    Q_low = min_i Q_i + (1 - P) |Q_1 - Q_2| / 2
    V̄(s) = Q̄_low(s, ã)
    y_t  = r_t + γ (1 - terminated) ((1 - c_{t+1}) V̄(s_{t+1}) + c_{t+1} y_{t+1})
    c_t  = λ (ω + (1 - ω) min(1, ρ_t)),  ρ_t = π(a_t|s_t) / b(a_t|s_t), or its root of degree D
    e_i  = (Q_i(s, a) - y) / u
    J_Q  = E ½ e_i² + w (½ e_i² / σ_i² + log σ_i),  summed over i
    J_π  = E α log π(ã|s) - Q_low(s, ã) / u  +  regulariser · ½ E μ²
    J_α  = E -log α (log π(ã|s) + H_target)

With the pessimism P = 1, Q_low is the smaller of the two Q, and with P = 0 it is their mean. The smaller one avoids
values that are too high. But where the two disagree it is low, and the policy avoids what it has seldom tried.

b is the policy that chose a. Where the current policy is less likely to choose a, the trace c is shorter, so the
rewards after it count less. With ω = 0 a return ends at the first action that π would not choose. With ω = 1 all
actions have the same trace. The ratio is that of Retrace (Munos et al. 2016). Retrace corrects with Q̄(s, a), this
target with V̄(s), so it is biased where the policies differ. With D action dimensions the ratio is a product of D
ratios, and with many it is nearly always small. Its root of degree D is their geometric mean.

u is a running root mean square of y. The networks of the critics return Q / u. When u changes, their last layers are
rescaled, so that Q stays the same (van Hasselt et al. 2016, without their mean). So one learning rate and one
temperature fit tasks with returns of any size. Departure: y does not contain the entropy. Over a horizon of 200 steps
the sum of entropies would exceed the rewards of most tasks. And because α is in units of u, u would influence itself.

With the weight w > 0 a critic also gives σ, the standard deviation of y / u, and its loss has the negative log
likelihood of y. So an error counts more where y is certain, for example shortly before an episode ends. Because of
the squared error, an error also counts where y is uncertain, for example where a reward is rare.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.models.nets import MLP, draw, gaussian_log_prob, tanh_gaussian
from beliefrl.models.optimisation import Optimisers, OptimiserState, soft_update, step_all, valid_mean
from beliefrl.models.returns import lambda_returns
from beliefrl.models.soft_actor_critic import LOG_SIGMA_MAX, LOG_SIGMA_MIN, alpha_loss, q_outputs, wanted_entropy
from beliefrl.types import Timestep

UNIT_RATE = 1e-3  # smallest weight of a new batch in u², reached after 1 / rate batches
UNIT_MIN = 1e-4
ACTION_MAX = 1 - 1e-6  # so that the inverse of tanh is finite
CRITIC_SIGMA_MIN = 0.02  # of a critic's σ, in units of u


class Policy(NamedTuple):
    """π(a|s): a Gaussian before the tanh."""

    mean: Float[Array, "*batch action"]  # μ
    log_sigma: Float[Array, "*batch action"]  # log σ


class Samples(NamedTuple):
    """Transitions with their targets."""

    belief: Float[Array, "*batch belief"]  # s_t
    action: Float[Array, "*batch action"]  # a_t
    target: Float[Array, "*batch"]  # y_t
    valid: Bool[Array, "*batch"]  # mask: False entries are ignored


class OneTrunkActor(eqx.Module):
    """π(a|s): a Gaussian squashed by tanh; one network for its mean and log σ."""

    network: MLP

    def __init__(self, belief: int, action: int, layers: tuple[int, ...]):
        self.network = MLP((belief, *layers, 2 * action), jax.nn.relu)

    def __call__(self, belief: Float[Array, " belief"]) -> Policy:
        """μ and log σ before the tanh, log σ clipped to [-20, 2]."""
        mean, log_sigma = jnp.split(self.network(belief), 2)
        return Policy(mean, jnp.clip(log_sigma, LOG_SIGMA_MIN, LOG_SIGMA_MAX))


class Unit(NamedTuple):
    """u, the size of returns."""

    square: Float[Array, ""]  # u², an average over batches; an exponential average after 1 / UNIT_RATE batches
    batches: Float[Array, ""]  # so far

    @property
    def u(self) -> Float[Array, ""]:
        return jnp.sqrt(self.square) + UNIT_MIN


class DoubleQController(NamedTuple):
    """Everything that J_Q, J_π and J_α train."""

    actor: OneTrunkActor
    critics: tuple[MLP, MLP]  # Q_1 / u, Q_2 / u; with w > 0 also log σ
    targets: tuple[MLP, MLP]  # the same of Q̄
    log_alpha: Float[Array, ""]
    unit: Unit

    @property
    def trained(self) -> tuple[OneTrunkActor, tuple[MLP, MLP], Float[Array, ""]]:
        """The parameters of each optimiser, in the order of `Optimisers`."""
        return self.actor, self.critics, self.log_alpha


def init_controller(
    key: Key[Array, ""],
    belief: int,
    action: int,
    policy_layers: tuple[int, ...],
    value_layers: tuple[int, ...],
    alpha: float,
    normalise_critics: bool,
    with_sigma: bool,
) -> DoubleQController:
    """A new controller for beliefs and actions of these sizes; Q̄ starts as Q, α at `alpha`, u at 1.

    A critic gives Q / u, and `with_sigma` also the σ of w > 0.
    """
    critic = MLP((belief + action, *value_layers, 2 if with_sigma else 1), jax.nn.relu, normalise_critics)
    actor, critics = draw(key, (OneTrunkActor(belief, action, policy_layers), (critic, critic)))
    unit = Unit(jnp.ones(()), jnp.zeros(()))
    return DoubleQController(actor, critics, jax.tree.map(jnp.copy, critics), jnp.full((), math.log(alpha)), unit)


def sample(
    actor: OneTrunkActor, belief: Float[Array, "batch belief"], key: Key[Array, ""]
) -> tuple[Float[Array, "batch action"], Float[Array, " batch"], Policy]:
    """ã, log π(ã|s) and π(a|s)."""
    policy = jax.vmap(actor)(belief)
    action, log_prob = jax.vmap(tanh_gaussian)(*policy, jax.random.normal(key, policy.mean.shape))
    return action, log_prob, policy


def q_low(
    critics: tuple[MLP, MLP],
    belief: Float[Array, "batch belief"],
    action: Float[Array, "batch action"],
    pessimism: float,
) -> Float[Array, " batch"]:
    """Q_low(s, a)."""
    one, two = (q_outputs(critic, belief, action)[:, 0] for critic in critics)
    return jnp.minimum(one, two) + (1 - pessimism) / 2 * jnp.abs(one - two)


def likeness(
    policy: Policy, behaviour: Policy, action: Float[Array, "*batch action"], per_dimension: bool = False
) -> Float[Array, "*batch"]:
    """min(1, ρ), from the densities before the tanh, because its derivative cancels.

    a is taken as at most `ACTION_MAX`. So the ratio is not exact where μ of a policy is beyond -7 or 7.
    """
    before = jnp.arctanh(jnp.clip(action, -ACTION_MAX, ACTION_MAX))
    pi, b = (gaussian_log_prob(before, each.mean, jnp.exp(each.log_sigma)) for each in (policy, behaviour))
    log_ratio = jnp.mean(pi - b, axis=-1) if per_dimension else jnp.sum(pi - b, axis=-1)
    return jnp.exp(jnp.minimum(log_ratio, 0.0))


class Traces(NamedTuple):
    """How far rewards ahead count in a λ-return."""

    gamma: float  # the discount γ
    decay: float  # λ
    off_policy: float  # ω: the trace is ωλ at an action that π would not choose
    per_dimension: bool = False  # whether ρ is the root of degree D


def critic_targets(
    controller: DoubleQController,
    belief: Float[Array, "time batch belief"],
    step: Timestep,
    valid: Bool[Array, "length batch"],
    behaviour: Policy,
    key: Key[Array, ""],
    traces: Traces,
    pessimism: float,
) -> tuple[Float[Array, "length batch"], Float[Array, "length batch"]]:
    """y_t of the transitions between length + 1 timesteps, and min(1, ρ) there.

    Args:
        controller: its actor is π.
        belief, step: at the timesteps.
        valid: which pairs of neighbours are transitions. For the others y_t has no meaning.
        behaviour: b(a|s_t) at the timesteps.
        key: the randomness of ã.
        traces: γ, λ, ω and ρ.
        pessimism: P.
    """
    flat = belief.reshape(-1, belief.shape[-1])
    action, _, policy = sample(controller.actor, flat, key)
    value = (controller.unit.u * q_low(controller.targets, flat, action, pessimism)).reshape(belief.shape[:2])
    policy = jax.tree.map(lambda leaf: leaf.reshape(*belief.shape[:2], -1)[:-1], policy)
    behaviour = jax.tree.map(lambda leaf: leaf[:-1], behaviour)
    like = likeness(policy, behaviour, step.prev_action[1:], traces.per_dimension)
    trace = traces.decay * (traces.off_policy + (1 - traces.off_policy) * like)
    return lambda_returns(step, valid, value, trace, traces.gamma), like


def rescale(
    controller: DoubleQController, y: Float[Array, " batch"], valid: Bool[Array, " batch"]
) -> DoubleQController:
    """The controller with u updated by the valid targets of one more batch, if there are any.

    Q and u σ stay the same (apart from `CRITIC_SIGMA_MIN`). Departure: Adam's moments are not rescaled.
    """
    old, some = controller.unit, jnp.any(valid)
    rate = jnp.where(some, jnp.maximum(1 / (old.batches + 1), UNIT_RATE), 0.0)
    new = Unit(old.square + rate * (valid_mean(y**2, valid) - old.square), old.batches + some)

    def rescaled(critic: MLP) -> MLP:
        last, ratio = critic.layers[-1], old.u / new.u
        is_q = jnp.arange(len(last.bias)) == 0  # the second output is log σ
        factor, summand = jnp.where(is_q, ratio, 1.0), jnp.where(is_q, 0.0, jnp.log(ratio))
        new_last = (last.weight * factor[:, None], last.bias * factor + summand)
        return eqx.tree_at(lambda critic: (critic.layers[-1].weight, critic.layers[-1].bias), critic, new_last)

    critics, targets = tuple(map(rescaled, controller.critics)), tuple(map(rescaled, controller.targets))
    return controller._replace(critics=critics, targets=targets, unit=new)


def q_loss(critics: tuple[MLP, MLP], batch: Samples, unit: Float[Array, ""], likelihood: float) -> Float[Array, ""]:
    """J_Q of both critics, summed. If the weight `likelihood` is not 0, the critics must give σ."""
    outputs = (q_outputs(critic, batch.belief, batch.action) for critic in critics)
    one, two = (q_error(each, batch.target / unit, likelihood) for each in outputs)
    return valid_mean(one + two, batch.valid)


def q_error(
    output: Float[Array, "batch output"], y: Float[Array, " batch"], likelihood: float
) -> Float[Array, " batch"]:
    """J_Q of one critic, before the mean. The second output is log σ without its minimum."""
    squared = 0.5 * (output[:, 0] - y) ** 2
    if likelihood == 0:
        return squared
    variance = CRITIC_SIGMA_MIN**2 + jnp.exp(2 * output[:, 1])
    return squared + likelihood * (squared / variance + 0.5 * jnp.log(variance))


def actor_loss(
    actor: OneTrunkActor,
    controller: DoubleQController,
    batch: Samples,
    key: Key[Array, ""],
    regulariser: float,
    pessimism: float,
) -> tuple[Float[Array, ""], tuple[Float[Array, " batch"], Float[Array, " batch"]]]:
    """J_π; also returns Q_low(s, ã) / u and log π(ã|s)."""
    action, log_prob, policy = sample(actor, batch.belief, key)
    q = q_low(controller.critics, batch.belief, action, pessimism)
    size = 0.5 * regulariser * jnp.mean(policy.mean**2, axis=-1)
    return valid_mean(jnp.exp(controller.log_alpha) * log_prob - q + size, batch.valid), (q, log_prob)


def update(
    optimisers: Optimisers,
    state: OptimiserState,
    controller: DoubleQController,
    batch: Samples,
    key: Key[Array, ""],
    *,
    tau: float,
    regulariser: float,
    pessimism: float,
    likelihood: float,
    target_entropy: float | None = None,
) -> tuple[DoubleQController, OptimiserState, dict[str, Float[Array, ""]]]:
    """One step of every optimiser, then a soft update of Q̄.

    `target_entropy` None is minus the number of action dimensions.
    """
    controller = rescale(controller, batch.target, batch.valid)
    j_q, grad_critics = jax.value_and_grad(q_loss)(controller.critics, batch, controller.unit.u, likelihood)
    differentiate = jax.value_and_grad(actor_loss, has_aux=True)
    (j_pi, (q, log_prob)), grad_actor = differentiate(controller.actor, controller, batch, key, regulariser, pessimism)
    entropy = wanted_entropy(batch.action, target_entropy)
    grad_alpha = jax.grad(alpha_loss)(controller.log_alpha, log_prob, batch.valid, entropy)
    gradient = grad_actor, grad_critics, grad_alpha
    (actor, critics, log_alpha), state = step_all(optimisers, state, controller.trained, gradient)
    metrics = {
        "loss_q": j_q,
        "loss_actor": j_pi,
        "alpha": jnp.exp(controller.log_alpha),
        "entropy": -valid_mean(log_prob, batch.valid),
        "q": valid_mean(q, batch.valid) * controller.unit.u,
        "unit": controller.unit.u,
    }
    targets = soft_update(controller.targets, critics, tau)
    return DoubleQController(actor, critics, targets, log_alpha, controller.unit), state, metrics
