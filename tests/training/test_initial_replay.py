"""A training that starts with the replay of another run."""

import json
import shutil

import jax
import numpy as np
import pytest
from gymnasium import spaces

from beliefrl import Run, UserError, resume, tasks, train
from beliefrl.runs import arrays
from beliefrl.runs.checkpoint import Checkpoints, listed
from beliefrl.runs.options import Options
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import initial_replay, replay, schedule
from beliefrl.types import StoredTimestep, Timestep
from worlds import saved, tiny
from wrong import Fine

TASK = tasks.make("pendulum-v")
AGENT = tiny("sac-mlp", step_start_rl=20, batch_size=8, pretrain_updates=5)


def numbered(*rings, capacity, added):
    """Rings of timesteps whose reward is 100 times the number of the ring plus the number of the timestep."""
    time = np.arange(capacity)
    number = np.stack([np.where((n - 1 - time) >= 0, time + (n - 1 - time) // capacity * capacity, 0) for n in added])
    reward = (number + 100 * np.arange(len(added))[:, None]).astype(np.float32).reshape(*rings, capacity)
    none = np.zeros(reward.shape, bool)
    step = Timestep(np.repeat(reward[..., None], TASK.spec.obs_dim, -1), reward, reward[..., None], none, none)
    return StoredTimestep(step, ())


@pytest.fixture
def source(tmp_path):
    """A run of the seeds 4 and 5, whose rings have had 7 and 12 timesteps."""
    return written(tmp_path / "source", capacity=20, added=(7, 12))


def written(folder, capacity, added, first=None):
    run = saved(folder, "sac-mlp", TASK, seeds=2)
    with Checkpoints(run.folder, 2) as checkpoints:
        rings = numbered(2, capacity=capacity, added=added)
        if first is not None:
            rings.step.reward[0, 0] = first
        checkpoints.save(30, {}, {"any": np.zeros(2)}, rings, np.array(added))
    return run


def taken(run, seeds=(0, 1), **options):
    return initial_replay.taken(run, Options(**options), AGENT, TASK, list(seeds))


def test_each_seed_has_the_timesteps_of_its_own_ring_in_order(source):
    found, about = taken(source, (1, 0, 1))
    assert about == {"replay_step": 30, "timesteps": 12}
    np.testing.assert_array_equal(found["added"], [12, 7, 12])
    np.testing.assert_array_equal(found[".step.reward"][0], 100 + np.arange(12))
    np.testing.assert_array_equal(found[".step.reward"][1], [*range(7), 0, 0, 0, 0, 0])


def test_a_longer_ring_that_is_not_taken_does_not_count(source):
    found, about = taken(source, (0,))
    assert about["timesteps"] == 7
    assert found[".step.reward"].shape == (1, 7)


def test_a_smaller_replay_takes_the_newest(source):
    found, about = taken(source, replay_capacity=9)
    assert about["timesteps"] == 9
    np.testing.assert_array_equal(found["added"], [7, 9])
    np.testing.assert_array_equal(found[".step.reward"][1], 100 + np.arange(3, 12))


def test_of_a_full_ring_all_that_is_left_is_taken(tmp_path):
    found, _ = taken(written(tmp_path / "source", capacity=5, added=(12, 12)))
    np.testing.assert_array_equal(found["added"], [5, 5])
    np.testing.assert_array_equal(found[".step.reward"][0], np.arange(7, 12))


def test_the_replay_begins_with_them_and_has_room_for_the_rest(source):
    found, about = taken(source)
    (source.folder / initial_replay.FILE).write_bytes(arrays.packed(found))
    room = schedule.capacity(AGENT, Options(steps=100), about["timesteps"])
    assert room == schedule.capacity(AGENT, Options(steps=100)) + 12
    empty = jax.vmap(lambda _: replay.init(initial_replay._timestep(AGENT, TASK.spec), room))(np.arange(2))
    started = initial_replay.started(source.folder, empty)
    jax.tree.map(lambda a, b: np.testing.assert_equal((a.shape, a.dtype), (b.shape, b.dtype)), started, empty)
    np.testing.assert_array_equal(started.added, [7, 12])
    np.testing.assert_array_equal(started.timesteps.step.reward[1, :12], 100 + np.arange(12))


@pytest.mark.parametrize(
    ("task", "options", "phrase"),
    [
        (tasks.make("pendulum-v", faults={"delay": 1}), {}, r"was trained with faults=None, and this training has"),
        (tasks.make("pendulum-v", mass=2.0), {}, r"was trained with constants=\S.*, and this training has"),
        (TASK, {"envs": 2}, "was trained with envs=1, and this training has 2"),
    ],
)
def test_timesteps_of_another_task_are_one_sentence_and_no_folder(source, tmp_path, task, options, phrase):
    with pytest.raises(UserError, match=phrase):
        train(AGENT, task, tmp_path / "run", init_from=source, init_replay=True, **options)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["store_state", "store_first_impression"])
def test_other_notes_are_one_sentence(tmp_path, name):
    old, new = (tiny("vrm", **{name: stores}) for stores in (True, False))
    run = saved(tmp_path / "run", "vrm", TASK, agent=old)
    with pytest.raises(UserError, match=rf"{name}=True, and this training has False"):
        initial_replay.taken(run, Options(), new, TASK, [0])


def test_the_replay_of_a_diverged_seed_is_not_taken(tmp_path):
    run = written(tmp_path / "source", 20, (7, 12), first=np.nan)
    taken(run, (1,))
    with pytest.raises(UserError, match="has numbers that are not finite, because a seed diverged"):
        taken(run, (0,))


def test_without_a_checkpoint_there_is_no_replay(source, tmp_path):
    with pytest.raises(UserError, match="has no checkpoint yet"):
        taken(saved(tmp_path / "new", "sac-mlp", TASK, seeds=2))
    (listed(source.folder)[0] / "manifest.json").write_text("{")
    with pytest.raises(UserError, match="has no undamaged checkpoint, so it cannot give its replay"):
        train(AGENT, TASK, tmp_path / "run", init_from=source, init_replay=True)
    assert not (tmp_path / "run").exists()
    assert len(listed(source.folder)) == 1  # nothing there has changed


@pytest.mark.slow
def test_a_training_goes_on_from_it_and_needs_the_other_run_no_more(tmp_path):
    options = {"eval_every": 1_000, "eval_episodes": 1, "seeds": 2, "envs": 2, "progress": False}
    rings = {}

    def keep(name):
        def listen(event):
            if event.snapshot is not None:
                rings.setdefault(name, []).append(jax.tree.map(np.array, event.snapshot.seeds.replay))

        return listen

    source = train(AGENT, TASK, tmp_path / "source", keep("source"), steps=40, **options)
    given = {"init_from": source.folder, "init_replay": True, "steps": 60}
    run = train(AGENT, TASK, tmp_path / "run", keep("run"), **given, **options)
    there, first = rings["source"][-1], rings["run"][0]
    count = int(there.added[0, 0])
    assert run.config["initial"]["timesteps"] == count
    np.testing.assert_array_equal(first.added, np.full((2, 2), count + 10))  # after 20 steps of the exploration
    for ring, old in zip(jax.tree.leaves(first.timesteps), jax.tree.leaves(there.timesteps), strict=True):
        np.testing.assert_array_equal(ring[:, :, :count], old[:, :, :count])

    agent = run.folder / "agent.safetensors"
    whole = agent.read_bytes()
    shutil.rmtree(source.folder)  # and as if it was killed before its first checkpoint
    shutil.rmtree(run.folder / "checkpoints")
    for name in ("results.json", "agent.safetensors", "best.safetensors"):
        (run.folder / name).unlink()
    hidden = (run.folder / initial_replay.FILE).rename(tmp_path / "hidden")
    with pytest.raises(UserError, match=r"initial-replay.safetensors is damaged: restore it from a copy"):
        resume(run, progress=False)
    hidden.rename(run.folder / initial_replay.FILE)
    resume(run, progress=False, callback=lambda event: event.step >= 20)
    assert not (run.folder / "results.json").exists()
    resume(run, progress=False)
    assert agent.read_bytes() == whole


def test_actions_with_other_bounds_are_one_sentence(tmp_path):
    run = written(tmp_path / "source", capacity=20, added=(7, 12))
    wide = spaces.Box(-9.0, 9.0, (1,), np.float32)
    task = GymnasiumTask(type("Fine", (Fine,), {"action_space": wide}))
    config = json.loads((run.folder / "config.json").read_text()) | tasks.describe(task)
    config["interface"] = GymnasiumTask(Fine).interface._asdict()
    (run.folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"another environment: lower bounds of the actions before: \[-2.0\]"):
        initial_replay.taken(Run(run.folder), Options(), AGENT, task, [0])
