"""Environments in processes of their own, and what a training does with environments that are hard to handle."""

import json
import multiprocessing
import signal

import jax
import numpy as np
import pytest

from beliefrl import UserError, evaluate, tasks, train
from beliefrl.errors import Fault
from beliefrl.runs.options import Options
from beliefrl.runs.run import Run
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.lockstep import Lockstep, step_seconds
from beliefrl.training.schedule import _processes
from worlds import saved, tiny
from wrong import Fine, OnlyHere, Single, Wide, WithChild

LANES = ["seed 0", "seed 1"]


@pytest.mark.slow
def test_an_environment_may_start_processes_in_its_process():
    lanes = Lockstep(GymnasiumTask(WithChild), LANES, "always")
    assert lanes.reset(np.array([0, 1])).shape == (2, 2)
    lanes.close()
    assert not any(process.is_alive() for process in lanes._envs.processes)


def test_one_that_cannot_be_made_in_its_process_says_why():
    lanes = Lockstep(GymnasiumTask(OnlyHere), LANES, "always")
    with pytest.raises(Fault, match=r"seed \d: OnlyHere cannot be made: OSError: the port is in use"):
        lanes.reset(np.array([0, 1]))
    lanes.close()


def test_the_switch_of_an_environment_to_64_bits_stays_in_its_process():
    lanes = Lockstep(GymnasiumTask(Wide), LANES, "always")
    assert not jax.config.read("jax_enable_x64")
    lanes.reset(np.array([0, 1]))
    lanes.close()


@pytest.mark.slow
def test_agents_are_evaluated_as_they_were_trained_each_in_its_process(tmp_path):
    run = saved(tmp_path / "run", "sac-mlp", GymnasiumTask(Single))
    config = json.loads((run.folder / "config.json").read_text())
    (run.folder / "config.json").write_text(
        json.dumps(config | {"options": config["options"] | {"processes": "always"}})
    )
    assert evaluate(Run(run.folder), 1, task=Single, own_process=True)["episodes"] == 1
    with pytest.raises(UserError, match="only one simulation per process"):
        evaluate(Run(run.folder), 1, task=Single)  # a script would start itself again


def test_environments_in_this_process_leave_its_signals_alone(monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: "as in a process pool")
    Lockstep(GymnasiumTask(Fine), LANES).close()
    assert signal.getsignal(signal.SIGTERM) is before


def test_those_already_made_are_closed_if_another_cannot_be_made():
    class Third(Fine):
        made, closed = 0, 0

        def __init__(self):
            Third.made += 1
            if Third.made > 3:  # the first was made for its sizes
                raise OSError("no more licences")
            super().__init__()

        def close(self):
            Third.closed += 1

    with pytest.raises(UserError, match="no more licences"):
        Lockstep(GymnasiumTask(Third), [*LANES, "seed 2"])
    assert Third.closed == 3


def test_one_that_fails_while_its_speed_is_measured_is_closed():
    class Falling(Fine):
        closed = 0

        def step(self, action):
            raise RuntimeError("fell")

        def close(self):
            Falling.closed += 1

    task = GymnasiumTask(Falling)
    assert step_seconds(task) == 0.0
    assert Falling.closed == 2  # and the one that was made for its sizes


def test_the_speed_of_a_shared_environment_is_not_measured():
    """It may be a robot, which would move."""
    assert _processes(Options(share_env=True), own_process=True) == "never"
    assert _processes(Options(share_env=True, seeds=2), own_process=True) == "always"
    assert _processes(Options(share_env=True, step_timeout=3.0), own_process=True) == "always"
    assert _processes(Options(share_env=True, seeds=2), own_process=False) == "never"


def test_no_more_environments_are_made_than_are_needed(tmp_path):
    class Counted(Fine):
        made = 0

        def __init__(self):
            Counted.made += 1
            super().__init__()

    agent = tiny("sac-mlp", step_start_rl=20, batch_size=8, pretrain_updates=5)
    task = GymnasiumTask(Counted, indices=(0,))
    train(agent, task, tmp_path / "run", steps=40, eval_every=20, eval_episodes=1, share_env=True, progress=False)
    assert Counted.made == 2  # one for its sizes, and one for all the rest


def test_a_script_with_an_object_as_an_argument_can_be_started_again(tmp_path):
    """The object has another address then, which is all that its text says."""

    class Gain:
        pass

    options = {"steps": 40, "eval_every": 40, "eval_episodes": 1, "resume": True, "progress": False}
    agent = tiny("sac-mlp", step_start_rl=20, batch_size=8, pretrain_updates=5)
    for _ in range(2):
        task = GymnasiumTask(Fine, arguments={"gain": Gain(), "speed": 2.0})
        run = train(agent, task, tmp_path / "run", **options)
    assert run.results()["step"] == 40
    with pytest.raises(UserError, match="was trained with constants="):
        train(agent, GymnasiumTask(Fine, arguments={"gain": Gain(), "speed": 3.0}), tmp_path / "run", **options)


def test_a_package_that_switches_to_64_bits_when_it_is_imported_does_not_change_the_training(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "wide.py").write_text(
        "import gymnasium, jax\n"
        "from wrong import Fine\n"
        "jax.config.update('jax_enable_x64', True)\n"
        "gymnasium.register('Wide-v0', Fine)\n"
    )
    _ = tasks.make("gym:wide:Wide-v0").spec
    assert not jax.config.read("jax_enable_x64")
