"""Values as classes: a network gives a distribution over fixed numbers, and learns it by cross-entropy.

The logits l_1 ... l_n define p = softmax(l) over the numbers z_1 < ... < z_n. The value is Σ_i p_i z_i. A target y
becomes a distribution q with the mean y. Only the two z_i beside y have a probability above zero ("two-hot"). The loss
is the cross-entropy -Σ_i q_i log p_i. Its gradient is bounded, so a rare, large error does not move the network far.

Source: Bellemare et al. 2017 (fixed numbers), Schrittwieser et al. 2020 (two-hot), Hafner et al. 2023 (z as here), and
Farebrother et al. 2024 (why critics learn well with it). The z_i are dense near 0 and go to ±20:

    z_i = sign(x_i) (exp |x_i| - 1),  x_i evenly spaced in ±log 21
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LIMIT = 20.0  # the largest z; targets beyond it are clipped


def numbers(classes: int) -> Float[Array, " classes"]:
    """z, for two classes or more."""
    x = jnp.linspace(-jnp.log1p(LIMIT), jnp.log1p(LIMIT), classes)
    return jnp.sign(x) * jnp.expm1(jnp.abs(x))


def value(logits: Float[Array, "*batch classes"]) -> Float[Array, "*batch"]:
    """Σ_i p_i z_i."""
    return jax.nn.softmax(logits) @ numbers(logits.shape[-1])


def two_hot(y: Float[Array, " batch"], classes: int) -> Float[Array, "batch classes"]:
    """q for each y; y is clipped to ±20."""
    z = numbers(classes)
    y = jnp.clip(y, z[0], z[-1])
    high = jnp.clip(jnp.searchsorted(z, y), 1, classes - 1)
    share = ((y - z[high - 1]) / (z[high] - z[high - 1]))[:, None]
    return (1 - share) * jax.nn.one_hot(high - 1, classes) + share * jax.nn.one_hot(high, classes)


def cross_entropy(logits: Float[Array, "batch classes"], y: Float[Array, " batch"]) -> Float[Array, " batch"]:
    """-Σ_i q_i log p_i."""
    return -jnp.sum(two_hot(y, logits.shape[-1]) * jax.nn.log_softmax(logits), axis=-1)
