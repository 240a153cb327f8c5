"""SLAC: its model against numpy, its gradient, what its actor and its critics read."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.agents.slac import SLACAgent, begin_windows
from beliefrl.errors import UserError
from beliefrl.models.latent_model import elbo_terms
from beliefrl.types import perception
from inputs import SPEC, along, changed_where_missing, differ, random_like, same, slope, windows

AGENT = SLACAgent(
    policy_layers=(8,),
    value_layers=(8,),
    model_layers=(8, 6),
    z1_size=3,
    z2_size=5,
    seq_len=4,
    batch_size=2,
    history=4,
)
TIME = AGENT.history + AGENT.seq_len


@pytest.fixture(scope="module")
def state():
    return jax.jit(lambda key: AGENT.init(key, SPEC))(jax.random.key(0))


def gaussian(network, *inputs):
    """A network's μ and σ in numpy."""
    x = np.concatenate(inputs, axis=-1)
    for index, layer in enumerate(network.mlp.layers):
        x = np.tanh(x) if index else x
        x = x @ np.asarray(layer.weight).T + np.asarray(layer.bias)
    mean, sigma = np.split(x, 2, axis=-1)
    return mean, np.log1p(np.exp(sigma)) + network.least


def log_prob(x, mean, sigma):
    return -0.5 * ((x - mean) / sigma) ** 2 - np.log(sigma) - 0.5 * np.log(2 * np.pi)


@pytest.fixture(scope="module")
def timesteps():
    """Six timesteps of two windows, with an episode that begins in the second."""
    is_first = jnp.zeros((2, 6), bool).at[:, 0].set(True).at[1, 3].set(True)
    return begin_windows(windows(jax.random.key(1), 2, 6, is_first))


@pytest.fixture(scope="module")
def noise():
    return tuple(jax.random.normal(jax.random.key(size), (6, 2, size)) for size in (AGENT.z1_size, AGENT.z2_size))


def test_inference_and_elbo_are_the_equations(state, timesteps, noise):
    model, step = state.model, timesteps.step

    @jax.jit
    def ours():
        latents = model.infer(perception(step), step.prev_action, step.is_first, noise)
        return latents, elbo_terms(model, latents, step.obs, step.reward, step.prev_action, step.is_first)

    latents, terms = ours()
    z1_before, before = np.zeros((2, 3)), np.zeros((2, 5))
    for t in range(6):
        first = np.asarray(step.is_first[t])[:, None]
        before = np.where(first, 0.0, before)
        action, begins = np.asarray(step.prev_action[t]), first.astype(float)
        mean, sigma = gaussian(model.posterior, np.asarray(perception(step)[t]), begins, action, before)
        z1 = mean + sigma * noise[0][t]
        z2_mean, z2_sigma = gaussian(model.next_z2, begins, action, z1, before)
        z2 = z2_mean + z2_sigma * noise[1][t]
        prior_mean, prior_sigma = (
            np.where(first, default, part)
            for default, part in zip((0, 1), gaussian(model.prior, before, action), strict=True)
        )
        kl = np.log(prior_sigma / sigma) + ((mean - prior_mean) ** 2 + sigma**2) / (2 * prior_sigma**2) - 0.5
        reward = log_prob(
            np.asarray(step.reward[t])[:, None], *gaussian(model.reward, z1_before, before, action, z1, z2)
        )
        for mine, theirs in (
            (latents.z1[t], z1),
            (latents.z2[t], z2),
            (terms.kl[t], kl.sum(-1)),
            (terms.log_obs[t], log_prob(np.asarray(step.obs[t]), *gaussian(model.decoder, z1, z2)).sum(-1)),
            (terms.log_reward[t], np.where(first, 0.0, reward)[:, 0]),
        ):
            np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-5)
        z1_before, before = z1, z2


@pytest.mark.slow
def test_the_gradient_of_the_elbo_agrees_with_finite_differences(state):
    window = windows(jax.random.key(1), 2, TIME)
    loss = jax.jit(lambda model: AGENT.model_loss(model, window, jax.random.key(2))[0])
    direction = random_like(state.model, jax.random.key(3))
    gradient = jax.jit(jax.grad(loss))(state.model)
    assert along(gradient, direction) == pytest.approx(slope(loss, state.model, direction, by=3e-3), rel=0.03)


@pytest.mark.nightly
def test_pretraining_trains_the_model_alone_and_an_update_the_controller_alone(state):
    window = windows(jax.random.key(1), 4, TIME)
    after, _ = jax.jit(AGENT.pretrain)(state, jax.tree.map(lambda leaf: leaf[:, :2], window), jax.random.key(2))
    assert differ(after.model, state.model)
    assert same(after.controller, state.controller)
    _, batches, _ = jax.jit(AGENT.begin_cycle)(state, window, jax.random.key(2))
    updated, _ = jax.jit(AGENT.update)(state, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(3))
    assert same(updated.model, state.model)
    assert differ(updated.controller._replace(target_value=0), state.controller._replace(target_value=1))


@pytest.mark.parametrize("begins", [[0], [0, 1], [0, 5], [0, 3, 6]])
def test_the_actor_learns_on_what_it_read(state, begins):
    """Also where an episode is younger than the history: its first observation stands for those before it."""
    is_first = jnp.zeros((1, TIME), bool).at[0, jnp.array(begins)].set(True)
    window = windows(jax.random.key(1), 1, TIME, is_first)
    learned = jax.jit(AGENT.histories)(window.step)
    memory, act = AGENT.reset(SPEC), jax.jit(AGENT.act)
    for t in range(TIME):
        timestep = jax.tree.map(lambda leaf, t=t: leaf[t, 0], window.step)
        _, memory = act(state, memory, timestep, jax.random.key(t), jnp.array(True))
        if t >= AGENT.history - 1:
            np.testing.assert_array_equal(learned[t - AGENT.history + 1, 0], memory.ravel())


def test_batches_are_aligned_in_time(state):
    window = windows(jax.random.key(1), 2, TIME)
    batch = jax.jit(AGENT.batches)(state.model, window, jax.random.key(2))
    step = window.step
    assert batch.actor_input.shape == (1, 2 * AGENT.seq_len, AGENT.history * 4)
    for t, sequence in ((0, 0), (1, 1), (3, 0)):
        row, now = 2 * t + sequence, AGENT.history - 1 + t
        np.testing.assert_array_equal(batch.actor_input[0, row, -4:], perception(step)[now, sequence])
        np.testing.assert_array_equal(batch.action[0, row], step.prev_action[now + 1, sequence])
        assert batch.reward[0, row] == step.reward[now + 1, sequence]
        if t:
            np.testing.assert_array_equal(batch.belief[0, row], batch.next_belief[0, row - 2])


def test_a_belief_knows_half_a_history_and_its_own_timestep(state):
    """And nothing after it: the first belief is of timestep 3."""
    window = windows(jax.random.key(1), 2, TIME)

    @jax.jit
    @jax.vmap
    def belief(time):
        obs = window.step.obs.at[time].add(1.0, mode="drop")
        changed = window._replace(step=window.step._replace(obs=obs))
        return AGENT.batches(state.model, changed, jax.random.key(2)).belief[0, :2]

    found = belief(jnp.arange(TIME + 1))  # the last one changes nothing
    assert np.any(found[:-1] != found[-1:], axis=(1, 2)).tolist() == [t in (1, 2, 3) for t in range(TIME)]


@pytest.mark.slow
def test_timesteps_that_do_not_exist_enter_no_loss(state):
    exists = jnp.ones((4, TIME), bool).at[:, 6:].set(False)
    results = changed_where_missing(AGENT, state, windows(jax.random.key(1), 4, TIME), exists)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), *results)


@pytest.mark.parametrize(
    "wrong",
    [{"history": 0}, {"z1_size": 0}, {"lr_model": -1.0}, {"train_interval_rl": 2}, {"elbo_scaling": "x"}],
)
def test_impossible_hyperparameters_are_refused(wrong, unchecked):
    with pytest.raises(UserError, match=f"{next(iter(wrong))}="):
        SLACAgent(**wrong)


def test_the_first_timestep_of_an_episode_has_no_previous_action():
    """`replay.sample` marks the oldest timestep of a full ring as the first of an episode."""
    drawn = windows(jax.random.key(1), 2, 6)
    marked = drawn.step._replace(is_first=drawn.step.is_first.at[3, 1].set(True))
    step = begin_windows(drawn._replace(step=marked)).step
    assert np.all(step.prev_action[0] == 0)
    assert np.all(step.prev_action[3, 1] == 0)
    assert np.any(step.prev_action[3, 0] != 0)
