"""Our CartPole has Gymnasium's physics, with a force of 30 N times the action."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from beliefrl.tasks import make
from beliefrl.tasks.cartpole import CartPoleState
from beliefrl.tasks.drawing import BLUE, GREEN, RED, Circle, Line, Picture, Polygon, paint

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


def test_it_starts_near_upright():
    task = make("cartpole")
    state, obs = jax.vmap(task.reset)(jax.random.split(KEY, 2000))
    for entry, value in enumerate(state):
        assert kstest(value, "uniform", args=(-0.05, 0.1)).pvalue > 0.01
        np.testing.assert_array_equal(obs[:, entry], value)


# Our pendulum is Gymnasium's Pendulum-v1.

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


def test_its_speed_is_limited_and_it_never_ends():
    task = make("pendulum")
    _, _, obs, _, terminated = episodes(task, spin_up)
    assert np.abs(obs[..., 2]).max() == 8.0
    assert not terminated.any()


def test_it_starts_at_any_angle_and_slowly():
    state, obs = jax.vmap(make("pendulum").reset)(jax.random.split(jax.random.key(1), 2000))
    assert kstest(state.theta, "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 0.01
    assert kstest(state.theta_dot, "uniform", args=(-1, 2)).pvalue > 0.01
    expected = np.stack([np.cos(state.theta), np.sin(state.theta), state.theta_dot], axis=-1)
    np.testing.assert_allclose(obs, expected, atol=1e-6)


# Shapes land where they are said to be, in their colours.

COLOURS = {RED: (200, 85, 61), GREEN: (75, 148, 96), BLUE: (42, 111, 158)}


def picture(*shapes):
    """One pixel is one unit."""
    return paint(Picture((-10.0, -20.0), (30.0, 40.0), shapes, pixels=60))


def at(pixels, x, y):
    return tuple(int(part) for part in pixels[39 - y, x + 10])


@pytest.mark.parametrize("colour", COLOURS)
@pytest.mark.parametrize(
    ("shape", "inside", "outside"),
    [
        (lambda c: Circle((5, 10), 4.0, c), [(5, 10), (5, 12), (2, 10)], [(5, 15), (9, 13)]),
        (lambda c: Line([(0, 0), (20, 0), (20, 30)], 4.0, c), [(10, 1), (20, 20), (-1, 0)], [(10, 3), (10, 10)]),
        (lambda c: Line([(5, 10)], 4.0, c), [(5, 10)], [(5, 13)]),
        (lambda c: Polygon([(0, 0), (20, 0), (0, 20)], c), [(2, 2), (2, 16), (16, 2)], [(12, 12), (-2, 2)]),
    ],
    ids=["circle", "line", "dot", "polygon"],
)
def test_a_shape_is_where_it_is_said_to_be(shape, inside, outside, colour):
    pixels = picture(shape(colour))
    assert {at(pixels, *point) for point in inside} == {COLOURS[colour]}
    assert {at(pixels, *point) for point in outside} == {at(picture(), 0, 0)}


def test_the_last_shape_is_uppermost():
    pixels = picture(Circle((0, 0), 5.0, RED), Circle((0, 0), 2.0, GREEN))
    assert (at(pixels, 0, 0), at(pixels, 3, 0)) == (COLOURS[GREEN], COLOURS[RED])


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, 1.2])
def test_a_line_is_as_wide_as_it_is_said_to_be_in_every_direction(angle):
    end = 8 * np.array([np.cos(angle), np.sin(angle)])
    pixels = paint(Picture((-10.0, -10.0), (10.0, 10.0), [Line([-end, end], 3.0, "black")], pixels=200))
    area = np.sum(1 - pixels[..., 0] / pixels.max()) * 0.1**2
    assert area == pytest.approx(16 * 3 + np.pi * 1.5**2, rel=0.02)


def test_both_sides_are_even_and_the_longer_one_is_as_asked_for():
    assert paint(Picture((0.0, 0.0), (3.0, 1.0), [], pixels=100)).shape == (34, 100, 3)
