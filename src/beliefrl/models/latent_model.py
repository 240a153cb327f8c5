"""SLAC's latent variable model: two latent variables a moment, z¹ inferred from the perception, z² a memory of it.

Source: Lee et al. 2019, Section 4; sizes and activations: Han, Doya, Tani 2020, Appendix A.2.3. With
x_t = (o_t, r_{t-1}) and z_t = [z¹_t, z²_t]:

    posterior  q(z¹_t) = N(μ, σ)[x_t, z²_{t-1}, a_{t-1}]
    prior      p(z¹_t) = N(μ, σ)[z²_{t-1}, a_{t-1}], and N(0, 1) at an episode's first moment
    both       p(z²_t) = N(μ, σ)[z¹_t, z²_{t-1}, a_{t-1}]
    decoders   p(o_t)  = N(μ, σ)[z_t],    p(r_{t-1}) = N(μ, σ)[z_{t-1}, a_{t-1}, z_t]
    ELBO               = Σ_t log p(o_t) + log p(r_{t-1}) - D_KL(q(z¹_t) ‖ p(z¹_t))

Speed decides the form: the products of the first layers with what does not come out of the loop are taken before it,
prior and decoders run after it, and the gradient of a weight inside the loop is one product after it
(`_loop_backward`).

Departures: perceptrons for convolutions, tanh, and a learned σ of the decoders, as Han et al. have it; μ and σ are two
outputs of one perceptron, as Lee et al. have it (Han et al. have a perceptron for each, at twice the cost); and at an
episode's first moment the same networks are used, with an input that marks it and zeros for z²_{t-1} and a_{t-1}, where
both papers have further networks.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from beliefrl.models.nets import MLP, Gaussian, gaussian_kl, gaussian_log_prob

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
        """The Gaussian for inputs given in parts, each (*batch, size)."""
        first = self.mlp.layers[0]
        return self.rest(_add(jnp.concatenate(inputs, axis=-1) @ first.weight.T, first.bias))[0]

    def rest(
        self, first: Float[Array, "*batch hidden"], zeros: Sequence[Array] | None = None
    ) -> tuple[Gaussian, tuple[Array, ...]]:
        """The Gaussian from what the first layer gave, and what each later layer was given.

        `zeros` are added to the later layers' outputs: their cotangents are those of the outputs.
        """
        x, inputs = first, []
        for index, layer in enumerate(self.mlp.layers[1:]):
            inputs.append(jnp.tanh(x))
            x = _add(inputs[-1] @ layer.weight.T, layer.bias)
            x = x if zeros is None else x + zeros[index]
        mean, sigma = jnp.split(x, 2, axis=-1)
        return Gaussian(mean, jax.nn.softplus(sigma) + self.least), tuple(inputs)

    def columns(self, *sizes: int) -> list[Float[Array, "_ hidden"]]:
        """The first layer's weights taken apart by the inputs' sizes, input by output."""
        return jnp.split(self.mlp.layers[0].weight.T, list(itertools.accumulate(sizes))[:-1])


def _add(x: Float[Array, "*batch size"], bias: Float[Array, " size"]) -> Float[Array, "*batch size"]:
    return x + jnp.broadcast_to(bias, x.shape)


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
        known = 1 + action  # whether it is the first moment, and a_{t-1}
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
        """The latent variables of windows; they begin anew wherever is_first, where prev_action must be 0."""
        known = jnp.concatenate([is_first[..., None].astype(x.dtype), prev_action], axis=-1)
        z1, z2 = (part.shape[-1] for part in noise)
        w_x, w_z2 = self.posterior.columns(x.shape[-1] + known.shape[-1], z2)
        w_known, w_z1, w_next_z2 = self.next_z2.columns(known.shape[-1], z1, z2)
        given1 = _add(jnp.concatenate([x, known], axis=-1) @ w_x, self.posterior.mlp.layers[0].bias)
        given2 = _add(known @ w_known, self.next_z2.mlp.layers[0].bias)
        weights = LatentLoopWeights(w_z2, w_z1, w_next_z2, self.posterior, self.next_z2)
        return _loop(weights, (given1, given2), is_first, noise)


def predict(
    model: LatentModel,
    x: Float[Array, "time x"],
    prev_action: Float[Array, "time action"],
    observed: Bool[Array, " time"],
    noise: tuple[Float[Array, "time z1"], Float[Array, "time z2"]],
) -> Gaussian:
    """p(x_t | z_{t-1}, a_{t-1}, z_t) along one episode from its first moment on, leaves (time, x).

    Where x_t is `observed`, z¹_t is drawn from the posterior: open loop. Where it is not, z¹_t is drawn from the prior:
    closed loop. The first moment comes with no reward: NaN stands there.
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


class LatentLoopWeights(NamedTuple):
    """The weights that stay inside the loop; of the two networks only what is behind their first layers."""

    w_z2: Float[Array, "z2 hidden"]
    w_z1: Float[Array, "z1 hidden"]
    w_next_z2: Float[Array, "z2 hidden"]
    posterior: GaussianMLP
    next_z2: GaussianMLP


def _cell(weights, before, given, zeros, is_first, noise):
    """One moment: the latent variables, and what each later layer of both networks was given."""
    before = jnp.where(is_first[:, None], 0.0, before)
    q, inputs1 = weights.posterior.rest(given[0] + before @ weights.w_z2, zeros[0])
    z1 = q.mean + q.sigma * noise[0]
    p, inputs2 = weights.next_z2.rest(given[1] + z1 @ weights.w_z1 + before @ weights.w_next_z2, zeros[1])
    z2 = p.mean + p.sigma * noise[1]
    return z2, (Latents(q, z1, before, z2), (inputs1, inputs2))


def _scan(weights, given, zeros, is_first, noise):
    def step(before, inputs):
        return _cell(weights, before, *inputs)

    return jax.lax.scan(step, jnp.zeros_like(noise[1][0]), (given, zeros, is_first, noise))[1]


def _zeros(weights, shape):
    """What is added to the outputs of the later layers."""
    networks = (weights.posterior, weights.next_z2)
    return tuple(
        tuple(jnp.zeros((*shape, layer.bias.shape[0])) for layer in network.mlp.layers[1:]) for network in networks
    )


@jax.custom_vjp
def _loop(weights, given, is_first, noise) -> Latents:
    return _scan(weights, given, _zeros(weights, is_first.shape), is_first, noise)[0]


def _loop_forward(weights, given, is_first, noise):
    zeros = _zeros(weights, is_first.shape)
    (latents, inputs), pullback = jax.vjp(
        lambda given, zeros: _scan(weights, given, zeros, is_first, noise), given, zeros
    )
    return latents, (weights, latents, inputs, pullback)


def _loop_backward(saved, cotangent):
    weights, latents, inputs, pullback = saved
    grad_given, grad_outputs = pullback((cotangent, jax.tree.map(jnp.zeros_like, inputs)))

    def product(left, right):
        return jnp.einsum("tbm,tbn->mn", left, right)

    def gradient(network, inputs, grad_outputs):
        first = network.mlp.layers[0]  # its gradient goes by the other entries
        grad_layers = [jnp.zeros_like(first.weight), jnp.zeros_like(first.bias)]
        for x, grad_output in zip(inputs, grad_outputs, strict=True):
            grad_layers += [product(grad_output, x), jnp.sum(grad_output, (0, 1))]
        return eqx.tree_at(lambda network: jax.tree.leaves(network.mlp.layers), network, grad_layers)

    grad_weights = LatentLoopWeights(
        product(latents.before, grad_given[0]),
        product(latents.z1, grad_given[1]),
        product(latents.before, grad_given[1]),
        gradient(weights.posterior, inputs[0], grad_outputs[0]),
        gradient(weights.next_z2, inputs[1], grad_outputs[1]),
    )
    return grad_weights, grad_given, None, None


_loop.defvjp(_loop_forward, _loop_backward)


class LatentElboTerms(NamedTuple):
    """The terms of the ELBO at every moment, summed over dimensions."""

    kl: Float[Array, "time batch"]
    log_obs: Float[Array, "time batch"]
    log_reward: Float[Array, "time batch"]  # of the reward before the moment; 0 where there was none


def elbo_terms(
    model: LatentModel,
    latents: Latents,
    obs: Float[Array, "time batch obs"],
    reward: Float[Array, "time batch"],
    prev_action: Float[Array, "time batch action"],
    is_first: Bool[Array, "time batch"],
) -> LatentElboTerms:
    """The terms of the ELBO of windows whose latent variables were inferred."""
    first = is_first[..., None]
    prior = model.prior(latents.before, prev_action)
    prior = Gaussian(jnp.where(first, 0.0, prior.mean), jnp.where(first, 1.0, prior.sigma))
    kl = jnp.sum(gaussian_kl(*latents.posterior, *prior), axis=-1)

    log_obs = jnp.sum(gaussian_log_prob(obs, *model.decoder(latents.z1, latents.z2)), axis=-1)
    moved = (latents.z1[:-1], latents.z2[:-1], prev_action[1:], latents.z1[1:], latents.z2[1:])
    log_reward = gaussian_log_prob(reward[1:, :, None], *model.reward(*moved))
    log_reward = jnp.where(first[1:], 0.0, log_reward)[..., 0]
    return LatentElboTerms(kl, log_obs, jnp.concatenate([jnp.zeros_like(log_reward[:1]), log_reward]))
