"""Updates during the steps of Gymnasium environments: when they are made, which weights act, and what is recorded."""

import os
import threading
import time
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import agents, resume, train
from beliefrl.errors import Fault, UserError
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import host_loop
from beliefrl.training.host_loop import HostLoop
from beliefrl.training.lockstep import Lockstep
from beliefrl.training.rounds import round_length
from training.test_host_loop import Late, Wrapped
from worlds import SHARED, Counting, CountingAgent, ReadingAgent, leaves, trained
from wrong import Fine

ENVS = 3  # with the agent's cycles of 4 steps, a round has 12


SHORT = {"steps": 200, "eval_every": 50, "eval_episodes": 1, "overlap": True, "progress": False}


def small_agent():
    return agents.make("sac-mlp", **SHARED, batch_size=8, pretrain_updates=10)


def overlapping(agent, environment, seeds=1, envs=1, measures=(), **settings):
    task = GymnasiumTask(environment, "overlapping", settings, measures=measures)
    return host_loop.program(agent, task, 90, 2, range(seeds), partial(Lockstep, task), envs=envs, overlap=True)


class Telling(CountingAgent):
    """Its action is a hundredth of the number of its updates."""

    def act(self, state, memory, step, key, explore):
        return state.offset[None] / 100, memory + 1

    def pretrain(self, state, windows, key):
        return state, {}

    def update(self, state, batch, key):
        return state._replace(offset=state.offset + 1), {}


class Listening(Fine):
    """Keeps the numbers of updates that its actions tell."""

    heard: ClassVar[list[int]] = []

    def step(self, action):
        self.heard.append(round(100 * (float(action[0]) - 2) / 4))  # from its range, -2 to 6
        return super().step(action)


def test_each_round_acts_with_the_weights_from_before_the_last_updates():
    Listening.heard.clear()
    program = overlapping(Telling(), Listening)
    seeds, _ = program.explore(program.begin(jax.random.split(jax.random.key(0), 1)), 0, 12)
    seeds, _ = program.learn(seeds, 12, 4)
    seeds, _ = program.learn(seeds, 28, 2)
    program.close()
    updates = [0, 0, 0, *[0, 0, 2, 4], *[8, 8]]  # of rounds of four steps; a cycle has two; the second call starts anew
    assert Listening.heard == [number for number in updates for _ in range(4)]
    assert seeds.state.offset == 12


class Thorough(CountingAgent):
    """An update takes about a second."""

    def pretrain(self, state, windows, key):
        return state, {}

    def update(self, state, batch, key):
        matrix = jax.random.normal(key, (700, 700))
        matrix = jax.lax.fori_loop(0, 100, lambda _, matrix: jnp.tanh(matrix @ matrix) / 700, matrix)
        return state._replace(offset=state.offset + matrix[0, 0]), {}


def test_updates_are_made_during_a_step_of_the_environments(monkeypatch):
    done, step = [], HostLoop._step

    def noticed(self, seeds, output, number, log):
        result = step(self, seeds, output, number, log)
        done.append(seeds.state.offset.is_ready())  # whether the updates ended before the step did
        return result

    program = overlapping(Thorough(), Fine)
    seeds, _ = program.explore(program.begin(jax.random.split(jax.random.key(0), 1)), 0, 12)
    seeds, _ = program.learn(seeds, 12, 0)
    monkeypatch.setattr(HostLoop, "_step", noticed)
    seeds, _ = program.learn(seeds, 12, 2)
    program.close()
    assert done[:5] == [True] * 4 + [False]  # the first round has no updates before it
    if len(os.sched_getaffinity(0)) > 1:  # on one core JAX acts when the updates are over
        assert done[5:] == [False] * 3


@pytest.mark.parametrize("envs", [1, ENVS])
def test_every_timestep_is_recorded_and_every_window_is_right(envs):
    program = overlapping(CountingAgent(), Wrapped, 2, envs, ("success",), task=Counting(max_steps=7))
    seeds, _ = program.explore(program.begin(jax.random.split(jax.random.key(0), 2)), 0, 12)
    seeds, _ = program.pretrain(seeds, 0, 3)
    seeds, learned = program.learn(program.refresh(seeds), 12, 84 // round_length(CountingAgent(), envs))
    program.close()
    steps = 96 // envs
    np.testing.assert_array_equal(seeds.replay.added.reshape(2, -1), np.full((2, envs), steps + steps // 7))
    assert (np.asarray(learned.metrics["valid"]) > 0).all()
    assert not np.any(learned.metrics["broken"])
    done = np.asarray(learned.episodes.done)
    np.testing.assert_array_equal(np.asarray(learned.episodes.length)[done], 7)


@pytest.mark.parametrize("envs", [1, ENVS])
def test_readers_go_on_through_every_cycle(envs):
    agent = ReadingAgent()
    program = overlapping(agent, Wrapped, 2, envs, ("success",), task=Counting(max_steps=20))
    seeds, _ = program.explore(program.begin(jax.random.split(jax.random.key(0), 2)), 0, 60)
    seeds, learned = program.learn(seeds, 60, 60 // round_length(agent, envs))
    program.close()
    np.testing.assert_array_equal(seeds.readers.turn, 120 % 16)
    np.testing.assert_array_equal(learned.metrics["broken"], 0)
    np.testing.assert_array_equal(learned.metrics["jumped"], 0)


class Slow(Fine):
    """Waits in some of its steps."""

    def step(self, action):
        if self.time % 3 == 0:
            time.sleep(0.02)
        return super().step(action)


def test_what_is_learned_does_not_depend_on_the_time_of_a_step():
    agent, learned = small_agent(), []
    for environment in (Fine, Slow):
        program = overlapping(agent, environment)
        seeds, log = trained(program, jax.random.split(jax.random.key(0), 1), cycle=round_length(agent))
        learned.append((leaves(seeds), log))
        program.close()
    (fast, log), (slow, other) = learned
    for ours, theirs in zip(fast, slow, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for one, two in zip(log, other, strict=True):
        assert one.metrics == two.metrics


def learners():
    return [thread for thread in threading.enumerate() if thread.name.startswith("learner")]


def test_a_training_with_it_can_be_stopped_and_resumed(tmp_path):
    run = train(small_agent(), GymnasiumTask(Fine), tmp_path / "run", callback=lambda event: event.step >= 100, **SHORT)
    assert [row["step"] for row in run.rows(0, "evaluation")] == [50, 100]
    assert run.config["options"]["overlap"] is True
    run = resume(run, task=GymnasiumTask(Fine), progress=False)
    assert [row["step"] for row in run.rows(0, "evaluation")] == [50, 100, 150, 200]
    assert [row["step"] for row in run.rows(0, "update")] == [50, 100, 150, 200]
    assert not learners()


def test_what_was_learned_before_an_environment_failed_is_saved(tmp_path):
    with pytest.raises(Fault, match="the battery is empty"):
        train(small_agent(), GymnasiumTask(Late, "robot"), tmp_path / "run", **SHORT)
    assert not learners()
    run = resume(tmp_path / "run", task=GymnasiumTask(Fine, "robot"), progress=False)
    assert [row["step"] for row in run.rows(0, "update")] == [26, 50, 100, 150, 200]


def test_a_task_in_jax_refuses_it(tmp_path):
    with pytest.raises(UserError, match=r"^overlap needs a Gymnasium environment: "):
        train("sac-mlp", "pendulum", tmp_path / "run", **SHORT)
    assert not (tmp_path / "run").exists()
