"""An environment that does not answer is reported, and a training says what it is doing."""

import threading
import time

import numpy as np
import pytest

from beliefrl import UserError, agents, train
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import lockstep
from beliefrl.training.lockstep import Lockstep
from beliefrl.training.schedule import Options, stages
from worlds import SHARED
from wrong import Fine, raising


class Sleeping(Fine):
    """Its third step takes long."""

    def step(self, action):
        if self.time == 2:
            time.sleep(0.5)
        return super().step(action)


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


def test_a_training_reports_a_slow_step(monkeypatch, tmp_path):
    monkeypatch.setattr(lockstep, "SLOW", 0.2)
    notes = []
    agent = agents.make("sac-mlp", **SHARED, batch_size=8, pretrain_updates=0)
    options = {"steps": 12, "eval_episodes": 1, "processes": "never"}
    train(agent, GymnasiumTask(Sleeping, "robot"), tmp_path / "run", lambda event: notes.append(event.note), **options)
    assert "robot (step 3): step has not returned for 0 s: it is slow, or it hangs." in notes


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
    told = RuntimeError("\x1b[31mred\x1b[0m \x1b]0;title\x07bell\x07 \x9b2Jclear\u202e")
    environment = GymnasiumTask(raising(told), "robot").environment()
    environment.reset()
    for _ in range(2):
        environment.step(np.zeros(1))
    with pytest.raises(UserError, match=r"^robot \(step 3\): step raised RuntimeError: red bell clear\.$"):
        environment.step(np.zeros(1))
