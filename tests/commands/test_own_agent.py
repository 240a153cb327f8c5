"""The command line with a user's own agent: named as MODULE:CLASS, and never imported unless it is."""

import importlib
import json
import sys

import pytest

from beliefrl import cli
from beliefrl.runs.run import Run
from beliefrl.sweeps.plan import grid, plan
from beliefrl.sweeps.run import sweep
from beliefrl.types import UserError
from worlds import installed

OWN = "worlds:CountingAgent"
TRAIN = f"train {OWN} pendulum-p --eval-every 20 --eval-episodes 1 --out run"
READ = ("resume run", "evaluate run", "export run p.jax", "predict run", "video run f.gif", "film run")


def complaint(capsys, line):
    """The one sentence that a mistake ends with."""
    with pytest.raises(SystemExit) as ended:
        cli.main(line.split())
    out, err = capsys.readouterr()
    assert (ended.value.code, out, err.count("\n")) == (2, "", 1)
    return err


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")
    importlib.invalidate_caches()
    return tmp_path


@pytest.fixture
def recorded(folder):
    """A run that an agent in a module of this folder has trained, as its config says."""
    (folder / "trap.py").write_text("raise AssertionError('It was imported.')")
    (folder / "run" / "metrics").mkdir(parents=True)
    config = {"agent": "trap:Agent", "hyperparameters": {"size": 3}, "task": "pendulum-p", "constants": {}}
    (folder / "run" / "config.json").write_text(json.dumps(config | {"options": {"seed": 0, "seeds": 1}}))
    yield folder
    assert "trap" not in sys.modules


@pytest.mark.slow
def test_it_is_trained_resumed_and_read(folder, capsys):
    cli.main([*TRAIN.split(), "--steps", "20", "--cycle", "2"])
    out = " ".join(capsys.readouterr().out.split())
    assert f"`beliefrl evaluate run --agent {OWN}`" in out
    assert Run("run").config["agent"] == OWN
    assert Run("run").config["hyperparameters"]["cycle"] == 2
    cli.main([*TRAIN.split(), "--steps", "22", "--cycle", "2", "--resume"])
    assert Run("run").results()["step"] == 22
    cli.main(f"resume run --steps 24 --agent {OWN}".split())
    assert Run("run").results()["step"] == 24
    cli.main(f"export run p.jax --agent {OWN}".split())
    cli.main(f"video run f.gif --steps 2 --agent {OWN}".split())
    cli.main(f"film run --steps 2 --agent {OWN}".split())
    assert all((folder / name).exists() for name in ("p.jax", "f.gif", "run/film.png"))
    capsys.readouterr()
    cli.main(f"evaluate run --episodes 1 --json --agent {OWN}".split())
    assert json.loads(capsys.readouterr().out)["episodes"] == 1
    assert "offers no predictions" in complaint(capsys, f"predict run --agent {OWN}")
    assert "was trained with cycle=2, not 4" in complaint(capsys, f"{TRAIN} --steps 24 --cycle 4 --resume")


def test_help_lists_its_fields(capsys):
    for command in ("train", "bench"):
        with pytest.raises(SystemExit):
            cli.main([command, OWN, "--help"])
        assert "--pretrain-windows" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "phrase"),
    [
        ("train worlds:Counting pendulum", "worlds:Counting is no agent: it lacks step_start_rl"),
        ("train worlds:CountinAgent pendulum", "did you mean worlds:CountingAgent?"),
        ("train nowhere:Agent pendulum", "The module nowhere cannot be imported: ModuleNotFoundError"),
        ("train faulty:Agent pendulum", "The module faulty cannot be imported: ValueError: red."),
        ("train clashing:Agent pendulum", "Agent has a field steps, an option of this command: rename it"),
        (f"train {OWN} pendulum --cycel 3", "no option --cycel: did you mean --cycle?"),
        ("bench nowhere:Agent", "The module nowhere cannot be imported"),
        ("sweep --agents nowhere:Agent --tasks pendulum", "The module nowhere cannot be imported"),
    ],
)
def test_mistakes_are_sentences(folder, capsys, line, phrase):
    (folder / "faulty.py").write_text("raise ValueError('\\x1b[31mred\\x1b[0m')")
    (folder / "clashing.py").write_text(
        "import dataclasses, worlds\n"
        "@dataclasses.dataclass(frozen=True)\nclass Agent(worlds.CountingAgent):\n    steps: int = 3\n"
    )
    assert phrase in complaint(capsys, line)


@pytest.mark.parametrize("line", READ)
def test_a_run_of_it_says_what_to_give(recorded, capsys, line):
    assert "run was trained by trap:Agent: give --agent trap:Agent" in complaint(capsys, line)
    assert f"was trained by trap:Agent, not by {OWN}" in complaint(capsys, f"{line} --agent {OWN}")


def test_what_is_recorded_is_shown_without_it(recorded, capsys):
    cli.main(["show", "run"])
    out = capsys.readouterr().out
    assert "trap:Agent" in out
    assert "size=3" in out


def test_a_sweep_trains_it_by_its_name(folder):
    (training,) = plan(grid([OWN], ["pendulum"], seeds=1, cycle=2))
    assert training.name == "worlds-CountingAgent-pendulum-cycle=2-seed0"
    assert training.command(folder)[:5] == ["train", OWN, "pendulum", "--cycle", "2"]


def test_a_sweep_goes_on_only_where_it_is_named_again(recorded, capsys):
    whole = {"name": "a", "agent": "trap:Agent", "task": "pendulum", "settings": {}, "options": {}, "observe": []}
    (recorded / "sweep").mkdir()
    (recorded / "sweep" / "sweep.json").write_text(json.dumps({"trainings": [whole]}))
    assert "sweep trains trap:Agent: name that agent again" in complaint(capsys, "sweep --out sweep")
    with pytest.raises(UserError, match="sweep trains trap:Agent"):
        sweep(grid(["vrm"], ["pendulum"]), "sweep")


def test_what_packages_declare_is_listed(tmp_path, monkeypatch, capsys):
    installed(tmp_path / "a", monkeypatch, "beliefrl.agents", counting=OWN)
    installed(tmp_path / "b", monkeypatch, "beliefrl.tasks", counts="worlds:Counting")
    for command, name in (("agents", "counting"), ("tasks", "counts")):
        cli.main([command])
        assert name in [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    with pytest.raises(SystemExit):
        cli.main(["train", "counting", "counts", "--help"])
    assert "--pretrain-windows" in capsys.readouterr().out
