"""The replay: its windows, draws and notes. The rollout: the timesteps that it adds, episodes, evaluation."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beliefrl import agents
from beliefrl.errors import UserError
from beliefrl.models import reading
from beliefrl.training import replay as ring
from beliefrl.training import rollout
from beliefrl.types import StoredTimestep, Timestep, WindowShape, transitions
from worlds import Alternating, Counting, CountingAgent


def timestep(number, is_first):
    """A timestep that carries its own running number everywhere."""
    value = jnp.asarray(number, float)
    step = Timestep(value[None], value, value[None], jnp.asarray(is_first), jnp.array(False))
    return StoredTimestep(step, (value,))


@jax.jit
def fill(replay, numbers, firsts, keep):
    def add(replay, inputs):
        number, first, keep = inputs
        return ring.add(replay, timestep(number, first), keep), None

    return jax.lax.scan(add, replay, (numbers, firsts, keep))[0]


def filled(capacity, firsts, keep=None):
    """A ring after these timesteps; the rest up to 40 is masked, so that one program serves every length."""
    keep = np.ones(len(firsts), bool) if keep is None else keep
    firsts, keep = (np.pad(np.asarray(flags, bool), (0, 40 - len(flags))) for flags in (firsts, keep))
    return fill(empty(capacity), np.arange(40), firsts, keep)


@functools.cache
def empty(capacity):
    return ring.init(timestep(0, False), capacity)


sample = jax.jit(ring.sample, static_argnums=(2, 3))


@settings(deadline=None, max_examples=25)
@given(
    st.lists(st.booleans(), min_size=2, max_size=40),
    st.sampled_from([5, 16, 64]),
    st.sampled_from([WindowShape(0, 3), WindowShape(4, 6), WindowShape(7, 20)]),
)
def test_windows_are_the_newest_timesteps_in_order(firsts, capacity, shape):
    replay = filled(capacity, firsts)
    stored = np.arange(len(firsts))[-capacity:]
    window = sample(replay, jax.random.key(0), 8, shape)
    numbers, exists = np.array(window.note[0]).T, np.array(window.exists).T
    for row, there, is_first in zip(numbers, exists, np.array(window.step.is_first).T, strict=True):
        seen = row[there].astype(int)
        assert len(seen) > 0
        np.testing.assert_array_equal(np.diff(seen), 1)
        assert set(seen) <= set(stored)
        expected = np.array([firsts[n] or n == stored[0] for n in seen])
        np.testing.assert_array_equal(is_first[there], expected)


@settings(deadline=None, max_examples=15)
@given(st.lists(st.booleans(), min_size=3, max_size=30), st.sampled_from([8, 64]))
def test_exactly_the_transitions_within_episodes_can_be_drawn(firsts, capacity):
    shape = WindowShape(3, 5)
    replay = filled(capacity, firsts)
    stored = range(max(len(firsts) - capacity, 0), len(firsts))
    expected = {n for n in stored[:-1] if not firsts[n + 1]}
    window = sample(replay, jax.random.key(1), 600, shape)
    valid = np.array(transitions(window, shape.burn_in))
    now = np.array(window.note[0])[shape.burn_in : -1]
    assert set(now[valid].astype(int)) == expected


def test_a_masked_addition_leaves_the_ring_alone():
    keep = np.arange(20) % 3 != 0
    replay = filled(64, np.zeros(20, bool), keep)
    assert int(replay.added) == keep.sum()
    np.testing.assert_array_equal(replay.timesteps.note[0][: keep.sum()], np.arange(20)[keep])


def test_an_addition_is_masked_only_where_asked():
    assert int(jax.jit(ring.add)(empty(8), timestep(1, False)).added) == 1


@pytest.mark.parametrize("least", [None, 1])
def test_starts_are_uniform(least):
    shape, count = WindowShape(2, 4, least=least), 30
    window = sample(filled(64, np.zeros(count, bool)), jax.random.key(2), 20_000, shape)
    starts = np.array(window.note[0])[shape.burn_in].astype(int)
    drawn = np.bincount(starts, minlength=count)
    possible = count - (least or shape.length)
    assert set(np.flatnonzero(drawn)) == set(range(possible))
    assert np.abs(drawn[:possible] / drawn.sum() * possible - 1).max() < 0.2


def test_the_newest_transition_is_drawn_also_for_returns_of_several_steps():
    shape = agents.make("sac-mlp", n_step=5).window
    window = sample(filled(64, np.zeros(30, bool)), jax.random.key(2), 5_000, shape)
    assert set(np.array(window.note[0])[0].astype(int)) == set(range(29))


def test_history_and_annotate_address_the_first_timesteps():
    replay = filled(64, [True, False, False, True, False])
    steps, exists = ring.history(replay, 8)
    np.testing.assert_array_equal(exists, np.arange(8) < 5)
    np.testing.assert_array_equal(steps.reward[:5], np.arange(5))
    replay = ring.annotate(replay, (jnp.arange(8.0) * 10,), 8)
    np.testing.assert_array_equal(replay.timesteps.note[0][:5], np.arange(5) * 10)
    np.testing.assert_array_equal(replay.timesteps.step.reward[:5], np.arange(5))


# The rollout.

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


def test_evaluation_draws_each_sampled_action_anew():
    explore = jnp.array([True, True, False])
    result = jax.jit(lambda key: rollout.evaluate(AGENT, Alternating(ends=2), STATE, key, explore))(jax.random.key(0))
    one, other, mode = np.asarray(result.episode_return)
    assert len({one, other, mode}) == 3
    assert mode == 0


SHAPE = WindowShape(0, 4, readers=6, jump=0.0)  # two of six readers at a time


@functools.partial(jax.jit, static_argnums=(3,))
def read(replay, readers, key, shape=SHAPE):
    return ring.read(replay, readers, key, 2, shape)


def begun(replay, key=0, shape=SHAPE):
    """The readers after each has read its first window, and these windows."""
    readers, windows = ring.init_readers(shape), []
    for number in range(3):
        window, readers = read(replay, readers, jax.random.key(key + number), shape)
        windows.append(window)
    return readers, windows


def numbers(window):
    """The running numbers of the timesteps of windows, (batch, time)."""
    return np.asarray(window.note[0]).T.astype(int)


def test_readers_take_turns_and_first_jump_to_random_places():
    readers, windows = begun(filled(64, np.zeros(40, bool)))
    assert [w.reading.reader.tolist() for w in windows] == [[0, 1], [2, 3], [4, 5]]
    assert not any(w.reading.continues.any() for w in windows)
    assert len({row[0] for w in windows for row in numbers(w)}) > 3
    assert int(readers.turn) == 0


def test_a_reader_continues_with_the_last_timestep_of_its_window_until_too_little_follows():
    replay = filled(64, np.arange(40) % 7 == 0)
    readers, windows = begun(replay)
    last, continued = np.concatenate([numbers(w)[:, -1] for w in windows]), 0
    for turn in range(30):
        window, readers = read(replay, readers, jax.random.key(100 + turn))
        rows, reader = numbers(window), np.asarray(window.reading.reader)
        possible = last[reader] + SHAPE.length < 40
        np.testing.assert_array_equal(window.reading.continues, possible)
        np.testing.assert_array_equal(rows[possible, 0], last[reader][possible])
        np.testing.assert_array_equal(np.diff(rows), 1)
        np.testing.assert_array_equal(np.asarray(window.step.is_first).T, rows % 7 == 0)
        assert window.exists.all()
        last[reader], continued = rows[:, -1], continued + possible.sum()
    assert continued > 30


def test_a_reader_jumps_from_timesteps_that_were_replaced():
    readers, _ = begun(filled(16, np.zeros(16, bool)))
    readers = readers._replace(number=jnp.array([7, 8, 9, 0, 11, 3]))
    later = filled(16, np.zeros(24, bool))  # has the last 16
    for number in range(3):
        before = readers.number[2 * number : 2 * number + 2]
        window, readers = read(later, readers, jax.random.key(number))
        np.testing.assert_array_equal(window.reading.continues, before >= 8)
        assert (numbers(window) >= 8).all()


def test_readers_stay_at_their_timesteps_when_these_are_numbered_anew():
    """As when a training with a full ring is resumed with a larger one."""
    full = filled(16, np.zeros(24, bool))  # has the last 16 of 24
    kept = ring.gather(full, jnp.arange(8, 24))
    pad = functools.partial(jax.tree.map, lambda leaf: jnp.concatenate([leaf, jnp.zeros_like(leaf)]))
    larger = ring.Replay(pad(kept), jnp.array(16))
    readers = ring.init_readers(SHAPE)._replace(number=jnp.array([7, 8, 12, 19, 20, ring.NOWHERE]))
    moved = ring.renumbered(readers, jnp.array(8))
    for number in range(3):
        (window, readers), (again, moved) = (
            read(*pair, jax.random.key(number)) for pair in ((full, readers), (larger, moved))
        )
        expected = [[False, True], [True, True], [False, False]][number]
        np.testing.assert_array_equal(window.reading.continues, expected)
        jax.tree.map(np.testing.assert_array_equal, window, again)
    np.testing.assert_array_equal(moved.number, readers.number - 8)


def test_after_a_jump_another_window_follows():
    """If a ring has two windows; else the reader jumps to its oldest timestep."""
    for count, most in ((40, 40 - 1 - 2 * SHAPE.length), (8, 0), (6, 0)):
        replay, found = filled(64, np.zeros(count, bool)), set()
        for key in range(40):
            window, _ = read(replay, ring.init_readers(SHAPE), jax.random.key(key))
            found |= set(numbers(window)[:, 0].tolist())
        assert max(found) <= most
        assert len(found) > most // 2


@pytest.mark.parametrize("count", [3, 5, 6, 8, 9, 12, 13, 16])
def test_readers_learn_from_every_transition_of_a_short_ring(count):
    replay = filled(64, np.arange(count) == 0)
    readers, known = ring.init_readers(SHAPE), set()
    for key in range(60):
        window, readers = read(replay, readers, jax.random.key(key))
        rows, valid = numbers(window), np.asarray(reading.known_transitions(window)).T
        known |= set(rows[:, :-1][valid].tolist())
    assert known == set(range(count - 1))


def test_a_jump_into_the_first_window_of_a_ring_goes_to_its_first_timestep_if_an_episode_begins_there():
    for starts, expected in ((np.arange(40) == 0, {0, *range(4, 32)}), (np.arange(40) == 5, set(range(32)))):
        replay, found = filled(64, starts), []
        for key in range(400):
            window, _ = read(replay, ring.init_readers(SHAPE), jax.random.key(key))
            found += numbers(window)[:, 0].tolist()
        assert set(found) == expected
        if starts[0]:
            assert found.count(0) > 2 * found.count(10)  # four places lead there


def test_readers_jump_with_the_given_probability():
    replay = filled(64, np.zeros(40, bool))
    always = begun(replay, shape=SHAPE._replace(jump=1.0))[0]
    assert not read(replay, always, jax.random.key(1), SHAPE._replace(jump=1.0))[0].reading.continues.any()
    near = begun(replay)[0]._replace(number=jnp.zeros(6, int))
    shape = SHAPE._replace(jump=0.25)
    keys = jax.random.split(jax.random.key(2), 400)
    continues = jax.jit(jax.vmap(lambda key: ring.read(replay, near, key, 2, shape)[0].reading.continues))(keys)
    assert abs(continues.mean() - 0.75) < 0.06


def test_a_reader_of_a_replay_with_less_than_a_window_marks_what_does_not_exist():
    window, _ = read(filled(64, np.zeros(3, bool)), ring.init_readers(SHAPE), jax.random.key(0))
    np.testing.assert_array_equal(np.asarray(window.exists).T, [[True, True, True, False, False]] * 2)


def test_a_reader_does_not_continue_after_timesteps_that_did_not_exist():
    first = ring.init_readers(SHAPE)
    for number in range(3):  # all six readers
        _, first = read(filled(64, np.zeros(3, bool)), first, jax.random.key(number))
    window, _ = read(filled(64, np.zeros(40, bool)), first, jax.random.key(9))
    assert not window.reading.continues.any()


def test_impossible_readers_are_refused():
    with pytest.raises(UserError, match="burn_in=2 is impossible with readers"):
        ring.init_readers(SHAPE._replace(burn_in=2))
    with pytest.raises(UserError, match="readers=6 is impossible: the agent reads 7 windows"):
        ring.read(filled(64, np.zeros(40, bool)), ring.init_readers(SHAPE), jax.random.key(0), 7, SHAPE)


def test_agents_without_readers_draw_windows_at_random():
    replay, shape = filled(64, np.zeros(40, bool)), WindowShape(2, 3)
    assert ring.init_readers(shape) is None
    window, readers = ring.windows(replay, None, jax.random.key(0), 8, shape)
    assert readers is None
    assert window.reading is None
    np.testing.assert_array_equal(numbers(window), numbers(sample(replay, jax.random.key(0), 8, shape)))
