"""The command line: what it lists, what it says of mistakes, and a training from beginning to end."""

import importlib.metadata
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from beliefrl import agents, cli, tasks
from beliefrl.analysis.curves import draw_curve
from beliefrl.runs import Run

TRAIN = "train vrm pendulum-v"
TASKS = {"pendulum", "pendulum-v", "pendulum-p", "cartpole", "cartpole-v", "cartpole-p", "target-reaching"}


def printed(capsys, line):
    """What a command prints that ends well."""
    try:
        cli.main(line.split())
    except SystemExit as end:
        assert not end.code
    return capsys.readouterr().out


def test_help_names_every_command(capsys):
    for line in ("", "-h", "--help", "help"):
        out = printed(capsys, line)
        assert all(f"beliefrl {command}" in out for command in cli.COMMANDS)


def test_the_help_of_training_shows_hyperparameters_and_where_they_stand(capsys):
    out = printed(capsys, "train vrm --help")
    assert all(text in out for text in ("--gamma", "(Table 1)", "--seq-len", "(Table 2)", "--burn-in", "--steps"))
    assert "beliefrl train vrm --help" in printed(capsys, "train --help")


def test_tasks_and_agents_are_listed_one_a_line(capsys):
    assert {line.split()[0] for line in printed(capsys, "tasks").splitlines()} == TASKS
    assert [line.split()[0] for line in printed(capsys, "agents").splitlines()] == ["vrm"]


def test_version(capsys):
    assert printed(capsys, "--version").strip() == importlib.metadata.version("beliefrl")


MISTAKES = {
    "trian": "did you mean train?",
    "frobnicate": "no command 'frobnicate'",
    "train": "No agent is named",
    "train vmr pendulum-v": "no agent 'vmr': did you mean vrm?",
    "train vrm": "TASK is missing",
    "train vrm pendulm-v": "no task 'pendulm-v': did you mean pendulum-v?",
    f"{TRAIN} extra": "one argument too many, 'extra'",
    f"{TRAIN} --setps 5": "no option --setps: did you mean --steps?",
    f"{TRAIN} --gama=2": "did you mean --gamma?",
    f"{TRAIN} --steps": "--steps needs a value",
    f"{TRAIN} --steps many": "--steps must be a whole number, not 'many'",
    f"{TRAIN} --steps 1.5": "--steps must be a whole number, not '1.5'",
    f"{TRAIN} --steps -5": "steps=-5 is impossible",
    f"{TRAIN} --steps 99999999999999999999": "steps=99999999999999999999 is impossible",
    f"{TRAIN} --seeds 0": "seeds=0 is impossible: it must be a whole number from 1",
    f"{TRAIN} --seeds 99999999999": "seeds=99999999999 is impossible",
    f"{TRAIN} --seed -1": "seed=-1 is impossible",
    f"{TRAIN} --seed 2147483647 --seeds 5": "seed=2147483647 is impossible",
    f"{TRAIN} --eval-every 0": "eval_every=0 is impossible",
    f"{TRAIN} --eval-episodes -2": "eval_episodes=-2 is impossible",
    f"{TRAIN} --gamma 2": "gamma=2.0 is impossible: it must be a number from 0 to 1",
    f"{TRAIN} --gamma x": "--gamma must be a number, not 'x'",
    f"{TRAIN} --tau -1": "tau=-1.0 is impossible",
    f"{TRAIN} --seq-len 0": "seq_len=0 is impossible: it must be a whole number of at least 1",
    f"{TRAIN} --batch-size 0": "batch_size=0 is impossible",
    f"{TRAIN} --d-size 99999999999": "d_size=99999999999 is impossible",
    f"{TRAIN} --lr-actor nan": "lr_actor=nan is impossible",
    f"{TRAIN} --lr-actor -1": "lr_actor=-1.0 is impossible",
    f"{TRAIN} --actor-regulariser inf": "actor_regulariser=inf is impossible",
    f"{TRAIN} --policy-layers 0": "policy_layers=(0,) is impossible",
    f"{TRAIN} --policy-layers": "policy_layers=() is impossible",
    f"{TRAIN} --elbo-scaling foo": "--elbo-scaling must be one of 'mean', 'sum', not 'foo'",
    f"{TRAIN} --train-interval-rl 3": "train_interval_klvrm=5 is not a multiple of train_interval_rl=3",
    f"{TRAIN} --replay-capacity 10": "replay_capacity=10 is too small: this agent needs at least 2000",
    f"{TRAIN} --out there": "there exists already",
    f"{TRAIN} --out there/file/run": "there/file/run cannot be made",
    "evaluate": "RUN is missing",
    "evaluate missing": "no run folder missing",
    "evaluate there": "there is not a run",
    "evaluate broken": "broken/config.json cannot be read",
    "evaluate empty": "empty/config.json lacks",
    "evaluate untrained": "untrained has no trained agent yet",
    "evaluate damaged": "damaged/agent.safetensors is damaged",
    "evaluate foreign": "no agent 'foreign'",
    "evaluate untrained --episodes 0": "episodes=0 is impossible",
    "evaluate untrained --episodes 999999999999": "episodes=999999999999 is impossible",
    "evaluate untrained --seed -1": "seed=-1 is impossible",
    "evaluate untrained --episdes 2": "did you mean --episodes?",
    "tasks all": "one argument too many, 'all'",
    "bench": "No agent is named",
    "bench vrm --obs 0": "obs_dim=0 is impossible",
    "bench vrm --actions -1": "action_dim=-1 is impossible",
    "bench vrm --seeds 0": "seeds=0 is impossible",
}


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """A working directory with runs that have something wrong with them, where no training can begin."""
    config = {
        "agent": "vrm",
        "hyperparameters": {"d_size": 4},
        **tasks.describe(tasks.make("pendulum-v")),
        "options": {"seed": 0, "seeds": 1},
    }
    foreign = json.dumps(config | {"agent": "foreign"})
    config = json.dumps(config)
    contents = {"broken": config[:50], "empty": "{}", "untrained": config, "damaged": config, "foreign": foreign}
    for name, content in contents.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(content)
    (tmp_path / "damaged" / "agent.safetensors").write_bytes(b"nonsense")
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("keep me")

    def begin(*_, **__):
        raise AssertionError("The mistake was not noticed.")

    monkeypatch.setattr("beliefrl.phases.compile_program", begin)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def complaint(capsys, argv):
    """The one sentence that a mistake ends with."""
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
def test_a_mistake_ends_with_one_sentence(folders, capsys, line):
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


def test_too_little_memory_is_said_in_one_sentence(folders, capsys, monkeypatch):
    def fail(*_, **__):
        raise MemoryError

    monkeypatch.setattr("beliefrl.phases.compile_program", fail)
    assert "not enough memory" in complaint(capsys, [*TRAIN.split(), "--out", "run"])


# A training

SMALL = {
    "step_start_rl": 20,
    "policy_layers": (8, 8),
    "value_layers": (8, 8),
    "train_times_fivrm": 5,
    "seq_len": 8,
    "batch_size": 2,
    "burn_in": 4,
    "d_size": 8,
    "z_size": 4,
    "hidden_size": 8,
}
OPTIONS = {"steps": 60, "seeds": 2, "seed": 0, "eval_every": 30, "eval_episodes": 2}


def flags(settings):
    """Settings as they are given on the command line."""
    words = []
    for name, value in settings.items():
        words += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words


def program(*argv):
    return [sys.executable, "-m", "beliefrl.cli", *map(str, argv)]


def output(*command):
    """What a program prints; it must end well, and complain of nothing."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """The folder of a finished training, and what it printed; made once where several workers want it."""
    temporary = tmp_path_factory.getbasetemp()
    folder = (temporary.parent if "PYTEST_XDIST_WORKER" in os.environ else temporary) / "trained"
    told = folder.with_suffix(".txt")
    try:
        folder.with_suffix(".lock").touch(exist_ok=False)
    except FileExistsError:
        wait_for(told.exists)
    else:
        printed = "The training failed."
        try:
            printed = output(*program(*TRAIN.split(), *flags(OPTIONS | SMALL), "--out", folder))
        finally:
            told.with_suffix(".part").write_text(printed)
            told.with_suffix(".part").rename(told)
    return folder, told.read_text()


def wait_for(happened, seconds=400):
    """Wait until something has happened."""
    until = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < until
        time.sleep(0.1)


def rows(folder, seed, kind):
    return list(Run(folder).rows(seed, kind))


def test_a_training_leaves_what_the_documentation_says(trained):
    folder, _ = trained
    files = {"config.json", "metrics", "tensorboard", "agent.safetensors", "results.json", "curve.png"}
    assert {path.name for path in folder.iterdir()} == files
    config = Run(folder).config
    assert (config["agent"], config["task"]) == ("vrm", "pendulum-v")
    assert agents.make("vrm", **SMALL) == agents.make(
        "vrm", **{k: tuple(v) if isinstance(v, list) else v for k, v in config["hyperparameters"].items()}
    )
    assert OPTIONS.items() <= config["options"].items()
    assert {"versions", "device", "git_commit", "command", "started"} <= set(config)
    for seed in range(2):
        (events,) = (folder / "tensorboard" / f"seed-{seed}").iterdir()
        assert events.stat().st_size > 500
        assert [row["step"] for row in rows(folder, seed, "pretrain")] == [5]
        assert all(np.isfinite(row["loss_q"]) for row in rows(folder, seed, "update"))
    assert rows(folder, 0, "update") != rows(folder, 1, "update")


def test_a_training_is_evaluated_in_both_modes(trained):
    folder, printed = trained
    for seed in range(2):
        evaluations = rows(folder, seed, "evaluation")
        assert [row["step"] for row in evaluations] == [30, 60]
        assert all(len(row[mode]) == 2 for row in evaluations for mode in ("sampled", "mode"))
    results = Run(folder).results()
    last = [rows(folder, seed, "evaluation")[-1]["mode"] for seed in range(2)]
    np.testing.assert_allclose(results["mode"]["seeds"], np.mean(last, axis=1), rtol=1e-6)
    table = printed[printed.index("vrm on pendulum-v after 60 steps") :]
    assert f"{results['mode']['mean']:.1f}" in table
    assert f"saved in {folder}" in printed.splitlines()[-1] or str(folder) in " ".join(printed.splitlines()[-2:])


def test_evaluate_prints_one_object_and_the_same_for_the_same_seed(trained):
    folder, _ = trained
    command = program("evaluate", folder, "--episodes", 3, "--json")
    first, again, other = output(*command), output(*command), output(*command, "--seed", "1")
    assert first == again
    assert first != other
    assert first.count("\n") == 1
    result = json.loads(first)
    assert set(result) == {"episodes", "sampled", "mode"}
    assert result["episodes"] == 3
    for mode in ("sampled", "mode"):
        assert set(result[mode]) == {"mean", "sem", "seeds", "success", "seeds_success"}
        assert len(result[mode]["seeds"]) == 2
        assert result[mode]["success"] is None


def test_python_gives_the_metrics_of_the_command_line(trained, tmp_path):
    folder, _ = trained
    script = f"""
import beliefrl
agent = beliefrl.make_agent("vrm", **{SMALL})
run = beliefrl.train(agent, beliefrl.make_task("pendulum-v"), out={str(tmp_path / "run")!r}, **{OPTIONS})
assert beliefrl.evaluate(run, episodes=1)["episodes"] == 1
"""
    assert output(sys.executable, "-c", script) == ""
    for seed in range(2):
        name = pathlib.Path("metrics") / f"seed-{seed}.jsonl"
        assert (tmp_path / "run" / name).read_text() == (folder / name).read_text()


def test_a_killed_training_can_be_evaluated_and_success_is_reported(tmp_path):
    folder = tmp_path / "run"
    options = OPTIONS | {"steps": 1_000_000, "seeds": 1, "eval_every": 50}
    command = program("train", "vrm", "target-reaching", *flags(options | SMALL), "--out", folder)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        log = folder / "metrics" / "seed-0.jsonl"
        try:
            wait_for(lambda: process.poll() is not None or (log.exists() and len(rows(folder, 0, "update")) > 5))
        finally:
            process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert len(rows(folder, 0, "evaluation")) >= 2
    assert "success sampled" in output(*program("evaluate", folder, "--episodes", 1))
    assert json.loads(output(*program("evaluate", folder, "--episodes", 2, "--json")))["mode"]["success"] in (0, 0.5, 1)
    assert draw_curve(Run(folder)).stat().st_size > 0


def test_ctrl_c_ends_with_one_sentence(tmp_path):
    settings = SMALL | {"step_start_rl": 10_000_000}
    command = program(*TRAIN.split(), "--steps", 20_000_000, "--seeds", 1, *flags(settings), "--out", tmp_path / "run")
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            for line in process.stdout:
                if line.endswith(" exploring\n"):
                    break
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130
    assert err.startswith("beliefrl: stopped")
    assert err.count("\n") == 1
