import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.models import latent_model, nets, variational_model
from beliefrl.models.nets import (
    MLP,
    LSTMState,
    draw,
    gaussian_kl,
    gaussian_log_prob,
    lstm_step,
    lstm_step_backward,
    tanh_gaussian,
)
from beliefrl.models.recurrence import unroll
from beliefrl.models.scales import RunningStatistics, initial_statistics, standardise, update_statistics
from inputs import random_like


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def test_lstm_step_is_the_textbook_cell():
    gates, c = jax.random.normal(jax.random.key(0), (5, 12)) * 3, jax.random.normal(jax.random.key(1), (5, 3))
    i, f, g, o = np.split(np.array(gates, np.float64), 4, axis=-1)
    c_next = sigmoid(f) * np.array(c) + sigmoid(i) * np.tanh(g)
    ours, _ = lstm_step(gates, c)
    np.testing.assert_allclose(ours.c, c_next, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(ours.d, sigmoid(o) * np.tanh(c_next), rtol=1e-5, atol=1e-6)


def test_lstm_step_has_the_gradient_of_the_textbook_cell():
    def textbook(gates, c):
        i, f, g, o = jnp.split(gates, 4, axis=-1)
        c = jax.nn.sigmoid(f) * c + jax.nn.sigmoid(i) * jnp.tanh(g)
        return LSTMState(jax.nn.sigmoid(o) * jnp.tanh(c), c)

    gates, c = jax.random.normal(jax.random.key(0), (2, 12)), jax.random.normal(jax.random.key(1), (2, 3))
    grad = LSTMState(*jax.random.normal(jax.random.key(2), (2, 2, 3)))
    ours = lstm_step_backward(lstm_step(gates, c)[1], grad)
    theirs = jax.vjp(textbook, gates, c)[1](grad)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), ours, theirs)


def test_kl_is_the_mean_log_ratio_of_samples():
    p, q = (0.3, 0.7), (-0.4, 1.1)
    x = q[0] + q[1] * jax.random.normal(jax.random.key(0), (400_000,))
    ratio = gaussian_log_prob(x, *(jnp.full_like(x, v) for v in q)) - gaussian_log_prob(
        x, *(jnp.full_like(x, v) for v in p)
    )
    kl = jax.jit(gaussian_kl)
    assert float(kl(*(jnp.array(v) for v in (*q, *p)))) == pytest.approx(float(ratio.mean()), abs=0.01)
    assert float(kl(*(jnp.array(v) for v in (*q, *q)))) == pytest.approx(0, abs=1e-6)


def test_density_of_squashed_actions_integrates_to_one():
    mean, log_sigma = jnp.array([0.4]), jnp.array([-0.5])
    noise = jnp.linspace(-6, 6, 20_001)[:, None]
    action, log_prob = jax.jit(jax.vmap(lambda n: tanh_gaussian(mean, log_sigma, n)))(noise)
    assert float(np.trapezoid(np.exp(log_prob), action[:, 0])) == pytest.approx(1, abs=1e-3)


def test_log_prob_stays_finite_where_tanh_saturates():
    action, log_prob = tanh_gaussian(jnp.array([40.0, -40.0]), jnp.array([2.0, 2.0]), jnp.array([3.0, -3.0]))
    np.testing.assert_array_equal(action, [1.0, -1.0])
    assert np.isfinite(log_prob)


def test_layers_start_in_pytorchs_bounds():
    mlp = draw(jax.random.key(0), MLP((50, 400, 3), jnp.tanh))
    for layer, fan_in in zip(mlp.layers, (50, 400), strict=True):
        for leaf in (layer.weight, layer.bias):
            assert float(jnp.abs(leaf).max()) <= fan_in**-0.5
        assert float(jnp.std(layer.weight)) == pytest.approx(fan_in**-0.5 / 3**0.5, rel=0.05)


def test_joint_layers_start_in_the_bounds_of_their_parts():
    joint = jax.jit(lambda key: draw(key, variational_model.Joint(2, 100, 50, 40)))(jax.random.key(0))
    parts = {100 + 2 + 40: (joint.w_d[:, :80], joint.w_features[:, :80], joint.w_action, joint.bias[:80])}
    parts |= {100: (joint.w_d[:, 80:], joint.w_features[:, 80:], joint.w_z, joint.bias[80:])}
    for fan_in, leaves in parts.items():
        for leaf in leaves:
            assert float(jnp.abs(leaf).max()) <= fan_in**-0.5
            assert float(jnp.std(leaf)) == pytest.approx(fan_in**-0.5 / 3**0.5, rel=0.1)


def test_layer_norm_removes_the_mean_and_the_scale_of_a_layer():
    one = draw(jax.random.key(1), MLP((3, 8, 2), jnp.tanh, normalise=True))
    x = np.asarray(one.layers[0](jnp.arange(3.0)))
    wanted = one.layers[1](jnp.tanh((x - x.mean()) / np.sqrt(x.var() + 1e-5)))
    np.testing.assert_allclose(one(jnp.arange(3.0)), wanted, rtol=1e-5)
    mlp, given = draw(jax.random.key(0), MLP((3, 8, 8, 2), jnp.tanh, normalise=True)), jnp.array([9.0, -4.0, 2.0])
    for layer, factor in ((0, 1), (1, 1), (2, 2)):  # the last layer is not normalised
        doubled = eqx.tree_at(lambda mlp, n=layer: mlp.layers[n], mlp, replace_fn=double)
        np.testing.assert_allclose(doubled(given), factor * mlp(given), rtol=1e-3)


def double(tree):
    return jax.tree.map(lambda leaf: 2 * leaf, tree)


def test_a_scale_has_the_moments_of_all_valid_vectors_and_makes_them_standard():
    x = 3.0 + jax.random.normal(jax.random.key(0), (4, 6, 5, 2)) * jnp.array([0.01, 2.0])[None, None, None]
    valid = jnp.ones((6, 5), bool).at[2, 1:].set(False)
    known, blind, update = initial_statistics(2), initial_statistics(2), jax.jit(update_statistics)
    for batch in x:
        known = update(known, batch, valid)
        blind = update(blind, jnp.where(valid[..., None], batch, 1e6), valid)
    seen = np.asarray(x)[:, np.asarray(valid)].reshape(-1, 2)
    np.testing.assert_allclose(known.mean, seen.mean(0), rtol=1e-5)
    np.testing.assert_allclose(jnp.sqrt(known.variance), seen.std(0), rtol=0.05)  # batches have means of their own
    jax.tree.map(np.testing.assert_array_equal, known, blind)
    made = np.asarray(standardise(known, jnp.asarray(seen)))
    np.testing.assert_allclose(made.mean(0), 0, atol=1e-4)
    np.testing.assert_allclose(made.std(0), [0.91, 1.0], rtol=0.05)  # 0.01 / (0.01 + 0.001): the quiet stay quieter


def test_a_scale_does_not_change_without_valid_vectors():
    for old in (initial_statistics(2), RunningStatistics(jnp.full(2, 3.0), jnp.full(2, 4.0), jnp.array(7.0))):
        new = jax.jit(update_statistics)(old, jnp.full((5, 2), 9.0), jnp.zeros(5, bool))
        jax.tree.map(np.testing.assert_array_equal, new, old)


def test_a_scale_forgets_and_its_entries_are_bounded():
    old = RunningStatistics(jnp.zeros(1), jnp.ones(1), jnp.array(1e6))
    after = jax.lax.fori_loop(
        0, 5000, lambda _, scale: update_statistics(scale, jnp.full((3, 1), 7.0), jnp.ones(3, bool)), old
    )
    np.testing.assert_allclose(after.mean, 7.0, rtol=0.01)  # e^-5 of the old mean is left
    np.testing.assert_array_equal(standardise(old, jnp.array([-1e9])), [-10.0])
    assert float(standardise(None, jnp.array([1e9]))[0]) == 1e9


# The hand-written gradient of every recurrence is that of plain differentiation of a plain loop.

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
