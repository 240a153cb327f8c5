"""The four ablations of VRM: which models there are, which of them learn when; and tiny worlds that VRM must learn."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import agents, catalogue
from beliefrl.models.window_loss import model_loss
from beliefrl.training import phases
from beliefrl.types import Spec, perception
from inputs import SMALL, SPEC, along, random_like, same, slope, windows
from worlds import Counting

MODELS = {"vrm": "first keep", "vrm-single": "keep", "vrm-first": "first", "vrm-keep": "keep"}


def made(name):
    """A small agent, its state, and its windows with the notes it would have made."""
    agent = agents.make(name, **SMALL)
    state = jax.jit(lambda key: agent.init(key, SPEC))(jax.random.key(0))
    window = windows(jax.random.key(1), agent.cycle_windows, 11)
    notes = jax.vmap(jax.vmap(lambda _: agent.note(agent.reset(SPEC))))(window.exists)
    return agent, state, window._replace(note=notes)


@pytest.mark.nightly
@pytest.mark.parametrize("name", MODELS)
def test_it_has_its_models_and_each_learns_in_its_time(name):
    agent, state, window = made(name)
    there = MODELS[name].split()
    assert [part for part in ("first", "keep") if getattr(state, part) is not None] == there
    assert state.controller.value.layers[0].weight.shape[1] == len(there) * 8 + 4
    assert (agent.pretrain_updates > 0) == (name != "vrm-keep")

    if agent.pretrain_updates:
        part = jax.tree.map(lambda leaf: leaf[:, :2], window)
        after, metrics = jax.jit(agent.pretrain)(state, part, jax.random.key(2))
        learned = [part for part in ("first", "keep") if not same(getattr(after, part), getattr(state, part))]
        assert learned == there[:1]
        assert metrics["negative_elbo"]
    after, batches, metrics = jax.jit(agent.begin_cycle)(state, window, jax.random.key(2))
    assert same(after.first, state.first)
    assert ("keep" in there) == (not same(after.keep, state.keep)) == bool(metrics)
    assert batches.belief.shape == (5, 12, len(there) * 8 + 4)
    updated, _ = jax.jit(agent.update)(after, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(3))
    assert same((updated.first, updated.keep), (after.first, after.keep))


@pytest.mark.parametrize("name", ["vrm-single", "vrm-first"])
@pytest.mark.slow
def test_acting_forms_the_belief_that_replay_forms(name):
    agent, state, window = made(name)
    agent = dataclasses.replace(agent, store_first_impression=False, deterministic=True)
    state = jax.jit(lambda key: agent.init(key, SPEC))(jax.random.key(0))
    windowed = jax.tree.map(lambda leaf: leaf[:, :10], window)._replace(note=())
    batch = jax.jit(agent.batches)(state, windowed, jax.random.key(2))
    memory, act = agent.reset(SPEC), jax.jit(agent.act)
    for t in range(11):
        step = jax.tree.map(lambda leaf, t=t: leaf[t, 0], windowed.step)
        _, memory = act(state, memory, step, jax.random.key(t), jnp.array(True))
        if t == agent.burn_in:
            d = (memory.first or memory.keep).d
            np.testing.assert_allclose(batch.belief[0, 0, :8], d, rtol=1e-5, atol=1e-6)


@pytest.fixture(scope="module")
def deterministic():
    return made("vrm-deterministic")


def test_a_deterministic_model_predicts_before_it_sees(deterministic):
    """z_t and the prediction of x_t come from d_{t-1} and a_{t-1}; x_t enters d_t. No key changes anything."""
    _, state, window = deterministic
    changed = window.step._replace(obs=window.step.obs.at[5].add(1.0))

    @jax.jit
    def infer(step, key):
        vrm = state.keep
        noise = jax.random.normal(key, (*step.reward.shape, 4))
        return vrm.infer(vrm.start(noise.shape[1]), perception(step), step.prev_action, step.is_first, noise)

    one, other = infer(window.step, jax.random.key(1)), infer(changed, jax.random.key(2))
    np.testing.assert_allclose(one.z[:6], other.z[:6], rtol=1e-6)
    np.testing.assert_allclose(one.state.d[:5], other.state.d[:5], rtol=1e-6)
    assert not np.allclose(one.state.d[5], other.state.d[5])
    assert not np.allclose(one.z[6], other.z[6])


def test_a_deterministic_models_loss_is_its_mean_squared_error(deterministic):
    agent, state, window = deterministic
    window = jax.tree.map(lambda leaf: leaf[:, :2], window)
    vrm, step = state.keep, window.between(0, -1).step

    @jax.jit
    def predicted():
        noise = jnp.zeros((10, 2, 4))
        inferred = vrm.infer(vrm.start(2), perception(step), step.prev_action, step.is_first, noise)
        return jax.vmap(jax.vmap(vrm.decode))(inferred.before, inferred.z).mean

    error = np.mean((np.asarray(predicted()) - np.asarray(perception(step)))[4:] ** 2)
    loss, metrics = jax.jit(lambda: model_loss(vrm, window, jax.random.key(2), agent.burn_in))()
    assert float(loss) == pytest.approx(error, rel=1e-5)
    assert set(metrics) == {"prediction_error"}


@pytest.mark.slow
def test_a_deterministic_models_gradient_agrees_with_finite_differences(deterministic):
    _, state, window = deterministic
    window = jax.tree.map(lambda leaf: leaf[:, :2], window)
    loss = jax.jit(lambda vrm: model_loss(vrm, window, jax.random.key(2), burn_in=0)[0])
    direction = random_like(state.keep, jax.random.key(3))
    gradient = jax.jit(jax.grad(loss))(state.keep)
    assert along(gradient, direction) == pytest.approx(slope(loss, state.keep, direction, by=3e-3), rel=0.03)


def test_names_find_their_agents_and_agents_their_names():
    for name in catalogue.agent_names():
        agent = agents.make(name, gamma=0.5)
        assert agents.name_of(agent) == name
        assert agents.make(name, **dataclasses.asdict(agent)) == agent
    assert agents.name_of(agents.make("vrm", models="single")) == "vrm-single"


# Tiny worlds with known values: what VRM must learn before anything else; two cannot be solved without memory.

LEARNING = {
    "step_start_rl": 100,
    "train_times_fivrm": 300,
    "seq_len": 8,
    "burn_in": 8,
    "batch_size": 8,
    "d_size": 16,
    "z_size": 4,
    "hidden_size": 16,
    "policy_layers": (32,),
    "value_layers": (32,),
    "lr_actor": 3e-3,
    "lr_critic": 3e-3,
    "lr_model": 3e-3,
    "tau": 0.05,
}
GREEDY = {"lr_alpha": 0.05, "target_entropy": -100.0}  # the temperature falls to nothing: values are plain returns

REMEMBERING = {
    "train_times_fivrm": 2000,
    "lr_model": 1e-3,
    "lr_alpha": 3e-3,
    "d_size": 32,
    "hidden_size": 32,
    "policy_layers": (64, 64),
    "value_layers": (64, 64),
}


@dataclasses.dataclass(frozen=True)
class Constant(Counting):
    """Pays 1 a step whatever is done, and shows nothing."""

    def step(self, state, action, key):
        state, obs, _, terminated = super().step(state, action, key)
        return state, jnp.zeros_like(obs), jnp.array(1.0), terminated


@dataclasses.dataclass(frozen=True)
class Recall:
    """Shows a sign once, in the first observation or as the first step's reward; pays action x sign at the last step.

    The terminal observation shows the sign again: a model that predicts has a reason to remember.
    """

    shown_in: str
    delay: int = 2

    @property
    def spec(self):
        return Spec(obs_dim=2, action_dim=1, max_steps=self.delay + 1)

    def observation(self, sign, time):
        shown = jnp.where(((time == 0) & (self.shown_in == "obs")) | (time > self.delay), sign, 0.0)
        return jnp.stack([shown, (time == self.delay).astype(float)])

    def reset(self, key) -> tuple[Any, Any]:
        sign = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
        return (sign, jnp.array(0)), self.observation(sign, jnp.array(0))

    def step(self, state, action, key):
        sign, time = state
        shown = jnp.where((time == 0) & (self.shown_in == "reward"), sign, 0.0)
        reward = jnp.where(time == self.delay, action[0] * sign, shown)
        return (sign, time + 1), self.observation(sign, time + 1), reward, time == self.delay


def learn(task, steps, seeds=1, **hyperparameters):
    """Train a small VRM; returns the last stretch's metrics and the mode actions' mean return."""
    agent = agents.make("vrm", **(LEARNING | hyperparameters))
    program = phases.compile_program(agent, task, capacity=2 * steps, episodes=32)
    keys = jax.random.split(jax.random.key(0), seeds)
    seeds, step = program.begin(keys), agent.step_start_rl
    seeds, _ = program.explore(seeds, 0, step)
    seeds, _ = program.pretrain(seeds, 0, agent.pretrain_updates)
    seeds = program.refresh(seeds)
    while step < steps:
        seeds, stretch = program.learn(seeds, step, 20)
        step += 100
    return stretch.metrics, np.asarray(program.evaluate(seeds.state, keys).episode_return)[:, 1].mean()


@pytest.mark.slow
def test_beyond_a_termination_there_is_no_value():
    metrics, _ = learn(Constant(ends=1), 800, gamma=0.5, **GREEDY)
    assert float(metrics["q"][0]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_beyond_a_time_limit_there_is_value():
    """1 + 0.5 + 0.25 + ... = 2, although no episode has more than 2 steps."""
    metrics, _ = learn(Constant(max_steps=2), 800, gamma=0.5, **GREEDY)
    assert float(metrics["q"][0]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(
    "shown_in", [pytest.param("obs", marks=pytest.mark.nightly), pytest.param("reward", marks=pytest.mark.slow)]
)
def test_what_was_shown_once_is_remembered(shown_in):
    """Without memory the best mean return is 0, with it nearly 1."""
    _, total = learn(Recall(shown_in), 2000, **REMEMBERING)
    assert total > 0.8
