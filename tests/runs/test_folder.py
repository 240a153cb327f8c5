"""A folder is used again where a training left nothing worth keeping; nothing of the user's is ever removed."""

import json

import pytest

from beliefrl.runs.folder import locked, make
from beliefrl.types import UserError

CONFIG = {
    "agent": "vrm",
    "hyperparameters": {},
    "task": "pendulum",
    "constants": {},
    "options": {"seed": 0, "seeds": 1},
}
LEFT = ("metrics/seed-0.jsonl", "tensorboard/seed-0/events.out", "lock", ".agent.safetensors.tmp")
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
