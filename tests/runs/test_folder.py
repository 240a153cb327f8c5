"""A folder is used again where a training left nothing worth keeping; nothing of the user's is ever removed.

And beside the last agents it has the best ones.
"""

import json

import numpy as np
import pytest

from beliefrl.runs import arrays, best
from beliefrl.runs.folder import locked, make
from beliefrl.runs.run import Recorder
from beliefrl.types import UserError

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
def test_a_damaged_file_of_best_agents_is_one_sentence(tmp_path, content):
    (tmp_path / best.BEST).write_bytes(content)
    with pytest.raises(UserError, match=r"best\.safetensors is damaged: restore it"):
        best.save(tmp_path, weights(1.0), 10, [1.0, 1.0])
    assert (tmp_path / best.BEST).read_bytes() == content


def test_a_run_of_an_older_version_has_no_best_agent(tmp_path):
    recorder = Recorder(tmp_path / "run", CONFIG)
    recorder.log(0, "evaluation", 10, {"sampled": [1.0], "mode": [1.0]})
    recorder.save(weights(1.0))
    recorder.close()
    with pytest.raises(UserError, match=r"has no best agent \(an older version trained it, .*: leave out --best"):
        recorder.agents(best=True)
    assert recorder.agents() == recorder.folder / "agent.safetensors"
