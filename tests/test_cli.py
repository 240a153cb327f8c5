"""The command line: what it lists, and what it says of mistakes."""

import contextlib
import importlib.metadata
import json
import os

import pytest

from beliefrl import cli, tasks

TRAIN = "train vrm pendulum-v"
AGENTS = {"vrm", "sac-mlp", "sac-lstm", "slac", "vrm-single", "vrm-first", "vrm-keep", "vrm-deterministic"}
TASKS = {"pendulum", "pendulum-v", "pendulum-p", "cartpole", "cartpole-v", "cartpole-p", "target-reaching"}
ROBOTS = {name + mask for name in ("hopper", "walker2d", "ant", "halfcheetah") for mask in ("", "-v", "-p")}


def printed(capsys, line):
    """What a command prints that ends well and complains of nothing."""
    with contextlib.suppress(SystemExit):
        cli.main(line.split())
    out, err = capsys.readouterr()
    assert err == ""
    return out


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
    "train slac pendulum-v --history 0": "history=0 is impossible",
    "train sac-lstm pendulum-v --burn-in -1": "burn_in=-1 is impossible",
    "train sac-mlp pendulum-v --seq-len 4": "There is no option --seq-len",
    f"{TRAIN} --models three": "--models must be one of 'both', 'single', 'first', 'keep', not 'three'",
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
    "export": "RUN is missing",
    "export missing policy.jax": "no run folder missing",
    "export untrained policy.jax": "untrained has no trained agent yet",
    "export untrained policy.jax --seed 3": "untrained has no seed 3: it has 0",
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
