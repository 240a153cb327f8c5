"""SAC-MLP: the golden update through its own windows, and what counts nowhere."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.moments import SPEC, differ, windows
from beliefrl.agents.sac_mlp import SACMLPAgent
from beliefrl.types import Step, UserError, Window

GOLDEN = pathlib.Path(__file__).parents[1] / "golden" / "sac.npz"
AGENT = SACMLPAgent(policy_layers=(8, 8), value_layers=(8, 8), batch_size=6)


@pytest.fixture(scope="module")
def state():
    return jax.jit(lambda key: AGENT.init(key, SPEC))(jax.random.key(0))


def test_its_transitions_are_those_of_the_golden_update():
    """The authors' numbers as windows of two moments come out as the transitions that `test_golden` learns from."""
    numbers = dict(np.load(GOLDEN))
    moments = [numbers["belief"], numbers["next_belief"]]
    rows, actions = len(numbers["reward"]), numbers["action"].shape[-1]
    step = Step(
        obs=jnp.stack(moments, axis=1),
        reward=jnp.stack([jnp.zeros(rows), numbers["reward"]], axis=1),
        prev_action=jnp.stack([jnp.zeros((rows, actions)), numbers["action"]], axis=1),
        is_first=jnp.zeros((rows, 2), bool).at[:, 0].set(True),
        terminated=jnp.stack([jnp.zeros(rows, bool), numbers["terminated"] > 0], axis=1),
    )
    batch = AGENT.batch(Window(step, (), jnp.ones((rows, 2), bool)))
    for name in ("belief", "next_belief", "action", "reward", "terminated"):
        np.testing.assert_array_equal(getattr(batch, name), numbers[name])
    assert batch.valid.all()


def test_pairs_across_episodes_enter_no_loss(state):
    is_first = jnp.zeros((6, 2), bool).at[:, 0].set(True).at[2, 1].set(True)
    update = jax.jit(AGENT.pretrain)
    one = windows(jax.random.key(1), 6, 2, is_first)
    other = jax.tree.map(lambda leaf: leaf.at[2].set(leaf[3]) if leaf.dtype != bool else leaf, one)
    results = [update(state, window, jax.random.key(2)) for window in (one, other)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), *results)
    assert not np.allclose(one.step.obs[2], other.step.obs[2])


def test_pretraining_is_an_update_of_the_controller(state):
    window = windows(jax.random.key(1), 6, 2)
    after, _ = jax.jit(AGENT.pretrain)(state, window, jax.random.key(2))
    begun, batches, metrics = jax.jit(AGENT.begin_cycle)(state, window, jax.random.key(7))
    again, _ = jax.jit(AGENT.update)(begun, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(2))
    assert metrics == {}
    assert differ(after.controller, state.controller)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), after, again)


@pytest.mark.parametrize("wrong", [{"batch_size": 0}, {"pretrain_updates": -1}, {"gamma": 2.0}, {"policy_layers": ()}])
def test_impossible_hyperparameters_are_refused(wrong):
    with pytest.raises(UserError, match=f"{next(iter(wrong))}="):
        SACMLPAgent(**wrong)
