"""Our CartPole has Gymnasium's physics, with a force of 30 N times the action."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from beliefrl.tasks import make
from beliefrl.tasks.cartpole import CartPoleState

KEY = jax.random.key(0)
OTHER = {"gravity": 3.7, "cart_mass": 2.0, "pole_mass": 0.4, "half_length": 0.8}
OTHER |= {"force": 20.0, "dt": 0.01, "max_x": 1.0, "max_theta": 0.1}
STATES = np.random.default_rng(0).uniform(-1, 1, (500, 4)) * [3.0, 4.0, 0.3, 4.0]
ACTIONS = np.random.default_rng(1).uniform(-1.3, 1.3, 500)


def step(task, states, actions):
    """One step from each state: states (n, 4) and actions (n,) give observations, rewards and ends."""
    states = CartPoleState(*jnp.asarray(states, jnp.float32).T)
    actions = jnp.asarray(actions, jnp.float32)[:, None]
    return jax.jit(jax.vmap(task.step, (0, 0, None)))(states, actions, KEY)[1:]


def gymnasium_like(task):
    env = gymnasium.make("CartPole-v1").unwrapped
    env.gravity, env.masscart, env.masspole, env.length = task.gravity, task.cart_mass, task.pole_mass, task.half_length
    env.total_mass, env.polemass_length = task.cart_mass + task.pole_mass, task.pole_mass * task.half_length
    env.force_mag, env.tau = task.force, task.dt
    env.x_threshold, env.theta_threshold_radians = task.max_x, task.max_theta
    return env


@pytest.mark.parametrize("constants", [{}, OTHER], ids=["default", "other constants"])
def test_full_force_is_gymnasiums_step(constants):
    task = make("cartpole", **constants)
    env, signs = gymnasium_like(task), np.sign(ACTIONS)
    obs, rewards, ends = step(task, STATES, signs)
    assert 0 < ends.sum() < len(STATES)
    expected = []
    for state, sign in zip(STATES, signs, strict=True):
        env.state, env.steps_beyond_terminated = state, None
        expected.append(env.step(int(sign > 0))[:3])
    expected_obs, expected_rewards, expected_ends = zip(*expected, strict=True)
    np.testing.assert_allclose(obs, expected_obs, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(rewards, expected_rewards)
    np.testing.assert_array_equal(ends, expected_ends)


def test_whole_episodes_are_gymnasiums():
    task = make("cartpole")
    env, rng, one_step = gymnasium_like(task), np.random.default_rng(2), jax.jit(task.step)
    for key in jax.random.split(KEY, 20):
        state, start = task.reset(key)
        env.state, env.steps_beyond_terminated, end = np.float64(start), None, False
        while not end:
            sign = rng.choice([-1.0, 1.0])
            state, obs, reward, end = one_step(state, jnp.array([sign]), key)
            expected_obs, expected_reward, expected_end, *_ = env.step(int(sign > 0))
            np.testing.assert_allclose(obs, expected_obs, rtol=1e-4, atol=1e-4)
            assert (reward, end) == (expected_reward, expected_end)


def test_fractional_force_obeys_the_equations_of_motion():
    """Newton's for the cart, Euler's for a rod on a hinge, solved as a linear system for the two accelerations."""
    m, total, half, g = 0.1, 1.1, 0.5, 9.8
    expected = []
    for (x, v, theta, omega), action in zip(STATES, ACTIONS, strict=True):
        coupling = m * half * np.cos(theta)
        masses = [[total, coupling], [coupling, 4 / 3 * m * half**2]]
        forces = [30 * np.clip(action, -1, 1) + m * half * omega**2 * np.sin(theta), m * g * half * np.sin(theta)]
        x_acc, theta_acc = np.linalg.solve(masses, forces)
        expected.append([x + 0.02 * v, v + 0.02 * x_acc, theta + 0.02 * omega, omega + 0.02 * theta_acc])
    np.testing.assert_allclose(step(make("cartpole"), STATES, ACTIONS)[0], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(("entry", "inside", "outside"), [(0, 2.399, 2.401), (2, np.radians(11.99), np.radians(12.01))])
def test_it_fails_just_beyond_its_bounds_and_is_paid_for_that_step_too(entry, inside, outside, sign):
    states = np.zeros((2, 4))
    states[:, entry] = sign * inside, sign * outside
    _, rewards, ends = step(make("cartpole"), states, np.zeros(2))
    assert ends.tolist() == [False, True]
    assert rewards.tolist() == [1.0, 1.0]


def test_it_starts_near_upright_and_never_succeeds():
    task = make("cartpole")
    state, obs = jax.vmap(task.reset)(jax.random.split(KEY, 2000))
    for entry, value in enumerate(state):
        assert kstest(value, "uniform", args=(-0.05, 0.1)).pvalue > 0.01
        np.testing.assert_array_equal(obs[:, entry], value)
    assert not np.any(jax.vmap(task.success)(state))
