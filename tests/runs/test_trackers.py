"""Where numbers go besides a run's own logs, and that nothing else happens."""

import importlib.util
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from beliefrl import Options, UserError, resume
from beliefrl.runs import trackers
from beliefrl.runs.run import Recorder
from written import a_run, flat

CONFIG = {"agent": "vrm", "hyperparameters": {}, "task": "pendulum", "constants": {}, "started": "2026-01-01T00:00:00"}


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


def recorder(folder, track, config=CONFIG):
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
from beliefrl.runs.run import Recorder
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
    assert len(np.unique([len(content) > 100 for content in contents])) == 1
    assert not (tmp_path / "wandb").exists()
