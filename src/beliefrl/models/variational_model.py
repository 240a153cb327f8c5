"""The variational recurrent model (VRM): it learns to predict its inputs, and forms a recurrent state d.

Source: Section 4.1, Appendix A.1. x_t = (o_t, r_{t-1}), a_{t-1} is the action before it, and [..] is a concatenation:

    prior      p(z_t)  = N(μ_p, σ_p)[d_{t-1}, a_{t-1}]
    posterior  q(z_t)  = N(μ_q, σ_q)[d_{t-1}, a_{t-1}, f_x(x_t)]
    decoder    p(x_t)  = N(μ_x, σ_x)[d_{t-1}, z_t]
    state      d_t     = LSTM(d_{t-1}; [f_x(x_t), z_t])
    ELBO               = E_q log p(x_t) - D_KL(q(z_t) ‖ p(z_t))

The code is arranged for speed. The posterior's first layers and the LSTM's gates are one layer, `Joint`, with separate
weights for each input. Its products with f_x(x) and a are one batched product before the loop. The products with d and
z are computed in the loop. Prior and decoder run after it. The loop and its gradient are those of `recurrence`.

Departure: a gate has one bias. In PyTorch's LSTM it is the sum of two.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from beliefrl.models.nets import (
    MLP,
    Gaussian,
    Linear,
    LSTMState,
    gaussian_kl,
    gaussian_log_prob,
    lstm_step,
    lstm_step_backward,
)
from beliefrl.models.recurrence import Cell, unroll

SIGMA_X_MIN = 1e-3


class Inferred(NamedTuple):
    """An unroll of the inference model, leaves (time, batch, ...)."""

    posterior: Gaussian  # of z_t
    z: Float[Array, "time batch z"]
    before: Float[Array, "time batch d"]  # d_{t-1}, zeros where an episode begins
    state: LSTMState  # d_t and its cell


class Joint(eqx.Module):
    """The first layers of μ_q and σ_q and the four gates, concatenated: (hidden, hidden, 4 d) = joint outputs.

    Weights are stored as (input, output), as the loop needs them. An output has weights only for its own inputs.
    """

    w_d: Float[Array, "d joint"]
    w_features: Float[Array, "hidden joint"]
    w_action: Float[Array, "action 2*hidden"]  # of the posterior only
    w_z: Float[Array, "z 4*d"]  # of the gates only
    bias: Float[Array, " joint"]

    def __init__(self, action: int, d: int, z: int, hidden: int):
        posterior, gates = (d + action + hidden) ** -0.5, d**-0.5  # PyTorch's bounds for a linear layer and an LSTM
        self.bias = jnp.concatenate([jnp.full(2 * hidden, posterior), jnp.full(4 * d, gates)])
        self.w_d = jnp.tile(self.bias, (d, 1))
        self.w_features = jnp.tile(self.bias, (hidden, 1))
        self.w_action = jnp.full((action, 2 * hidden), posterior)
        self.w_z = jnp.full((z, 4 * d), gates)

    def given(
        self,
        features: Float[Array, "time batch hidden"],
        prev_action: Float[Array, "time batch action"],
        posterior_reads_x: bool,
    ) -> Float[Array, "time batch joint"]:
        """What the layer gets from f_x(x_t) and a_{t-1}; without f_x(x_t) for the posterior unless it reads x_t."""
        w_features, posterior, gates = self.w_features, self.w_action.shape[1], self.w_z.shape[1]
        if not posterior_reads_x:
            w_features = w_features.at[:, :posterior].set(0.0)
        w_action = jnp.pad(self.w_action, ((0, 0), (0, gates)))  # the gates get no action
        # All in one product: adding the part of the action and the bias to it would take another fifth of its time.
        inputs = jnp.concatenate([features, prev_action, jnp.ones_like(prev_action[..., :1])], axis=-1)
        return inputs @ jnp.concatenate([w_features, w_action, self.bias[None]])


class VRM(eqx.Module):
    """The weights of one variational recurrent model."""

    features: MLP  # f_x
    joint: Joint
    posterior_mean: Linear  # last layers of μ_q and σ_q
    posterior_sigma: Linear
    prior_mean: MLP
    prior_sigma: MLP
    decoder_mean: MLP
    decoder_sigma: MLP
    deterministic: bool = eqx.field(static=True)

    def __init__(self, x: int, action: int, d: int, z: int, hidden: int, deterministic: bool = False):
        """Widths: perception (observation and reward), action, d, z, and every hidden layer.

        In a `deterministic` model posterior and prior are the same, z_t = μ_q[d_{t-1}, a_{t-1}] (Appendix C). It does
        not use its networks for the prior and for σ.
        """

        def net(*sizes: int) -> MLP:
            return MLP(sizes, jnp.tanh)

        self.features = net(x, hidden, hidden)
        self.joint = Joint(action, d, z, hidden)
        self.posterior_mean, self.posterior_sigma = Linear(hidden, z), Linear(hidden, z)
        self.prior_mean, self.prior_sigma = net(d + action, hidden, z), net(d + action, hidden, z)
        self.decoder_mean, self.decoder_sigma = net(d + z, hidden, hidden, x), net(d + z, hidden, hidden, x)
        self.deterministic = deterministic

    def start(self, batch: int) -> LSTMState:
        """The state at the start of an episode, leaves (batch, d)."""
        return LSTMState.empty(batch, self.joint.w_d.shape[0])

    def prior(self, before: Float[Array, " d"], prev_action: Float[Array, " action"]) -> Gaussian:
        """p(z_t | d_{t-1}, a_{t-1})."""
        known = jnp.concatenate([before, prev_action])
        return Gaussian(self.prior_mean(known), jax.nn.softplus(self.prior_sigma(known)))

    def decode(self, before: Float[Array, " d"], z: Float[Array, " z"]) -> Gaussian:
        """p(x_t | z_t, d_{t-1})."""
        known = jnp.concatenate([before, z])
        return Gaussian(self.decoder_mean(known), jax.nn.softplus(self.decoder_sigma(known)) + SIGMA_X_MIN)

    def infer(
        self,
        start: LSTMState,
        x: Float[Array, "time batch x"],
        prev_action: Float[Array, "time batch action"],
        is_first: Bool[Array, "time batch"],
        noise: Float[Array, "time batch z"],
    ) -> Inferred:
        """Unroll the inference model with z_t = μ_q + σ_q · noise_t, from `start`, and from zero where is_first."""
        given = self.joint.given(jax.vmap(jax.vmap(self.features))(x), prev_action, not self.deterministic)
        noise = jnp.zeros_like(noise) if self.deterministic else noise
        mean, sigma = self.posterior_mean, self.posterior_sigma
        weights = LoopWeights(self.joint.w_d, self.joint.w_z, mean.weight.T, sigma.weight.T, mean.bias, sigma.bias)
        return unroll(CELL, weights, start, given, is_first, noise)

    def next_state(self, state: LSTMState, x: Float[Array, " x"], z: Float[Array, " z"]) -> LSTMState:
        """d_t and its cell, from d_{t-1} and its cell."""
        joint, gates = self.joint, slice(-self.joint.w_z.shape[1], None)
        given = self.features(x) @ joint.w_features[:, gates] + state.d @ joint.w_d[:, gates] + joint.bias[gates]
        return lstm_step(given + z @ joint.w_z, state.c)[0]


def predict(
    vrm: VRM,
    x: Float[Array, "time x"],
    prev_action: Float[Array, "time action"],
    observed: Bool[Array, " time"],
    noise: tuple[Float[Array, "time z"], Float[Array, "time x"]],
) -> Gaussian:
    """p(x_t | z_t, d_{t-1}) along one episode from its first timestep on, leaves (time, x).

    Where x_t is `observed` (open loop), z_t is drawn from the posterior. Elsewhere (closed loop) z_t is drawn from the
    prior, and the LSTM reads a sample of x_t from the decoder. A deterministic model has σ = 0.
    """

    def step(state: LSTMState, inputs: tuple) -> tuple[LSTMState, Gaussian]:
        x, prev_action, observed, (noise_z, noise_x) = inputs
        timestep = jax.tree.map(lambda leaf: leaf[None, None], (x, prev_action, jnp.array(False), noise_z))
        z = vrm.infer(jax.tree.map(lambda leaf: leaf[None], state), *timestep).z[0, 0]
        if not vrm.deterministic:  # in deterministic models posterior and prior are the same
            prior = vrm.prior(state.d, prev_action)
            z = jnp.where(observed, z, prior.mean + prior.sigma * noise_z)
        mean, sigma = vrm.decode(state.d, z)
        sigma = jnp.zeros_like(sigma) if vrm.deterministic else sigma
        return vrm.next_state(state, jnp.where(observed, x, mean + sigma * noise_x), z), Gaussian(mean, sigma)

    start, x = LSTMState.empty(vrm.joint.w_d.shape[0]), jnp.where(observed[:, None], x, 0.0)
    return jax.lax.scan(step, start, (x, prev_action, observed, noise))[1]


class VRMElboTerms(NamedTuple):
    """The two terms of the ELBO at every step, each summed or averaged over its dimensions."""

    kl: Float[Array, "time batch"]  # D_KL(q ‖ p)
    log_likelihood: Float[Array, "time batch"]  # log p(x)


def elbo_terms(
    vrm: VRM,
    inferred: Inferred,
    x: Float[Array, "time batch x"],
    prev_action: Float[Array, "time batch action"],
    scaling: str = "mean",
    prior_noise: Float[Array, "time batch z"] | None = None,
) -> VRMElboTerms:
    """Both terms of the ELBO of an unroll.

    `scaling` "mean" averages over the dimensions of z and x, as in the authors' code (their learning rate was tuned
    with it). "sum" is the paper's formula. With `prior_noise`, x is decoded from a z of the prior, as in their code.
    """
    prior = jax.vmap(jax.vmap(vrm.prior))(inferred.before, prev_action)
    z = inferred.z if prior_noise is None else prior.mean + prior.sigma * prior_noise
    decoded = jax.vmap(jax.vmap(vrm.decode))(inferred.before, z)
    reduce = {"mean": jnp.mean, "sum": jnp.sum}[scaling]
    kl = reduce(gaussian_kl(*inferred.posterior, *prior), axis=-1)
    return VRMElboTerms(kl, reduce(gaussian_log_prob(x, *decoded), axis=-1))


def prediction_error(vrm: VRM, inferred: Inferred, x: Float[Array, "time batch x"]) -> Float[Array, "time batch"]:
    """The squared error of a deterministic model's prediction of x_t, mean over its dimensions."""
    predicted = jax.vmap(jax.vmap(vrm.decode))(inferred.before, inferred.z).mean
    return jnp.mean((predicted - x) ** 2, axis=-1)


class LoopWeights(NamedTuple):
    """The weights inside the loop, each (input, output), and the biases of the posterior's last layers."""

    w_d: Float[Array, "d joint"]
    w_z: Float[Array, "z 4*d"]
    mean: Float[Array, "hidden z"]
    sigma: Float[Array, "hidden z"]
    mean_bias: Float[Array, " z"]
    sigma_bias: Float[Array, " z"]


def _forward(weights, before, given, noise):
    """One step: computes the posterior's hidden layers and the gates, draws z, and computes the LSTM's next state."""
    hidden = weights.mean.shape[0]
    joint = given + before.d @ weights.w_d
    first = jnp.tanh(joint[:, : 2 * hidden])
    bias_mean, bias_sigma = (jnp.broadcast_to(b, noise.shape) for b in (weights.mean_bias, weights.sigma_bias))
    mean = first[:, :hidden] @ weights.mean + bias_mean
    sigma = jax.nn.softplus(first[:, hidden:] @ weights.sigma + bias_sigma)
    z = mean + sigma * noise
    state, slopes = lstm_step(joint[:, 2 * hidden :] + z @ weights.w_z, before.c)
    return state, Inferred(Gaussian(mean, sigma), z, before.d, state), (first, slopes)


def _backward(weights, memory, grad_state, grad_output):
    """The gradient of one step; the weights are transposed."""
    first, slopes = memory.saved
    grad_gates, grad_c = lstm_step_backward(slopes, jax.tree.map(jnp.add, grad_state, grad_output.state))
    grad_z = grad_output.z + grad_gates @ weights.w_z
    grad_mean = grad_output.posterior.mean + grad_z
    softplus_slope = -jnp.expm1(-memory.output.posterior.sigma)  # a sigmoid, of σ = softplus(x)
    grad_sigma = (grad_output.posterior.sigma + grad_z * memory.noise) * softplus_slope
    grad_hidden = jnp.concatenate([grad_mean @ weights.mean, grad_sigma @ weights.sigma], axis=-1)
    grad_joint = jnp.concatenate([grad_hidden * (1 - first**2), grad_gates], axis=-1)
    grad_d = grad_output.before + grad_joint @ weights.w_d
    return LSTMState(grad_d, grad_c), (grad_joint, grad_mean, grad_sigma)


def _factors(memory, grads):
    """The gradient of `given`; the factor of each weight in the loop; the gradient of each product."""
    grad_joint, grad_mean, grad_sigma = grads
    hidden_mean, hidden_sigma = jnp.split(memory.saved[0], 2, axis=-1)
    before, z = memory.output.before, memory.output.z
    inputs = LoopWeights(before, z, hidden_mean, hidden_sigma, hidden_mean, hidden_sigma)
    grad_gates = grad_joint[..., 2 * hidden_mean.shape[-1] :]
    return grad_joint, inputs, LoopWeights(grad_joint, grad_gates, grad_mean, grad_sigma, grad_mean, grad_sigma)


CELL = Cell(_forward, _backward, _factors)
