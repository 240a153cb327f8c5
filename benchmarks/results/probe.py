"""What `knows.py` and `remembers.py` share: VRM's beliefs along an episode, and a linear map that is fitted to them."""

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl.types import perception


def perceiver(agent, task, trained):
    """A function that gives what both models make of an episode, (time, belief), with samples of z or means."""

    def perceive(memory, moment):
        step, key, sampled = moment
        _, memory = agent.act(trained, memory, step, key, sampled)
        return memory, jnp.concatenate([perception(step), memory.first.d, memory.keep.d])

    @jax.jit
    def beliefs(steps, sampled):
        time = len(steps.reward)
        moments = steps, jax.random.split(jax.random.key(0), time), jnp.full(time, sampled)
        return jax.lax.scan(perceive, agent.reset(task.spec), moments)[1]

    def padded(steps, sampled):  # all episodes of one length: one compilation
        missing = task.spec.max_steps + 1 - len(steps.reward)
        longer = jax.tree.map(lambda leaf: np.pad(leaf, [(0, missing)] + [(0, 0)] * (leaf.ndim - 1)), steps)
        return np.asarray(beliefs(longer, sampled), float)[: len(steps.reward)]

    return padded


def fit(inputs, targets, penalty, weight=1.0):
    """The linear map from inputs (time, size), standardised, to targets (time, size): ridge regression."""
    mean, deviation = inputs.mean(0), inputs.std(0) + 1e-6

    def columns(inputs):
        return np.c_[(inputs - mean) / deviation, np.ones(len(inputs))]

    of_fit = columns(inputs)
    gram = of_fit.T @ (weight * of_fit) + penalty * np.eye(of_fit.shape[1])
    weights = np.linalg.solve(gram, of_fit.T @ (weight * targets))
    return lambda others: columns(others) @ weights
