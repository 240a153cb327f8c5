"""n-step and λ-returns: against plain Python, at every kind of end; in the agents; what they are for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beliefrl import agents
from beliefrl.models.returns import lambda_returns, n_step_returns, transition_batch
from beliefrl.types import Timestep
from inputs import SMALL, SPEC, windows

GAMMA = 0.9


def step_of(rewards, firsts, terminated):
    rewards, number = np.array(rewards, np.float32)[:, None], np.arange(len(rewards), dtype=np.float32)[:, None, None]
    return Timestep(number, rewards, number, np.array(firsts)[:, None], np.array(terminated)[:, None])


def plainly(rewards, firsts, terminated, first, n):
    """The return that begins at one timestep, by walking."""
    total, now = 0.0, first
    while now - first < n and now + 1 < len(rewards) and not firsts[now + 1] and not terminated[now]:
        total += GAMMA ** (now - first) * rewards[now + 1]
        now += 1
    return now, total, terminated[now], GAMMA ** (now - first)


jitted_returns = jax.jit(n_step_returns, static_argnums=(2, 3))
timesteps = st.sampled_from([3, 10]).flatmap(
    lambda count: st.tuples(
        st.lists(st.floats(-2, 2, width=32), min_size=count, max_size=count),
        st.lists(st.booleans(), min_size=count, max_size=count),
        st.lists(st.booleans(), min_size=count, max_size=count),
    )
)


@settings(deadline=None, max_examples=40)
@given(timesteps, st.sampled_from([1, 2, 3, 5, 20]))
def test_returns_are_those_of_walking_along_the_episode(window, n):
    rewards, firsts, ends = window
    terminated = [end and i + 1 < len(firsts) and firsts[i + 1] for i, end in enumerate(ends)]
    step = step_of(rewards, firsts, terminated)
    valid = ~step.is_first[1:]
    returns = jax.tree.map(np.asarray, jitted_returns(step, valid, n, GAMMA))
    for first in np.flatnonzero(valid[:, 0]):
        end, total, terminal, discount = plainly(rewards, firsts, terminated, first, n)
        assert returns.end[first, 0] == end
        assert bool(returns.terminated[first, 0]) == terminal
        np.testing.assert_allclose(returns.reward[first, 0], total, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(returns.discount[first, 0], discount, rtol=1e-6)


def plain_lambda_return(rewards, firsts, terminated, values, traces, first):
    """The λ-return that begins at one timestep, by walking."""
    if terminated[first + 1]:
        return rewards[first + 1]
    follows = first + 2 < len(rewards) and not firsts[first + 2]
    trace = traces[first + 1] if follows else 0.0
    ahead = (1 - trace) * values[first + 1]
    if follows:
        ahead += trace * plain_lambda_return(rewards, firsts, terminated, values, traces, first + 1)
    return rewards[first + 1] + GAMMA * ahead


jitted_lambda_returns = jax.jit(lambda_returns, static_argnums=4)


@settings(deadline=None, max_examples=40)
@given(timesteps, st.integers(0, 1000))
def test_lambda_returns_are_those_of_walking_along_the_episode(window, seed):
    rewards, firsts, ends = window
    terminated = [end and i + 1 < len(firsts) and firsts[i + 1] for i, end in enumerate(ends)]
    step, rng = step_of(rewards, firsts, terminated), np.random.default_rng(seed)
    values, traces = rng.normal(size=len(rewards)), rng.uniform(size=len(rewards))
    valid = ~step.is_first[1:]
    given = np.float32(values)[:, None], np.float32(traces)[:-1, None]
    y = np.asarray(jitted_lambda_returns(step, valid, *given, GAMMA))
    for first in np.flatnonzero(valid[:, 0]):
        expected = plain_lambda_return(rewards, firsts, terminated, values, traces, first)
        np.testing.assert_allclose(y[first, 0], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("n", "reward", "after"),
    [
        (1, [1, 1, 1, 1], [10, 20, 40, 50]),
        (2, [1 + GAMMA, 1, 1 + GAMMA, 1], [20, 20, 50, 50]),
        (4, [1 + GAMMA, 1, 1 + GAMMA, 1], [20, 20, 50, 50]),
    ],
)
def test_a_truncated_episode_bootstraps_from_its_last_timestep_and_a_terminated_one_does_not(n, reward, after):
    firsts = [True, False, False, True, False, False]
    step = step_of([0, 1, 1, 0, 1, 1], firsts, [False, False, False, False, False, True])
    valid = ~step.is_first[1:, 0]
    batch = jax.jit(transition_batch, static_argnums=(4, 5))(step, valid[:, None], step.obs, 10 * step.obs, n, GAMMA)
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[valid, 0], batch)
    np.testing.assert_array_equal(batch.belief[:, 0], [0, 1, 3, 4])
    np.testing.assert_array_equal(batch.action[:, 0], [1, 2, 4, 5])
    np.testing.assert_array_equal(batch.next_belief[:, 0], after)
    np.testing.assert_array_equal(batch.terminated, [False, False, n > 1, True])
    np.testing.assert_allclose(batch.reward, reward)


@pytest.mark.parametrize(
    "name", ["sac-mlp", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("vrm", "sac-lstm", "slac"))]
)
def test_every_agent_learns_from_n_steps_and_as_often_as_its_options_say(name):
    settings = {"policy_layers": (8,), "value_layers": (8,), "batch_size": 2}
    settings |= {
        "vrm": {**SMALL, "store_first_impression": False},
        "sac-lstm": {"d_size": 8, "seq_len": 6, "burn_in": 4},
    }.get(name, {})
    settings |= {"slac": {"z1_size": 4, "z2_size": 4, "model_layers": (8,), "history": 3, "seq_len": 6}}.get(name, {})
    one, five = (agents.make(name, updates_per_step=3, n_step=n, **settings) for n in (1, 5))
    state = jax.jit(lambda key: five.init(key, SPEC))(jax.random.key(0))
    given = windows(jax.random.key(1), five.cycle_windows, five.window.burn_in + five.window.length + 1)
    batches = [jax.jit(agent.begin_cycle)(state, given, jax.random.key(2))[1] for agent in (one, five)]
    assert {len(leaf) for leaf in jax.tree.leaves(batches[1])} == {3 * five.cycle}
    if name == "sac-lstm":  # its batches are windows, and the transitions come in an update
        losses = [jax.jit(agent.update)(state, first(batches[0]), jax.random.key(3))[1] for agent in (one, five)]
        assert losses[0]["loss_q"] != losses[1]["loss_q"]
        return
    np.testing.assert_array_equal(batches[0].belief, batches[1].belief)
    np.testing.assert_allclose(batches[0].discount, five.gamma)
    np.testing.assert_allclose(jnp.min(batches[1].discount), five.gamma**5, rtol=1e-6)
    after = jax.jit(five.update)(state, first(batches[1]), jax.random.key(3))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(after))


def first(batches):
    return jax.tree.map(lambda leaf: leaf[0], batches)


def test_values_start_where_the_option_says():
    @jax.jit
    def values(key):
        controller = agents.make("sac-mlp", value_start=100.0).init(key, SPEC).controller
        obs = jax.random.normal(key, (64, SPEC.obs_dim))
        both = [jax.vmap(value)(obs)[:, 0] for value in (controller.value, controller.target_value)]
        return [*both, controller.q(obs, jnp.zeros((64, SPEC.action_dim)))]

    np.testing.assert_allclose(values(jax.random.key(0)), 100.0, atol=1.0)


def test_targets_grow_with_the_steps_of_the_return():
    """With V̄ = 0 the target is the sum of the rewards: (1 - γ^n) / (1 - γ)."""
    for n in (1, 5):
        agent = agents.make("sac-mlp", n_step=n, batch_size=8)
        window = windows(jax.random.key(1), 8, n + 1)
        window = window._replace(step=window.step._replace(reward=jnp.ones((n + 1, 8))))
        batch = jax.jit(agent.batch)(window)
        np.testing.assert_allclose(batch.reward, (1 - agent.gamma**n) / (1 - agent.gamma), rtol=1e-5)
