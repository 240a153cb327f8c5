"""Soft actor-critic with V (besides `test_golden`) and without: losses, masks, what each optimiser moves, the start."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from beliefrl.models import double_q
from beliefrl.models import soft_actor_critic as sac
from beliefrl.models.double_q import Policy, Samples, Unit
from beliefrl.models.nets import tanh_gaussian
from beliefrl.models.optimisation import Optimisers, init_optimisers, valid_mean
from beliefrl.models.soft_actor_critic import Actor, Batch
from beliefrl.types import Timestep

BELIEF, ACTION, ROWS = 5, 2, 6
RATES = {"actor": 0.25, "critic": 0.5, "alpha": 0.125}


@partial(jax.jit, static_argnames=("actor_size", "value_start"))
def init(key, **options):
    return sac.init_controller(key, BELIEF, ACTION, (4,), (3,), **options)


@pytest.fixture(scope="module")
def controller():
    controller = init(jax.random.key(0))
    return controller._replace(log_alpha=jnp.array(0.3), target_value=init(jax.random.key(1)).value)


@pytest.fixture(scope="module")
def batch():
    random = np.random.default_rng(0)
    return Batch(
        *(jnp.asarray(random.normal(size=(ROWS, size)), jnp.float32) for size in (BELIEF, BELIEF, ACTION)),
        reward=jnp.arange(float(ROWS)),
        terminated=jnp.array([False, True, False, False, True, False]),
        discount=jnp.full(ROWS, 0.5),
        valid=jnp.array([True, True, False, True, False, True]),
    )


NOISE = jnp.asarray(np.random.default_rng(1).normal(size=(ROWS, ACTION)), jnp.float32)
loss = jax.jit(jax.value_and_grad(sac.loss, has_aux=True), static_argnames=("regulariser", "target_entropy"))


def shapes(network):
    return [layer.weight.shape for layer in network.layers]


def test_a_controller_starts_with_its_target_at_the_value_and_its_temperature_at_one():
    start = init(jax.random.key(0))
    assert float(start.log_alpha) == 0
    jax.tree.map(np.testing.assert_array_equal, start.target_value, start.value)
    assert shapes(start.actor.mean) == shapes(start.actor.log_sigma) == [(4, BELIEF), (ACTION, 4)]
    assert [shapes(critic) for critic in start.critics] == [[(3, BELIEF + ACTION), (1, 3)]] * 2
    assert shapes(start.value) == [(3, BELIEF), (1, 3)]
    first, second = start.critics
    assert np.any(first.layers[0].weight != second.layers[0].weight)


def test_the_actors_input_has_a_size_of_its_own_and_values_a_start():
    plain, other = (init(jax.random.key(0), actor_size=9, value_start=start) for start in (0.0, 7.0))
    assert shapes(other.actor.mean) == shapes(other.actor.log_sigma) == [(4, 9), (ACTION, 4)]
    raised = (*other.critics, other.value, other.target_value)
    for high, low in zip(raised, (*plain.critics, plain.value, plain.target_value), strict=True):
        np.testing.assert_allclose(high.layers[-1].bias - low.layers[-1].bias, 7.0, rtol=1e-5)
        np.testing.assert_array_equal(high.layers[0].bias, low.layers[0].bias)


@pytest.mark.parametrize(("bias", "clipped"), [([-50.0, 50.0], [-20.0, 2.0]), ([-19.0, 1.5], [-19.0, 1.5])])
def test_log_sigma_is_clipped(controller, bias, clipped):
    where = lambda actor: (actor.log_sigma.layers[-1].weight, actor.log_sigma.layers[-1].bias)  # noqa: E731
    actor = eqx.tree_at(where, controller.actor, (jnp.zeros((ACTION, 4)), jnp.array(bias)))
    np.testing.assert_allclose(jax.jit(Actor.__call__)(actor, jnp.ones(BELIEF))[1], clipped)


def test_the_mean_counts_what_is_valid_and_is_zero_where_nothing_is():
    mean, x = jax.jit(valid_mean), jnp.array([1.0, jnp.nan, 4.0])
    assert float(mean(x, jnp.array([True, False, True]))) == 2.5
    assert float(mean(x, jnp.array([True, False, False]))) == 1.0
    assert float(mean(x, jnp.zeros(3, bool))) == 0.0


def test_rows_that_are_not_valid_and_values_after_a_terminal_timestep_enter_no_loss(controller, batch):
    valid, terminated = batch.valid[:, None], batch.terminated[:, None]
    other = batch._replace(
        belief=jnp.where(valid, batch.belief, 3.0),
        next_belief=jnp.where(valid & ~terminated, batch.next_belief, 3.0),
        action=jnp.where(valid, batch.action, 0.1),
        reward=jnp.where(batch.valid, batch.reward, 50.0),
    )
    results = [loss(controller, each, NOISE, regulariser=1e-3) for each in (batch, other)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), *results)
    later = batch._replace(next_belief=batch.next_belief.at[0].add(1.0))
    assert loss(controller, later, NOISE, regulariser=1e-3)[0][1]["loss_q"] != results[0][0][1]["loss_q"]


def test_the_losses_are_the_equations(controller, batch):
    """With V, V̄, Q and π from the networks, in plain numpy."""

    @jax.jit
    def parts():
        mean, log_sigma = jax.vmap(controller.actor)(batch.belief)
        action, log_prob = jax.vmap(tanh_gaussian)(mean, log_sigma, NOISE)
        q = [
            [jax.vmap(critic)(jnp.concatenate([batch.belief, a], 1))[:, 0] for critic in controller.critics]
            for a in (batch.action, action)
        ]
        values = [sac.state_value(controller.value, batch.belief)]
        return mean, log_sigma, log_prob, *q, *values, sac.state_value(controller.target_value, batch.next_belief)

    mean, log_sigma, log_prob, q, q_new, value, after = jax.tree.map(np.asarray, parts())
    rows, alpha, lowest = np.asarray(batch.valid), np.exp(0.3), np.minimum(*q_new)
    target = np.asarray(batch.reward) + 0.5 * np.where(batch.terminated, 0.0, after)
    size = np.mean(mean**2, 1) + np.mean(np.exp(2 * log_sigma), 1)
    j_pi = np.mean((alpha * log_prob - lowest + 0.5 * 0.1 * size)[rows])
    j_v = np.mean(0.5 * (value - (lowest - alpha * log_prob))[rows] ** 2)
    j_q = np.mean(sum(0.5 * (each - target) ** 2 for each in q)[rows])
    expected = {"loss_actor": j_pi, "loss_value": j_v, "loss_q": j_q, "alpha": alpha}
    expected |= {"entropy": -np.mean(log_prob[rows]), "q": np.mean(lowest[rows])}
    for target_entropy, wanted in ((None, -2.0), (1.5, 1.5)):
        (total, metrics), gradient = loss(controller, batch, NOISE, regulariser=0.1, target_entropy=target_entropy)
        assert {name: float(value) for name, value in metrics.items()} == pytest.approx(expected, rel=1e-4)
        j_alpha = -0.3 * np.mean(log_prob[rows] + wanted)
        assert float(total) == pytest.approx(j_pi + j_v + j_q + j_alpha, rel=1e-4)
        assert float(gradient.log_alpha) == pytest.approx(j_alpha / 0.3, rel=1e-4)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient.target_value))


def test_the_actor_reads_its_own_input_and_learns_from_no_belief_through_q(controller, batch):
    @jax.jit
    def slopes(belief, actor_input):
        def j_pi(belief, actor_input):
            given = batch._replace(belief=belief, actor_input=actor_input)
            return sac.actor_loss(controller.actor, controller, given, NOISE, 0.1)[0]

        return jax.value_and_grad(j_pi, (0, 1))(belief, actor_input)

    value, (by_belief, by_input) = slopes(batch.belief, batch.belief)
    assert float(value) == pytest.approx(float(loss(controller, batch, NOISE, regulariser=0.1)[0][1]["loss_actor"]))
    assert not np.any(by_belief)
    assert np.any(by_input)
    assert slopes(batch.belief, batch.belief + 1)[0] != value


def test_every_group_has_its_optimiser_and_the_target_follows_the_new_value(controller):
    optimisers = Optimisers(*(optax.sgd(RATES[name]) for name in Optimisers._fields))
    gradient = jax.tree.map(jnp.ones_like, controller)
    step = jax.jit(
        lambda: sac.update(optimisers, init_optimisers(optimisers, controller.trained), controller, gradient, 0.1)
    )
    after, _ = step()

    def moved(part, by):
        old, new = (getattr(each, part) for each in (controller, after))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a - b, by, rtol=1e-4), old, new)

    moved("actor", 0.25)
    moved("critics", 0.5)
    moved("value", 0.5)
    moved("log_alpha", 0.125)
    expected = jax.tree.map(lambda old, new: 0.9 * old + 0.1 * new, controller.target_value, after.value)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), after.target_value, expected)


# Without V (double_q): the equations against numpy, and the unit of returns.

COUNT = 12
KEY = jax.random.key(0)


def make(key=KEY, normalise=False, likelihood=0.0):
    sizes = BELIEF, ACTION, (8, 8), (8, 8)
    controller = jax.jit(lambda key: double_q.init_controller(key, *sizes, 0.1, normalise, likelihood > 0))(key)
    return controller._replace(unit=Unit(jnp.array(9.0), jnp.array(4.0)))


def random_batch(key=KEY):
    keys = jax.random.split(key, 3)
    return Samples(
        belief=jax.random.normal(keys[0], (COUNT, BELIEF)),
        action=jnp.tanh(jax.random.normal(keys[1], (COUNT, ACTION))),
        target=10 * jax.random.normal(keys[2], (COUNT,)),
        valid=jnp.arange(COUNT) % 4 != 1,
    )


def dense(network, x):
    """A perceptron with relu, in numpy."""
    for index, layer in enumerate(network.layers):
        x = (np.maximum(x, 0) if index else x) @ np.asarray(layer.weight).T + np.asarray(layer.bias)
    return x


def outputs(critic, belief, action):
    return dense(critic, np.concatenate([belief, action], axis=-1))


def q(critic, belief, action):
    return outputs(critic, belief, action)[:, 0]


def sigma(critic, belief, action):
    """σ, in units of u."""
    return np.sqrt(double_q.CRITIC_SIGMA_MIN**2 + np.exp(outputs(critic, belief, action)[:, 1]) ** 2)


def policy(actor, belief, noise):
    """ã and log π(ã|s) by the textbook's formula."""
    mean, log_sigma = np.split(dense(actor.network, np.asarray(belief)), 2, axis=-1)
    u = mean + np.exp(log_sigma) * noise
    normal = -0.5 * (noise**2 + np.log(2 * np.pi)) - log_sigma
    return np.tanh(u), np.sum(normal - np.log(1 - np.tanh(u) ** 2 + 1e-6), axis=-1), mean


def density(policy, action):
    """The density of the action before the tanh."""
    before, sigma = np.arctanh(action), np.exp(policy.log_sigma)
    return np.prod(np.exp(-0.5 * ((before - policy.mean) / sigma) ** 2) / sigma, axis=-1)


def q_low(one, two, pessimism):
    """The smaller value for a pessimism of 1, and the mean for 0."""
    return pessimism * np.minimum(one, two) + (1 - pessimism) * (one + two) / 2


def test_the_likeness_per_dimension_is_the_root_of_the_ratio():
    keys = jax.random.split(jax.random.key(0), 5)
    policies = [Policy(*0.3 * jax.random.normal(key, (2, 50, 3))) for key in keys[:2]]
    action = jnp.tanh(0.5 * jax.random.normal(keys[2], (50, 3)))
    whole, root = (np.asarray(double_q.likeness(*policies, action, each)) for each in (False, True))
    assert (whole < 1).any()
    assert (whole == 1).any()
    np.testing.assert_allclose(root, whole ** (1 / 3), rtol=1e-4)


@pytest.mark.parametrize(("pessimism", "likelihood"), [(1.0, 0.0), (0.25, 0.0), (0.25, 0.1)])
def test_targets_mix_the_values_of_the_target_networks_by_how_likely_the_actions_are(pessimism, likelihood):
    controller, key, time = make(likelihood=likelihood), jax.random.key(3), 4
    keys = jax.random.split(jax.random.key(5), 5)
    belief = jax.random.normal(keys[0], (time, 2, BELIEF))
    action = jnp.tanh(jax.random.normal(keys[1], (time, 2, ACTION)))
    first, terminated = jnp.zeros((time, 2), bool), jnp.zeros((time, 2), bool).at[-1, 0].set(True)
    step = Timestep(belief, jax.random.normal(keys[2], (time, 2)), action, first, terminated)
    behaviour = Policy(*(0.5 * jax.random.normal(key, (time, 2, ACTION)) for key in keys[3:]))
    valid = jnp.ones((time - 1, 2), bool)
    settings = double_q.Traces(0.9, decay=0.8, off_policy=0.25), pessimism
    made = jax.jit(lambda: double_q.critic_targets(controller, belief, step, valid, behaviour, key, *settings))
    y, like = map(np.asarray, made())

    flat = np.asarray(belief).reshape(-1, BELIEF)
    noise = np.asarray(jax.random.normal(key, (time * 2, ACTION)))
    sampled, _, _ = policy(controller.actor, flat, noise)
    value = 3 * q_low(*(q(critic, flat, sampled) for critic in controller.targets), pessimism).reshape(time, 2)  # u = 3
    now = Policy(*np.split(dense(controller.actor.network, np.asarray(belief)), 2, axis=-1))
    ahead = value[-1]
    for t in reversed(range(time - 1)):
        taken, before = np.asarray(action[t + 1]), jax.tree.map(lambda leaf, t=t: np.asarray(leaf[t]), (now, behaviour))
        expected = np.minimum(1, density(before[0], taken) / density(before[1], taken))
        np.testing.assert_allclose(like[t], expected, rtol=1e-3)
        expected_y = np.asarray(step.reward[t + 1]) + 0.9 * np.where(step.terminated[t + 1], 0, ahead)
        np.testing.assert_allclose(y[t], expected_y, rtol=1e-3, atol=1e-4)
        trace = 0.8 * (0.25 + 0.75 * expected)
        ahead = (1 - trace) * value[t] + trace * expected_y
    assert (like < 1).any()
    assert (like == 1).any()


def test_an_action_at_the_bound_has_a_finite_likeness():
    narrow, wide = (Policy(jnp.zeros(2), jnp.full(2, log_sigma)) for log_sigma in (-20.0, 2.0))
    action = jnp.array([1.0, -1.0])
    for policy, behaviour, expected in ((wide, wide, 1.0), (narrow, wide, 0.0), (wide, narrow, 1.0)):
        np.testing.assert_allclose(double_q.likeness(policy, behaviour, action), expected, atol=1e-6)


@pytest.mark.parametrize(("pessimism", "likelihood"), [(1.0, 0.0), (0.25, 0.0), (1.0, 0.1), (1.0, 10.0)])
def test_the_losses_are_their_formulas_over_valid_transitions(pessimism, likelihood):
    controller, data, key = make(likelihood=likelihood), random_batch(), jax.random.key(3)
    valid, y = np.asarray(data.valid), np.asarray(data.target / controller.unit.u)
    expected = 0.0
    for critic in controller.critics:
        error = 0.5 * (q(critic, data.belief, data.action) - y) ** 2
        if likelihood > 0:
            s = sigma(critic, data.belief, data.action)
            error = error + likelihood * (error / s**2 + np.log(s))
        expected += np.mean(error[valid])
    j_q = double_q.q_loss(controller.critics, data, controller.unit.u, likelihood)
    np.testing.assert_allclose(j_q, expected, rtol=1e-4)

    j_pi, (low, log_prob) = jax.jit(double_q.actor_loss, static_argnums=(4, 5))(
        controller.actor, controller, data, key, 0.2, pessimism
    )
    action, density, mean = policy(controller.actor, data.belief, np.asarray(jax.random.normal(key, (COUNT, ACTION))))
    values = q_low(*(q(critic, data.belief, action) for critic in controller.critics), pessimism)
    np.testing.assert_allclose(low, values, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(log_prob, density, rtol=1e-4, atol=1e-4)
    expected = 0.1 * density - values + 0.5 * 0.2 * np.mean(mean**2, axis=-1)
    np.testing.assert_allclose(j_pi, np.mean(expected[valid]), rtol=1e-4)


def test_an_error_counts_more_where_the_target_is_certain_and_never_less_than_a_squared_error():
    """The gradient of Q is (Q - y) (1 + w / σ²)."""
    output, y = jnp.array([[0.5, -1.0], [2.0, 9.0]]), jnp.array([1.0, -1.0])
    variance = double_q.CRITIC_SIGMA_MIN**2 + jnp.exp(2 * output[:, 1])
    for weight in (0.0, 0.1, 1.0):
        gradient = jax.grad(lambda output, weight=weight: double_q.q_error(output, y, weight).sum())(output)
        np.testing.assert_allclose(gradient[:, 0], (output[:, 0] - y) * (1 + weight / variance), rtol=1e-5)


def test_the_likelihood_is_highest_at_the_mean_and_the_deviation_of_the_targets():
    y = 2.0 + 0.5 * jax.random.normal(KEY, (4000,))

    @jax.jit
    def learned(output):
        def loss(output):
            return jnp.mean(double_q.q_error(jnp.broadcast_to(output, (y.size, 2)), y, 1.0))

        return jax.lax.fori_loop(0, 2000, lambda _, output: output - 0.05 * jax.grad(loss)(output), output)

    mean, log_sigma = learned(jnp.zeros(2))
    np.testing.assert_allclose([mean, jnp.exp(log_sigma)], [y.mean(), y.std()], rtol=1e-2)


@pytest.mark.parametrize("likelihood", [0.0, 0.1])
@pytest.mark.parametrize("normalise", [False, True])
def test_a_new_unit_leaves_every_q_as_it_is(normalise, likelihood):
    controller, data = make(normalise=normalise, likelihood=likelihood), random_batch()
    after = jax.jit(double_q.rescale)(controller, 100 * data.target, data.valid)
    assert after.unit.u > 2 * controller.unit.u
    for old, new in zip((*controller.critics, *controller.targets), (*after.critics, *after.targets), strict=True):
        before, now = (q(critic, data.belief, data.action) for critic in (old, new))
        np.testing.assert_allclose(float(after.unit.u) * now, float(controller.unit.u) * before, rtol=1e-4, atol=1e-4)
        if likelihood > 0:
            before, now = (np.exp(outputs(critic, data.belief, data.action)[:, 1]) for critic in (old, new))
            np.testing.assert_allclose(float(after.unit.u) * now, float(controller.unit.u) * before, rtol=1e-4)


def test_a_batch_without_valid_targets_does_not_change_the_unit():
    controller, data = make(), random_batch()
    after = jax.jit(double_q.rescale)(controller, data.target, jnp.zeros_like(data.valid))
    jax.tree.map(np.testing.assert_array_equal, after.unit, controller.unit)


def test_the_unit_is_the_root_mean_square_of_targets():
    controller, valid = make()._replace(unit=Unit(jnp.ones(()), jnp.zeros(()))), jnp.array([True, True, True, False])
    for y in ([1.0, 2.0, 2.0, 99.0], [3.0, 0.0, 0.0, 99.0]):
        controller = jax.jit(double_q.rescale)(controller, jnp.array(y), valid)
    np.testing.assert_allclose(controller.unit.u, np.sqrt(3.0), rtol=1e-3)  # of 1, 4, 4, 9, 0 and 0


def test_the_unit_follows_the_returns_after_any_number_of_batches():
    controller, y = make()._replace(unit=Unit(jnp.ones(()), jnp.array(1e6))), jnp.full(4, 10.0)
    after = jax.jit(double_q.rescale)(controller, y, jnp.ones(4, bool))
    np.testing.assert_allclose(after.unit.square, 1 + double_q.UNIT_RATE * (10**2 - 1), rtol=1e-6)


@pytest.mark.parametrize(("target_entropy", "wanted"), [(None, -ACTION), (1.5, 1.5)])
def test_the_temperature_falls_with_the_entropy_above_its_target(target_entropy, wanted):
    """Gradient descent on J_α with a rate of 1: log α rises by the mean of log π(ã|s) + H_target."""
    optimisers, controller, data = Optimisers(*(optax.sgd(rate) for rate in (0.1, 0.1, 1.0))), make(), random_batch()
    settings = {"tau": 0.1, "regulariser": 1e-3, "pessimism": 1.0, "likelihood": 0.0, "target_entropy": target_entropy}
    given = init_optimisers(optimisers, controller.trained), controller, data, KEY
    after, _, metrics = jax.jit(lambda: double_q.update(optimisers, *given, **settings))()
    _, log_prob, _ = policy(controller.actor, data.belief, np.asarray(jax.random.normal(KEY, (COUNT, ACTION))))
    mean = np.mean(log_prob[np.asarray(data.valid)])
    np.testing.assert_allclose(after.log_alpha, controller.log_alpha + mean + wanted, rtol=1e-4)
    np.testing.assert_allclose(metrics["entropy"], -mean, rtol=1e-4)


@pytest.mark.nightly
@pytest.mark.parametrize("likelihood", [0.0, 0.1])
@pytest.mark.parametrize("size", [0.01, 1000.0])
def test_what_is_learned_does_not_depend_on_the_size_of_rewards(size, likelihood):
    """Rewards of any size give the same actor, once u is known."""
    optimisers, data = Optimisers(*(optax.adam(1e-2) for _ in range(3))), random_batch()

    @jax.jit
    def learn(controller, data):
        state = init_optimisers(optimisers, controller.trained)
        for number in range(5):
            key = jax.random.key(number)
            settings = {"tau": 0.1, "regulariser": 1e-3, "pessimism": 1.0, "likelihood": likelihood}
            controller, state, _ = double_q.update(optimisers, state, controller, data, key, **settings)
        return controller

    plain = make(likelihood=likelihood)._replace(unit=Unit(jnp.array(25.0), jnp.array(1e6)))
    scaled = plain._replace(unit=Unit(jnp.array(25.0) * size**2, jnp.array(1e6)))
    actors = learn(plain, data).actor, learn(scaled, data._replace(target=size * data.target)).actor
    for a, b in zip(*map(jax.tree.leaves, actors), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)


@pytest.mark.parametrize("likelihood", [0.0, 0.1])
def test_an_update_moves_the_targets_by_tau_and_ignores_what_is_not_valid(likelihood):
    optimisers, controller = Optimisers(*(optax.adam(1e-2) for _ in range(3))), make(likelihood=likelihood)
    data = random_batch()
    other = jax.tree.map(
        lambda a, b: jnp.where(data.valid.reshape(-1, *[1] * (a.ndim - 1)), a, b), data, random_batch(jax.random.key(7))
    )
    other = other._replace(valid=data.valid)

    @jax.jit
    def update(data):
        settings = {"tau": 0.25, "regulariser": 1e-3, "pessimism": 1.0, "likelihood": likelihood}
        state = init_optimisers(optimisers, controller.trained)
        return double_q.update(optimisers, state, controller, data, KEY, **settings)[0]

    after, same = update(data), update(other)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    ratio = controller.unit.u / after.unit.u
    old, new, target = (c[0].layers[-1].weight[0] for c in (controller.targets, after.critics, after.targets))
    np.testing.assert_allclose(target, ratio * old + 0.25 * (new - ratio * old), rtol=1e-4, atol=1e-6)
