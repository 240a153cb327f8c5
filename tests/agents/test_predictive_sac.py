"""Predictive SAC: beliefs and transitions in time, where gradients go, the pool."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.agents.predictive_sac import Note, PredictiveSACAgent
from beliefrl.errors import UserError
from beliefrl.models import double_q, reading
from beliefrl.models.double_q import Policy
from beliefrl.models.predictive_model import init_model, prediction_loss, remember
from beliefrl.models.scales import Usual, standardise
from beliefrl.types import Reading
from inputs import SPEC, changed_where_missing, same, windows

AGENT = PredictiveSACAgent(
    policy_layers=(8,),
    value_layers=(8,),
    d_size=8,
    hidden_size=8,
    seq_len=6,
    sequences=2,
    batch_size=16,
    pool=3,
    reward_memory=(2.0, 10.0),
    observation_memory=(3.0, 20.0),
)
TIME = 7  # timesteps of a window


def noted(window, excess=lambda reward: reward):
    """The window, read by the first readers after a jump, with the notes of an actor whose memory was empty.

    `excess` is u. The policy that acted is a standard normal before the tanh.
    """
    step, zeros = window.step, jnp.zeros_like(window.step.prev_action)
    u = jnp.where(step.is_first, 0.0, excess(step.reward))
    rewards, observations = sums(step.is_first, u, (2.0, 10.0)), sums(step.is_first, step.obs, (3.0, 20.0))
    return read(window._replace(note=Note(rewards, Policy(zeros, zeros), observations)), continues=False)


def sums(is_first, values, constants):
    """Decaying sums of values (time, batch, ...) since the last first timestep, with a last axis of time constants."""
    total, found = np.zeros((*values.shape[1:], len(constants))), []
    for t in range(len(values)):
        begins = np.asarray(is_first[t]).reshape(-1, *[1] * (total.ndim - 1))
        total = np.where(begins, 0.0, total) * (1 - 1 / np.array(constants)) + np.asarray(values[t])[..., None]
        found.append(total)
    return jnp.array(found)


def read(window, continues, reader=None):
    """The window as read by these readers, the first ones by default."""
    batch = window.step.reward.shape[1]
    reader = jnp.arange(batch) if reader is None else jnp.array(reader)
    return window._replace(reading=Reading(reader, jnp.broadcast_to(jnp.array(continues), (batch,))))


def unrolled(state, window, start=None):
    """The LSTM's states along a window, from zero by default."""
    x = state.scales.perception(window.step, window.note.observations)
    inputs = state.scales.model_input(x, window.note.rewards)
    start = state.model.lstm.start(window.step.reward.shape[1]) if start is None else start
    return jax.jit(lambda: state.model.lstm.unroll(start, inputs, window.step.is_first))()


def usual(state, reward, deviation):
    """The state after a pre-training on rewards with this median and this mean deviation."""
    return state._replace(scales=state.scales._replace(usual=Usual(*map(jnp.array, (reward, deviation, 1.0)))))


@pytest.fixture(scope="module")
def state():
    return jax.jit(lambda key: AGENT.init(key, SPEC))(jax.random.key(0))


@pytest.fixture(scope="module")
def begun(state):
    """The state after a cycle was begun on some windows, those windows, and the batches."""
    window = noted(windows(jax.random.key(1), 2, TIME))
    return *jax.jit(AGENT.begin_cycle)(state, window, jax.random.key(2))[:2], window


def test_acting_forms_the_belief_that_replay_forms(state):
    first = jnp.zeros((1, TIME), bool).at[0, jnp.array([0, 3])].set(True)
    state = usual(state, 0.3, 0.1)
    window = windows(jax.random.key(1), 1, TIME, first)
    window = noted(window, lambda r: jnp.where(jnp.abs(r - 0.3) > 0.5, r - 0.3, 0.0))
    step, at_once = window.step, unrolled(state, window)
    memory, act = AGENT.reset(SPEC), jax.jit(AGENT.act)
    for t in range(TIME):
        now = jax.tree.map(lambda leaf, t=t: leaf[t, 0], step)
        memory = AGENT.reset(SPEC) if now.is_first else memory
        _, memory = act(state, memory, now, jax.random.key(t), jnp.array(False))
        note = AGENT.note(memory)
        np.testing.assert_allclose(note.rewards, window.note.rewards[t, 0], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(note.observations, window.note.observations[t, 0], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(memory.lstm.d, at_once.d[t, 0], rtol=1e-5, atol=1e-6)


def test_a_prediction_is_made_from_the_belief_before_in_the_units_of_the_task(state):
    """One step ahead, where all is observed; standardised again, it is the output of the predictor."""
    window = noted(windows(jax.random.key(1), 1, TIME))
    state = jax.jit(AGENT.learn_model)(usual(state, 0.0, 0.0), window)[0]  # scales that differ from 0 and 1
    steps = jax.tree.map(lambda leaf: leaf[:, 0], window.step)
    ask = jax.jit(lambda seen: AGENT.predict(state, "lstm", steps, seen, jax.random.key(0)).mean)
    d = unrolled(state, window).d[:-1, 0]
    expected = jax.vmap(state.model.predict)(d, steps.prev_action[1:])
    found = ask(jnp.ones(TIME, bool))
    of_time = steps._replace(obs=found[:, :-1], reward=found[:, -1])
    np.testing.assert_allclose(state.scales.prediction(of_time)[1:], expected, rtol=1e-4, atol=1e-5)
    assert np.isnan(found[0]).all()


def test_the_model_learns_to_predict_the_next_timestep_from_the_action_before_it(state):
    first = jnp.zeros((2, TIME), bool).at[:, 0].set(True).at[1, 4].set(True)
    window = noted(windows(jax.random.key(1), 2, TIME, first))
    after, _, metrics = jax.jit(AGENT.learn_model)(state, window)
    d = unrolled(state._replace(scales=after.scales), window).d
    predicted = jax.vmap(jax.vmap(state.model.predict))(d[:-1], window.step.prev_action[1:])
    error = np.asarray(predicted - after.scales.prediction(window.step)[1:])
    np.testing.assert_allclose(metrics["loss_model"], np.mean(error[~first.T[1:]] ** 2), rtol=1e-5)


def test_scales_are_of_known_beliefs_and_of_real_rewards(state):
    """Nothing is known after a jump until an episode begins; its first timestep has no reward."""
    first = jnp.zeros((2, TIME), bool).at[0, 3].set(True)
    exists = jnp.ones((2, TIME), bool).at[0, -1].set(False)
    window = noted(windows(jax.random.key(1), 2, TIME, first, exists))
    reward = window.step.reward.at[3, 0].set(70.0)
    window = window._replace(step=window.step._replace(reward=reward))
    after, belief, _ = jax.jit(AGENT.learn_model)(state, window)
    real = np.asarray(reward)[np.asarray(exists & ~first).T]
    np.testing.assert_allclose(after.scales.reward.mean, [real.mean()], rtol=1e-5)
    np.testing.assert_allclose(after.scales.reward.variance, [real.var()], rtol=1e-5)
    known = np.asarray(belief)[3:-1, 0]
    np.testing.assert_allclose(after.scales.belief.mean, known.mean(0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(after.scales.belief.variance, known.var(0), rtol=1e-4, atol=1e-6)


def test_without_observations_a_prediction_is_made_from_earlier_predictions(state):
    """What is predicted of unobserved timesteps is what is predicted if they are as predicted."""
    window = noted(windows(jax.random.key(1), 1, TIME))
    state = jax.jit(AGENT.learn_model)(usual(state, 0.0, 0.1), window)[0]
    steps, time = jax.tree.map(lambda leaf: leaf[:, 0], window.step), jnp.arange(TIME)
    ask = jax.jit(lambda steps, seen: AGENT.predict(state, "lstm", steps, seen, jax.random.key(0)).mean)
    alone = ask(steps, time < 3)
    as_predicted = steps._replace(
        obs=jnp.where((time < 3)[:, None], steps.obs, alone[:, :-1]),
        reward=jnp.where(time < 3, steps.reward, alone[:, -1]),
    )
    np.testing.assert_allclose(ask(as_predicted, time >= 0), alone, rtol=1e-4, atol=1e-5)
    assert not np.allclose(ask(steps, time >= 0)[4:], alone[4:])


def test_a_window_that_continues_starts_from_the_state_at_the_end_of_the_last_one(state):
    """The last timestep of a window is the first of the next one; the other readers keep their states."""
    whole, learn, reader = noted(windows(jax.random.key(1), 2, 2 * TIME - 1)), jax.jit(AGENT.learn_model), (3, 1)
    one = read(whole.between(0, TIME), False, reader)
    two = read(whole.between(TIME - 1, None), True, reader)
    first, _, _ = learn(state, one)
    second, belief, _ = learn(first, two)
    before = jax.tree.map(lambda leaf: leaf[-2], unrolled(state._replace(scales=first.scales), one))
    kept = jax.tree.map(lambda leaf: leaf[jnp.array(reader)], first.readers)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), before, kept)
    np.testing.assert_array_equal(first.readers.d[jnp.array([0, 2, 4, 5])], 0.0)
    d = unrolled(first._replace(scales=second.scales), two, kept).d
    np.testing.assert_allclose(belief[..., : AGENT.d_size], d, rtol=1e-5, atol=1e-6)
    assert reading.known_transitions(two).all()


def test_after_a_jump_nothing_is_learned_until_an_episode_begins(state):
    first = jnp.zeros((2, TIME), bool).at[0, 3].set(True)
    window = noted(windows(jax.random.key(1), 2, TIME, first))
    full = state._replace(readers=jax.tree.map(jnp.ones_like, state.readers))
    after, belief, metrics = jax.jit(AGENT.learn_model)(full, window)
    in_pool = jax.jit(AGENT.begin_cycle)(full, window, jax.random.key(2))[0].pool.transitions.valid[0]
    np.testing.assert_array_equal(in_pool.reshape(-1, 2), [[t >= 3, False] for t in range(TIME - 1)])
    d = unrolled(state._replace(scales=after.scales), window).d  # from zero
    np.testing.assert_allclose(belief[..., : AGENT.d_size], d, rtol=1e-5, atol=1e-6)
    obs = window.step.obs.at[:3, 0].add(5.0).at[1:, 1].add(5.0)  # what is not learned from
    scaled = window._replace(step=window.step._replace(obs=obs))
    same_scales = full._replace(scales=full.scales._replace(obs=full.scales.obs._replace(batches=jnp.array(1e9))))
    losses = [jax.jit(AGENT.learn_model)(same_scales, each)[2]["loss_model"] for each in (window, scaled)]
    assert metrics["loss_model"] > 0
    np.testing.assert_allclose(*losses, rtol=2e-2)


def test_a_belief_in_the_replay_remembers_rewards_from_before_its_window(state):
    window = noted(windows(jax.random.key(1), 2, TIME))
    rewards = window.note.rewards.at[:, 0].add(1.0)  # a reward before the window
    long_ago = window._replace(note=window.note._replace(rewards=rewards))
    learn = jax.jit(AGENT.learn_model)
    plain, other = learn(state, window)[1], learn(state, long_ago)[1]
    d = AGENT.d_size
    assert (jnp.abs(plain - other)[:, 0, :d].max(axis=-1) > 1e-4).all()
    np.testing.assert_allclose(plain[..., d:], other[..., d:], rtol=1e-5)  # x_t has no memory of rewards


def test_without_time_constants_there_is_no_memory_of_rewards_or_observations():
    agent = dataclasses.replace(AGENT, reward_memory=(), observation_memory=())
    state = jax.jit(lambda key: agent.init(key, SPEC))(jax.random.key(0))
    window = noted(windows(jax.random.key(1), 1, TIME))
    window = window._replace(note=window.note._replace(rewards=jnp.zeros((TIME, 1, 0)), observations=None))
    step = jax.tree.map(lambda leaf: leaf[0, 0], window.step)
    _, memory = jax.jit(agent.act)(state, agent.reset(SPEC), step, jax.random.key(2), jnp.array(False))
    d = unrolled(state, window).d[0, 0]
    np.testing.assert_allclose(memory.lstm.d, d, rtol=1e-5, atol=1e-6)
    assert agent.note(memory).rewards.shape == (0,)
    assert agent.note(memory).observations is None


def test_an_agent_that_does_not_perceive_the_reward_still_learns_to_predict_it():
    agent = dataclasses.replace(AGENT, perceive_reward=False)
    state = jax.jit(lambda key: agent.init(key, SPEC))(jax.random.key(0))
    state = usual(state, 0.0, 0.0)  # every reward is unusual
    window = noted(windows(jax.random.key(1), 2, TIME))
    window = window._replace(note=window.note._replace(rewards=jnp.zeros((TIME, 2, 0))))
    other = window._replace(step=window.step._replace(reward=window.step.reward.at[3, 0].add(5.0)))
    learn = jax.jit(agent.learn_model)
    (after, belief, metrics), (_, same_belief, changed) = learn(state, window), learn(state, other)
    np.testing.assert_array_equal(belief, same_belief)
    assert abs(changed["loss_model"] / metrics["loss_model"] - 1) > 1e-3
    assert belief.shape[-1] == agent.d_size + SPEC.obs_dim + SPEC.action_dim + SPEC.obs_dim * 2
    assert not same(after.model, state.model)
    step = jax.tree.map(lambda leaf: leaf[0, 0], window.step)._replace(is_first=jnp.array(False))
    others, act = (agent.reset(SPEC), jax.random.key(2), jnp.array(False)), jax.jit(agent.act)
    zero, nine = (act(state, others[0], step._replace(reward=jnp.array(r)), *others[1:]) for r in (0.0, 9.0))
    assert same(zero, nine)


def test_equal_rewards_tell_no_time(state):
    """Where all rewards are alike, as on CartPole, the memory stays empty; so it does before the pre-training."""
    step = jax.tree.map(lambda leaf: leaf[0, 0], windows(jax.random.key(1), 1, TIME).step)
    for trained in (state, usual(state, 1.0, 0.0)):
        memory = AGENT.reset(SPEC)
        for t in range(3):
            now = step._replace(is_first=jnp.array(t == 0), reward=jnp.array(float(t > 0)))
            _, memory = jax.jit(AGENT.act)(trained, memory, now, jax.random.key(t), jnp.array(False))
        np.testing.assert_array_equal(memory.note.rewards, 0.0)


def test_pretraining_learns_which_rewards_are_usual_and_what_follows_does_not_change_it(state):
    rewards = jnp.ones((TIME, 2)).at[3, 0].set(9.0).at[5, 1].set(3.0).at[0].set(-70.0)  # the last are no rewards
    window = noted(windows(jax.random.key(1), 2, TIME))
    window = window._replace(step=window.step._replace(reward=rewards))
    trained, _ = jax.jit(AGENT.pretrain)(state, window, jax.random.key(2))
    np.testing.assert_allclose(trained.scales.usual, (1.0, 10 / 12, 1.0), rtol=1e-6)
    np.testing.assert_allclose(trained.scales.usual.excess(jnp.array(5.1)), 0.0)  # five deviations
    np.testing.assert_allclose(trained.scales.usual.excess(jnp.array(5.2)), 4.2, rtol=1e-6)
    np.testing.assert_allclose(trained.scales.usual.excess(jnp.array(-3.2)), -4.2, rtol=1e-6)
    later, _, _ = jax.jit(AGENT.begin_cycle)(trained, window, jax.random.key(3))
    assert same(later.scales.usual, trained.scales.usual)
    assert later.model_optimiser[1].count == 2  # the updates after which the learning rate falls include these


def test_the_targets_have_the_discount_of_the_agent(begun):
    trained, _, window = begun
    other = dataclasses.replace(AGENT, gamma=0.5)
    plain, half = (jax.jit(agent.begin_cycle)(trained, window, jax.random.key(3))[0].pool for agent in (AGENT, other))
    assert not same(plain, half)


def test_usual_rewards_are_averages_over_the_batches():
    before, valid = Usual(*jnp.zeros(3)), jnp.ones(4, bool)
    for rewards in ([0.0, 0.0, 0.0, 8.0], [1.0, 2.0, 4.0, 5.0]):
        before = before.include(jnp.array(rewards), valid)
    np.testing.assert_allclose(before, ((0 + 3) / 2, (2 + 1.5) / 2, 2), rtol=1e-6)
    none = before.include(jnp.array([9.0, 9.0, 9.0, 9.0]), ~valid)
    assert same(none, before)


def test_the_memory_of_rewards_decays():
    memory = jnp.zeros(2)
    for excess in (1.0, 0.0, 3.0):
        memory = remember(memory, jnp.array(excess), (2.0, 10.0))
    np.testing.assert_allclose(memory, [0.25 + 3, 0.9**2 + 3], rtol=1e-6)


def test_the_memory_of_observations_has_sums_of_each_entry():
    memory = jnp.zeros((3, 2))
    for obs in ([1.0, 0.0, 2.0], [0.0, 0.0, 0.0], [3.0, -1.0, 0.0]):
        memory = remember(memory, jnp.array(obs), (2.0, 10.0))
    expected = [[0.25 + 3, 0.9**2 + 3], [-1, -1], [2 * 0.25, 2 * 0.9**2]]
    np.testing.assert_allclose(memory, expected, rtol=1e-6)


def test_the_memory_of_observations_is_standardised_and_read_by_the_model_and_the_controller(state):
    """x_t ends with n_t, in units in which its entries have variances of about 1."""
    window = noted(windows(jax.random.key(1), 2, TIME))
    after, belief, _ = jax.jit(AGENT.learn_model)(state, window)
    n = np.asarray(window.note.observations).reshape(TIME, 2, 6)
    np.testing.assert_allclose(after.scales.memory.mean, n.mean((0, 1)), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(after.scales.memory.variance, n.var((0, 1)), rtol=1e-4)
    expected = (n - n.mean((0, 1))) / (n.std((0, 1)) + 1e-3)
    np.testing.assert_allclose(belief[..., -6:], expected, rtol=1e-3, atol=1e-4)
    long_ago = window._replace(note=window.note._replace(observations=window.note.observations.at[:, 0].add(1.0)))
    other = jax.jit(AGENT.learn_model)(state, long_ago)[1]
    assert (jnp.abs(belief - other)[:, 0, : AGENT.d_size].max(axis=-1) > 1e-4).all()


def test_an_actor_notes_the_policy_that_chose_its_action(state):
    """Of a sampled action, the note's policy is the one at its own belief; the mode is its mean."""
    step = jax.tree.map(lambda leaf: leaf[0, 0], windows(jax.random.key(1), 1, TIME).step)
    mode, memory = jax.jit(AGENT.act)(state, AGENT.reset(SPEC), step, jax.random.key(0), jnp.array(False))
    belief = jnp.concatenate([memory.lstm.d, state.scales.perception(step, memory.note.observations)])
    policy = AGENT.note(memory).policy
    expected = state.controller.actor(standardise(state.scales.belief, belief))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), policy, expected)
    np.testing.assert_allclose(mode, jnp.tanh(policy.mean), rtol=1e-5)
    _, sampled = jax.jit(AGENT.act)(state, AGENT.reset(SPEC), step, jax.random.key(0), jnp.array(True))
    assert same(sampled.note.policy, policy)


def test_transitions_in_the_pool_are_aligned_in_time(state, begun):
    after, _, window = begun
    pool, step = jax.tree.map(lambda leaf: leaf[0], after.pool.transitions), window.step
    x = after.scales.perception(step, window.note.observations)  # the scales of this cycle, the model before its update
    belief = jnp.concatenate([unrolled(state._replace(scales=after.scales), window).d, x], axis=-1)
    for t, sequence in ((0, 0), (2, 1), (5, 1)):
        row = 2 * t + sequence
        np.testing.assert_allclose(pool.belief[row], belief[t, sequence], rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(pool.action[row], step.prev_action[t + 1, sequence])


def test_targets_in_the_pool_are_those_of_the_window(state, begun):
    """With λ = 1, ω = 1 and V̄ = 0 a target has the rewards until the end of the episode or of the window."""
    _, _, window = begun
    first = window.step.is_first.at[3, 0].set(True)
    terminated = window.step.terminated.at[2, 0].set(True).at[4, 1].set(True)
    window = window._replace(step=window.step._replace(is_first=first, terminated=terminated))
    agent = dataclasses.replace(AGENT, gamma=0.9, trace_decay=1.0, off_policy_trace=1.0)
    zero = jax.tree.map(jnp.zeros_like, state.controller.targets)
    valueless = state._replace(controller=state.controller._replace(targets=zero))
    after, _, _ = jax.jit(agent.begin_cycle)(valueless, window, jax.random.key(2))
    step, expected = jax.tree.map(np.asarray, window.step), np.zeros(2)
    y, valid = (np.asarray(leaf[0]).reshape(6, 2) for leaf in after.pool.transitions[2:])
    np.testing.assert_array_equal(valid, ~step.is_first[1:])
    for t in reversed(range(6)):
        expected = step.reward[t + 1] + agent.gamma * np.where(step.terminated[t + 1], 0.0, expected)
        np.testing.assert_allclose(y[t][valid[t]], expected[valid[t]], rtol=1e-4, atol=1e-5)
        expected = np.where(valid[t], expected, 0.0)


def test_traces_use_the_policy_noted_at_their_timestep(state, begun):
    _, _, window = begun
    keys = jax.random.split(jax.random.key(7))
    policy = Policy(*(0.5 * jax.random.normal(key, window.step.prev_action.shape) for key in keys))
    window = window._replace(note=window.note._replace(policy=policy))
    agent, key = dataclasses.replace(AGENT, trace_decay=0.8, off_policy_trace=0.0, pessimism=0.25), jax.random.key(2)
    after, _, _ = jax.jit(agent.begin_cycle)(state, window, key)
    belief = jax.jit(agent.learn_model)(state, window)[1]
    valid, key = jnp.ones((6, 2), bool), jax.random.split(key)[0]
    given = standardise(after.scales.belief, belief), window.step, valid, policy, key
    traces = double_q.Traces(agent.gamma, decay=0.8, off_policy=0.0)
    y, _ = jax.jit(lambda: double_q.critic_targets(state.controller, *given, traces, 0.25))()
    np.testing.assert_allclose(after.pool.transitions.target[0], y.ravel(), rtol=1e-4, atol=1e-5)


def test_a_pessimism_of_0_gives_the_actor_higher_values(state, begun):
    batch, key = jax.tree.map(lambda leaf: leaf[0], begun[1]), jax.random.key(2)
    low, mean = (dataclasses.replace(AGENT, pessimism=pessimism) for pessimism in (1.0, 0.0))
    assert jax.jit(mean.update)(state, batch, key)[1]["q"] > jax.jit(low.update)(state, batch, key)[1]["q"]


def test_a_batch_is_standardised_and_drawn_from_all_cycles_in_the_pool(state, begun):
    after, batches, _ = begun
    assert batches.target.shape == (1, 16)
    raw = after.pool.draw(jax.random.split(jax.random.key(2))[1], (1, 16))
    np.testing.assert_allclose(batches.belief, standardise(after.scales.belief, raw.belief), rtol=1e-5, atol=1e-6)

    begin, seen = jax.jit(AGENT.begin_cycle), after
    for number in range(4):  # the pool has room for three cycles
        seen, _, _ = begin(seen, noted(windows(jax.random.key(10 + number), 2, TIME)), jax.random.key(number))
        cycles = min(number + 2, 3)
        stored = set(np.asarray(seen.pool.transitions.target)[:cycles].ravel().tolist())
        drawn = set(np.asarray(seen.pool.draw(jax.random.key(3), (8, 64)).target).ravel().tolist())
        assert drawn == stored
    assert not set(np.asarray(after.pool.transitions.target[0]).tolist()) & stored  # the first cycle was replaced


@pytest.mark.parametrize("steps", [1, 3])
def test_a_cycle_has_the_updates_of_its_steps(begun, steps):
    trained, _, window = begun
    agent = dataclasses.replace(AGENT, train_interval_rl=steps, updates_per_step=4)
    batches = jax.eval_shape(agent.begin_cycle, trained, window, jax.random.key(2))[1]
    assert batches.target.shape == (4 * steps, AGENT.batch_size)


def test_only_the_critics_are_normalised():
    controller = AGENT.init(jax.random.key(0), SPEC).controller
    assert [each.normalise for each in (*controller.critics, *controller.targets)] == [True] * 4
    assert not controller.actor.network.normalise
    agent = dataclasses.replace(AGENT, normalise_critics=False)
    assert not agent.init(jax.random.key(0), SPEC).controller.critics[0].normalise


@pytest.mark.parametrize(
    ("settings", "rates"),
    [
        ({}, [0.8, 0.8, 0.8, 0.8 * 2 / 3, 0.8 * 2 / 4, 0.8 * 2 / 5]),
        ({"lr_model_min": 0.5}, [0.8, 0.8, 0.8, 0.8 * 2 / 3, 0.5, 0.5]),
        ({"lr_model_min": 0.9}, [0.8] * 6),
    ],
)
def test_the_learning_rate_of_the_model_falls(settings, rates):
    """With a constant gradient, a step of Adam is as long as its learning rate."""
    agent = dataclasses.replace(AGENT, lr_model=0.8, lr_model_updates=2, **settings)
    optimiser, gradient, steps = agent.model_optimiser, jnp.ones(()), []
    state = optimiser.init(gradient)
    for _ in rates:
        step, state = optimiser.update(gradient, state)
        steps.append(-float(step))
    np.testing.assert_allclose(steps, rates, rtol=1e-4)


def test_the_controller_sends_no_gradient_into_the_model(state, begun):
    after, batches, _ = begun
    learned, _ = jax.jit(AGENT.update)(after, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(4))
    assert same(learned.model, after.model)
    assert not same(after.model, state.model)
    assert not same(learned.controller.actor, after.controller.actor)


def test_what_is_evaluated_is_an_average_of_the_last_weights(state, begun):
    """The first update replaces the average. Then it follows at 10 / (n + 9), or at its rate if that is more."""
    moved = jax.tree.map(lambda leaf: leaf + 1.0, state.average.weights)
    assert same(
        AGENT.networks(state._replace(average=state.average._replace(weights=moved))).model, state.model
    )  # before the first update
    agent = dataclasses.replace(AGENT, average_rate=0.8)
    begin, update, weights = jax.jit(agent.begin_cycle), jax.jit(agent.update), []
    for number in range(4):
        window = noted(windows(jax.random.key(number), 2, TIME))
        state, batches, _ = begin(state, window, jax.random.key(number))
        state, _ = update(state, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(number))
        weights.append((state.model.lstm.w_d, state.controller.actor.network.layers[0].weight))
    expected = weights[0]
    for rate, newest in zip((10 / 11, 10 / 12, 0.8), weights[1:], strict=True):
        expected = [old + rate * (new - old) for old, new in zip(expected, newest, strict=True)]
    trained = agent.networks(state)
    found = trained.model.lstm.w_d, trained.controller.actor.network.layers[0].weight
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), tuple(expected), found)
    assert same(trained.controller.critics, state.controller.critics)
    newest = dataclasses.replace(AGENT, average_rate=1.0)
    after, batches, _ = begun
    learned, _ = jax.jit(newest.update)(after, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(4))
    assert same(newest.networks(learned).model, learned.model)


def test_pretraining_teaches_the_model_to_predict(state):
    """Of a world in which the next observation is the action before and the reward is an entry of it."""
    window = noted(windows(jax.random.key(1), 2, TIME))
    step = window.step
    action = step.prev_action
    obs = jnp.concatenate([jnp.zeros((1, 2, 3)), action[:-1, :, jnp.array([0, 1, 0])]])
    window = window._replace(step=step._replace(obs=obs, reward=obs[..., 1]))
    learn = jax.jit(dataclasses.replace(AGENT, lr_model=1e-2).pretrain)
    losses = []
    for number in range(200):
        state, metrics = learn(state, window, jax.random.key(number))
        losses.append(float(metrics["loss_model"]))
    assert losses[-1] < 0.1 * losses[0]


@pytest.mark.nightly
def test_what_does_not_exist_changes_nothing(state):
    exists = jnp.ones((2, TIME), bool).at[1, -2:].set(False)
    first = jnp.zeros((2, TIME), bool).at[:, 0].set(True)
    window = noted(windows(jax.random.key(1), 2, TIME, first))
    results = changed_where_missing(AGENT, state, window, exists)
    (a, metrics_a), (b, metrics_b) = results
    for x, y in ((a.model, b.model), (a.controller, b.controller), (metrics_a, metrics_b)):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-6), x, y)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gamma", 1.5),
        ("pool", 0),
        ("jump", 1.5),
        ("long_memories", 1.5),
        ("trace_decay", 1.5),
        ("pessimism", 1.5),
        ("off_policy_trace", -0.1),
        ("alpha_start", -1.0),
        ("average_rate", 0.0),
        ("lr_model_updates", 0),
        ("lr_model_min", -0.1),
        ("reward_memory", (8.0, 0.5)),
        ("observation_memory", (0.5,)),
    ],
)
def test_impossible_values_are_refused(field, value):
    with pytest.raises(UserError, match=re.escape(f"{field}={value} is impossible")):
        PredictiveSACAgent(**{field: value})


# A recurrent model that learns only to predict: its memories and its loss.

OBS, ACTION, D = 3, 2, 8
SIZES = OBS, ACTION, 8, D, 6


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
    made, step, keys = model(), windows(jax.random.key(2), 2, 5).step, jax.random.split(jax.random.key(1), 2)
    inputs, target = jax.random.normal(keys[0], (5, 2, 8)), jax.random.normal(keys[1], (4, 2, OBS + 1))
    valid = jnp.ones((4, 2), bool).at[1, 0].set(False)
    loss, lstm = jax.jit(prediction_loss)(made, made.lstm.start(2), inputs, step, target, valid)
    errors = [
        np.mean((np.asarray(made.predict(lstm.d[t, b], step.prev_action[t + 1, b])) - np.asarray(target[t, b])) ** 2)
        for t in range(4)
        for b in range(2)
        if valid[t, b]
    ]
    np.testing.assert_allclose(loss, np.mean(errors), rtol=1e-5)
