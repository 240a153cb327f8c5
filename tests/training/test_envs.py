"""Several environments for one agent: recording, time limits, resets, the ratio of updates, both loops, resuming."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import agents, resume, tasks, train
from beliefrl.runs.options import Options
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import host_loop, phases, schedule
from beliefrl.training import replay as ring
from beliefrl.types import StoredTimestep, Timestep, UserError, WindowShape, transitions
from training.test_host_loop import Hanging, Wrapped
from training.test_resume import AGENT, OPTIONS, Crash, crash_at, files
from worlds import SHARED, Counting, CountingAgent, leaves, trained

ENVS = 3  # with the agent's cycles of 4 steps, a round has 12


@pytest.mark.parametrize("hosted", [False, True])
@pytest.mark.parametrize("task", [Counting(max_steps=7), Counting(ends=3)])
def test_every_environment_is_recorded_with_its_own_episodes(task, hosted):
    agent = CountingAgent()
    if hosted:
        wrapped = GymnasiumTask(Wrapped, "counting", {"task": task}, measures=("success",))
        program = host_loop.program(agent, wrapped, 90, 2, range(2), "never", envs=ENVS)
    else:
        program = phases.compile_program(agent, task, 90, 2, ENVS)
    length = min(task.max_steps, task.ends)
    seeds = program.begin(jax.random.split(jax.random.key(0), 2))
    seeds, explored = program.explore(seeds, 0, 12)  # steps in all, so four of each environment
    np.testing.assert_array_equal(seeds.replay.added, np.full((2, ENVS), 4 + 4 // length))
    seeds, metrics = program.pretrain(seeds, 0, 3)
    assert not metrics["broken"].any()
    seeds = program.refresh(seeds)
    seeds, learned = program.learn(seeds, 12, 7)  # rounds of twelve steps: 28 of each environment
    np.testing.assert_array_equal(seeds.replay.added, np.full((2, ENVS), 32 + 32 // length))
    assert (np.asarray(learned.metrics["valid"]) > 0).all()
    assert not np.any(learned.metrics["broken"])
    done = np.asarray(learned.episodes.done)
    assert explored.episodes.done.sum() + done.sum() == 2 * ENVS * (32 // length)
    np.testing.assert_array_equal(np.asarray(learned.episodes.length)[done], length)
    np.testing.assert_array_equal(np.asarray(learned.episodes.episode_return)[done], length * (length + 1) / 2)
    program.close()


class Updates(CountingAgent):
    """Its offset is the number of its updates."""

    def update(self, state, batch, key):
        return state._replace(offset=state.offset + 1), {}


def test_there_are_as_many_updates_per_step_as_with_one_environment():
    counts = []
    for envs in (1, ENVS):
        program = phases.compile_program(Updates(), Counting(), 90, 1, envs)
        seeds = program.begin(jax.random.split(jax.random.key(0), 1))
        seeds, _ = program.explore(seeds, 0, 12)
        seeds, _ = program.learn(seeds, 12, 48 // phases.round_length(Updates(), envs))
        counts.append(float(seeds.state.offset[0]))
    assert counts == [24, 24]  # two batches in a cycle of 4 steps


def test_environments_of_a_seed_begin_and_act_differently():
    agent = agents.make("sac-mlp", **SHARED)
    program = phases.compile_program(agent, Hanging(), 90, 1, ENVS)
    seeds, _ = program.explore(program.begin(jax.random.split(jax.random.key(0), 2)), 0, 12)
    actions = np.asarray(seeds.replay.timesteps.step.prev_action)[:, :, 1:4].reshape(2 * ENVS, 3)
    assert len({tuple(row) for row in actions.tolist()}) == 2 * ENVS
    seed = phases.begin(CountingAgent(), tasks.make("pendulum"), 10, jax.random.key(0), ENVS)
    assert len({tuple(row) for row in np.asarray(seed.actor.step.obs).tolist()}) == ENVS


@pytest.mark.nightly
def test_the_host_loop_learns_what_the_compiled_loop_learns():
    agent = agents.make("sac-mlp", **SHARED, batch_size=8, pretrain_updates=10)
    task, keys = Hanging(max_steps=9), jax.random.split(jax.random.key(0), 2)
    stretches = {"learn": (20, 40), "cuts": (10, 10), "cycle": phases.round_length(agent, 2)}
    there, log = trained(phases.compile_program(agent, task, 100, 2, 2), keys, **stretches)
    wrapped = GymnasiumTask(Wrapped, "wrapped", {"task": task})
    program = host_loop.program(agent, wrapped, 100, 2, range(2), "never", envs=2)
    here, log_here = trained(program, keys, **stretches)
    program.close()
    theirs = there._replace(actor=there.actor._replace(task_state=()))
    for ours, their in zip(leaves(here), leaves(theirs), strict=True):
        np.testing.assert_allclose(ours, their, rtol=1e-3, atol=1e-4)
    for one, other in zip(log, log_here, strict=True):
        assert one.episodes.done[:, : other.episodes.done.shape[1]].tolist() == other.episodes.done.tolist()


@pytest.mark.slow
def test_a_crashed_training_goes_on_to_the_last_bit(tmp_path):
    options = OPTIONS | {"envs": ENVS}
    events = []
    train(AGENT, "pendulum-v", tmp_path / "whole", events.append, **options)
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", tmp_path / "run", crash_at(int(0.6 * len(events))), **options)
    resume(tmp_path / "run")
    assert files(tmp_path / "run") == files(tmp_path / "whole")


def test_windows_begin_at_every_transition_of_every_ring():
    def filled(count):
        def add(replay, number):
            value = number.astype(float)
            step = Timestep(value[None], value, value[None], jnp.array(False), jnp.array(False))
            return ring.add(replay, StoredTimestep(step, (value,)), number < count), None

        return jax.lax.scan(add, ring.init(like, 32), jnp.arange(40))[0]

    number = jnp.zeros(())
    like = StoredTimestep(Timestep(number[None], number, number[None], jnp.array(False), jnp.array(False)), (number,))
    shape, counts = WindowShape(2, 1), jnp.array([4, 20, 40])
    window = jax.jit(lambda: ring.sample(jax.vmap(filled)(counts), jax.random.key(0), 4000, shape))()
    now = np.asarray(window.note[0])[2][np.asarray(transitions(window, 2))[0]].astype(int)
    starts = [*range(3), *range(19), *range(8, 39)]  # the last ring has lost its first eight
    found = np.bincount(now, minlength=40)
    expected = 4000 / len(starts) * np.bincount(starts, minlength=40)
    assert not found[expected == 0].any()
    np.testing.assert_allclose(found, expected, atol=5 * np.sqrt(expected.max()))


def test_the_replay_is_divided_among_the_environments():
    agent = agents.make("sac-mlp", step_start_rl=1000)
    assert schedule.capacity(agent, Options(steps=400_000, envs=4)) == 125_000
    assert schedule.capacity(agent, Options(steps=400_000, envs=4, replay_capacity=5_000)) == 1_250
    with pytest.raises(UserError, match="at least 2000"):
        schedule.capacity(agent, Options(envs=4, replay_capacity=1_000))
    with pytest.raises(UserError, match="envs=0 is impossible"):
        Options(envs=0)
