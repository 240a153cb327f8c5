import functools

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from beliefrl.training import replay as ring
from beliefrl.types import StoredTimestep, Timestep, WindowShape, transitions


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


def test_starts_are_uniform():
    shape, count = WindowShape(2, 4), 30
    window = sample(filled(64, np.zeros(count, bool)), jax.random.key(2), 20_000, shape)
    starts = np.array(window.note[0])[shape.burn_in].astype(int)
    drawn = np.bincount(starts, minlength=count)
    possible = count - shape.length
    assert set(np.flatnonzero(drawn)) == set(range(possible))
    assert np.abs(drawn[:possible] / drawn.sum() * possible - 1).max() < 0.2


def test_history_and_annotate_address_the_first_timesteps():
    replay = filled(64, [True, False, False, True, False])
    steps, exists = ring.history(replay, 8)
    np.testing.assert_array_equal(exists, np.arange(8) < 5)
    np.testing.assert_array_equal(steps.reward[:5], np.arange(5))
    replay = ring.annotate(replay, (jnp.arange(8.0) * 10,), 8)
    np.testing.assert_array_equal(replay.timesteps.note[0][:5], np.arange(5) * 10)
    np.testing.assert_array_equal(replay.timesteps.step.reward[:5], np.arange(5))
