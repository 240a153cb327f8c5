"""A run's folder: what is written can be read back, and nothing half written is ever read."""

import json
import os
import pathlib
import pickle
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import beliefrl
from beliefrl.errors import UserError
from beliefrl.runs import best, records
from beliefrl.runs.arrays import write_whole
from beliefrl.runs.folder import folder_name, free_folder
from beliefrl.runs.options import Options
from beliefrl.runs.recorder import Recorder
from beliefrl.runs.records import provenance
from beliefrl.runs.run import Run
from beliefrl.training import log
from beliefrl.training.restore import as_argument
from beliefrl.training.rollout import Episode
from beliefrl.training.schedule import Event, Phase
from beliefrl.training.summary import summary
from inputs import a_run, flat

CONFIG = {
    "agent": "vrm",
    "hyperparameters": {},
    "task": "pendulum-v",
    "constants": {},
    "options": {"seed": 3, "seeds": 2},
}

MODE = {"mean": 1.5, "sem": None, "seeds": [1.5, None], "success": None, "seeds_success": None}
RESULTS = {"step": 7, "sampled": MODE, "mode": MODE}


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
    recorder.log(3, "evaluation", 5, {"sampled": [1.0, 2.0], "mode": [3.0]})
    recorder.log(4, "update", 5, {"loss": 0.25})
    update = {"step": 5, "kind": "update", "loss": 0.5}
    evaluation = {"step": 5, "kind": "evaluation", "sampled": [1.0, 2.0], "mode": [3.0]}
    assert list(recorder.rows(3)) == [update, evaluation]
    assert list(recorder.rows(3, "evaluation")) == [evaluation]
    assert [row["loss"] for row in recorder.rows(4)] == [0.25]
    assert list(recorder.rows(9)) == []


def test_a_line_that_was_cut_short_is_skipped(recorder):
    recorder.log(3, "update", 5, {"loss": 0.5})
    with (recorder.folder / "metrics" / "seed-3.jsonl").open("a") as file:
        file.write('{"step": 10, "kind": "upd')
    assert [row["step"] for row in recorder.rows(3)] == [5]


DAMAGED = [
    b"hello",
    b"",
    b"{}",
    b"[]",
    b"5",
    b'{"step": 7, "kind"',
    b"\x00\xff\xfe",
    b"[" * 10_000,
    b'{"step": 7}',
    b'{"kind": "update"}',
    b'{"step": "7", "kind": "update"}',
    b'{"step": -7, "kind": "update"}',
    b'{"step": 1e400, "kind": "update"}',
    b'{"step": 7, "kind": []}',
    b'{"step": 7, "kind": "update", "loss": null}',
    b'{"step": 7, "kind": "update", "loss": {"a": 1}}',
    b'{"step": 7, "kind": "update", "loss": [[1]]}',
    b'{"step": 7, "kind": "update", "loss": 1' + b"0" * 400 + b"}",
    b'{"step": 7, "kind": "evaluation", "sampled": [1.0]}',
    b'{"step": 7, "kind": "evaluation", "sampled": [], "mode": [1.0]}',
    b'{"step": 7, "kind": "evaluation", "sampled": "much", "mode": [1.0]}',
]


@pytest.mark.parametrize("line", DAMAGED)
def test_a_damaged_line_is_left_out_and_named(recorder, line):
    recorder.log(3, "update", 5, {"loss": 0.5})
    with (recorder.folder / "metrics" / "seed-3.jsonl").open("ab") as file:
        file.write(line + b"\n")
    recorder.log(3, "update", 10, {"loss": 0.25})
    assert [row["step"] for row in recorder.rows(3)] == [5, 10]
    assert [row["step"] for row in recorder.last_rows(3)] == [5, 10]
    (sentence,) = recorder.damage()
    assert sentence == f"Line 2 of {recorder.folder / 'metrics' / 'seed-3.jsonl'} is damaged and left out."


def test_many_damaged_lines_are_one_sentence(recorder):
    (recorder.folder / "metrics" / "seed-4.jsonl").write_bytes(b"\n".join([*DAMAGED, b""]))
    (sentence,) = recorder.damage()
    assert sentence.startswith(f"{len(DAMAGED)} lines of ")
    assert sentence.endswith("the first is line 1.")


def test_a_missing_log_is_named_and_a_half_written_line_is_not(recorder):
    (recorder.folder / "metrics" / "seed-3.jsonl").write_text('{"step": 10, "kind": "upd')
    assert recorder.damage() == []
    (recorder.folder / "metrics" / "seed-3.jsonl").unlink()
    assert list(recorder.rows(3)) == recorder.last_rows(3) == []
    assert "metrics lacks the log of seed 3" in recorder.damage()[0]


def test_a_log_that_cannot_be_opened_is_refused(recorder):
    path = recorder.folder / "metrics" / "seed-3.jsonl"
    path.unlink()
    path.mkdir()
    for read in (lambda: list(recorder.rows(3)), lambda: recorder.last_rows(3), recorder.damage):
        with pytest.raises(UserError, match="cannot be read"):
            read()


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
        CONFIG | {"observe": 5},
        CONFIG | {"initial": "x"},
        CONFIG | {"resumed": 5},
        CONFIG | {"resumed": [5]},
        CONFIG | {"versions": "new"},
        CONFIG | {"command": "train"},
    ],
)
def test_a_config_that_no_training_wrote_is_refused(tmp_path, config):
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match="lacks entries that every training writes"):
        Run(tmp_path)


@pytest.mark.parametrize("content", [b"", b"{", b"\x00\xff", b"[" * 100_000, b"null", b"9" * 10_000])
def test_a_config_that_is_no_json_is_refused(tmp_path, content):
    (tmp_path / "config.json").write_bytes(content)
    with pytest.raises(UserError, match="cannot be read"):
        Run(tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        {"seeds": 10**9},
        {"seeds": 0},
        {"seed": -1},
        {"steps": 10**10},
        {"eval_episodes": 10**6},
        {"processes": "some"},
    ],
)
def test_options_outside_their_range_are_refused_with_the_file_and_the_name(tmp_path, options, unchecked):
    (tmp_path / "config.json").write_text(json.dumps(CONFIG | {"options": CONFIG["options"] | options}))
    with pytest.raises(UserError, match=rf"config.json cannot be used: {next(iter(options))}=.* is impossible"):
        Run(tmp_path)


OTHER_TYPES = """
import json, pathlib, sys
from beliefrl.training.restore import agent_of
from beliefrl.runs.run import Run
from beliefrl.training.summary import summary
from beliefrl.training.rollout import Episode
from beliefrl.errors import UserError
config = json.loads(pathlib.Path("config.json").read_text())
for part, wrong in (
    ("options", {"seeds": "two", "seed": [2], "steps": None, "track": 5, "processes": {}, "eval_episodes": 1e4}),
    ("options", {"track": [[]], "seeds": True, "checkpoint_minutes": "ten"}),
    ("hyperparameters", {"d_size": [4], "z_size": True, "policy_layers": 5, "value_layers": [[4]], "deterministic": 2}),
    ("hyperparameters", {"models": [], "gamma": None, "target_entropy": "low", "standardise": None, "d_size": 10**9}),
):
    for name, value in wrong.items():
        pathlib.Path("config.json").write_text(json.dumps(config | {part: config[part] | {name: value}}))
        try:
            agent_of(Run("."))
        except UserError as error:
            assert f"config.json cannot be used: {name}=" in str(error), error
        else:
            raise AssertionError(name)
"""


def test_values_of_another_type_are_refused_too(tmp_path):  # in a process whose types beartype does not check
    (tmp_path / "config.json").write_text(json.dumps(CONFIG))
    done = subprocess.run([sys.executable, "-c", OTHER_TYPES], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_options_of_another_version_are_left_out(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(CONFIG | {"options": CONFIG["options"] | {"colour": 1}}))
    assert Run(tmp_path).options == Options(seed=3, seeds=2)


def test_saved_agents_come_back_bit_for_bit(recorder):
    recorder.save(states())
    loaded = Run(recorder.folder).load(jax.eval_shape(states))
    assert jax.tree.structure(loaded) == jax.tree.structure(states())
    for saved, back in zip(jax.tree.leaves(states()), jax.tree.leaves(loaded), strict=True):
        assert back.dtype == saved.dtype
        assert back.tobytes() == np.asarray(saved).tobytes()


def test_the_best_agent_has_the_highest_return_with_sampled_actions(recorder):
    for step, sampled, mode in ((10, 1.0, 9.0), (20, 2.0, 5.0)):
        returns = jnp.broadcast_to(jnp.array([[sampled], [mode]]), (2, 2, 1))
        evaluation = Episode(jnp.ones((2, 2, 1), bool), returns, jnp.ones((2, 2, 1), int), {})
        log.record(recorder, Event(Phase.LEARNING, step, evaluation=evaluation, states=states()), ())
    assert best.evaluations(recorder.folder, 2) == [{"step": 20, "return": 2.0}] * 2


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
    for path in pathlib.Path(beliefrl.__file__).parent.rglob("*.py"):
        assert not re.search(r"\b(pickle|cloudpickle|dill|joblib|allow_pickle)\b", path.read_text()), path


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "agent"
    write_whole(path, b"old")

    def interrupt(_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_whole(path, b"new and longer")
    assert path.read_bytes() == b"old"
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_finish_writes_the_results(recorder):
    recorder.finish(RESULTS)
    assert Run(recorder.folder).results() == RESULTS


@pytest.mark.parametrize(
    "results",
    [
        [],
        None,
        {"step": 7},
        RESULTS | {"step": "many"},
        RESULTS | {"mode": 5},
        RESULTS | {"mode": MODE | {"mean": None}},
        RESULTS | {"mode": MODE | {"sem": "small"}},
        RESULTS | {"mode": MODE | {"seeds": [1.0]}},
        RESULTS | {"mode": MODE | {"seeds": [1.0, "two"]}},
        RESULTS | {"mode": MODE | {"success": 0.5}},
        RESULTS | {"mode": MODE | {"success": 0.5, "seeds_success": [0.5, "none"]}},
        RESULTS | {"mode": MODE | {"distance": None, "seeds_distance": [0.5, None]}},
        RESULTS | {"mode": {name: value for name, value in MODE.items() if name != "sem"}},
    ],
)
def test_damaged_results_are_refused(recorder, results):
    (recorder.folder / "results.json").write_text(json.dumps(results))
    with pytest.raises(UserError, match=r"results.json is damaged"):
        recorder.results()


def test_free_folder_takes_the_first_free_number(tmp_path):
    parent = str(tmp_path)
    assert free_folder("vrm-pendulum", parent) == tmp_path / "vrm-pendulum-1"
    (tmp_path / "vrm-pendulum-1").mkdir()
    (tmp_path / "vrm-pendulum-3").mkdir()
    assert free_folder("vrm-pendulum", parent) == tmp_path / "vrm-pendulum-2"
    assert free_folder("v" * 300, parent) == tmp_path / ("v" * 300 + "-1")  # `Recorder` says that this is too long


def test_a_damaged_file_of_agents_is_set_aside_where_a_seed_keeps_its_agent(recorder):
    path = recorder.folder / "agent.safetensors"
    path.write_bytes(b"nonsense")
    recorder.save({"w": jnp.arange(2.0)}, but=[0], step=7)
    assert (recorder.folder / "damaged-agent.safetensors").read_bytes() == b"nonsense"
    np.testing.assert_array_equal(Run(recorder.folder).load({"w": jnp.zeros(2)})["w"], [0.0, 1.0])


def test_a_folder_with_a_space_is_quoted_in_the_commands_of_messages(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = a_run(tmp_path / "my run", [flat(1.0)])
    assert as_argument(Run("my run")) == "'my run'"
    run.config["agent"] = "module:Agent"
    assert as_argument(run) == f"'{run.folder}' --agent module:Agent"
    (run.folder / "agent.safetensors").write_bytes(b"")
    with pytest.raises(UserError, match=r"or `beliefrl resume 'my run'`; in Python"):
        Recorder("my run", CONFIG)


def test_a_run_is_where_it_was_opened_and_is_called_as_it_was_given(recorder, monkeypatch):
    monkeypatch.chdir(recorder.folder.parent)
    run = Run("run")
    recorder.log(3, "update", 5, {"loss": 0.5})
    monkeypatch.chdir("/")
    assert [row["step"] for row in run.rows(3)] == [5]
    assert run.folder == recorder.folder
    assert (run.shown, repr(run)) == ("run", "<Run run: vrm on pendulum-v>")


def test_special_characters_in_the_name_of_a_folder_become_dashes():
    assert folder_name("m:Own-gym:a/B-v0-tau=0.1,0.2") == "m-Own-gym-a-B-v0-tau=0.1,0.2"


def test_provenance_says_what_a_run_was_made_with():
    made = provenance()
    assert set(made) == {"versions", "device", "git_commit", "command", "started"}
    assert set(made["versions"]) >= {"python", "beliefrl", "jax", "jaxlib", "equinox", "optax", "numpy"}
    assert ("gymnasium" in made["versions"]) == ("gymnasium" in sys.modules)
    assert made["versions"]["jax"] == jax.__version__
    json.dumps(made)


def test_the_commit_is_not_that_of_a_project_around_the_package(tmp_path, monkeypatch):
    inside = tmp_path / "project" / ".venv" / "records.py"
    inside.parent.mkdir(parents=True)
    inside.touch()
    git = ["git", "-C", str(tmp_path / "project"), "-c", "user.name=a", "-c", "user.email=a"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "first"], check=True)
    monkeypatch.setattr(records, "__file__", str(inside))
    assert provenance()["git_commit"] is None
    subprocess.run([*git, "add", "-f", str(inside)], check=True)
    subprocess.run([*git, "commit", "-q", "-m", "second"], check=True)
    assert re.fullmatch("[0-9a-f]{40}", provenance()["git_commit"])


def test_a_measure_that_no_episode_has_can_be_read_again(recorder):
    """`summary.summary` writes None for it."""
    nan, returns = np.full((2, 2, 3), np.nan), np.ones((2, 2, 3))
    result = summary(Episode(np.ones((2, 2, 3), bool), returns, returns.astype(int), {"time": nan}))
    assert result["mode"]["time"] is None
    assert result["mode"]["seeds_time"] == [None, None]
    recorder.finish({"step": 7} | result)
    assert Run(recorder.folder).results()["mode"]["seeds_time"] == [None, None]
