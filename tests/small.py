"""Small agents through the phases of a training, as both loops run them."""

import jax
import jax.numpy as jnp
import numpy as np

SHARED = {"step_start_rl": 20, "policy_layers": (8,), "value_layers": (8,)}
MODELS = {"train_times_fivrm": 10, "d_size": 8, "z_size": 4, "hidden_size": 8}
SEQUENCES = {"seq_len": 8, "burn_in": 4, "batch_size": 2}


def trained(program, keys, cuts=(10, 10), learn=(10, 15), cycle=5):
    """Explore, pre-train, refresh and learn, in stretches of these lengths."""
    seeds, step, log = program.begin(keys), 0, []
    for steps in cuts:
        seeds, stretch = program.explore(seeds, step, steps)
        step += steps
    seeds, _ = program.pretrain(seeds, 0, 10)
    seeds = program.refresh(seeds)
    for steps in learn:
        seeds, stretch = program.learn(seeds, step, steps // cycle)
        log.append(jax.tree.map(np.asarray, stretch))
        step += steps
    return seeds, log


def leaves(tree):
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(tree)
    ]
