"""A run's folder: what is written can be read back, and nothing half written is ever read."""

import json
import os
import pathlib
import pickle
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import folders, runs
from beliefrl.provenance import provenance
from beliefrl.runs import Recorder, Run
from beliefrl.types import UserError

CONFIG = {
    "agent": "vrm",
    "hyperparameters": {},
    "task": "pendulum-v",
    "constants": {},
    "options": {"seed": 3, "seeds": 2},
}


@pytest.fixture
def recorder(tmp_path):
    recorder = Recorder(tmp_path / "run", CONFIG)
    yield recorder
    recorder.close()


def states():
    return {
        "weights": (jnp.array([[0.1, jnp.nan], [-0.0, 1e-40]], jnp.float32), jnp.array([True, False])),
        "count": jnp.array([3, 2**31 - 1], jnp.int32),
    }


def test_a_run_knows_its_config_and_its_seeds(recorder):
    run = Run(recorder.folder)
    assert run.config == CONFIG
    assert run.seeds == [3, 4]
    assert run.results() is None


def test_rows_come_back_in_their_order_and_by_kind(recorder):
    recorder.log(3, "update", 5, {"loss": 0.5})
    recorder.log(3, "evaluation", 5, {"sampled": [1.0, 2.0]})
    recorder.log(4, "update", 5, {"loss": 0.25})
    update = {"step": 5, "kind": "update", "loss": 0.5}
    evaluation = {"step": 5, "kind": "evaluation", "sampled": [1.0, 2.0]}
    assert list(recorder.rows(3)) == [update, evaluation]
    assert list(recorder.rows(3, "evaluation")) == [evaluation]
    assert [row["loss"] for row in recorder.rows(4)] == [0.25]
    assert list(recorder.rows(9)) == []


def test_a_line_that_was_cut_short_is_skipped(recorder):
    recorder.log(3, "update", 5, {"loss": 0.5})
    with (recorder.folder / "metrics" / "seed-3.jsonl").open("a") as file:
        file.write('{"step": 10, "kind": "upd')
    assert [row["step"] for row in recorder.rows(3)] == [5]


def test_a_line_is_on_disk_as_soon_as_it_is_logged(recorder):
    recorder.log(3, "update", 5, {"loss": 0.5})
    assert (recorder.folder / "metrics" / "seed-3.jsonl").read_text().endswith("0.5}\n")


def test_a_folder_that_exists_is_refused_and_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("keep me")
    with pytest.raises(UserError, match="exists already"):
        Recorder(tmp_path, CONFIG)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be made"):
        Recorder(tmp_path / "file" / "run", CONFIG)
    with pytest.raises(UserError, match="cannot be made"):
        Recorder(tmp_path / ("x" * 300), CONFIG)


@pytest.mark.parametrize(
    "config",
    [
        [],
        {},
        CONFIG | {"agent": 1},
        CONFIG | {"hyperparameters": []},
        CONFIG | {"options": {}},
        CONFIG | {"options": {"seed": 0, "seeds": "two"}},
    ],
)
def test_a_config_that_no_training_wrote_is_refused(tmp_path, config):
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match="lacks what"):
        Run(tmp_path)


def test_saved_agents_come_back_bit_for_bit(recorder):
    recorder.save(states())
    loaded = Run(recorder.folder).load(jax.eval_shape(states))
    assert jax.tree.structure(loaded) == jax.tree.structure(states())
    for saved, back in zip(jax.tree.leaves(states()), jax.tree.leaves(loaded), strict=True):
        assert back.dtype == saved.dtype
        assert back.tobytes() == np.asarray(saved).tobytes()


def test_there_is_nothing_to_load_before_the_first_save(recorder):
    with pytest.raises(UserError, match="no trained agent yet"):
        recorder.load(jax.eval_shape(states))


@pytest.mark.parametrize("keep", [0, 7, 100, -1])
def test_a_damaged_agent_is_refused(recorder, keep):
    recorder.save(states())
    path = recorder.folder / "agent.safetensors"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(UserError, match="damaged"):
        recorder.load(jax.eval_shape(states))


@pytest.mark.parametrize(
    "like",
    [
        {"weights": (jnp.zeros((2, 3)), jnp.zeros(2, bool)), "count": jnp.zeros(2, int)},
        {"weights": (jnp.zeros((2, 2)), jnp.zeros(2, bool)), "count": jnp.zeros(2)},
        {"weights": (jnp.zeros((2, 2)), jnp.zeros(2, bool)), "count": jnp.zeros(2, int), "more": jnp.zeros(2)},
    ],
    ids=["shape", "type", "structure"],
)
def test_an_agent_of_another_training_is_refused(recorder, like):
    recorder.save(states())
    with pytest.raises(UserError, match="does not fit"):
        recorder.load(like)


class Trap:
    """Writes a file where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return pathlib.Path.touch, (self.path,)


def test_loading_runs_no_code_from_the_file(recorder, tmp_path):
    (recorder.folder / "agent.safetensors").write_bytes(pickle.dumps(Trap(tmp_path / "sprung")))
    with pytest.raises(UserError, match="damaged"):
        recorder.load(jax.eval_shape(states))
    assert not (tmp_path / "sprung").exists()


def test_the_library_unpickles_nothing():
    for path in pathlib.Path(runs.__file__).parent.rglob("*.py"):
        assert not re.search(r"\b(pickle|cloudpickle|dill|joblib|allow_pickle)\b", path.read_text()), path


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "agent"
    runs.write_whole(path, b"old")

    def interrupt(_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupt)
        with pytest.raises(KeyboardInterrupt):
            runs.write_whole(path, b"new and longer")
    assert path.read_bytes() == b"old"
    runs.write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_finish_writes_the_results(recorder):
    recorder.finish({"step": 7, "sampled": {"mean": 1.5}})
    assert Run(recorder.folder).results() == {"step": 7, "sampled": {"mean": 1.5}}


def test_free_folder_takes_the_first_free_number(tmp_path):
    parent = str(tmp_path)
    assert folders.free_folder("vrm-pendulum", parent) == tmp_path / "vrm-pendulum-1"
    (tmp_path / "vrm-pendulum-1").mkdir()
    (tmp_path / "vrm-pendulum-3").mkdir()
    assert folders.free_folder("vrm-pendulum", parent) == tmp_path / "vrm-pendulum-2"


def test_provenance_says_what_a_run_was_made_with():
    made = provenance()
    assert set(made) == {"versions", "device", "git_commit", "command", "started"}
    assert set(made["versions"]) == {"python", "beliefrl", "jax", "jaxlib", "equinox", "optax", "numpy"}
    assert made["versions"]["jax"] == jax.__version__
    json.dumps(made)
