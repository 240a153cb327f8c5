"""The random keys of a training: from a seed's key, a purpose, and the number of a step or of an update.

So no result depends on how the steps are divided into blocks, except with the option `overlap`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

ACT, UPDATE, SAMPLE, CYCLE, PRETRAIN, REFRESH, EVALUATE, REVIVE = range(8)  # purposes of keys: no two share one


def step_key(key: Key[Array, ""], step: Int[Array, ""], purpose: int) -> Key[Array, ""]:
    return jax.random.fold_in(jax.random.fold_in(key, purpose), step)


def acting_keys(key: Key[Array, ""], step: Int[Array, ""], envs: int) -> Key[Array, "*env"]:
    """The key of each environment for its step; the environments' steps have the numbers from `step` on."""
    if envs == 1:
        return step_key(key, step, ACT)
    return jax.vmap(lambda env: step_key(key, step + env, ACT))(jnp.arange(envs))
