"""Soft actor-critic without V: its equations against numpy, and the unit of returns."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from beliefrl.models import double_q
from beliefrl.models.double_q import Unit, init_optimisers
from beliefrl.models.soft_actor_critic import Batch, Optimisers

BELIEF, ACTION, COUNT = 5, 2, 12
KEY = jax.random.key(0)


def make(key=KEY):
    controller = jax.jit(lambda key: double_q.init_controller(key, BELIEF, ACTION, (8, 8), (8, 8), 0.1))(key)
    return controller._replace(unit=Unit(jnp.array(9.0), jnp.array(4.0)))


def batch(key=KEY):
    keys = jax.random.split(key, 6)
    return Batch(
        belief=jax.random.normal(keys[0], (COUNT, BELIEF)),
        next_belief=jax.random.normal(keys[1], (COUNT, BELIEF)),
        action=jnp.tanh(jax.random.normal(keys[2], (COUNT, ACTION))),
        reward=10 * jax.random.normal(keys[3], (COUNT,)),
        terminated=jnp.arange(COUNT) % 3 == 0,
        discount=jax.random.uniform(keys[4], (COUNT,)),
        valid=jnp.arange(COUNT) % 4 != 1,
    )


def dense(network, x):
    """A perceptron with relu, in numpy."""
    for index, layer in enumerate(network.layers):
        x = (np.maximum(x, 0) if index else x) @ np.asarray(layer.weight).T + np.asarray(layer.bias)
    return x


def q(critic, belief, action):
    return dense(critic, np.concatenate([belief, action], axis=-1))[:, 0]


def policy(actor, belief, noise):
    """ã and log π(ã|s) by the textbook's formula."""
    mean, log_sigma = np.split(dense(actor.network, np.asarray(belief)), 2, axis=-1)
    u = mean + np.exp(log_sigma) * noise
    normal = -0.5 * (noise**2 + np.log(2 * np.pi)) - log_sigma
    return np.tanh(u), np.sum(normal - np.log(1 - np.tanh(u) ** 2 + 1e-6), axis=-1), mean


def test_targets_are_bootstrapped_from_the_lesser_target_and_hold_no_entropy():
    controller, data, key = make(), batch(), jax.random.key(3)
    y = jax.jit(double_q.target)(controller, data, key)
    action, _, _ = policy(controller.actor, data.next_belief, np.asarray(jax.random.normal(key, (COUNT, ACTION))))
    after = np.minimum(*(q(critic, data.next_belief, action) for critic in controller.targets))
    expected = data.reward + data.discount * np.where(data.terminated, 0, float(controller.unit.u) * after)
    np.testing.assert_allclose(y, expected, rtol=1e-4, atol=1e-4)


def test_the_losses_are_their_formulas_over_valid_transitions():
    controller, data, key = make(), batch(), jax.random.key(3)
    valid, u = np.asarray(data.valid), float(controller.unit.u)
    y = 10 * jax.random.normal(key, (COUNT,))
    errors = [q(critic, data.belief, data.action) - np.asarray(y) / u for critic in controller.critics]
    expected = np.mean(sum(0.5 * error[valid] ** 2 for error in errors))
    np.testing.assert_allclose(double_q.q_loss(controller.critics, data, y, controller.unit.u), expected, rtol=1e-4)

    j_pi, (least, log_prob) = jax.jit(double_q.actor_loss, static_argnums=4)(
        controller.actor, controller, data, key, 0.2
    )
    action, density, mean = policy(controller.actor, data.belief, np.asarray(jax.random.normal(key, (COUNT, ACTION))))
    values = np.minimum(*(q(critic, data.belief, action) for critic in controller.critics))
    np.testing.assert_allclose(least, values, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(log_prob, density, rtol=1e-4, atol=1e-4)
    expected = 0.1 * density - values + 0.5 * 0.2 * np.mean(mean**2, axis=-1)
    np.testing.assert_allclose(j_pi, np.mean(expected[valid]), rtol=1e-4)


def test_a_new_unit_leaves_every_q_as_it_is():
    controller, data = make(), batch()
    after = jax.jit(double_q.rescale)(controller, 100 * data.reward, data.valid)
    assert after.unit.u > 2 * controller.unit.u
    for old, new in zip((*controller.critics, *controller.targets), (*after.critics, *after.targets), strict=True):
        before, now = (q(critic, data.belief, data.action) for critic in (old, new))
        np.testing.assert_allclose(float(after.unit.u) * now, float(controller.unit.u) * before, rtol=1e-4, atol=1e-4)


def test_the_unit_is_the_root_mean_square_of_targets():
    controller, valid = make()._replace(unit=Unit(jnp.ones(()), jnp.zeros(()))), jnp.array([True, True, True, False])
    for y in ([1.0, 2.0, 2.0, 99.0], [3.0, 0.0, 0.0, 99.0]):
        controller = jax.jit(double_q.rescale)(controller, jnp.array(y), valid)
    np.testing.assert_allclose(controller.unit.u, np.sqrt(3.0), rtol=1e-3)  # of 1, 4, 4, 9, 0 and 0


@pytest.mark.nightly
@pytest.mark.parametrize("size", [0.01, 1000.0])
def test_what_is_learned_does_not_depend_on_the_size_of_rewards(size):
    """Rewards of any size give the same actor, once u is known."""
    optimisers, data = Optimisers(*(optax.adam(1e-2) for _ in range(3))), batch()

    @jax.jit
    def learn(controller, data):
        state = init_optimisers(optimisers, controller)
        for number in range(5):
            key = jax.random.key(number)
            controller, state, _ = double_q.update(optimisers, state, controller, data, key, 0.1, 1e-3)
        return controller

    plain = make()._replace(unit=Unit(jnp.array(25.0), jnp.array(1e6)))
    scaled = plain._replace(unit=Unit(jnp.array(25.0) * size**2, jnp.array(1e6)))
    actors = learn(plain, data).actor, learn(scaled, data._replace(reward=size * data.reward)).actor
    for a, b in zip(*map(jax.tree.leaves, actors), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)


def test_an_update_moves_the_targets_by_tau_and_ignores_what_is_not_valid():
    optimisers, controller, data = Optimisers(*(optax.adam(1e-2) for _ in range(3))), make(), batch()
    other = jax.tree.map(
        lambda a, b: jnp.where(data.valid.reshape(-1, *[1] * (a.ndim - 1)), a, b), data, batch(jax.random.key(7))
    )
    other = other._replace(valid=data.valid)

    @jax.jit
    def update(data):
        return double_q.update(optimisers, init_optimisers(optimisers, controller), controller, data, KEY, 0.25, 1e-3)[
            0
        ]

    after, same = update(data), update(other)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    ratio = controller.unit.u / after.unit.u
    old, new, target = (c[0].layers[-1].weight for c in (controller.targets, after.critics, after.targets))
    np.testing.assert_allclose(target, ratio * old + 0.25 * (new - ratio * old), rtol=1e-4, atol=1e-6)
