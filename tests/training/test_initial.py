"""A training that starts from the networks of another run."""

import shutil

import jax
import numpy as np
import pytest

from beliefrl import Options, Run, UserError, resume, tasks, train
from beliefrl.runs import arrays
from beliefrl.training import initial
from beliefrl.training.schedule import Phase
from worlds import saved, tiny

TASK = tasks.make("pendulum-v")
AGENT = tiny("sac-mlp", step_start_rl=20, batch_size=8, pretrain_updates=5)


@pytest.fixture
def source(tmp_path):
    """A run of the seeds 4 and 5."""
    return saved(tmp_path / "source", "sac-mlp", TASK, seeds=2)


def test_a_seed_starts_from_its_number_and_others_in_turn(source):
    networks, origin = initial.taken(Options(init_from=str(source.folder), seed=3, seeds=4), AGENT, TASK.spec)
    there = arrays.load(source.agents())
    for name, array in networks.items():
        np.testing.assert_array_equal(array, there[name][[1, 0, 1, 0]])
    assert {seed: found["seed"] for seed, found in origin["seeds"].items()} == {3: 5, 4: 4, 5: 5, 6: 4}
    assert (origin["run"], origin["agent"], origin["task"]) == (str(source.folder), "sac-mlp", "pendulum-v")


@pytest.mark.parametrize(
    ("agent", "task", "phrase"),
    [
        (AGENT, "pendulum", r"weight has the shape \(8, 1\), this training's has the shape \(8, 3\); the agent and"),
        (tiny("sac-lstm"), "pendulum-v", r"lstm\.\S+ has no such array, this training's has the shape"),
        (tiny("sac-mlp", standardise=True), "pendulum-v", r"scale\.mean has no such array, this training's has"),
    ],
)
def test_other_sizes_are_one_sentence_and_no_folder(source, tmp_path, agent, task, phrase):
    with pytest.raises(UserError, match=phrase):
        train(agent, task, tmp_path / "run", init_from=source)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_training_starts_there_without_pretraining_and_needs_the_other_run_no_more(source, tmp_path):
    networks = arrays.load(source.agents())
    states, phases = [], []

    def watch(event):
        phases.append(event.phase)
        if event.evaluation is not None:
            states.append(arrays.copied(event.states))

    options = {"steps": 25, "eval_every": 20, "eval_episodes": 1, "seed": 4, "seeds": 2}
    run = train(AGENT, TASK, tmp_path / "run", watch, init_from=source.folder, **options)
    assert not {Phase.PRETRAINING, Phase.COMPILING_PRETRAINING} & set(phases)
    learned = run.folder / "agent.safetensors"
    before, end = learned.read_bytes(), states[-1]
    for name, array in states[0].items():
        np.testing.assert_array_equal(array, networks[name])
    assert any(not np.array_equal(end[name], array) for name, array in states[0].items())
    assert Run(run.folder).config["initial"]["seeds"]["5"] == {"seed": 5}

    shutil.rmtree(source.folder)  # and as if it was killed before its first checkpoint
    shutil.rmtree(run.folder / "checkpoints")
    for name in ("results.json", "agent.safetensors", "best.safetensors"):
        (run.folder / name).unlink()
    resume(run)
    assert learned.read_bytes() == before


def test_optimisers_start_anew(source):
    keys = jax.random.split(jax.random.key(1), 2)
    states = jax.vmap(lambda key: AGENT.init(key, TASK.spec))(keys)
    (source.folder / initial.FILE).write_bytes(source.agents().read_bytes())
    started = initial.started(source.folder, AGENT, states)
    jax.tree.map(np.testing.assert_array_equal, started.controller_optimiser, states.controller_optimiser)
    assert jax.tree.structure(started) == jax.tree.structure(states)
