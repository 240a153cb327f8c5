import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.training import replay as ring
from beliefrl.training import rollout
from worlds import Counting, CountingAgent

AGENT = CountingAgent()
STATE = AGENT.init(jax.random.key(0), Counting().spec)


def advanced(task, steps, key=0):
    """The replay after some steps, as numpy, and what the steps reported of episodes."""

    def step(carry, key):
        actor, replay, episode = rollout.advance(AGENT, task, STATE, *carry, key)
        return (actor, replay), episode

    @jax.jit
    def run(key_begin, key_steps):
        actor = rollout.begin(AGENT, task, key_begin)
        replay = ring.init(rollout.stored(AGENT, actor), 3 * steps)
        return jax.lax.scan(step, (actor, replay), jax.random.split(key_steps, steps))

    (actor, replay), episodes = run(jax.random.key(key), jax.random.key(key + 1))
    timesteps = jax.tree.map(lambda leaf: np.asarray(leaf)[: int(replay.added)], replay.timesteps)
    return timesteps, jax.tree.map(np.asarray, episodes), actor


def test_a_truncated_episode_keeps_its_last_observation_and_is_not_terminal():
    timesteps, episodes, _ = advanced(Counting(max_steps=7), 21)
    np.testing.assert_array_equal(timesteps.step.obs[:, 0], [*range(8)] * 3)
    np.testing.assert_array_equal(timesteps.step.is_first, timesteps.step.obs[:, 0] == 0)
    assert not timesteps.step.terminated.any()
    np.testing.assert_array_equal(np.flatnonzero(episodes.done), [6, 13, 20])


def test_a_terminated_episode_marks_its_last_observation_only():
    timesteps, episodes, _ = advanced(Counting(ends=4), 12)
    np.testing.assert_array_equal(timesteps.step.obs[:, 0], [*range(5)] * 3)
    np.testing.assert_array_equal(timesteps.step.terminated, timesteps.step.obs[:, 0] == 4)
    np.testing.assert_array_equal(episodes.length[episodes.done], 4)
    np.testing.assert_array_equal(episodes.episode_return[episodes.done], 1 + 2 + 3 + 4)


def test_termination_at_the_time_limit_is_termination():
    timesteps, _, _ = advanced(Counting(ends=7, max_steps=7), 14)
    np.testing.assert_array_equal(timesteps.step.terminated, timesteps.step.obs[:, 0] == 7)


def test_the_current_timestep_is_not_in_the_replay_yet():
    timesteps, _, actor = advanced(Counting(), 5)
    np.testing.assert_array_equal(timesteps.step.obs[:, 0], range(5))
    assert float(actor.step.obs[0]) == 5


def test_first_timesteps_carry_no_reward_and_no_action():
    timesteps, _, _ = advanced(Counting(), 21)
    first = timesteps.step.is_first
    assert not timesteps.step.reward[first].any()
    assert not timesteps.step.prev_action[first].any()
    assert timesteps.step.prev_action[~first].all()


def test_actions_are_sampled_in_training():
    timesteps, _, _ = advanced(Counting(), 21)
    actions = timesteps.step.prev_action[~timesteps.step.is_first]
    assert len(np.unique(actions)) == len(actions)  # the agent's mode is 0.5


def test_memory_counts_unbroken_through_every_episode():
    timesteps, _, _ = advanced(Counting(ends=5), 23)
    np.testing.assert_array_equal(timesteps.note[0], timesteps.step.obs[:, 0])


def test_success_is_reported_where_the_episode_ends():
    for ends, success in ((4, False), (6, True)):
        _, episodes, _ = advanced(Counting(ends=ends), 12)
        np.testing.assert_array_equal(episodes.measures["success"][episodes.done], success)


@pytest.mark.parametrize("steps", [10, 14])
def test_a_refresh_restores_notes_and_memory(steps):
    timesteps, _, actor = advanced(Counting(), steps)
    replay = ring.init(rollout.stored(AGENT, actor), 64)
    blank = jax.tree.map(lambda ring, new: ring.at[: new.shape[0]].set(new), replay.timesteps, timesteps)
    blank = blank._replace(note=jax.tree.map(lambda note: note * 0 - 9, blank.note))
    replay = ring.Replay(blank, jnp.array(timesteps.step.reward.shape[0]))
    spec = Counting().spec
    again, replay = jax.jit(lambda a, r: rollout.refresh(AGENT, spec, STATE, a, r, jax.random.key(1), 20))(
        actor, replay
    )
    np.testing.assert_array_equal(replay.timesteps.note[0][: len(timesteps.note[0])], timesteps.note[0])
    assert float(again.memory) == float(actor.memory)


def test_evaluation_plays_whole_episodes_and_stops_counting_at_their_end():
    explore = jnp.array([True, True, False])
    for task, total, length in ((Counting(), 28, 7), (Counting(ends=4), 10, 4)):
        result = jax.jit(lambda key, task=task: rollout.evaluate(AGENT, task, STATE, key, explore))(jax.random.key(0))
        assert result.done.all()
        np.testing.assert_array_equal(result.episode_return, total)
        np.testing.assert_array_equal(result.length, length)
        np.testing.assert_array_equal(result.measures["success"], length >= 5)


class Alternating(Counting):
    """Pays the action, by turns added and subtracted."""

    def step(self, state, action, key):
        state, obs, _, terminated = super().step(state, action, key)
        return state, obs, jnp.where(state % 2 == 0, action[0], -action[0]), terminated


def test_evaluation_draws_each_sampled_action_anew():
    explore = jnp.array([True, True, False])
    result = jax.jit(lambda key: rollout.evaluate(AGENT, Alternating(ends=2), STATE, key, explore))(jax.random.key(0))
    one, other, mode = np.asarray(result.episode_return)
    assert len({one, other, mode}) == 3
    assert mode == 0
