"""A trained policy: it acts like the agent, in numpy; its export runs with jax alone."""

import inspect
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import beliefrl
from beliefrl import agents, tasks
from beliefrl.errors import UserError
from beliefrl.policy import Policy
from beliefrl.runs.run import Run
from beliefrl.tasks import make
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.interface import Interface
from beliefrl.tasks.spaces import scale
from beliefrl.training import rollout
from worlds import TINY, begun, saved, tiny
from wrong import Fine

TASK = tasks.make("pendulum-p", max_steps=4)


def a_state(name):
    """A small agent, and one of its states."""
    return tiny(name), begun(name, TASK.spec, jax.random.key(0))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "slac" else ()) for name in TINY]
)
def test_it_acts_as_the_agent_does_through_episodes(name):
    """Two episodes in one batch, one of which restarts while the other continues: mode actions at every step."""
    agent, state = a_state(name)
    policy = Policy(agent, TASK.spec, state)
    move = jax.jit(lambda actor: rollout.move(agent, TASK, state, actor, jax.random.key(1), jnp.array(False)))
    actors = [rollout.begin(agent, TASK, jax.random.key(k)) for k in (1, 2)]
    memory = None
    for t in range(5):
        if t == 3:
            actors[1] = rollout.begin(agent, TASK, jax.random.key(3))
        steps = [actor.step for actor in actors]
        parts = ("obs", "reward", "is_first")
        obs, reward, first = (np.stack([getattr(step, part) for step in steps]) for part in parts)
        # the reward is ignored at the start of an episode
        action, memory = policy.predict(obs, np.where(first, 7.0, reward), memory, first)
        actors = [move(actor)[0] for actor in actors]
        np.testing.assert_allclose(action, np.stack([actor.step.prev_action for actor in actors]), rtol=1e-5, atol=1e-6)


def test_one_episode_is_a_batch_of_one():
    policy = Policy(*_with_spec("vrm"))
    alone, state = policy.predict([0.1, 0.2])
    together, _ = policy.predict([[0.1, 0.2]])
    assert alone.shape == (1,)
    np.testing.assert_array_equal(alone, together[0])
    again, _ = policy.predict([0.3, 0.1], -1.0, state)
    fresh, _ = policy.predict([0.3, 0.1], -1.0)
    assert not np.allclose(again, fresh)


def _with_spec(name):
    agent, state = a_state(name)
    return agent, TASK.spec, state


@pytest.mark.parametrize("obs", [[0.1, 0.2], [[0.1, 0.2], [0.3, 0.4]]])
def test_an_action_may_be_changed_in_place(obs):
    policy = Policy(*_with_spec("vrm"))
    action, state = policy.predict(obs)
    kept = tuple(part.copy() for part in state)
    action *= 2.0
    changed, _ = policy.predict(obs, -1.0, state)
    np.testing.assert_array_equal(changed, policy.predict(obs, -1.0, kept)[0])
    state[-1][:] = 0.0  # the state may be changed, too
    assert not np.array_equal(policy.predict(obs, -1.0, state)[0], changed)


def test_bools_are_numbers_as_in_a_training():
    policy = Policy(*_with_spec("vrm"))
    action, state = policy.predict([True, False])
    np.testing.assert_array_equal(action, policy.predict([1.0, 0.0])[0])
    for reached in (True, np.bool_(True)):
        action, _ = policy.predict(np.array([False, True]), reached, state)
        np.testing.assert_array_equal(action, policy.predict([0.0, 1.0], 1.0, state)[0])


def test_samples_differ_and_come_back_with_their_seed():
    drawn = {}
    for seed in (1, 1, 2):
        policy = Policy(*_with_spec("sac-mlp"), seed)
        actions = np.stack([policy.predict(np.zeros((3, 2)), deterministic=False)[0] for _ in range(2)])
        assert len(np.unique(actions)) == 6
        np.testing.assert_array_equal(drawn.setdefault(seed, actions), actions)
    assert not np.array_equal(drawn[1], drawn[2])


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"obs": np.zeros(3)}, r"obs has the shape \(3,\): it must be \(2,\) or \(batch, 2\)"),
        ({"obs": np.zeros((2, 2)), "reward": np.zeros(3)}, r"reward has the shape \(3,\)"),
        ({"obs": np.zeros((2, 2)), "episode_start": [True]}, r"episode_start has the shape \(1,\)"),
        ({"obs": np.zeros((2, 2)), "state": (np.zeros((1, 1)),)}, "state is not one of this policy for 2 episodes"),
        ({"obs": [0.0, 0.0], "state": "abc"}, "state is not one of this policy for 1 episode: give the second result"),
        ({"obs": [0.0, 0.0], "state": (np.full((1, 1), np.nan, np.float32),)}, "state holds a number that is not"),
        ({"obs": "abc"}, "obs must be real numbers, not 'abc'"),
        ({"obs": [0.0, None]}, "entry 1 of obs is None: give finite numbers"),
        ({"obs": [[0.0, 0.0], [None, 0.0]]}, "entry 0 of obs of episode 1 is None"),
        ({"obs": np.array([0.0, 0.0], object)}, "obs must be real numbers, not array"),
        ({"obs": None}, "obs is None"),
        ({"obs": np.zeros((0, 2))}, "obs has no episodes"),
        ({"obs": np.zeros((2, 2)), "reward": [True, False]}, r"reward must be real numbers, not \[True, False\]"),
        ({"obs": True}, r"obs has the shape \(\): it must be"),
        ({"obs": [0.0, 0.0], "state": True}, "state is not one of this policy for 1 episode"),
        ({"obs": [0.0, 0.0], "state": 1.0}, "state is not one of this policy for 1 episode"),
        ({"obs": [1j, 0.0]}, "obs must be real numbers"),
        ({"obs": [[0.0, 0.0], [0.0]]}, "obs must be real numbers"),
        ({"obs": [0.0, 0.0], "reward": "1"}, "reward must be real numbers, not '1'"),
        ({"obs": [0.0, 0.0], "reward": (np.zeros((1, 1)), np.zeros((1, 2)))}, "reward must be real numbers"),
        ({"obs": (np.zeros((1, 8)), np.zeros((1, 9)), np.zeros((1, 9)))}, r"obs must be real numbers, not \("),
        ({"obs": [0.0, 0.0], "episode_start": [[1, 0], [1]]}, r"episode_start must be True or False, not \[\[1, 0"),
        ({"obs": [0.0, 0.0], "episode_start": "no"}, "episode_start must be True or False, not 'no'"),
        ({"obs": [0.0, 0.0], "deterministic": 2}, "deterministic must be True or False, not 2"),
    ],
)
def test_wrong_shapes_and_types_are_one_sentence(wrong, sentence):
    with pytest.raises(UserError, match=sentence):
        Policy(*_with_spec("sac-mlp")).predict(**wrong)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"obs": [0.1, np.nan]}, "entry 1 of obs is nan: give finite numbers"),
        ({"obs": [1e39, 0.1]}, r"entry 0 of obs is 1e\+39: give finite numbers"),
        ({"obs": [0.1, 0.2], "reward": np.nan}, "reward is nan: give"),
        ({"obs": [[0.1, 0.2], [0.1, -np.inf]]}, "entry 1 of obs of episode 1 is -inf"),
        ({"obs": [[0.1, 0.2]] * 2, "reward": [0.0, np.nan]}, "reward of episode 1 is nan"),
    ],
)
def test_numbers_that_are_not_finite_are_named_and_the_state_is_as_good_as_before(wrong, sentence):
    policy, same = Policy(*_with_spec("vrm")), Policy(*_with_spec("vrm"))
    obs = np.full_like(wrong["obs"], 0.3)
    states = [each.predict(obs)[1] for each in (policy, same)]
    with pytest.raises(UserError, match=sentence):
        policy.predict(state=states[0], **wrong)
    after = [
        each.predict(obs, -1.0, state, deterministic=False)[0]
        for each, state in zip((policy, same), states, strict=True)
    ]
    np.testing.assert_array_equal(*after)


def test_an_action_that_would_not_be_finite_is_an_error():
    agent, state = a_state("sac-mlp")
    state = jax.tree.map(lambda leaf: leaf * 1e6 if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, state)
    policy = Policy(agent, TASK.spec, state)
    assert np.isfinite(policy.predict([[0.1, 0.2], [-0.1, 0.3]])[0]).all()
    with pytest.raises(UserError, match="obs or reward of episode 1 is too large for this policy"):
        policy.predict([[0.1, 0.2], [3e38, 3e38]])


@pytest.mark.parametrize("batch", [0, -1, 1.5, "two"])
def test_a_batch_is_a_whole_number(batch):
    with pytest.raises(UserError, match="is impossible: it must be a whole number of at least 1"):
        inspect.unwrap(Policy.initial_state)(Policy(*_with_spec("sac-mlp")), batch)


def test_a_reward_is_ignored_where_an_episode_begins():
    policy = Policy(*_with_spec("vrm"))
    np.testing.assert_array_equal(policy.predict([0.1, 0.2], np.nan)[0], policy.predict([0.1, 0.2])[0])


def test_what_a_policy_is_shows():
    agent, state = a_state("sac-mlp")
    assert repr(Policy(agent, TASK.spec, state, 3, task="pendulum-p")) == (
        "<Policy sac-mlp on pendulum-p: observation (2,), action (1,), seed 3>"
    )


@pytest.mark.parametrize("wrong", [None, 123])
def test_what_is_no_path_is_no_run(wrong):
    with pytest.raises(UserError, match=f"{wrong} is not a run: give a run, or the path of its folder"):
        inspect.unwrap(Run.__init__)(Run.__new__(Run), wrong)  # in tests types are checked before it is called


def test_an_export_that_cannot_be_written_is_one_sentence(tmp_path):
    policy = Policy(*_with_spec("sac-mlp"))
    with pytest.raises(UserError, match=r"policy.jax cannot be written \(there is no folder .*missing\)"):
        policy.export(tmp_path / "missing" / "policy.jax")
    with pytest.raises(UserError, match=r"cannot be written \(it is a folder\)"):
        policy.export("")


ALONE = """
import pathlib, sys
import jax, jax.export, numpy as np
policy = jax.export.deserialize(pathlib.Path(sys.argv[1]).read_bytes())
(obs, reward, *state, start, seed, mode) = policy.in_avals
state = tuple(np.zeros((2, *part.shape[1:]), part.dtype) for part in state)
for first in (True, False):
    inputs = np.full((2, 2), 0.3, np.float32), np.full(2, -1.0, np.float32), state, np.full(2, first)
    action, state = policy.call(*inputs, np.uint32(0), np.bool_(True))
    print(*np.asarray(action).ravel())
assert "beliefrl" not in sys.modules
"""


@pytest.mark.parametrize(
    "name", [pytest.param("vrm", marks=pytest.mark.slow), pytest.param("slac", marks=pytest.mark.nightly)]
)
def test_the_export_acts_the_same_with_jax_alone(name, tmp_path):
    policy = Policy(*_with_spec(name))
    policy.export(tmp_path / "policy.jax")
    command = [sys.executable, "-c", ALONE, tmp_path / "policy.jax"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    obs, state = np.full((2, 2), 0.3), None
    for line in done.stdout.splitlines():
        action, state = policy.predict(obs, -1.0, state)
        np.testing.assert_allclose(np.array(line.split(), float), action.ravel(), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_a_runs_policy_is_loaded_by_its_seed(tmp_path):
    options = {"steps": 12, "seeds": 2, "seed": 4, "eval_every": 12, "eval_episodes": 1}
    agent = agents.make("sac-mlp", policy_layers=(8,), value_layers=(8,), step_start_rl=10, pretrain_updates=0)
    run = beliefrl.train(agent, TASK, tmp_path / "run", **options)
    first, second = (beliefrl.load(run, seed).predict([0.1, 0.2])[0] for seed in (4, 5))
    assert first != second
    np.testing.assert_array_equal(beliefrl.load(tmp_path / "run").predict([0.1, 0.2])[0], first)
    with pytest.raises(UserError, match="has no seed 6: it has 4, 5"):
        beliefrl.load(run, 6)


def test_actions_are_scaled_to_the_bounds_of_the_environment(tmp_path):
    task = GymnasiumTask(Fine)  # its action is in [-2, 6]
    run = saved(tmp_path / "run", "sac-mlp", task)
    policy = beliefrl.load(run, task=task)
    np.testing.assert_allclose(policy.scale([[-1.0], [0.0], [0.5], [3.0]]), [[-2.0], [2.0], [4.0], [6.0]])
    np.testing.assert_allclose(policy.scale(np.array([-0.5])), [0.0])
    for wrong in ([0.1, 0.2], 0.1, [np.nan]):
        with pytest.raises(UserError, match="action"):
            policy.scale(wrong)
    with pytest.raises(UserError, match=r"a task in JAX has none, its actions are in \[-1, 1\]"):
        beliefrl.load(saved(tmp_path / "other", "sac-mlp", make("pendulum"))).scale([0.0])


@pytest.mark.parametrize(("bound", "kind"), [(0.3, np.float32), (0.3, np.float64), (1.0, np.float64)])
def test_a_scaled_action_is_one_of_the_environments_actions(bound, kind):
    space = spaces.Box(-bound, bound, (2,), kind)
    interface = Interface(("angle",), space.low.tolist(), space.high.tolist())
    policy = Policy(*_with_spec("sac-mlp"), interface=interface)
    for action in ([-1.0, 1.0], [1.0, -1.0], [0.3, -0.7]):
        scaled = policy.scale(action)
        assert space.contains(scaled)
        np.testing.assert_allclose(scaled, scale(space, np.array(action)), rtol=1e-6)
