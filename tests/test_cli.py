"""The command line: its lists, its messages for mistakes, and a user's own agent."""

import contextlib
import dataclasses
import importlib
import importlib.metadata
import json
import os
import subprocess
import sys
from typing import Annotated, Literal

import pytest
import tyro

from beliefrl import cli
from beliefrl.commands import COMMANDS
from beliefrl.commands.arguments import parse
from beliefrl.commands.pictures import DemoOptions, FilmOptions, PredictOptions
from beliefrl.errors import UserError
from beliefrl.runs.run import Run
from beliefrl.sweeps.experiments import grid
from beliefrl.sweeps.plan import plan
from beliefrl.sweeps.run import sweep
from mistakes import MISTAKES, TRAIN, prepare
from worlds import installed

AGENTS = {
    "vrm",
    "sac-mlp",
    "sac-lstm",
    "slac",
    "predictive-sac",
    "vrm-single",
    "vrm-first",
    "vrm-keep",
    "vrm-deterministic",
}
TASKS = {"pendulum", "pendulum-v", "pendulum-p", "cartpole", "cartpole-v", "cartpole-p", "target-reaching"}
RUNNERS = ("hopper", "walker2d", "ant", "halfcheetah")
ROBOTS = {kind + name + mask for kind in ("", "mujoco-") for name in RUNNERS for mask in ("", "-v", "-p")}


def printed(capsys, line):
    """The output of a command that succeeds without messages on stderr."""
    with contextlib.suppress(SystemExit):
        cli.main(line.split())
    out, err = capsys.readouterr()
    assert err == ""
    return out


@pytest.mark.parametrize(("options", "given"), [(PredictOptions, ["run"]), (FilmOptions, ["run"]), (DemoOptions, [])])
def test_the_file_of_a_picture_can_be_given_by_a_short_option(options, given):
    assert str(parse(options, [*given, "-o", "file.png"], "beliefrl").out) == "file.png"


def test_help_names_every_command(capsys):
    for line in ("", "-h", "--help", "help"):
        out = printed(capsys, line)
        assert all(f"beliefrl {command}" in out for command in cli.COMMANDS)


def test_the_help_of_training_shows_hyperparameters_and_where_they_stand(capsys):
    out = printed(capsys, "train vrm --help")
    assert all(text in out for text in ("--gamma", "(Table 1)", "--seq-len", "(Table 2)", "--burn-in", "--steps"))
    assert "beliefrl train vrm --help" in printed(capsys, "train --help")


def test_tasks_and_agents_are_listed_one_a_line(capsys):
    listed = {line.split()[0] for line in printed(capsys, "tasks").splitlines()}
    assert {name for name in listed if not name.startswith("gym:")} == TASKS | ROBOTS
    assert {"gym:Hopper-v5", "gym:MountainCarContinuous-v0", "gym:ID"} < listed
    assert {line.split()[0] for line in printed(capsys, "agents").splitlines()} == AGENTS


def test_version(capsys):
    assert printed(capsys, "--version").strip() == importlib.metadata.version("beliefrl")


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """A working directory with faulty runs, in which a training must not start."""
    prepare(tmp_path)

    def begin(*_, **__):
        raise AssertionError("The mistake was not noticed.")

    monkeypatch.setattr("beliefrl.training.phases.compile_program", begin)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def complaint(capsys, argv):
    """The error message of a mistake, which is one line."""
    with pytest.raises(SystemExit) as end:
        cli.main(argv)
    out, err = capsys.readouterr()
    assert end.value.code == 2
    assert out == ""
    assert err.startswith("beliefrl: ")
    assert err.endswith("\n")
    assert err.count("\n") == 1
    return err


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_ends_with_one_sentence(folders, capsys, line, unchecked):
    before = sorted(folders.rglob("*"))
    assert MISTAKES[line] in complaint(capsys, line.split())
    assert sorted(folders.rglob("*")) == before
    assert (folders / "there" / "file").read_text() == "keep me"


@pytest.mark.parametrize("argv", [[""], ["train", ""], ["train", "vrm", ""], ["evaluate", ""], ["evaluate", "a\nb"]])
def test_empty_and_broken_words_are_mistakes_too(folders, capsys, argv):
    complaint(capsys, argv)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_parent_that_cannot_be_written_to_is_a_mistake(folders, capsys):
    (folders / "there").chmod(0o500)
    assert "cannot be made" in complaint(capsys, [*TRAIN.split(), "--out", "there/run"])


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes")])
def test_too_little_memory_is_said_in_one_sentence(folders, capsys, monkeypatch, error):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("beliefrl.training.phases.compile_program", fail)
    assert "not enough memory" in complaint(capsys, [*TRAIN.split(), "--out", "run"])


def test_a_mistake_has_its_exit_code_without_anybody_who_reads_it(tmp_path, monkeypatch):
    class Closed:
        def write(self, text):
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", Closed())
    with pytest.raises(SystemExit) as ended:
        cli.main(["show", str(tmp_path / "nowhere")])
    assert ended.value.code == 2


def test_a_program_without_an_output_ends_as_usual(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    cli.main(["--version"])


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("line", ["agents", "--version", "train vrm --help"])
def test_a_reader_that_closes_the_pipe_is_no_error(line, unbuffered):
    reads, writes = os.pipe()
    os.close(reads)
    command = [sys.executable, "-m", "beliefrl.cli", *line.split()]
    env = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    found = subprocess.run(command, stdout=writes, stderr=subprocess.PIPE, text=True, env=env)
    os.close(writes)
    assert (found.returncode, found.stderr) == (0, "")


@pytest.mark.parametrize(
    ("name", "shown", "why"),
    [
        ("foreign", "foreign", "There is no agent 'foreign'"),
        ("overset", "colour=1", "no hyperparameter 'colour'"),
    ],
)
def test_a_run_of_another_version_is_shown(folders, capsys, name, shown, why):
    cli.main(["show", name])
    out, err = capsys.readouterr()
    table, _, notes = out.rpartition("└")
    assert shown in table
    assert why in notes
    assert err == ""


def test_an_environment_that_changes_the_working_directory_does_not_move_a_picture(folders, capsys, monkeypatch):
    def moves(*_, **__):
        os.chdir("there")

    written = []
    monkeypatch.setattr("beliefrl.viewing.prediction.predictions", moves)
    monkeypatch.setattr("beliefrl.viewing.prediction.draw_predictions", lambda _, path, __: written.append(path))
    cli.main(["predict", "untrained", "--out", "picture.png"])
    assert written == [folders / "picture.png"]
    assert capsys.readouterr().out == "written to picture.png and picture.pdf\n"


# How values on the command line are parsed, and shown in the help.


@dataclasses.dataclass(frozen=True)
class Given:
    """Options of every kind."""

    files: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="FILES")] = ()
    steps: int = 1
    most: int | None = 2
    layers: tuple[int, ...] = (8, 8)
    preset: Literal["a", "b"] | None = None


def read(line):
    return parse(Given, line.split(), "beliefrl")


@pytest.mark.parametrize(("text", "number"), [("1e4", 10_000), ("20_000", 20_000), ("7", 7), ("-3", -3), ("2.0", 2)])
def test_whole_numbers_may_be_written_short(text, number):
    assert read(f"--steps {text}").steps == number
    assert read(f"--most {text}").most == number
    assert read(f"--layers 3 {text}").layers == (3, number)


@pytest.mark.parametrize("text", ["1.5", "many", "inf", "nan", "1e-3", "1e999999", "20k"])
def test_what_is_no_whole_number_is_a_mistake(text):
    for option in ("steps", "most"):
        with pytest.raises(UserError, match=f"^--{option} must be a whole number, not '{text}'"):
            read(f"--{option} {text}")


def test_options_may_be_none_and_lists_may_be_empty():
    assert read("--most None --preset None --layers") == Given(most=None, layers=())
    assert read("x y --preset b") == Given(files=("x", "y"), preset="b")
    with pytest.raises(UserError, match="--preset must be one of 'a', 'b', 'None', not 'c'"):
        read("--preset c")


NAMED = {"train": "train vrm", "bench": "bench vrm", "figure": "figure curves"}


@pytest.mark.parametrize("command", sorted(set(COMMANDS) - {"tasks", "agents"}))
def test_no_help_has_gaps(capsys, command):
    with pytest.raises(SystemExit):
        cli.main([*NAMED.get(command, command).split(), "--help"])
    out = capsys.readouterr().out
    assert "usage: beliefrl" in out
    assert "(default: )" not in out
    assert "{None}" not in out


def test_the_help_names_the_choices(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "vrm", "--help"])
    assert "--processes {auto,always,never}" in capsys.readouterr().out


# A user's own agent: named as MODULE:CLASS, and never imported unless it is.

OWN = "worlds:CountingAgent"
TRAIN_OWN = f"train {OWN} pendulum-p --eval-every 20 --eval-episodes 1 --out run"
READ = ("resume run", "evaluate run", "export run p.jax", "predict run", "video run f.gif", "film run")


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
    cli.main([*TRAIN_OWN.split(), "--steps", "20", "--cycle", "2"])
    out = " ".join(capsys.readouterr().out.split())
    assert f"`beliefrl evaluate run --agent {OWN}`" in out
    assert Run("run").config["agent"] == OWN
    assert Run("run").config["hyperparameters"]["cycle"] == 2
    cli.main([*TRAIN_OWN.split(), "--steps", "22", "--cycle", "2", "--resume"])
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
    assert "offers no predictions" in complaint(capsys, f"predict run --agent {OWN}".split())
    assert "was trained with cycle=2, not 4" in complaint(capsys, f"{TRAIN_OWN} --steps 24 --cycle 4 --resume".split())


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
    assert phrase in complaint(capsys, line.split())


@pytest.mark.parametrize("line", READ)
def test_a_run_of_it_says_what_to_give(recorded, capsys, line):
    assert "run was trained by trap:Agent: give --agent trap:Agent" in complaint(capsys, line.split())
    assert f"was trained by trap:Agent, not by {OWN}" in complaint(capsys, f"{line} --agent {OWN}".split())


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
    (recorded / "sweep" / "sweep.json").write_text(json.dumps({"format": 1, "trainings": [whole]}))
    assert "sweep trains trap:Agent: name that agent again" in complaint(capsys, ["sweep", "--out", "sweep"])
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
