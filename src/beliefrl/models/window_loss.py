"""The loss of a variational recurrent model on windows of the replay, and its states along them.

Source: Section 4.1, Appendix A.1.2. The loss is the negative ELBO, or in a deterministic model (Appendix C) the squared
error of the predicted x. It is a mean over the timesteps after the burn-in, which only computes the state before them.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from beliefrl.models.nets import LSTMState
from beliefrl.models.optimisation import valid_mean
from beliefrl.models.variational_model import VRM, elbo_terms, prediction_error
from beliefrl.types import Window, perception


def draw_noise(key: Key[Array, ""], windows: Window, z_size: int) -> Float[Array, "time batch z"]:
    """The noise of z at every timestep of windows (time-major)."""
    return jax.random.normal(key, (*windows.exists.shape, z_size))


def states(vrm: VRM, windows: Window, noise: Float[Array, "time batch z"], known: LSTMState | None = None) -> LSTMState:
    """A model's states along windows (time-major), leaves (time, batch, d).

    `known` are the states of the first timestep, leaves (batch, d); None: the windows start from the empty state.
    """
    step = windows.step
    inputs = perception(step), step.prev_action, step.is_first, noise
    if known is None:
        return vrm.infer(vrm.start(windows.exists.shape[1]), *inputs).state
    later = vrm.infer(known, *(leaf[1:] for leaf in inputs)).state
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), known, later)


def model_loss(
    vrm: VRM,
    windows: Window,
    key: Key[Array, ""],
    burn_in: int,
    known: LSTMState | None = None,
    scaling: Literal["mean", "sum"] = "mean",
    decode_from: Literal["posterior", "prior"] = "posterior",
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The loss, mean over the valid timesteps after the burn-in, and its terms.

    Args:
        vrm: the model.
        windows: time-major; their last timestep is not used.
        key: the randomness of z.
        burn_in: timesteps before those that count. No gradient goes through them.
        known: as in `states`. It needs a burn-in.
        scaling: as in `elbo_terms`.
        decode_from: the distribution of the z from which x is decoded.
    """
    key_burn_in, key_infer, key_prior = jax.random.split(key, 3)
    before, after = windows.between(0, burn_in), windows.between(burn_in, -1)
    z_size = vrm.joint.w_z.shape[0]
    start = vrm.start(windows.exists.shape[1])
    if burn_in:
        burnt_in = states(jax.lax.stop_gradient(vrm), before, draw_noise(key_burn_in, before, z_size), known)
        start = jax.tree.map(lambda leaf: leaf[-1], burnt_in)
    inputs = (perception(after.step), after.step.prev_action)
    inferred = vrm.infer(start, *inputs, after.step.is_first, draw_noise(key_infer, after, z_size))

    def mean(term: Float[Array, "time batch"]) -> Float[Array, ""]:
        return valid_mean(term, after.exists)

    if vrm.deterministic:
        error = mean(prediction_error(vrm, inferred, inputs[0]))
        return error, {"prediction_error": error}
    prior_noise = draw_noise(key_prior, after, z_size) if decode_from == "prior" else None
    kl, log_likelihood = map(mean, elbo_terms(vrm, inferred, *inputs, scaling, prior_noise))
    return kl - log_likelihood, {"kl": kl, "log_likelihood": log_likelihood, "negative_elbo": kl - log_likelihood}
