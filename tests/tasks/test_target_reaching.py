"""Target reaching does what its description says, worked out a second time in NumPy."""

import cmath
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from beliefrl.tasks import make
from beliefrl.tasks.target_reaching import TargetReachingState, wall_distance

KEY = jax.random.key(0)
KEYS = jax.random.split(KEY, 24)
TASK = make("target-reaching")
STEP = jax.jit(TASK.step)
STARTS = jax.jit(jax.vmap(TASK.reset))
START = TargetReachingState(
    position=jnp.array([3.0, 4.0]),
    heading=jnp.array(0.0),
    targets=jnp.array([[3.5, 4.0], [6.0, 6.0], [9.0, 9.0]]),
    reached=jnp.array(0),
    reward=jnp.array(0.0),
)


def random_action(state, key):
    return jax.random.uniform(key, (2,), minval=-1.3, maxval=1.3)


def forward(state, key):
    return jnp.array([1.0, 0.9])


def to_target(state, key):
    """Turn towards the target that is due, then drive until 0.2 before it."""
    x, y = state.targets[jnp.minimum(state.reached, 2)] - state.position
    error = (jnp.arctan2(y, x) - state.heading + jnp.pi) % (2 * jnp.pi) - jnp.pi
    turn, drive = jnp.clip(error / 2, -1, 1), jnp.minimum((jnp.hypot(x, y) - 0.2) / 0.8, 1)
    return jnp.where(jnp.abs(error) > 0.03, turn * jnp.array([1.0, -1.0]), drive)


@functools.cache
def episodes(policy):
    """States before and after each step, actions, and what the step gave; every array (episode, time, ...)."""

    def one(start, key):
        def timestep(state, key):
            action = policy(state, key)
            after, obs, reward, terminated = TASK.step(state, action, key)
            return after, (state, after, action, obs, reward, terminated)

        return jax.lax.scan(timestep, start, jax.random.split(key, 128))[1]

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(STARTS(KEYS)[0], KEYS))


def wall(p, heading):
    """Distance along a ray from the point p to the four lines x = 0, x = 15, y = 0, y = 15: the first one ahead."""
    lines = [(0 - p.real) / math.cos(heading), (15 - p.real) / math.cos(heading)]
    lines += [(0 - p.imag) / math.sin(heading), (15 - p.imag) / math.sin(heading)]
    return min(distance for distance in lines if distance >= 0)


def expected_step(position, heading, targets, reached, action):
    """The step after the description, on complex numbers in double precision: observation, position, end."""
    p, goals = complex(*position), [complex(*target) for target in targets]
    a1, a2 = np.clip(action, -1, 1)
    q, reward = p + 0.8 * (a1 + a2) / 2 * cmath.rect(1, heading), 0.0
    distance = abs(q - goals[reached])
    if not (0 <= q.real <= 15 and 0 <= q.imag <= 15):
        q, reward = p, -0.1
    elif distance < 0.4:
        reward, reached = (20, 50, 100)[reached] / (1 + distance), reached + 1
    heading += a1 - a2  # (a1 - a2) / 2 / 0.5
    seen = [(goal - q) * cmath.rect(1, -heading) for goal in goals]  # in the robot's own frame
    distances = [abs(s) for s in seen] + [wall(q, heading), wall(q, heading + math.pi)]
    bearings = [s.imag / abs(s) for s in seen] + [s.real / abs(s) for s in seen]
    return [math.exp(-d / 3) for d in distances] + bearings + [reward, q.real, q.imag, reached == 3]


@pytest.mark.parametrize("policy", [random_action, forward, to_target])
def test_every_step_is_as_described(policy):
    before, after, actions, obs, rewards, ends = episodes(policy)
    position, heading, targets, actions = map(np.float64, (before.position, before.heading, before.targets, actions))
    for e in range(len(KEYS)):
        length = ends[e].argmax() + 1 if ends[e].any() else 128
        parts = (part[e, :length] for part in (position, heading, targets, before.reached, actions))
        expected = [expected_step(*row) for row in zip(*parts, strict=True)]
        ours = np.column_stack([obs[e], after.position[e], ends[e]])[:length]
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(obs[e, :, 11], rewards[e])


def test_driving_to_each_target_is_rewarded_in_order_and_ends_at_the_third():
    _, after, _, _, rewards, ends = episodes(to_target)
    success = jax.vmap(jax.vmap(TASK.measures))(after)["success"]
    for e in range(len(KEYS)):
        assert ends[e].any()
        last = ends[e].argmax()
        np.testing.assert_array_equal(success[e, : last + 1], np.arange(last + 1) == last)
        prizes = rewards[e, : last + 1][rewards[e, : last + 1] > 0]
        assert len(prizes) == 3
        assert (prizes <= [20, 50, 100]).all()
        assert (prizes > np.array([20, 50, 100]) / 1.4).all()


def test_the_wall_holds_the_robot_and_costs_a_little():
    before, after, _, _, rewards, _ = episodes(forward)
    hit = rewards < 0
    assert hit.any(axis=1).mean() > 0.5
    np.testing.assert_allclose(rewards[hit], -0.1)
    np.testing.assert_array_equal(after.position[hit], before.position[hit])
    turns = np.sin(after.heading - before.heading)  # it turns all the same
    np.testing.assert_allclose(turns, math.sin(0.1), atol=1e-5)


@pytest.mark.parametrize(("reached", "reward"), [(0, 20.0), (1, 0.0), (2, 0.0)])
def test_only_the_target_that_is_due_is_rewarded(reached, reward):
    state = START._replace(position=START.targets[0], reached=jnp.array(reached))
    after, obs, got, terminated = STEP(state, jnp.zeros(2), KEY)
    assert got == obs[11] == reward
    assert after.reached == reached + (reached == 0)
    assert not terminated


@pytest.mark.parametrize(("distance", "reward"), [(0.39, 20 / 1.39), (0.41, 0.0)])
def test_a_target_is_reached_within_its_radius(distance, reward):
    state = START._replace(position=START.targets[0] - jnp.array([distance, 0.0]))
    np.testing.assert_allclose(STEP(state, jnp.zeros(2), KEY)[2], reward, rtol=1e-5)


@pytest.mark.parametrize(
    ("action", "move", "turn"), [([1, 1], 0.8, 0), ([-1, -1], -0.8, 0), ([1, -1], 0, 2), ([0, 0.5], 0.2, -0.5)]
)
def test_wheels_move_along_the_heading_as_it_stood_and_then_turn(action, move, turn):
    after = STEP(START, jnp.array(action, jnp.float32), KEY)[0]
    np.testing.assert_allclose(after.position, [3 + move, 4], rtol=1e-6)
    np.testing.assert_allclose(after.heading, turn % (2 * math.pi), rtol=1e-6)


def test_the_observation_of_a_known_place():
    """Heading along x from (3, 4): red is half a step ahead, green to the left (positive angle)."""
    obs = jax.jit(TASK.observation)(START)
    distances = [0.5, math.sqrt(13), math.sqrt(61), 12, 3]
    bearings = [0, math.atan2(2, 3), math.atan2(5, 6)]
    expected = [*np.exp(np.divide(distances, -3)), *np.sin(bearings), *np.cos(bearings), 0]
    np.testing.assert_allclose(obs, expected, atol=1e-6)


def test_wall_distances_are_those_that_a_marching_ray_finds():
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 15, (40, 2))
    headings = np.append(rng.uniform(0, 2 * math.pi, 36), np.arange(4) * math.pi / 2)
    found = jax.vmap(lambda p, h: wall_distance(p, h, 15.0))(jnp.float32(positions), jnp.float32(headings))
    marched = np.arange(0, 22, 0.005)
    for position, heading, distance in zip(positions, headings, found, strict=True):
        points = position + marched[:, None] * [math.cos(heading), math.sin(heading)]
        first_outside = ((points < 0) | (points > 15)).any(axis=1).argmax()
        assert abs(marched[first_outside] - distance) < 0.006


def test_it_starts_anywhere_with_targets_apart_in_the_middle():
    state, _ = STARTS(jax.random.split(jax.random.key(1), 2000))
    assert kstest(state.position.ravel(), "uniform", args=(0, 15)).pvalue > 0.01
    assert kstest(state.heading, "uniform", args=(0, 2 * math.pi)).pvalue > 0.01
    targets = np.asarray(state.targets)
    assert 5.5 <= targets.min() < 5.51
    assert 9.49 < targets.max() <= 9.5
    gaps = np.linalg.norm(targets - targets[:, [1, 2, 0]], axis=-1)
    assert math.sqrt(2) < gaps.min() < 1.45
    np.testing.assert_array_equal(state.reached, 0)
    np.testing.assert_array_equal(state.reward, 0)
