"""The hand-written gradient of every recurrence is that of plain differentiation of a plain loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.random_windows import random_like
from beliefrl.models import latent_model, nets, variational_model
from beliefrl.models.nets import LSTMState
from beliefrl.models.recurrence import unroll

TIME, BATCH, D, Z, HIDDEN = 5, 3, 8, 4, 6


def shapes(*lead, **sizes):
    return {name: jnp.zeros((*lead, *np.atleast_1d(size))) for name, size in sizes.items()}


def lstm():
    return nets.LSTM_CELL, jnp.zeros((D, 4 * D)), LSTMState(*jnp.zeros((2, BATCH, D))), jnp.zeros((TIME, BATCH, 4 * D))


def vrm():
    joint = 2 * HIDDEN + 4 * D
    weights = shapes(w_d=(D, joint), w_z=(Z, 4 * D), mean=(HIDDEN, Z), sigma=(HIDDEN, Z), mean_bias=Z, sigma_bias=Z)
    given = jnp.zeros((TIME, BATCH, joint))
    start = LSTMState(*jnp.zeros((2, BATCH, D)))
    return variational_model.CELL, variational_model.LoopWeights(**weights), start, given


def slac():
    """Two hidden layers in one network, one in the other."""
    first = shapes(w_z2=(D, HIDDEN), w_z1=(Z, HIDDEN), w_next_z2=(D, HIDDEN))
    layers = [(jnp.zeros(sizes), jnp.zeros(sizes[1])) for sizes in ((HIDDEN, 7), (7, 2 * Z), (HIDDEN, 2 * D))]
    later, given = (tuple(layers[:2]), tuple(layers[2:])), tuple(jnp.zeros((2, TIME, BATCH, HIDDEN)))
    weights = latent_model.LoopWeights(**first, posterior=later[0], next_z2=later[1])
    return latent_model.CELL, weights, jnp.zeros((BATCH, D)), given


def step_by_step(cell, weights, start, given, is_first, noise):
    state, outputs = start, []
    for t in range(TIME):
        before = jax.tree.map(lambda leaf, t=t: jnp.where(is_first[t][:, None], 0.0, leaf), state)
        inputs = jax.tree.map(lambda leaf, t=t: leaf[t], (given, noise))
        state, output, _ = cell.forward(weights, before, *inputs)
        outputs.append(output)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *outputs)


@pytest.fixture(params=[(lstm, ()), (vrm, Z), (slac, (Z, D))], ids=["lstm", "vrm", "slac"])
def case(request):
    """The cell, random numbers to differentiate in, and the others."""
    make, sizes = request.param
    cell, *zeros = make()
    is_first = jnp.zeros((TIME, BATCH), bool).at[2, 1].set(True).at[0, 2].set(True)
    noise = jax.tree.map(lambda size: jax.random.normal(jax.random.key(size), (TIME, BATCH, size)), sizes)
    numbers = jax.tree.map(lambda leaf: 0.3 * leaf, random_like(zeros, jax.random.key(0)))
    return cell, numbers, (is_first, noise)


def test_the_gradient_is_that_of_plain_differentiation(case):
    cell, numbers, others = case
    outputs, pullback = jax.vjp(lambda *args: unroll(cell, *args, *others), *numbers)
    expected, plain_pullback = jax.vjp(lambda *args: step_by_step(cell, *args, *others), *numbers)
    cotangent = random_like(outputs, jax.random.key(1))
    for ours, theirs in ((outputs, expected), (pullback(cotangent), plain_pullback(cotangent))):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), ours, theirs)


def test_the_gradients_of_several_losses_come_from_one_mapped_pullback(case):
    cell, numbers, others = case
    outputs, pullback = jax.vjp(lambda *args: unroll(cell, *args, *others), *numbers)
    cotangents = [random_like(outputs, jax.random.key(key)) for key in (1, 2)]
    together = jax.vmap(pullback)(jax.tree.map(lambda *leaves: jnp.stack(leaves), *cotangents))
    alone = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(pullback, cotangents))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), together, alone)
