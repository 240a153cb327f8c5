"""SLAC's latent variable model: two latent variables at each timestep, z¹ inferred from x_t, z² from z¹.

Source: Lee et al. 2019, Section 4; sizes and activations: Han, Doya, Tani 2020, Appendix A.2.3. With
x_t = (o_t, r_{t-1}) and z_t = [z¹_t, z²_t]:

    posterior  q(z¹_t) = N(μ, σ)[x_t, z²_{t-1}, a_{t-1}]
    prior      p(z¹_t) = N(μ, σ)[z²_{t-1}, a_{t-1}], and N(0, 1) at an episode's first timestep
    both       p(z²_t) = N(μ, σ)[z¹_t, z²_{t-1}, a_{t-1}]
    decoders   p(o_t)  = N(μ, σ)[z_t],    p(r_{t-1}) = N(μ, σ)[z_{t-1}, a_{t-1}, z_t]
    ELBO               = Σ_t log p(o_t) + log p(r_{t-1}) - D_KL(q(z¹_t) ‖ p(z¹_t))

The code is arranged for speed: the products of the first layers with inputs from outside the loop are computed before
the loop, and prior and decoders run after it. The loop and its gradient are those of `recurrence`.

Departures: MLPs in place of convolutions, tanh activations, and a learned σ of the decoders, as in Han et al. μ and σ
are two outputs of one perceptron, as in Lee et al. (Han et al. have a perceptron for each, at twice the cost). The
first timestep of an episode uses the same networks, with an input that marks it and zeros for z²_{t-1} and a_{t-1}.
Both papers have further networks there.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from beliefrl.models.nets import MLP, Gaussian, gaussian_kl, gaussian_log_prob
from beliefrl.models.recurrence import Cell, unroll

SIGMA_MIN = 1e-2  # of the decoders


class GaussianMLP(eqx.Module):
    """μ and σ of a Gaussian from one perceptron."""

    mlp: MLP
    least: float = eqx.field(static=True)

    def __init__(self, inputs: int, layers: tuple[int, ...], outputs: int, least: float = 0.0):
        """`layers` are the widths of the hidden layers, `least` is the smallest σ."""
        self.mlp = MLP((inputs, *layers, 2 * outputs), jnp.tanh)
        self.least = least

    def __call__(self, *inputs: Float[Array, "*batch _"]) -> Gaussian:
        """The Gaussian for inputs in several parts, each (*batch, size)."""
        first, *later = self.weights()
        (mean, sigma), _ = _layers(_linear(first, jnp.concatenate(inputs, axis=-1)), later)
        return Gaussian(mean, sigma + self.least)

    def weights(self) -> tuple[tuple[Float[Array, "input output"], Float[Array, " output"]], ...]:
        """The weight (input, output) and the bias of each layer."""
        return tuple((layer.weight.T, layer.bias) for layer in self.mlp.layers)

    def columns(self, *sizes: int) -> list[Float[Array, "_ hidden"]]:
        """The first layer's weights (input, output), split into parts for inputs of these sizes."""
        return jnp.split(self.mlp.layers[0].weight.T, list(itertools.accumulate(sizes))[:-1])


class Latents(NamedTuple):
    """Latent variables along windows, leaves (time, batch, ...)."""

    posterior: Gaussian  # of z¹_t
    z1: Float[Array, "time batch z1"]
    before: Float[Array, "time batch z2"]  # z²_{t-1}, zeros where an episode begins
    z2: Float[Array, "time batch z2"]


class LatentModel(eqx.Module):
    """The networks of the model."""

    posterior: GaussianMLP
    prior: GaussianMLP
    next_z2: GaussianMLP
    decoder: GaussianMLP
    reward: GaussianMLP

    def __init__(self, obs: int, action: int, z1: int, z2: int, layers: tuple[int, ...]):
        """Widths: observation, action, both latent variables, and the hidden layers of every network."""
        known = 1 + action  # whether it is the first timestep, and a_{t-1}
        self.posterior = GaussianMLP(obs + 1 + known + z2, layers, z1)
        self.prior = GaussianMLP(z2 + action, layers, z1)
        self.next_z2 = GaussianMLP(known + z1 + z2, layers, z2)
        self.decoder = GaussianMLP(z1 + z2, layers, obs, SIGMA_MIN)
        self.reward = GaussianMLP(2 * (z1 + z2) + action, layers, 1, SIGMA_MIN)

    def infer(
        self,
        x: Float[Array, "time batch x"],
        prev_action: Float[Array, "time batch action"],
        is_first: Bool[Array, "time batch"],
        noise: tuple[Float[Array, "time batch z1"], Float[Array, "time batch z2"]],
    ) -> Latents:
        """The latent variables of windows. They are reset where is_first is set; prev_action must be 0 there."""
        known = jnp.concatenate([is_first[..., None].astype(x.dtype), prev_action], axis=-1)
        z1, z2 = (part.shape[-1] for part in noise)
        w_x, w_z2 = self.posterior.columns(x.shape[-1] + known.shape[-1], z2)
        w_known, w_z1, w_next_z2 = self.next_z2.columns(known.shape[-1], z1, z2)
        (_, bias1), *later1 = self.posterior.weights()
        (_, bias2), *later2 = self.next_z2.weights()
        given = _linear((w_x, bias1), jnp.concatenate([x, known], axis=-1)), _linear((w_known, bias2), known)
        weights = LoopWeights(w_z2, w_z1, w_next_z2, tuple(later1), tuple(later2))
        return unroll(CELL, weights, jnp.zeros_like(noise[1][0]), given, is_first, noise)


def predict(
    model: LatentModel,
    x: Float[Array, "time x"],
    prev_action: Float[Array, "time action"],
    observed: Bool[Array, " time"],
    noise: tuple[Float[Array, "time z1"], Float[Array, "time z2"]],
) -> Gaussian:
    """p(x_t | z_{t-1}, a_{t-1}, z_t) along one episode from its first timestep on, leaves (time, x).

    Where x_t is `observed` (open loop), z¹_t is drawn from the posterior. Elsewhere (closed loop) it is drawn from the
    prior. The first timestep has no reward: its entries are NaN.
    """
    is_first = jnp.arange(len(observed)) == 0

    def step(before: tuple[Array, Array], inputs: tuple) -> tuple[tuple[Array, Array], Gaussian]:
        x, prev_action, is_first, observed, noise = inputs
        known = jnp.concatenate([is_first[None].astype(x.dtype), prev_action])
        q, p = model.posterior(x, known, before[1]), model.prior(before[1], prev_action)
        p = Gaussian(jnp.where(is_first, 0.0, p.mean), jnp.where(is_first, 1.0, p.sigma))
        of_z1 = jax.tree.map(lambda posterior, prior: jnp.where(observed, posterior, prior), q, p)
        z1 = of_z1.mean + of_z1.sigma * noise[0]
        of_z2 = model.next_z2(known, z1, before[1])
        z2 = of_z2.mean + of_z2.sigma * noise[1]
        reward = model.reward(*before, prev_action, z1, z2)
        reward = jax.tree.map(lambda leaf: jnp.where(is_first, jnp.nan, leaf), reward)
        both = jax.tree.map(lambda *parts: jnp.concatenate(parts), model.decoder(z1, z2), reward)
        return (z1, z2), both

    start, x = (jnp.zeros_like(noise[0][0]), jnp.zeros_like(noise[1][0])), jnp.where(observed[:, None], x, 0.0)
    return jax.lax.scan(step, start, (x, prev_action, is_first, observed, noise))[1]


class LoopWeights(NamedTuple):
    """The weights inside the loop, each (input, output); the later layers also have biases."""

    w_z2: Float[Array, "z2 hidden"]  # of the posterior's first layer
    w_z1: Float[Array, "z1 hidden"]  # of the first layer of z²'s network
    w_next_z2: Float[Array, "z2 hidden"]
    posterior: tuple[tuple[Float[Array, "input output"], Float[Array, " output"]], ...]
    next_z2: tuple[tuple[Float[Array, "input output"], Float[Array, " output"]], ...]


def _linear(layer: tuple[Array, Array], x: Float[Array, "*batch input"]) -> Float[Array, "*batch output"]:
    """A layer's output, from its weight (input, output) and its bias."""
    product = x @ layer[0]
    return product + jnp.broadcast_to(layer[1], product.shape)


def _layers(
    first: Float[Array, "*batch output"], later: Sequence[tuple[Array, Array]]
) -> tuple[Gaussian, tuple[Array, ...]]:
    """A Gaussian and the later layers' inputs, from the first layer's output and the later layers."""
    x, inputs = first, []
    for layer in later:
        inputs.append(jnp.tanh(x))
        x = _linear(layer, inputs[-1])
    mean, sigma = jnp.split(x, 2, axis=-1)
    return Gaussian(mean, jax.nn.softplus(sigma)), tuple(inputs)


def _layers_backward(later, inputs, sigma, grad):
    """The gradients of all layers' outputs, first to last, given that of the Gaussian; the weights are transposed."""
    softplus_slope = -jnp.expm1(-sigma)  # a sigmoid, of σ = softplus(x)
    grads = [jnp.concatenate([grad.mean, grad.sigma * softplus_slope], axis=-1)]
    for (weight, _), x in zip(reversed(later), reversed(inputs), strict=True):
        grads.insert(0, (grads[0] @ weight) * (1 - x**2))
    return tuple(grads)


def _forward(weights, before, given, noise):
    """One step: draws z¹ from its posterior, then z²."""
    q, inputs1 = _layers(given[0] + before @ weights.w_z2, weights.posterior)
    z1 = q.mean + q.sigma * noise[0]
    p, inputs2 = _layers(given[1] + z1 @ weights.w_z1 + before @ weights.w_next_z2, weights.next_z2)
    z2 = p.mean + p.sigma * noise[1]
    return z2, Latents(q, z1, before, z2), (inputs1, inputs2, p.sigma)


def _backward(weights, memory, grad_z2, grad_output):
    """The gradient of one step; the weights are transposed."""
    inputs1, inputs2, sigma_z2 = memory.saved
    grad_z2 = grad_z2 + grad_output.z2
    grads2 = _layers_backward(weights.next_z2, inputs2, sigma_z2, Gaussian(grad_z2, grad_z2 * memory.noise[1]))
    grad_z1 = grad_output.z1 + grads2[0] @ weights.w_z1
    q, grad_q = memory.output.posterior, grad_output.posterior
    grad_q = Gaussian(grad_q.mean + grad_z1, grad_q.sigma + grad_z1 * memory.noise[0])
    grads1 = _layers_backward(weights.posterior, inputs1, q.sigma, grad_q)
    grad_before = grad_output.before + grads1[0] @ weights.w_z2 + grads2[0] @ weights.w_next_z2
    return grad_before, (grads1, grads2)


def _factors(memory, grads):
    """The gradient of `given`; the factor of each weight in the loop; the gradient of each product."""
    (inputs1, inputs2, _), before = memory.saved, memory.output.before
    (first1, *later1), (first2, *later2) = grads
    inputs = LoopWeights(before, memory.output.z1, before, _twice(inputs1), _twice(inputs2))
    return (first1, first2), inputs, LoopWeights(first1, first2, first2, _twice(later1), _twice(later2))


def _twice(leaves: Sequence[Array]) -> tuple[tuple[Array, Array], ...]:
    """Each leaf twice: for the weight and for the bias of a layer."""
    return tuple((leaf, leaf) for leaf in leaves)


CELL = Cell(_forward, _backward, _factors)


class LatentElboTerms(NamedTuple):
    """The terms of the ELBO at every timestep, summed over dimensions."""

    kl: Float[Array, "time batch"]
    log_obs: Float[Array, "time batch"]
    log_reward: Float[Array, "time batch"]  # of r_{t-1}; 0 at an episode's first timestep


def elbo_terms(
    model: LatentModel,
    latents: Latents,
    obs: Float[Array, "time batch obs"],
    reward: Float[Array, "time batch"],
    prev_action: Float[Array, "time batch action"],
    is_first: Bool[Array, "time batch"],
) -> LatentElboTerms:
    """The terms of the ELBO of windows, given their inferred latent variables."""
    first = is_first[..., None]
    prior = model.prior(latents.before, prev_action)
    prior = Gaussian(jnp.where(first, 0.0, prior.mean), jnp.where(first, 1.0, prior.sigma))
    kl = jnp.sum(gaussian_kl(*latents.posterior, *prior), axis=-1)

    log_obs = jnp.sum(gaussian_log_prob(obs, *model.decoder(latents.z1, latents.z2)), axis=-1)
    moved = (latents.z1[:-1], latents.z2[:-1], prev_action[1:], latents.z1[1:], latents.z2[1:])
    log_reward = gaussian_log_prob(reward[1:, :, None], *model.reward(*moved))
    log_reward = jnp.where(first[1:], 0.0, log_reward)[..., 0]
    return LatentElboTerms(kl, log_obs, jnp.concatenate([jnp.zeros_like(log_reward[:1]), log_reward]))
