"""Values as classes: the distribution of a target, its mean, and what the cross-entropy learns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.models import two_hot


@pytest.mark.parametrize("classes", [2, 3, 101])
def test_the_numbers_are_symmetric_and_dense_near_zero(classes):
    z = np.asarray(two_hot.numbers(classes))
    np.testing.assert_allclose(z, -z[::-1], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(z[[0, -1]], [-20, 20], rtol=1e-5)
    gaps = np.diff(z)
    assert (gaps > 0).all()
    assert gaps[0] >= gaps[classes // 2 - 1]


@pytest.mark.parametrize("classes", [2, 3, 101])
def test_a_target_is_the_mean_of_its_distribution_over_two_neighbours(classes):
    z = np.asarray(two_hot.numbers(classes))
    y = np.array([-20.0, -3.2, 0.0, 1e-3, 0.7, 12.0, 20.0, z[0], z[1], z[-1]])
    p = np.asarray(two_hot.two_hot(jnp.array(y), classes))
    np.testing.assert_allclose(p.sum(-1), 1, rtol=1e-6)
    np.testing.assert_allclose(p @ z, y, atol=1e-5)
    assert (p >= 0).all()
    for row in p:
        (some,) = np.nonzero(row > 1e-6)
        assert some[-1] - some[0] <= 1


def test_targets_beyond_the_numbers_are_clipped():
    np.testing.assert_allclose(two_hot.two_hot(jnp.array([-50.0, 50.0]), 5), np.eye(5)[[0, -1]], atol=1e-6)


def test_the_value_and_the_loss_are_their_formulas():
    logits, y = jax.random.normal(jax.random.key(0), (4, 7)), jnp.array([-1.0, 0.2, 3.0, 30.0])
    p = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    np.testing.assert_allclose(two_hot.value(logits), p @ np.asarray(two_hot.numbers(7)), rtol=1e-5)
    expected = -(np.asarray(two_hot.two_hot(y, 7)) * np.log(p)).sum(-1)
    np.testing.assert_allclose(two_hot.cross_entropy(logits, y), expected, rtol=1e-5)


def test_the_loss_is_smallest_where_the_value_is_the_mean_of_the_targets():
    y = jnp.array([0.0, 0.0, 0.0, 8.0])  # a rare large return

    @jax.jit
    def learned(logits):
        def loss(logits):
            return jnp.mean(two_hot.cross_entropy(jnp.broadcast_to(logits, (4, 101)), y))

        return jax.lax.fori_loop(0, 3000, lambda _, logits: logits - jax.grad(loss)(logits), logits)

    np.testing.assert_allclose(two_hot.value(learned(jnp.zeros(101))), 2.0, rtol=1e-2)
