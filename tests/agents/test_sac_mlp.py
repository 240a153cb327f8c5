"""SAC-MLP: the golden update through its own windows, and what counts nowhere."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.random_windows import SPEC, differ, windows
from beliefrl.agents.sac_mlp import SACMLPAgent
from beliefrl.types import Timestep, UserError, Window

GOLDEN = pathlib.Path(__file__).parents[1] / "models" / "golden" / "sac.npz"
AGENT = SACMLPAgent(policy_layers=(8, 8), value_layers=(8, 8), batch_size=6)
STANDARDISED = dataclasses.replace(AGENT, standardise=True)


def begun(agent):
    return jax.jit(lambda key: agent.init(key, SPEC))(jax.random.key(0))


@pytest.fixture(scope="module")
def state():
    return begun(AGENT)


def test_its_transitions_are_those_of_the_golden_update():
    """The authors' numbers as windows of two timesteps come out as the transitions that `test_golden` learns from."""
    numbers = dict(np.load(GOLDEN))
    timesteps = [numbers["belief"], numbers["next_belief"]]
    rows, actions = len(numbers["reward"]), numbers["action"].shape[-1]
    step = Timestep(
        obs=jnp.stack(timesteps, axis=1),
        reward=jnp.stack([jnp.zeros(rows), numbers["reward"]], axis=1),
        prev_action=jnp.stack([jnp.zeros((rows, actions)), numbers["action"]], axis=1),
        is_first=jnp.zeros((rows, 2), bool).at[:, 0].set(True),
        terminated=jnp.stack([jnp.zeros(rows, bool), numbers["terminated"] > 0], axis=1),
    )
    window = jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), Window(step, (), jnp.ones((rows, 2), bool)))
    batch = jax.jit(AGENT.batch)(window)
    for name in ("belief", "next_belief", "action", "reward", "terminated"):
        np.testing.assert_array_equal(getattr(batch, name), numbers[name])
    assert batch.valid.all()


def test_pairs_across_episodes_enter_no_loss(state):
    is_first = jnp.zeros((6, 2), bool).at[:, 0].set(True).at[2, 1].set(True)
    update = jax.jit(AGENT.pretrain)
    one = windows(jax.random.key(1), 6, 2, is_first)
    other = jax.tree.map(lambda leaf: leaf.at[:, 2].set(leaf[:, 3]) if leaf.dtype != bool else leaf, one)
    results = [update(state, window, jax.random.key(2)) for window in (one, other)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), *results)
    assert not np.allclose(one.step.obs[:, 2], other.step.obs[:, 2])


@pytest.mark.parametrize("agent", [AGENT, pytest.param(STANDARDISED, marks=pytest.mark.nightly)])
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
    raw = jax.jit(AGENT.act)(after._replace(scale=None), (), step, jax.random.key(3), jnp.array(False))[0]
    assert np.abs(raw - actions[0]).max() > 0.05


WRONG = [
    *({"batch_size": 0}, {"batch_size": True}, {"pretrain_updates": -1}, {"gamma": 2.0}),
    *({"policy_layers": ()}, {"policy_layers": 64}, {"policy_layers": [64, 64]}),
]


@pytest.mark.parametrize("wrong", WRONG)
def test_impossible_hyperparameters_are_refused(wrong, unchecked):
    with pytest.raises(UserError, match=f"{next(iter(wrong))}="):
        SACMLPAgent(**wrong)
