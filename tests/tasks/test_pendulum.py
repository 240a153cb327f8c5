"""Our pendulum is Gymnasium's Pendulum-v1."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from beliefrl.tasks import make

KEYS = jax.random.split(jax.random.key(0), 8)
EARTH_AND_HEAVY = {"gravity": 9.81, "mass": 1.3, "length": 0.7, "max_torque": 3.0, "max_speed": 6.0, "dt": 0.04}


@functools.cache
def episodes(task, policy):
    """States before each step, actions, and what the step gave; every array (episode, time, ...)."""

    def one(key):
        def timestep(state, key):
            action = policy(state, key)
            after, obs, reward, terminated = task.step(state, action, key)
            return after, (jnp.stack(state), action, obs, reward, terminated)

        return jax.lax.scan(timestep, task.reset(key)[0], jax.random.split(key, 200))[1]

    return [np.asarray(x) for x in jax.jit(jax.vmap(one))(KEYS)]


def random_action(state, key):
    return jax.random.uniform(key, (1,), minval=-1.2, maxval=1.2)


def spin_up(state, key):
    return jnp.sign(state.theta_dot)[None]


@pytest.mark.parametrize("constants", [{}, EARTH_AND_HEAVY], ids=["default", "other constants"])
@pytest.mark.parametrize("policy", [random_action, spin_up])
def test_every_step_is_gymnasiums(policy, constants):
    task = make("pendulum", **constants)
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.g, env.m, env.l = task.gravity, task.mass, task.length
    env.max_torque, env.max_speed, env.dt = task.max_torque, task.max_speed, task.dt
    states, actions, obs, rewards, _ = (np.concatenate(x) for x in episodes(task, policy))
    expected_obs, expected_rewards = [], []
    for state, action in zip(np.float64(states), actions, strict=True):
        env.state = state
        o, r, *_ = env.step(task.max_torque * np.clip(action, -1, 1))
        expected_obs.append(o)
        expected_rewards.append(r)
    np.testing.assert_allclose(obs, expected_obs, atol=3e-5)
    np.testing.assert_allclose(rewards, expected_rewards, rtol=1e-5, atol=2e-4)


def test_its_speed_is_limited_and_it_never_ends_or_succeeds():
    task = make("pendulum")
    _, _, obs, _, terminated = episodes(task, spin_up)
    assert np.abs(obs[..., 2]).max() == 8.0
    assert not terminated.any()
    assert not task.success(task.reset(KEYS[0])[0])


def test_it_starts_at_any_angle_and_slowly():
    state, obs = jax.vmap(make("pendulum").reset)(jax.random.split(jax.random.key(1), 2000))
    assert kstest(state.theta, "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 0.01
    assert kstest(state.theta_dot, "uniform", args=(-1, 2)).pvalue > 0.01
    expected = np.stack([np.cos(state.theta), np.sin(state.theta), state.theta_dot], axis=-1)
    np.testing.assert_allclose(obs, expected, atol=1e-6)
