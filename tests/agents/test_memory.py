"""Whoever runs an episode gives the agent an empty memory at its first timestep, even where that is not zeros."""

import dataclasses
import pathlib

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.policy import Policy
from beliefrl.tasks.environment import TaskEnvironment
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import host_loop, phases
from beliefrl.viewing.episodes import Player
from worlds import Counting, CountingAgent

ENDS = 4


@dataclasses.dataclass(frozen=True)
class Paying(Counting):
    """Pays what is done."""

    def step(self, state, action, key):
        state, obs, _, terminated = super().step(state, action, key)
        return state, obs, action[0], terminated


@dataclasses.dataclass(frozen=True)
class Checking(CountingAgent):
    """Does 1 where its memory is the count of this episode, else -1; looks at is_first nowhere."""

    def act(self, state, memory, step, key, explore):
        right = memory == self.empty + step.obs[0]
        return jnp.where(right, 1.0, -1.0)[None], memory + 1


AGENT, TASK = Checking(), Paying(ends=ENDS)
STATE = AGENT.init(jax.random.key(0), TASK.spec)
HOSTED = GymnasiumTask(TaskEnvironment, "paying", {"task": TASK}, max_steps=TASK.max_steps)
KEYS = jax.random.split(jax.random.key(0), 2)


@pytest.fixture(params=["compiled", "host"])
def program(request):
    if request.param == "compiled":
        yield phases.compile_program(AGENT, TASK, 60, 3)
    else:
        program = host_loop.program(AGENT, HOSTED, 60, 3, range(2), "never")
        yield program
        program.close()


def test_in_training_after_it_was_refreshed_and_in_evaluation(program):
    seeds = program.begin(KEYS)
    seeds, explored = program.explore(seeds, 0, 10)  # ends within an episode
    seeds = program.refresh(seeds)
    seeds, learned = program.learn(seeds, 10, 5)
    for episodes in (explored.episodes, learned.episodes):
        done = np.asarray(episodes.done)
        assert done.sum() >= 4
        np.testing.assert_array_equal(np.asarray(episodes.episode_return)[done], ENDS)
    result = program.evaluate(seeds.state, KEYS)
    np.testing.assert_array_equal(result.episode_return, np.full((2, 2, 3), ENDS))


def counts(policy, arguments):
    """The actions of two episodes of three timesteps each."""
    state, actions = policy.initial_state(1), []
    for time in (0, 1, 2, 0, 1, 2):
        obs, reward = np.full((1, 1), time, np.float32), np.zeros(1, np.float32)
        action, state = arguments(obs, reward, state, np.array([time == 0]))
        actions.append(float(action[0, 0]))
    return actions


def test_in_a_policy_and_in_its_export(tmp_path):
    policy = Policy(AGENT, TASK.spec, STATE)
    assert counts(policy, policy.predict) == [1.0] * 6
    policy.export(tmp_path / "policy.jax")
    exported = jax.export.deserialize(pathlib.Path(tmp_path / "policy.jax").read_bytes())
    assert counts(policy, lambda *inputs: exported.call(*inputs, np.uint32(0), np.bool_(True))) == [1.0] * 6


@pytest.mark.parametrize("task", [TASK, HOSTED], ids=["compiled", "host"])
def test_in_episodes_that_are_shown(task):
    with Player(AGENT, task, STATE) as player:
        assert [player.play(seed).total for seed in range(2)] == [ENDS, ENDS]
