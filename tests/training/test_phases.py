"""The compiled phases: windows are unbroken, seeds alone as together up to rounding, cuts change nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import agents, tasks
from beliefrl.errors import UserError
from beliefrl.runs.options import Options
from beliefrl.training import phases, schedule
from beliefrl.training.evaluation import evaluate
from beliefrl.training.log import without
from beliefrl.training.rollout import Episode
from beliefrl.training.schedule import Event, Phase
from beliefrl.training.summary import MODES, summary
from worlds import MODELS, SEQUENCES, SHARED, Alternating, Counting, CountingAgent, leaves, trained

SMALL = {
    "vrm": MODELS | SEQUENCES | {"standardise": True},
    "vrm-single": MODELS | SEQUENCES,
    "sac-mlp": {"batch_size": 8, "pretrain_updates": 10, "standardise": True},
    "sac-lstm": {"d_size": 8, "pretrain_updates": 10} | SEQUENCES,
    "predictive-sac": {
        "d_size": 8,
        "hidden_size": 8,
        "pretrain_updates": 10,
        "seq_len": 8,
        "sequences": 2,
    },
    "slac": {"z1_size": 2, "z2_size": 4, "model_layers": (8,), "batch_size": 2, "pretrain_updates": 10},
}


MARKS = {"sac-mlp": pytest.mark.slow}


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=MARKS.get(name, pytest.mark.nightly)) for name in SMALL],
)
def small(request):
    """A small agent's training program and its agent's cycle."""
    agent, task = agents.make(request.param, **SHARED, **SMALL[request.param]), tasks.make("pendulum-p", max_steps=9)
    return phases.compile_program(agent, task, capacity=200, episodes=2), agent.cycle


@pytest.fixture
def doubles():
    """Numbers of 64 bits: with 32, rounding can decide a gradient that is zero but for it, a whole step to Adam."""
    with jax.enable_x64(True):
        yield


@pytest.mark.usefixtures("doubles")
def test_a_seed_among_others_learns_as_it_does_alone_up_to_rounding(small):
    program, cycle = small
    keys = jax.random.split(jax.random.key(0), 3)
    together, stretches = trained(program, keys, cycle=cycle)
    alone, stretches_alone = trained(program, keys[1:2], cycle=cycle)
    for ours, theirs in zip(leaves(together), leaves(alone), strict=True):
        np.testing.assert_allclose(ours[1], theirs[0], rtol=1e-10, atol=1e-12)
    for name, values in stretches[-1].metrics.items():
        np.testing.assert_allclose(values[1], stretches_alone[-1].metrics[name][0], rtol=1e-9, atol=1e-10)
    assert not np.allclose(leaves(together.state)[0][0], leaves(together.state)[0][1])


@pytest.mark.usefixtures("doubles")
def test_no_result_depends_on_where_the_training_is_cut(small):
    program, cycle = small
    keys = jax.random.split(jax.random.key(0), 1)
    one, _ = trained(program, keys, cuts=(20,), learn=(25,), cycle=cycle)
    other, _ = trained(program, keys, cuts=(7, 12, 1), learn=(5, 15, 5), cycle=cycle)
    for ours, theirs in zip(leaves(one), leaves(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)


class KeyKeeper(CountingAgent):
    """Makes more updates than steps, and keeps the key of each."""

    def init(self, key, spec):
        return super().init(key, spec)._replace(seen=jnp.zeros((120, 2), jnp.uint32))

    def begin_cycle(self, state, windows, key):
        return state, jnp.arange(10), {}

    def update(self, state, batch, key):
        return state._replace(seen=jnp.roll(state.seen, 1, axis=0).at[0].set(jax.random.key_data(key))), {}


def test_an_update_is_made_for_every_batch_and_no_two_have_one_key():
    agent = KeyKeeper()
    seed = phases.begin(agent, Counting(), 100, jax.random.key(0))
    for first in range(10, 10 + 12 * agent.cycle, agent.cycle):
        seed, _ = phases.learn_round(agent, seed, jnp.array(first))
    assert len({tuple(key) for key in np.array(seed.state.seen).tolist()}) == 120
    assert np.array(seed.state.seen).any(axis=1).all()


class Numbering(CountingAgent):
    """Its metric is the number of updates before it."""

    def pretrain(self, state, windows, key):
        return state._replace(offset=state.offset + 1), {"number": state.offset}


def test_metrics_of_the_pretraining_are_means_over_its_updates():
    program, found = phases.compile_program(Numbering(), Counting(), capacity=90, episodes=1), []
    seeds, _ = program.explore(program.begin(jax.random.split(jax.random.key(0), 2)), 0, 10)
    for first, updates in ((0, 3), (3, 4)):
        seeds, metrics = program.pretrain(seeds, first, updates)
        found.append(metrics["number"].tolist())
    assert found == [[1.0, 1.0], [4.5, 4.5]]


def counting(steps=120, task=None):
    agent = CountingAgent()
    traces = []

    class Traced(Counting):
        def step(self, state, action, key):
            traces.append(1)
            return super().step(state, action, key)

    task = task or Traced()
    program = phases.compile_program(agent, task, capacity=90, episodes=2)
    seeds = program.begin(jax.random.split(jax.random.key(0), 2))
    logged, counts = [], []
    for first, length in ((0, 4), (4, 6)):
        seeds, _ = program.explore(seeds, first, length)
        counts.append(len(traces))
    for first in (0, 1):
        seeds, metrics = program.pretrain(seeds, first, 1 + first)
        logged.append(metrics)
    seeds = program.refresh(seeds)
    step = 10
    for cycles in (1, 3, 5, steps // 4 - 9):
        seeds, stretch = program.learn(seeds, step, cycles)
        step += 4 * cycles
        logged.append(stretch.metrics)
        counts.append(len(traces))
    return seeds, logged, counts


@pytest.mark.slow
def test_every_window_of_a_training_is_unbroken():
    """The counter that the task shows is the agent's own count, through memory, resets, replay and its wrapping."""
    for task in (Counting(max_steps=7), Counting(ends=3), Counting(ends=1), Counting(max_steps=50)):
        seeds, logged, _ = counting(task=task)
        for metrics in logged:
            np.testing.assert_array_equal(metrics["broken"], 0)
            assert (np.asarray(metrics["valid"]) > 0).all()
        assert (np.asarray(seeds.state.seen) > 0).all()


def test_each_phase_is_compiled_once_whatever_the_stretch():
    _, _, counts = counting()
    explore, learn = counts[:2], counts[2:]
    assert explore[0] == explore[1]
    assert len(set(learn)) == 1


def test_steps_are_counted_as_environment_steps():
    task = Counting(max_steps=7)
    agent = CountingAgent()
    program = phases.compile_program(agent, task, capacity=90, episodes=2)
    seeds = program.begin(jax.random.split(jax.random.key(0), 1))
    seeds, stretch = program.explore(seeds, 0, 50)
    assert int(seeds.replay.added[0]) == 50 + 50 // 7  # every end of an episode is one timestep more
    assert int(stretch.episodes.done.sum()) == 50 // 7
    assert int(seeds.actor.length[0]) == 50 % 7


def test_evaluation_has_the_returns_of_sampled_actions_and_of_mode_actions():
    """The agent's mode is the same action at every step, so it has a return of 0."""
    program = phases.compile_program(CountingAgent(), Alternating(ends=4), capacity=90, episodes=3)
    keys = jax.random.split(jax.random.key(0), 2)
    returns = np.asarray(program.evaluate(program.begin(keys).state, keys).episode_return)
    assert returns.shape == (2, 2, 3)
    np.testing.assert_array_equal(returns[:, MODES.index("mode")], 0)
    assert len(np.unique(returns[:, MODES.index("sampled")])) == 6


@pytest.mark.parametrize(
    ("steps", "limit", "expected"),
    [
        (1_000_000, 1_000_000, 1_000_000),
        (400_000, 1_000_000, 500_000),  # room for 1.25 timesteps a step
        (1_000, 1_000_000, 2_000),  # the exploration always fits, with episodes of one step too
        (600, 1_000_000, 1_200),  # no more than can come
        (400_000, 5_000, 5_000),
    ],
)
def test_the_replay_has_room_for_a_training_and_little_more(steps, limit, expected):
    options = Options(steps=steps, replay_capacity=limit)
    assert schedule.capacity(agents.make("sac-mlp"), options) == expected


def test_a_weak_type_in_an_agents_state_does_not_compile_learning_twice():
    class Weak(CountingAgent):
        def init(self, key, spec):
            return super().init(key, spec)._replace(offset=jnp.where(True, 0.0, 1.0))

    program = phases.compile_program(Weak(), Counting(), capacity=90, episodes=2)
    before = program.shapes(jax.random.split(jax.random.key(0), 2))
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(before))


# Summaries of evaluations, against NumPy.

TOTAL = np.array([[[1.0, 2.0], [10.0, 30.0]], [[3.0, 6.0], [-10.0, -30.0]], [[0.0, 3.0], [0.0, 6.0]]], np.float32)
SUCCESS = np.array([[[1, 0], [1, 1]], [[0, 0], [0, 1]], [[1, 1], [0, 0]]], bool)  # (seed, mode, episodes)


def episode(total, success):
    done, length = jnp.ones(total.shape, bool), jnp.ones(total.shape, int)
    return Episode(done, jnp.array(total), length, {"success": jnp.array(success, float)})


def test_means_and_standard_errors_are_over_seeds():
    table = summary(episode(TOTAL, SUCCESS))
    assert list(table) == ["sampled", "mode"]
    for mode, seeds in {"sampled": [1.5, 4.5, 1.5], "mode": [20.0, -20.0, 3.0]}.items():
        assert table[mode]["seeds"] == seeds
        assert table[mode]["mean"] == pytest.approx(np.mean(seeds))
        assert table[mode]["sem"] == pytest.approx(np.std(seeds, ddof=1) / np.sqrt(3))


def test_success_is_a_rate():
    table = summary(episode(TOTAL, SUCCESS))
    assert table["sampled"]["seeds_success"] == [0.5, 0.0, 1.0]
    assert table["sampled"]["success"] == 0.5
    assert table["mode"]["seeds_success"] == [1.0, 0.5, 0.0]


def test_a_lost_seed_has_no_success_and_does_not_count():
    event = without(Event(Phase.EVALUATING, 5, evaluation=episode(TOTAL, SUCCESS)), {1})
    assert event.evaluation is not None
    table = summary(event.evaluation)
    assert table["sampled"]["seeds_success"] == [0.5, None, 1.0]
    assert table["sampled"]["success"] == 0.75
    assert table["sampled"]["seeds"] == [1.5, None, 1.5]


def test_a_lost_seed_has_no_ends_of_episodes():
    event = without(Event(Phase.LEARNING, 5, episodes=episode(TOTAL[:, 0], SUCCESS[:, 0])), {1})
    assert event.episodes is not None
    assert event.episodes.done.any(axis=1).tolist() == [True, False, True]


def test_one_seed_has_no_standard_error():
    table = summary(episode(TOTAL[:1], SUCCESS[:1]))
    assert table["sampled"]["sem"] is None
    assert table["sampled"]["mean"] == 1.5


def test_a_task_without_success_reports_none():
    table = summary(episode(TOTAL, SUCCESS)._replace(measures={}))
    assert table["mode"]["success"] is None
    assert table["mode"]["seeds_success"] is None


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"episodes": 10**9}, {"seed": -1}, {"seed": 10**20}])
def test_impossible_numbers_are_refused_by_name(wrong):
    with pytest.raises(UserError, match=next(iter(wrong))):
        evaluate("nowhere", **wrong)
