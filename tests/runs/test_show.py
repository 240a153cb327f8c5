"""`beliefrl show`: the settings, progress, results and damage of a run that is written by hand."""

import json
import re

import numpy as np
import pytest

from beliefrl.cli import main
from beliefrl.runs import best
from inputs import a_folder, flat

INITIAL = {
    "run": "runs/first",
    "agent": "vrm",
    "task": "pendulum",
    "git_commit": "abc",
    "best": True,
    "replay_step": 1000,
    "timesteps": 500,
}
FIRST = {
    "started": "2026-01-01T10:00:00+00:00",
    "ended": "2026-01-01T11:00:00+00:00",
    "device": "cpu",
    "command": ["beliefrl", "train", "vrm"],
    "git_commit": "def",
    "versions": {"jax": "0.10.0", "numpy": "2.0.0"},
}
SECOND = {"started": "2026-01-02T10:00:00+00:00", "device": "gpu", "command": ["beliefrl", "resume"]}
RESULTS = {
    "step": 30,
    "sampled": {"mean": -150.0, "sem": None, "seeds": [-150.0, None], "success": None, "seeds_success": None},
    "mode": {"mean": -140.0, "sem": None, "seeds": [-140.0, None], "success": None, "seeds_success": None},
}


def cells(text):
    """The rows of the tables in a text, with the border lines left out."""
    rows = (re.split("[│┃|]", line)[1:-1] for line in text.splitlines())
    return [tuple(cell.strip() for cell in row) for row in rows if row]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of a run, whose name must not become a colour; the screen is so wide that no line is broken."""
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "[red]run"


def test_everything_that_is_known_of_a_run_is_shown(folder, capsys):
    seeds = [flat(-300.0, -200.0, -150.0), flat(-250.0)]
    run = a_folder(
        folder,
        seeds,
        steps=100,
        diverged=[1],
        hyperparameters={"gamma": 0.9, "tau": 0.005},
        constants={"mass": 2.0},
        observe=[0],
        faults={"noise": 0.1},
        initial=INITIAL,
        resumed=[SECOND],
        **FIRST,
    )
    networks = {"weight": np.zeros((2, 3))}
    best.save(run, networks, 10, [-300.0, -250.0])
    best.save(run, networks, 20, [-200.0, np.nan])
    for name in ("000001-step-10", "000002-step-20"):
        (run / "checkpoints" / name).mkdir(parents=True)
    (run / "results.json").write_text(json.dumps(RESULTS))
    log = run / "metrics" / "seed-0.jsonl"
    log.write_text(log.read_text() + "scribble\n")

    main(["show", folder.name])
    out, err = capsys.readouterr()
    assert err == ""
    assert out.splitlines()[0].strip() == folder.name
    replay = "its replay of step 1,000 (at most 500 timesteps)"
    assert cells(out) == [
        ("agent", "vrm"),
        ("settings", "gamma=0.9"),
        ("task", "pendulum-v mass=2.0 observe=0 noise=0.1"),
        ("seeds", "0, 1"),
        ("steps", "30 of 100"),
        ("diverged", "seed 1 by step 15: a loss is not finite"),
        ("initial networks", f"best agent of runs/first (vrm on pendulum), commit abc, and {replay}"),
        ("best agent", "seed 0 at step 20: return -200.0 sampled"),
        ("best agent", "seed 1 at step 10: return -250.0 sampled"),
        ("checkpoints", "000001-step-10, 000002-step-20"),
        ("started", "2026-01-01T10:00:00+00:00 to 2026-01-01T11:00:00+00:00, cpu"),
        ("command", "beliefrl train vrm"),
        ("commit", "def"),
        ("versions", "jax 0.10.0 numpy 2.0.0"),
        ("resumed", "2026-01-02T10:00:00+00:00 to ?, gpu"),
        ("command", "beliefrl resume"),
        ("commit", "None"),
        ("versions", ""),
        ("seed", "sampled actions", "mode actions"),
        ("0", "-150.0", "-140.0"),
        ("1", "diverged", "diverged"),
        ("mean ± S.E.M.", "-150.0", "-140.0"),
    ]
    assert "after 30 steps" in out
    assert out.splitlines()[-1] == f"damaged: Line 5 of {folder.name}/metrics/seed-0.jsonl is damaged and left out."


def test_results_that_are_older_than_the_log_are_said_to_be_so(folder, capsys):
    """The training still runs, or was killed."""
    run = a_folder(folder, [flat(-300.0, -200.0), flat(-300.0, -200.0)], steps=100)
    (run / "results.json").write_text(json.dumps(RESULTS | {"step": 10}))
    main(["show", folder.name])
    command = f"`beliefrl figure table '{folder.name}' --unfinished`"
    assert (
        f"the log has an evaluation of step 20 that is not in results.json: {command} shows it"
        in capsys.readouterr().out
    )


def test_of_a_run_that_has_only_begun_little_is_shown(folder, capsys):
    a_folder(folder, [[]], steps=100, updates=[], initial={"run": "runs/first", "agent": "vrm", "task": "pendulum"})
    main(["show", folder.name])
    out = capsys.readouterr().out
    shown = dict(row for row in cells(out) if len(row) == 2)
    assert shown["settings"] == "the agent's defaults"
    assert shown["steps"] == "0 of 100"
    assert shown["checkpoints"] == "none"
    assert shown["initial networks"] == "last agent of runs/first (vrm on pendulum), commit None"
    assert "best agent" not in shown
    assert "not in results.json" not in out
    assert "diverged" not in out
    assert "damaged" not in out
