"""What a run's folder keeps: nothing of the user's is removed, the best agents stay, and trackers get the numbers."""

import errno
import importlib.util
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from beliefrl import Options, UserError, resume
from beliefrl.runs import arrays, best, trackers
from beliefrl.runs.folder import is_locked, locked, make
from beliefrl.runs.recorder import Recorder
from inputs import a_run, flat

CONFIG = {
    "agent": "vrm",
    "hyperparameters": {},
    "task": "pendulum",
    "constants": {},
    "options": {"seed": 0, "seeds": 1},
}
LEFT = ("metrics/seed-0.jsonl", "tensorboard/seed-0/events.out", "lock", ".agent.safetensors.tmp")
LEFT += ("initial.safetensors",)
LEFT += ("checkpoints/.000001-step-10.tmp/state.safetensors", "checkpoints/replay/000001.safetensors")


def left(folder, *names):
    """The folder of a training that saved nothing, with more in it."""
    for name in (*LEFT, *names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    (folder / "config.json").write_text(json.dumps(CONFIG))
    return folder


def test_what_a_failed_training_left_is_replaced(tmp_path):
    make(left(tmp_path), CONFIG | {"agent": "slac"})
    assert {path.name for path in tmp_path.iterdir()} == {"metrics", "config.json", "lock"}
    assert json.loads((tmp_path / "config.json").read_text())["agent"] == "slac"
    assert not any((tmp_path / "metrics").iterdir())


def test_an_empty_folder_and_one_that_was_just_made_are_taken(tmp_path):
    make(tmp_path, CONFIG)
    (tmp_path / "config.json").rename(tmp_path / ".config.json.tmp")
    make(tmp_path, CONFIG)
    assert (tmp_path / "config.json").exists()


@pytest.mark.parametrize(
    "name",
    [
        "agent.safetensors",
        "results.json",
        "notes.txt",
        "metrics/thesis.tex",
        "checkpoints/000001-step-10/manifest.json",
        "checkpoints/damaged-000001-step-10/manifest.json",
        "checkpoints/kept-for-seed-0/manifest.json",
    ],
)
def test_what_was_saved_or_is_the_users_stays(tmp_path, name):
    left(tmp_path, name)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match="exists already: choose another --out, or `beliefrl resume"):
        make(tmp_path, CONFIG)
    assert sorted(tmp_path.rglob("*")) == before


def test_the_config_of_another_program_stays(tmp_path):
    (tmp_path / "config.json").write_text('{"editor": "vi"}')
    with pytest.raises(UserError, match=r"exists already: choose another --out; in Python out=\.$"):
        make(tmp_path, CONFIG)
    assert (tmp_path / "config.json").read_text() == '{"editor": "vi"}'


def test_a_training_that_goes_on_is_left_alone(tmp_path):
    with locked(left(tmp_path), "is being trained"), pytest.raises(UserError, match="is being trained by"):
        make(tmp_path, CONFIG)
    assert (tmp_path / "metrics" / "seed-0.jsonl").exists()


def weights(value):
    """The agents of two seeds."""
    return {"w": np.full((2, 3), value, np.float32)}


def test_the_best_agent_of_each_seed_stays(tmp_path):
    assert best.evaluations(tmp_path, 2) == [None, None]
    for step, returns in ((10, [1.0, np.nan]), (20, [0.5, -3.0]), (30, [1.0, -2.5]), (40, [np.nan, -2.6])):
        best.save(tmp_path, weights(step), step, returns)
    assert best.evaluations(tmp_path, 2) == [{"step": 10, "return": 1.0}, {"step": 30, "return": -2.5}]
    np.testing.assert_array_equal(arrays.load(tmp_path / best.BEST)["['w']"][:, 0], [10, 30])
    written = (tmp_path / best.BEST).stat().st_mtime_ns
    best.save(tmp_path, weights(50), 50, [1.0, -2.5])
    assert (tmp_path / best.BEST).stat().st_mtime_ns == written  # equal is not better


@pytest.mark.parametrize("content", [b"nonsense", arrays.packed(weights(1.0), {"evaluations": "[1, 2]"})])
def test_a_damaged_file_of_best_agents_is_one_sentence_and_a_training_sets_it_aside(tmp_path, content):
    (tmp_path / best.BEST).write_bytes(content)
    with pytest.raises(UserError, match=r"best\.safetensors is damaged: restore it"):
        best.evaluations(tmp_path, 2)
    best.save(tmp_path, weights(1.0), 10, [1.0, 1.0])
    assert (tmp_path / f"damaged-{best.BEST}").read_bytes() == content
    assert best.evaluations(tmp_path, 2) == [{"step": 10, "return": 1.0}] * 2


def test_a_run_of_an_older_version_has_no_best_agent(tmp_path):
    recorder = Recorder(tmp_path / "run", CONFIG)
    recorder.log(0, "evaluation", 10, {"sampled": [1.0], "mode": [1.0]})
    recorder.save(weights(1.0))
    recorder.close()
    with pytest.raises(UserError, match="has only its last agent: leave out --best"):
        recorder.agents(best=True)
    assert recorder.agents() == recorder.folder / "agent.safetensors"


# Where numbers go besides a run's own logs, and that nothing else happens.

TRACKED = CONFIG | {"started": "2026-01-01T00:00:00"}


class Heard:
    """A tracker that remembers."""

    def __init__(self, is_whole):
        self.is_whole, self.rows, self.closed = is_whole, [], False

    def log(self, step, values):
        self.rows.append((step, values))

    def flush(self):
        pass

    def close(self):
        self.closed = True


@pytest.fixture
def heard(monkeypatch):
    """Trackers whole and not, of all seeds."""
    made = {}

    def make(name):
        def one(folder, seed, config):
            made[name, seed] = Heard(name == "tensorboard")
            return made[name, seed]

        return one

    monkeypatch.setattr(trackers, "TRACKERS", {name: make(name) for name in ("tensorboard", "wandb")})
    return made


def recorder(folder, track, config=TRACKED):
    options = {"seed": 0, "seeds": 2, "track": track}
    return Recorder(folder, config and {**config, "options": options})


def test_trackers_get_numbers_and_means_of_lists(tmp_path, heard):
    run = recorder(tmp_path / "run", ["tensorboard", "wandb"])
    run.log(1, "evaluation", 10, {"sampled": [1.0, 3.0], "why": "words"})
    run.close()
    for name in ("tensorboard", "wandb"):
        assert heard[name, 1].rows == [(10, {"evaluation/sampled": 2.0})]
        assert heard[name, 0].rows == []
        assert heard[name, 1].closed


def test_one_that_is_written_anew_gets_everything_and_another_only_what_is_new(tmp_path, heard):
    run = recorder(tmp_path / "run", ["tensorboard", "wandb"])
    run.log(0, "update", 1, {"loss": 1.0})
    lengths = run.lengths()
    run.log(0, "update", 2, {"loss": 2.0})
    run.close()
    again = Recorder(tmp_path / "run", None)
    again.rewind(lengths)
    again.log(0, "update", 2, {"loss": 2.5})
    again.close()
    assert [step for step, _ in heard["tensorboard", 0].rows] == [1, 2]
    assert heard["wandb", 0].rows == [(2, {"update/loss": 2.5})]


def test_no_tracker_gets_anything_where_that_is_asked_for(tmp_path, heard):
    run = recorder(tmp_path / "run", [])
    run.log(0, "update", 1, {"loss": 1.0})
    run.close()
    assert heard == {}
    assert len(list(run.rows(0))) == 1


def test_tensorboard_has_event_files(tmp_path):
    run = recorder(tmp_path / "run", ["tensorboard"])
    run.log(0, "update", 1, {"loss": 1.0})
    run.close()
    assert [path.parent.name for path in sorted((tmp_path / "run" / "tensorboard").rglob("*tfevents*"))] == [
        "seed-0",
        "seed-1",
    ]


def test_all_are_closed_whatever_one_of_them_does(tmp_path, heard, monkeypatch):
    def fail(self):
        raise OSError("no room")

    run = recorder(tmp_path / "run", ["tensorboard", "wandb"])
    monkeypatch.setattr(heard["wandb", 1], "close", fail.__get__(heard["wandb", 1]))
    with pytest.raises(KeyError, match="the first"), run:
        raise KeyError("the first")
    assert [heard[which].closed for which in heard] == [True, True, True, False]
    again = Recorder(tmp_path / "run", None)
    with pytest.raises(OSError, match="no room"), again:
        again._trackers = {1: [heard["wandb", 1]]}
    Recorder(tmp_path / "run", None).close()


def test_a_tracker_that_cannot_be_opened_is_one_sentence_and_blocks_nothing(tmp_path, heard, monkeypatch):
    def fail(*_):
        raise RuntimeError("\x1b[31mno key\x1b[0m\nlog in")

    working = trackers.TRACKERS["wandb"]
    monkeypatch.setitem(trackers.TRACKERS, "wandb", fail)
    with pytest.raises(UserError, match=r"^track=wandb cannot be opened: RuntimeError: no key log in\.$"):
        recorder(tmp_path / "run", ["tensorboard", "wandb"])
    assert heard["tensorboard", 0].closed
    monkeypatch.setitem(trackers.TRACKERS, "wandb", working)
    recorder(tmp_path / "run", ["wandb"]).close()


def went_on_elsewhere(folder):
    """A run with a checkpoint that was tracked by Weights & Biases on another machine."""
    run = a_run(folder / "run", [flat(1.0)])
    config = run.config | {"options": run.config["options"] | {"track": ["wandb"]}}
    (run.folder / "config.json").write_text(json.dumps(config))
    checkpoint = run.folder / "checkpoints" / "000001-step-10"
    checkpoint.mkdir(parents=True)
    (checkpoint / "manifest.json").write_text("{}")
    return run.folder


def test_a_package_that_is_missing_is_an_error_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'beliefrl\[wandb\]'"):
        trackers.check(("wandb",))
    trackers.check(("tensorboard",))
    with pytest.raises(UserError, match=r"pip install 'beliefrl\[wandb\]'"):
        resume(went_on_elsewhere(tmp_path))
    assert Options().track == ("tensorboard",)


OFFLINE = """
import socket, sys
allowed = {socket.AF_UNIX}
real = socket.socket.connect
def connect(self, address):
    local = self.family in allowed or address[0] in ("127.0.0.1", "::1", "localhost")
    assert local, f"The network was used: {address}"
    return real(self, address)
socket.socket.connect = connect
from beliefrl.runs.recorder import Recorder
config = {"agent": "vrm", "hyperparameters": {}, "task": "pendulum", "constants": {}, "started": "2026-01-01T00:00:00"}
run = Recorder(sys.argv[1], {**config, "options": {"seed": 0, "seeds": 2, "track": ["wandb"]}})
for seed in (0, 1):
    run.log(seed, "evaluation", 10, {"sampled": [1.0, 3.0 + seed]})
run.close()
"""


@pytest.mark.slow
def test_weights_and_biases_is_kept_offline_in_the_runs_folder(tmp_path):
    pytest.importorskip("wandb", reason="W&B is not installed: pip install 'beliefrl[wandb]'.")
    quiet = {name: value for name, value in os.environ.items() if not name.startswith("WANDB")}
    quiet.pop("JAX_DISABLE_MOST_OPTIMIZATIONS", None)
    command = [sys.executable, "-c", OFFLINE, str(tmp_path / "run")]
    done = subprocess.run(command, env=quiet, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    kept = sorted((tmp_path / "run" / "wandb").rglob("*.wandb"))
    assert len(kept) == 2
    contents = [path.read_bytes() for path in kept]
    assert all(b"evaluation/sampled" in content for content in contents)
    assert all(len(content) > 100 for content in contents)
    assert not (tmp_path / "wandb").exists()


def test_whether_a_folder_is_locked_can_be_asked(tmp_path):
    assert not is_locked(tmp_path / "missing")
    assert not is_locked(tmp_path)
    with locked(tmp_path, "is in use"):
        assert is_locked(tmp_path)
        assert (tmp_path / "lock").read_text()  # it still says who has locked it
    assert not is_locked(tmp_path)


def test_a_file_system_without_locks_is_no_error(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def flock(file, how):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(fcntl, "flock", flock)
    locked(tmp_path, "is being trained").close()
