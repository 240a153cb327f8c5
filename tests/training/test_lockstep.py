"""An environment that does not answer is reported, and a training says what it is doing."""

import re
import threading
import time

import numpy as np
import pytest

from beliefrl import UserError, agents, train
from beliefrl.tasks.gymnasium import Fault, GymnasiumTask
from beliefrl.training import lockstep
from beliefrl.training.lockstep import Lockstep
from beliefrl.training.schedule import Options, _processes, stages
from worlds import SHARED
from wrong import Fine, Sleeping, Stuck, raising


@pytest.mark.parametrize("processes", ["never", pytest.param("always", marks=pytest.mark.slow)])
def test_a_slow_step_is_reported_once_while_it_goes_on(monkeypatch, processes):
    lanes = Lockstep(GymnasiumTask(Sleeping, "robot"), ["seed 0"], processes)  # made before the watch: it takes seconds
    monkeypatch.setattr(lockstep, "SLOW", 0.2)
    reports = []
    watch = threading.Thread(target=lanes._watch, args=(lambda report: reports.append((time.monotonic(), report)),))
    watch.start()
    lanes.reset(np.array([0]))
    for _ in range(3):
        lanes.step(np.zeros((1, 1), np.float32))
    ended = time.monotonic()
    lanes.close()
    watch.join(timeout=5)
    assert not watch.is_alive()
    assert [report for _, report in reports] == [
        "robot (step 3): step has not returned for 0 s: it is slow, or it hangs."
    ]
    assert reports[0][0] < ended - 0.1


def test_a_step_that_takes_too_long_is_a_fault_and_names_the_seed(monkeypatch):
    monkeypatch.setattr(lockstep, "PATIENCE", 0.1)
    lanes = Lockstep(GymnasiumTask(Stuck, "robot"), ["seed 0", "seed 1"], "always", timeout=3.0)
    lanes.reset(np.array([0, 1]))
    actions = np.array([[-1.0], [1.0]], np.float32)
    lanes.step(actions)
    lanes.step(actions)
    message = "robot (step 3): the step of seed 1 has not returned after 3 s, the step_timeout: "
    began = time.monotonic()
    with pytest.raises(Fault, match=f"^{re.escape(message)}"):
        lanes.step(actions)
    lanes.close()
    assert time.monotonic() - began < 30
    assert not any(process.is_alive() for process in lanes._envs.processes)


def test_a_seed_that_has_diverged_does_not_stop_the_environments_of_the_others():
    class Echo(Fine):
        def step(self, action):
            return np.full(2, action[0], np.float32), 0.0, False, False, {}

    lanes = Lockstep(GymnasiumTask(Echo), ["seed 0", "seed 1"])
    lanes.reset(np.array([0, 1]))
    obs = lanes.step(np.array([[np.nan], [0.5]], np.float32)).obs
    np.testing.assert_array_equal(obs[:, 0], [2.0, 4.0])  # the middle of its bounds, and three quarters
    lanes.close()


def test_a_time_limit_needs_processes(tmp_path):
    agent, task = agents.make("sac-mlp", **SHARED, batch_size=8), GymnasiumTask(Fine)
    for processes in ("auto", "never"):
        with pytest.raises(UserError, match=r"^step_timeout needs a process for each environment"):
            train(agent, task, tmp_path / "run", step_timeout=5.0, processes=processes)
    assert not (tmp_path / "run").exists()
    assert _processes(Options(step_timeout=5.0), own_process=True) == "always"
    assert _processes(Options(), own_process=True) == "auto"


@pytest.mark.slow
def test_a_training_reports_a_slow_step(monkeypatch, tmp_path):
    monkeypatch.setattr(lockstep, "SLOW", 0.2)
    notes = []
    agent = agents.make("sac-mlp", **SHARED, batch_size=8, pretrain_updates=0)
    options = {"steps": 12, "eval_episodes": 1, "processes": "never"}
    train(agent, GymnasiumTask(Sleeping, "robot"), tmp_path / "run", lambda event: notes.append(event.note), **options)
    assert "robot (step 3): step has not returned for 0 s: it is slow, or it hangs." in notes


@pytest.mark.nightly
@pytest.mark.parametrize("task", ["pendulum-v", GymnasiumTask(Fine)], ids=["compiled", "host"])
def test_what_is_shown_is_what_is_done(task):
    """No phase is shown that the agent does not have, and an environment acts only in a phase that says so."""
    from beliefrl import tasks

    made = tasks.make(task) if isinstance(task, str) else task
    making = ["making the environments"] if task is made else []
    for updates in (0, 5):
        agent = agents.make("sac-mlp", **SHARED, batch_size=8, pretrain_updates=updates)
        events = stages(agent, made, Options(steps=agent.step_start_rl + 5, eval_every=1000, eval_episodes=1))
        phases = list(dict.fromkeys(event.phase for event in events))
        pretraining = ["compiling the pre-training", "pre-training"] if updates else []
        begun = [*making, "compiling the agent", "compiling the exploration", "exploring", *pretraining]
        assert phases == [*begun, "compiling the learning", "learning", "evaluating", "finished"]


def test_the_first_step_is_taken_when_exploring_is_shown():
    seen = []

    def run():
        for event in stages(agents.make("sac-mlp"), GymnasiumTask(Broken), Options(steps=5)):
            seen.append(event.phase)

    with pytest.raises(UserError):
        run()
    assert seen[-2:] == ["exploring", "stopped by a fault"]


class Broken(Fine):
    def step(self, action):
        raise RuntimeError("broken")


def test_no_control_character_of_an_environment_reaches_the_terminal():
    error = RuntimeError("\x1b[31mred\x1b[0m \x1b]0;title\x07bell\x07 \x9b2Jclear\u202e")
    environment = GymnasiumTask(raising(error), "robot").environment()
    environment.reset()
    for _ in range(2):
        environment.step(np.zeros(1))
    with pytest.raises(UserError, match=r"^robot \(step 3\): step raised RuntimeError: red bell clear\.$"):
        environment.step(np.zeros(1))
