"""A recurrent model that learns only to predict: its memories, its loss, and its burn-in."""

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl.models.predictive_model import init_model, prediction_loss

OBS, ACTION, D = 3, 2, 8
SIZES = OBS, ACTION, D, 6


def model(long_memories=0.25, longest=50):
    return jax.jit(lambda key: init_model(key, *SIZES, long_memories, longest))(jax.random.key(0))


def test_a_fraction_of_the_cells_begins_with_a_long_memory():
    usual, some = (np.asarray(model(fraction).lstm.bias).reshape(4, D) for fraction in (0.0, 0.5))
    assert (np.abs(usual) <= D**-0.5).all()
    assert (some[1, : D // 2] > 0).all()
    assert (some[1, : D // 2] <= np.log(50)).all()
    np.testing.assert_array_equal(some[1, D // 2 :], usual[1, D // 2 :])
    np.testing.assert_array_equal(some[[0, 2, 3]], usual[[0, 2, 3]])  # the other gates begin as ever


def test_the_loss_is_the_mean_squared_error_of_valid_predictions():
    made, keys = model(), jax.random.split(jax.random.key(1), 3)
    d = jax.random.normal(keys[0], (5, 2, D))
    action, target = jax.random.normal(keys[1], (4, 2, ACTION)), jax.random.normal(keys[2], (4, 2, OBS + 1))
    valid = jnp.ones((4, 2), bool).at[1, 0].set(False)
    loss = jax.jit(prediction_loss)(made, d, action, target, valid)
    errors = [
        np.mean((np.asarray(made.predict(d[t, b], action[t, b])) - np.asarray(target[t, b])) ** 2)
        for t in range(4)
        for b in range(2)
        if valid[t, b]
    ]
    np.testing.assert_allclose(loss, np.mean(errors), rtol=1e-5)
