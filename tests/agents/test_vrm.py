"""VRM: its tables, its gradients' reach, its beliefs in time."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import agents
from beliefrl.agents.vrm import VRMAgent
from beliefrl.errors import UserError
from beliefrl.models.scales import initial_statistics, standardise
from beliefrl.models.variational_model import VRM
from beliefrl.models.window_loss import draw_noise, model_loss, states
from beliefrl.types import Timestep, Window, perception
from inputs import SMALL, SPEC, differ, same

AGENT = VRMAgent(**SMALL)


@pytest.fixture(scope="module")
def state():
    return jax.jit(lambda key: AGENT.init(key, SPEC))(jax.random.key(0))


def windows(key, batch, is_first=None, exists=None):
    """Random windows of the small agent's length, with random notes."""
    time = AGENT.burn_in + AGENT.seq_len + 1
    keys = jax.random.split(key, 4)
    none = jnp.zeros((batch, time), bool)
    step = Timestep(
        jax.random.normal(keys[0], (batch, time, SPEC.obs_dim)),
        jax.random.normal(keys[1], (batch, time)),
        jnp.tanh(jax.random.normal(keys[2], (batch, time, SPEC.action_dim))),
        none.at[:, 0].set(True) if is_first is None else is_first,
        none,
    )
    note = (jax.random.normal(keys[3], (batch, time, AGENT.d_size)),)
    window = Window(step, note, ~none if exists is None else exists)
    return jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), window)


def test_the_defaults_are_the_papers_tables():
    table = {
        "gamma": 0.99,
        "step_start_rl": 1000,
        "train_interval_rl": 1,
        "lr_actor": 0.0003,
        "lr_critic": 0.0003,
        "lr_alpha": 0.0003,
        "target_entropy": None,
        "tau": 0.005,
        "policy_layers": (256, 256),
        "value_layers": (256, 256),
        "train_times_fivrm": 5000,
        "train_interval_klvrm": 5,
        "lr_model": 0.0008,
        "seq_len": 64,
        "batch_size": 4,
        "burn_in": 64,
        "d_size": 256,
        "z_size": 64,
    }
    settings = dataclasses.asdict(VRMAgent())
    assert {name: settings[name] for name in table} == table


@pytest.mark.parametrize(
    "wrong",
    [
        {"gamma": 1.5},
        {"tau": -0.1},
        {"seq_len": 0},
        {"lr_model": float("nan")},
        {"policy_layers": ()},
        {"value_layers": (8, 0)},
        {"train_interval_rl": 3},
        {"no_such_thing": 1},
    ],
)
def test_impossible_hyperparameters_are_refused_by_name(wrong):
    with pytest.raises(UserError, match=next(iter(wrong))):
        agents.make("vrm", **wrong)


@pytest.mark.parametrize(
    ("wrong", "choices"),
    [
        ({"elbo_scaling": "median"}, "mean or sum"),
        ({"decode_from": "x"}, "posterior or prior"),
        ({"models": "three"}, "both or single or first or keep"),
    ],
)
def test_a_choice_that_there_is_not_is_refused_with_those_there_are(wrong, choices, unchecked):
    ((name, value),) = wrong.items()
    for make in (VRMAgent, functools.partial(agents.make, "vrm")):
        with pytest.raises(UserError, match=f"^{name}='{value}' is impossible: it must be {choices}"):
            make(**wrong)


def test_the_controllers_gradient_never_reaches_the_models(state):
    after, batches, _ = jax.jit(AGENT.begin_cycle)(state, windows(jax.random.key(1), 12), jax.random.key(2))
    updated, _ = jax.jit(AGENT.update)(after, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(3))
    assert same(updated.first, after.first)
    assert same(updated.keep, after.keep)
    assert differ(updated.controller, after.controller)


def test_a_cycle_trains_the_keep_learning_model_alone(state):
    after, _, _ = jax.jit(AGENT.begin_cycle)(state, windows(jax.random.key(1), 12), jax.random.key(2))
    assert same(after.first, state.first)
    assert same(after.controller, state.controller)
    assert differ(after.keep, state.keep)


@pytest.mark.slow
def test_pretraining_trains_the_first_impression_model_alone(state):
    after, _ = jax.jit(AGENT.pretrain)(state, windows(jax.random.key(1), 2), jax.random.key(2))
    assert differ(after.first, state.first)
    assert same((after.keep, after.controller), (state.keep, state.controller))


@jax.jit
def infer(vrm, window, noise):
    step = window.step
    return vrm.infer(vrm.start(noise.shape[1]), perception(step), step.prev_action, step.is_first, noise)


def test_an_episode_inside_a_window_begins_with_an_empty_memory(state):
    window = windows(jax.random.key(1), 1)
    two = window._replace(step=window.step._replace(is_first=window.step.is_first.at[5, 0].set(True)))
    noise = jax.random.normal(jax.random.key(2), (11, 1, AGENT.z_size))
    whole = infer(state.keep, two, noise)
    second = infer(state.keep, jax.tree.map(lambda leaf: leaf[5:], two), noise[5:])
    np.testing.assert_allclose(whole.state.d[5:], second.state.d, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(whole.before[5], 0)
    assert not np.allclose(infer(state.keep, window, noise).state.d[5], whole.state.d[5])


def test_the_burn_in_and_the_sequence_are_one_unroll(state):
    window = windows(jax.random.key(1), 3)
    noise = jax.random.normal(jax.random.key(2), (11, 3, AGENT.z_size))
    whole = infer(state.keep, window, noise)
    start = jax.tree.map(lambda leaf: leaf[3], whole.state)
    step = window.between(4, None).step
    rest = jax.jit(VRM.infer)(state.keep, start, perception(step), step.prev_action, step.is_first, noise[4:])
    np.testing.assert_allclose(rest.state.d, whole.state.d[4:], rtol=1e-5, atol=1e-6)


def test_no_gradient_goes_into_the_burn_in(state):
    """The weights by which the burn-in alone perceives the first input do not learn."""
    window = windows(jax.random.key(1), 2)
    obs = window.step.obs.at[AGENT.burn_in :, :, 0].set(0.0)
    window = window._replace(step=window.step._replace(obs=obs))
    gradient = jax.jit(jax.grad(lambda vrm: model_loss(vrm, window, jax.random.key(2), AGENT.burn_in)[0]))(state.keep)
    weight = gradient.features.layers[0].weight
    np.testing.assert_array_equal(weight[:, 0], 0.0)
    assert np.all(weight[:, 1] != 0.0)


def test_acting_forms_the_belief_that_replay_forms(state):
    """One timestep after the other as in acting, and all at once as in the replay: the same d, with the same z."""
    window = windows(jax.random.key(1), 1)
    at_once = infer(state.keep, window, jnp.zeros((11, 1, AGENT.z_size)))
    memory, mode, act = AGENT.reset(SPEC), jnp.array(False), jax.jit(AGENT.act)
    for t in range(11):
        step = jax.tree.map(lambda leaf, t=t: leaf[t, 0], window.step)
        _, memory = act(state, memory, step, jax.random.key(t), mode)
        np.testing.assert_allclose(memory.keep.d, at_once.state.d[t, 0], rtol=1e-5, atol=1e-6)


def test_mode_actions_are_deterministic_and_samples_are_not(state):
    step = jax.tree.map(lambda leaf: leaf[0, 0], windows(jax.random.key(1), 1).step)
    act = jax.jit(AGENT.act)
    actions = {
        mode: [act(state, AGENT.reset(SPEC), step, jax.random.key(k), jnp.array(mode))[0] for k in (1, 2)]
        for mode in (False, True)
    }
    np.testing.assert_array_equal(*actions[False])
    assert differ(*actions[True])


def test_batches_are_aligned_in_time(state):
    """Transition t: belief of t, action and reward that came with t+1, belief of t+1."""
    window = windows(jax.random.key(1), 10)
    batch = jax.jit(AGENT.batches)(state, window, jax.random.key(2))
    assert batch.belief.shape == (5, 12, 2 * AGENT.d_size + 4)
    for update, t, sequence in ((0, 0, 0), (3, 2, 1), (4, 5, 1)):
        row, source, now = t * 2 + sequence, update * 2 + sequence, AGENT.burn_in + t
        picked = jax.tree.map(lambda leaf, update=update, row=row: leaf[update, row], batch)
        step = jax.tree.map(lambda leaf, source=source: leaf[:, source], window.step)
        np.testing.assert_array_equal(picked.belief[: AGENT.d_size], window.note[0][now, source])
        np.testing.assert_array_equal(picked.next_belief[: AGENT.d_size], window.note[0][now + 1, source])
        np.testing.assert_array_equal(picked.belief[-4:], [*step.obs[now], step.reward[now]])
        np.testing.assert_array_equal(picked.next_belief[-4:], [*step.obs[now + 1], step.reward[now + 1]])
        np.testing.assert_array_equal(picked.action, step.prev_action[now + 1])
        assert picked.reward == step.reward[now + 1]


@pytest.mark.slow
def test_timesteps_that_do_not_exist_enter_no_loss(state):
    exists = jnp.ones((12, 11), bool).at[:, 8:].set(False)
    here = windows(jax.random.key(1), 12, exists=exists)
    other = windows(jax.random.key(9), 12, exists=exists)
    exists = exists.T
    there = jax.tree.map(lambda a, b: jnp.where(exists.reshape(exists.shape + (1,) * (a.ndim - 2)), a, b), here, other)
    results = []
    for window in (here, there):
        after, batches, metrics = jax.jit(AGENT.begin_cycle)(state, window, jax.random.key(2))
        for number in range(2):
            after, more = jax.jit(AGENT.update)(
                after, jax.tree.map(lambda leaf, number=number: leaf[number], batches), jax.random.key(number)
            )
            metrics |= more
        results.append((after, metrics))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), *results)


@pytest.mark.slow
def test_a_recomputed_first_impression_is_the_stored_one_up_to_its_sample(state):
    """With notes that the model itself made, both ways of forming beliefs agree on everything but the draw of z."""
    recompute = dataclasses.replace(AGENT, store_first_impression=False)
    window = windows(jax.random.key(1), 10)
    key_first, _ = jax.random.split(jax.random.key(2))
    d_first = jax.jit(states)(state.first, window, draw_noise(key_first, window, AGENT.z_size)).d
    stored = jax.jit(AGENT.batches)(state, window._replace(note=(d_first,)), jax.random.key(2))
    again = jax.jit(recompute.batches)(state, window._replace(note=()), jax.random.key(2))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), stored, again)


def test_beliefs_of_means_are_without_noise_where_it_acts_and_where_it_learns(state):
    window = windows(jax.random.key(1), 10)
    agents = [dataclasses.replace(AGENT, store_first_impression=False, sample_belief=each) for each in (False, True)]
    mean, sampled = ([jax.jit(a.batches)(state, window, jax.random.key(k)).belief for k in (2, 3)] for a in agents)
    np.testing.assert_array_equal(*mean)
    assert differ(*sampled)
    memory, act = AGENT.reset(SPEC), jax.jit(agents[0].act)
    for t in range(AGENT.burn_in + 1):  # until the belief of the first transition
        step = jax.tree.map(lambda leaf, t=t: leaf[t, 0], window.step)
        _, memory = act(state, memory, step, jax.random.key(t), jnp.array(True))
    belief = jnp.concatenate([memory.first.d, memory.keep.d])
    np.testing.assert_allclose(belief, mean[0][0, 0, : 2 * AGENT.d_size], rtol=1e-5, atol=1e-6)
    assert differ(*(act(state, memory, step, jax.random.key(k), jnp.array(True))[0] for k in (1, 2)))  # still samples


def test_a_burn_in_from_stored_states_continues_them(state):
    """With states that the model itself made, beliefs are those of the whole episode."""
    agent = dataclasses.replace(AGENT, store_state=True, sample_belief=False)
    whole, begin = windows(jax.random.key(1), 12), 2
    made = jax.jit(states)(state.keep, whole, agent.belief_noise(jax.random.key(0), whole))
    window = whole._replace(note=(*whole.note, *made)).between(begin, None)
    short = dataclasses.replace(agent, burn_in=agent.burn_in - begin)
    from_zero = dataclasses.replace(short, store_state=False)
    kept = slice(agent.d_size, 2 * agent.d_size)
    stored, zero, true = (
        jax.jit(each.batches)(state, given, jax.random.key(2)).belief[..., kept]
        for each, given in (
            (short, window),
            (from_zero, window),
            (dataclasses.replace(agent, store_state=False), whole),
        )
    )
    np.testing.assert_allclose(stored, true, rtol=1e-5, atol=1e-6)
    assert differ(zero, true)

    changed = window._replace(note=(*window.note[:1], *(leaf + 1 for leaf in window.note[1:])))
    losses = [
        jax.jit(short.begin_cycle)(state, each, jax.random.key(2))[2]["negative_elbo"] for each in (window, changed)
    ]
    assert differ(*losses)  # the model learns from them as well


def test_stored_states_are_those_after_acting(state):
    agent = dataclasses.replace(AGENT, store_state=True)
    step = jax.tree.map(lambda leaf: leaf[0, 0], windows(jax.random.key(1), 1).step)
    _, memory = jax.jit(agent.act)(state, agent.reset(SPEC), step, jax.random.key(2), jnp.array(True))
    assert same(agent.note(memory), (memory.first.d, memory.keep.d, memory.keep.c))


@pytest.mark.parametrize("options", [{"burn_in": 0}, {"models": "first"}])
def test_stored_states_need_a_burn_in_and_a_keep_learning_model(options):
    with pytest.raises(UserError, match="store_state=True is impossible"):
        VRMAgent(store_state=True, **options)


@pytest.mark.nightly
def test_standardised_beliefs_are_what_the_controller_learns_from_and_acts_on(state):
    agent, window = dataclasses.replace(AGENT, standardise=True), windows(jax.random.key(1), 12)
    fresh = state._replace(scale=initial_statistics(2 * AGENT.d_size + SPEC.obs_dim + 1))
    after, batches, _ = jax.jit(agent.begin_cycle)(fresh, window, jax.random.key(2))
    plain, others, _ = jax.jit(AGENT.begin_cycle)(state, window, jax.random.key(2))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), after._replace(scale=None), plain)
    np.testing.assert_allclose(batches.belief, standardise(after.scale, others.belief), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(batches.next_belief, standardise(after.scale, others.next_belief), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(jnp.mean(batches.belief, (0, 1)), 0, atol=1e-4)  # of the one batch that was seen
    step, mode = jax.tree.map(lambda leaf: leaf[0, 0], window.step), jnp.array(False)
    action, memory = jax.jit(agent.act)(after, agent.reset(SPEC), step, jax.random.key(3), mode)
    belief = standardise(after.scale, jnp.concatenate([memory.first.d, memory.keep.d, step.obs, step.reward[None]]))
    np.testing.assert_allclose(action, agent.choose(after.controller.actor(belief), jax.random.key(3), mode), rtol=1e-5)


@pytest.mark.slow
def test_decoding_from_the_prior_and_sums_are_other_losses(state):
    window = windows(jax.random.key(1), 2)
    loss = {
        options: jax.jit(
            lambda options=options: model_loss(
                state.keep, window, jax.random.key(2), AGENT.burn_in, decode_from=options[0], scaling=options[1]
            )
        )()[1]
        for options in (("posterior", "mean"), ("prior", "mean"), ("posterior", "sum"))
    }
    mean, prior, total = loss.values()
    assert float(prior["kl"]) == pytest.approx(float(mean["kl"]), rel=1e-5)
    assert float(prior["log_likelihood"]) != pytest.approx(float(mean["log_likelihood"]), rel=1e-3)
    assert float(total["kl"]) == pytest.approx(float(mean["kl"]) * AGENT.z_size, rel=1e-4)
    assert float(total["log_likelihood"]) == pytest.approx(float(mean["log_likelihood"]) * 4, rel=1e-4)
