"""SAC-MLP: what enters no loss, units of observations. SAC-LSTM: its LSTM, gradients, beliefs in time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.agents.sac_lstm import SACLSTMAgent
from beliefrl.agents.sac_mlp import SACMLPAgent
from beliefrl.errors import UserError
from beliefrl.models.nets import LSTM, LSTMState, draw, lstm_step
from beliefrl.models.soft_actor_critic import actor_loss, q_loss, state_value, value_loss
from inputs import SPEC, along, changed_where_missing, differ, random_like, slope, windows

MLP = SACMLPAgent(policy_layers=(8, 8), value_layers=(8, 8), batch_size=6)
STANDARDISED = dataclasses.replace(MLP, standardise=True)


def begun(agent):
    return jax.jit(lambda key: agent.init(key, SPEC))(jax.random.key(0))


def test_pairs_across_episodes_enter_no_loss():
    is_first = jnp.zeros((6, 2), bool).at[:, 0].set(True).at[2, 1].set(True)
    state, update = begun(MLP), jax.jit(MLP.pretrain)
    one = windows(jax.random.key(1), 6, 2, is_first)
    other = jax.tree.map(lambda leaf: leaf.at[:, 2].set(leaf[:, 3]) if leaf.dtype != bool else leaf, one)
    results = [update(state, window, jax.random.key(2)) for window in (one, other)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), *results)
    assert not np.allclose(one.step.obs[:, 2], other.step.obs[:, 2])


@pytest.mark.parametrize("agent", [MLP, pytest.param(STANDARDISED, marks=pytest.mark.nightly)])
def test_pretraining_is_an_update_of_the_controller(agent):
    window, state = windows(jax.random.key(1), 6, 2), begun(agent)
    after, _ = jax.jit(agent.pretrain)(state, window, jax.random.key(2))
    cycle, batches, metrics = jax.jit(agent.begin_cycle)(state, window, jax.random.key(7))
    again, _ = jax.jit(agent.update)(cycle, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(2))
    assert metrics == {}
    assert differ(after.controller, state.controller)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), after, again)


def test_standardised_it_does_not_matter_in_which_units_observations_are():
    window, state = windows(jax.random.key(1), 6, 2), begun(STANDARDISED)
    units = np.array([[[100.0, 20.0, 0.5]]], np.float32)
    others = window._replace(step=window.step._replace(obs=(window.step.obs + 7) * units))
    actions, learn, act = [], jax.jit(STANDARDISED.pretrain), jax.jit(STANDARDISED.act)
    for each in (window, others):
        after, _ = learn(state, each, jax.random.key(2))
        step = jax.tree.map(lambda leaf: leaf[1, 3], each.step)
        actions.append(act(after, (), step, jax.random.key(3), jnp.array(False))[0])
    np.testing.assert_allclose(*actions, rtol=0.01)  # but for what keeps quiet entries from infinity
    raw = jax.jit(MLP.act)(after._replace(scale=None), (), step, jax.random.key(3), jnp.array(False))[0]
    assert np.abs(raw - actions[0]).max() > 0.05


WRONG = [
    *({"batch_size": 0}, {"batch_size": True}, {"pretrain_updates": -1}, {"gamma": 2.0}),
    *({"policy_layers": ()}, {"policy_layers": 64}, {"policy_layers": [64, 64]}),
]


@pytest.mark.parametrize("wrong", WRONG)
def test_impossible_hyperparameters_of_sac_mlp_are_refused(wrong, unchecked):
    with pytest.raises(UserError, match=f"{next(iter(wrong))}="):
        SACMLPAgent(**wrong)


# SAC-LSTM.

RECURRENT = SACLSTMAgent(policy_layers=(8,), value_layers=(8,), d_size=8, seq_len=6, batch_size=2, burn_in=4)
TIME = 11


@pytest.fixture(scope="module")
def state():
    return jax.jit(lambda key: RECURRENT.init(key, SPEC))(jax.random.key(0))


def test_the_lstm_goes_through_time_and_is_empty_where_an_episode_begins():
    lstm = draw(jax.random.key(0), LSTM(3, 4))
    x = np.asarray(jax.random.normal(jax.random.key(1), (5, 2, 3)))
    is_first = np.zeros((5, 2), bool)
    is_first[3, 1] = True
    ours = jax.jit(lambda: lstm.unroll(lstm.start(2), jnp.asarray(x), jnp.asarray(is_first)))()
    state, (w_x, w_d, bias) = LSTMState.empty(2, 4), map(np.asarray, (lstm.w_x, lstm.w_d, lstm.bias))
    for t in range(5):
        d, c = (np.where(is_first[t][:, None], 0.0, part) for part in state)
        state, _ = lstm_step(jnp.asarray(x[t] @ w_x + d @ w_d + bias), jnp.asarray(c))
        for part, expected in zip(ours, state, strict=True):
            np.testing.assert_allclose(part[t], expected, rtol=1e-4, atol=1e-6)


def test_acting_forms_the_belief_that_replay_forms(state):
    window = windows(jax.random.key(1), 1, TIME, jnp.zeros((1, TIME), bool).at[0, jnp.array([0, 5])].set(True))
    step = window.step
    at_once = jax.jit(lambda: state.lstm.unroll(state.lstm.start(1), RECURRENT.perception(step), step.is_first))()
    memory, act = RECURRENT.reset(SPEC), jax.jit(RECURRENT.act)
    for t in range(TIME):
        timestep = jax.tree.map(lambda leaf, t=t: leaf[t, 0], window.step)
        _, memory = act(state, memory, timestep, jax.random.key(t), jnp.array(False))
        np.testing.assert_allclose(memory.d, at_once.d[t, 0], rtol=1e-5, atol=1e-6)


def batch_of(agent, lstm, window):
    d = agent.beliefs(lstm, window)
    return agent.batch(window, d, d, d)


def test_batches_are_aligned_in_time(state):
    window = windows(jax.random.key(1), 2, TIME)
    batch = jax.jit(lambda: batch_of(RECURRENT, state.lstm, window))()
    step = window.step
    d = jax.jit(lambda: state.lstm.unroll(state.lstm.start(2), RECURRENT.perception(step), step.is_first).d)()
    for t, sequence in ((0, 0), (2, 1), (5, 1)):
        row, now = 2 * t + sequence, RECURRENT.burn_in + t
        np.testing.assert_allclose(batch.belief[row], d[now, sequence], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(batch.next_belief[row], d[now + 1, sequence], rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(batch.actor_input[row], batch.belief[row])
        np.testing.assert_array_equal(batch.action[row], step.prev_action[now + 1, sequence])
        assert batch.reward[row] == step.reward[now + 1, sequence]


def frozen_losses(agent, state, window, key):
    """J_π, J_V and J_Q as functions of the LSTM, in which all that they are not to train keeps its value."""
    fixed, controller = batch_of(agent, state.lstm, window), state.controller
    noise = jax.random.normal(key, fixed.action.shape)
    q, log_prob = actor_loss(controller.actor, controller, fixed, noise, 1e-3)[1]
    v_target = q - jnp.exp(controller.log_alpha) * log_prob
    beyond = jnp.where(fixed.terminated, 0.0, state_value(controller.target_value, fixed.next_belief))
    ends = fixed._replace(reward=fixed.reward + agent.gamma * beyond, terminated=jnp.ones_like(fixed.terminated))

    def j_pi(lstm):
        actor_input = batch_of(agent, lstm, window).belief
        return actor_loss(controller.actor, controller, fixed._replace(actor_input=actor_input), noise, 1e-3)[0]

    def j_v(lstm):
        return value_loss(controller.value, batch_of(agent, lstm, window).belief, v_target, fixed.valid)

    def j_q(lstm):
        belief = batch_of(agent, lstm, window).belief
        return q_loss(controller.critics, controller.target_value, ends._replace(belief=belief))

    return j_pi, j_v, j_q


@pytest.mark.slow
def test_gradients_of_three_losses_reach_the_lstm_and_none_through_targets(state):
    """By finite differences of each loss alone; those of J_V and J_Q come together, that of J_π by itself."""
    agent = dataclasses.replace(RECURRENT, burn_in=0, seq_len=TIME - 1)
    window, key = windows(jax.random.key(1), 2, TIME), jax.random.key(2)
    direction = random_like(state.lstm, jax.random.key(3))
    functions = [jax.jit(function) for function in frozen_losses(agent, state, window, key)]
    grad_pi, grad_v, grad_q = (slope(function, state.lstm, direction, by=2e-3) for function in functions)
    grad_critics, grad_actor, _ = jax.jit(agent.gradients)(state.lstm, state.lstm, state.controller, window, key)[0]
    assert min(abs(grad_pi), abs(grad_v), abs(grad_q)) > 1e-3
    assert along(grad_critics, direction) == pytest.approx(grad_v + grad_q, rel=0.02)
    assert along(grad_actor, direction) == pytest.approx(grad_pi, rel=0.02)


@pytest.mark.nightly
def test_the_target_lstm_is_what_the_target_value_reads(state):
    window, key = windows(jax.random.key(1), 2, TIME), jax.random.key(2)
    other = jax.tree.map(lambda leaf: leaf + 0.1, state.lstm)
    d = RECURRENT.beliefs(state.lstm, window)
    batch = RECURRENT.batch(window, d, d, RECURRENT.beliefs(other, window))
    np.testing.assert_array_equal(batch.belief, batch_of(RECURRENT, state.lstm, window).belief)
    np.testing.assert_array_equal(batch.next_belief, batch_of(RECURRENT, other, window).next_belief)
    gradients = jax.jit(RECURRENT.gradients)
    (grad_critics, grad_actor, _), _ = gradients(state.lstm, state.lstm, state.controller, window, key)
    (grad_critics_now, grad_actor_now, _), _ = gradients(state.lstm, other, state.controller, window, key)
    assert differ(grad_critics, grad_critics_now)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-8), grad_actor, grad_actor_now)


def test_no_gradient_goes_into_the_burn_in(state):
    """The weights by which the burn-in alone perceives the first input do not learn."""
    window, key = windows(jax.random.key(1), 2, TIME), jax.random.key(2)
    obs = window.step.obs.at[RECURRENT.burn_in :, :, 0].set(0.0)
    window = window._replace(step=window.step._replace(obs=obs))
    grad_critics, grad_actor, _ = jax.jit(RECURRENT.gradients)(state.lstm, state.lstm, state.controller, window, key)[0]
    for gradient in (grad_critics, grad_actor):
        np.testing.assert_array_equal(gradient.w_x[0], 0.0)
        assert np.all(gradient.w_x[1] != 0.0)


def test_an_update_trains_everything_and_the_targets_follow_slowly(state):
    agent, window = dataclasses.replace(RECURRENT, tau=0.25), windows(jax.random.key(1), 2, TIME)
    after, _ = jax.jit(agent.pretrain)(state, window, jax.random.key(2))
    assert differ(after.lstm, state.lstm)
    assert differ(after.controller._replace(target_value=0), state.controller._replace(target_value=1))
    for target, before, network in (
        (after.target_lstm, state.target_lstm, after.lstm),
        (after.controller.target_value, state.controller.target_value, after.controller.value),
    ):
        expected = jax.tree.map(lambda old, new: old + 0.25 * (new - old), before, network)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7), target, expected)


def test_the_critics_of_an_update_learn_from_the_target_lstm(state):
    window, update = windows(jax.random.key(1), 2, TIME), jax.jit(RECURRENT.update)
    other = state._replace(target_lstm=jax.tree.map(lambda leaf: leaf + 0.1, state.target_lstm))
    plain, changed = (update(each, window, jax.random.key(2))[1] for each in (state, other))
    assert plain["loss_q"] != changed["loss_q"]
    np.testing.assert_allclose(plain["loss_actor"], changed["loss_actor"], rtol=1e-6)


def test_the_lstm_learns_with_one_adam_for_the_critics_and_another_for_the_actor(state):
    window, adams = windows(jax.random.key(1), 2, TIME), [RECURRENT.lstm_optimiser.init(state.lstm)] * 2
    gradients, update, lstm = jax.jit(RECURRENT.gradients), jax.jit(RECURRENT.update), state.lstm
    step = jax.jit(RECURRENT.lstm_optimiser.update)
    for key in jax.random.split(jax.random.key(2)):
        found, _ = gradients(state.lstm, state.target_lstm, state.controller, window, key)
        for index in range(2):
            change, adams[index] = step(found[index], adams[index])
            lstm = jax.tree.map(jnp.add, lstm, change)
        state, _ = update(state, window, key)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), state.lstm, lstm)


def test_timesteps_that_do_not_exist_enter_no_loss(state):
    exists = jnp.ones((2, TIME), bool).at[:, 8:].set(False)
    results = changed_where_missing(RECURRENT, state, windows(jax.random.key(1), 2, TIME), exists)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), *results)


def test_it_perceives_what_its_options_name():
    step = windows(jax.random.key(1), 2, TIME).step
    obs, action, reward = step.obs, step.prev_action, step.reward[..., None]
    for more, parts in (
        ({}, [obs]),
        ({"perceive_action": True}, [obs, action]),
        ({"perceive_reward": True}, [obs, reward]),
        ({"perceive_action": True, "perceive_reward": True}, [obs, action, reward]),
    ):
        agent, expected = dataclasses.replace(RECURRENT, **more), jnp.concatenate(parts, axis=-1)
        state = jax.eval_shape(lambda key, agent=agent: agent.init(key, SPEC), jax.random.key(0))
        assert state.lstm.w_x.shape[0] == expected.shape[-1]
        np.testing.assert_array_equal(agent.perception(step), expected)


@pytest.mark.parametrize("wrong", [{"seq_len": 0}, {"burn_in": -1}, {"lr_lstm": 2.0}, {"pretrain_updates": -1}])
def test_impossible_hyperparameters_of_sac_lstm_are_refused(wrong):
    with pytest.raises(UserError, match=f"{next(iter(wrong))}="):
        SACLSTMAgent(**wrong)
