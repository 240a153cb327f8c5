"""Several environments for one agent: recording, resets, updates, both loops; and one that does not answer."""

import os
import pathlib
import re
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import UserError, agents, resume, tasks, train
from beliefrl.errors import Fault
from beliefrl.runs.options import Options
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import host_loop, lockstep, phases, rounds, schedule
from beliefrl.training import replay as ring
from beliefrl.training.lockstep import Lockstep
from beliefrl.training.schedule import _processes, stages
from beliefrl.types import StoredTimestep, Timestep, WindowShape, transitions
from training.test_host_loop import Hanging, Wrapped
from training.test_resume import AGENT, OPTIONS, Crash, crash_at, files
from worlds import SHARED, Counting, CountingAgent, ReadingAgent
from wrong import Fine, Sleeping, Stuck, StuckClose, StuckReset, raising

ENVS = 3  # with the agent's cycles of 4 steps, a round has 12


@pytest.mark.parametrize(
    ("task", "hosted"),
    [
        (Counting(max_steps=7), True),
        (Counting(ends=3), False),
        pytest.param(Counting(max_steps=7), False, marks=pytest.mark.slow),
        pytest.param(Counting(ends=3), True, marks=pytest.mark.slow),
    ],
)
def test_every_environment_is_recorded_with_its_own_episodes(task, hosted):
    agent = CountingAgent()
    if hosted:
        wrapped = GymnasiumTask(Wrapped, "counting", {"task": task}, measures=("success",))
        program = host_loop.program(agent, wrapped, 90, 2, range(2), partial(Lockstep, wrapped), envs=ENVS)
    else:
        program = phases.compile_program(agent, task, 90, 2, ENVS)
    length = min(task.max_steps, task.ends)
    seeds = program.begin(jax.random.split(jax.random.key(0), 2))
    seeds, explored = program.explore(seeds, 0, 12)  # steps in all, so four of each environment
    np.testing.assert_array_equal(seeds.replay.added, np.full((2, ENVS), 4 + 4 // length))
    seeds, metrics = program.pretrain(seeds, 0, 3)
    assert not metrics["broken"].any()
    seeds = program.refresh(seeds)
    seeds, learned = program.learn(seeds, 12, 7)  # rounds of twelve steps: 28 of each environment
    np.testing.assert_array_equal(seeds.replay.added, np.full((2, ENVS), 32 + 32 // length))
    assert (np.asarray(learned.metrics["valid"]) > 0).all()
    assert not np.any(learned.metrics["broken"])
    done = np.asarray(learned.episodes.done)
    assert explored.episodes.done.sum() + done.sum() == 2 * ENVS * (32 // length)
    np.testing.assert_array_equal(np.asarray(learned.episodes.length)[done], length)
    np.testing.assert_array_equal(np.asarray(learned.episodes.episode_return)[done], length * (length + 1) / 2)
    program.close()


@pytest.mark.parametrize(("envs", "hosted"), [(1, False), (ENVS, False), (1, True), (ENVS, True)])
def test_readers_go_on_through_pretraining_and_every_cycle(envs, hosted):
    """Five windows in each of 6 updates of the pre-training, and eight in each of 15 cycles: at most 150 continue."""
    agent, task = ReadingAgent(), Counting(max_steps=20)
    if hosted:
        wrapped = GymnasiumTask(Wrapped, "counting", {"task": task}, measures=("success",))
        program = host_loop.program(agent, wrapped, 90, 2, range(2), partial(Lockstep, wrapped), envs=envs)
    else:
        program = phases.compile_program(agent, task, 90, 2, envs)
    seeds = program.begin(jax.random.split(jax.random.key(0), 2))
    seeds, _ = program.explore(seeds, 0, 60)
    seeds, pretrained = program.pretrain(seeds, 0, 6)
    before = np.asarray(seeds.state.offset)
    np.testing.assert_array_equal(seeds.readers.turn, 30 % 16)
    seeds, learned = program.learn(seeds, 60, 60 // rounds.round_length(agent, envs))
    np.testing.assert_array_equal(seeds.readers.turn, 150 % 16)
    for broken in (pretrained["broken"], learned.metrics["broken"], learned.metrics["jumped"]):
        np.testing.assert_array_equal(broken, 0)
    assert (before > 0).all()
    assert (np.asarray(seeds.state.offset) - before > 20).all()
    program.close()


class Updates(CountingAgent):
    """Its offset is the number of its updates."""

    def update(self, state, batch, key):
        return state._replace(offset=state.offset + 1), {}


def test_there_are_as_many_updates_per_step_as_with_one_environment():
    counts = []
    for envs in (1, ENVS):
        program = phases.compile_program(Updates(), Counting(), 90, 1, envs)
        seeds = program.begin(jax.random.split(jax.random.key(0), 1))
        seeds, _ = program.explore(seeds, 0, 12)
        seeds, _ = program.learn(seeds, 12, 48 // rounds.round_length(Updates(), envs))
        counts.append(float(seeds.state.offset[0]))
    assert counts == [24, 24]  # two batches in a cycle of 4 steps


def test_environments_of_a_seed_begin_and_act_differently():
    agent = agents.make("sac-mlp", **SHARED)
    program = phases.compile_program(agent, Hanging(), 90, 1, ENVS)
    seeds, _ = program.explore(program.begin(jax.random.split(jax.random.key(0), 2)), 0, 12)
    actions = np.asarray(seeds.replay.timesteps.step.prev_action)[:, :, 1:4].reshape(2 * ENVS, 3)
    assert len({tuple(row) for row in actions.tolist()}) == 2 * ENVS
    seed = phases.begin(CountingAgent(), tasks.make("pendulum"), 10, jax.random.key(0), ENVS)
    assert len({tuple(row) for row in np.asarray(seed.actor.step.obs).tolist()}) == ENVS


@pytest.mark.slow
def test_a_crashed_training_goes_on_to_the_last_bit(tmp_path):
    options = OPTIONS | {"envs": ENVS}
    events = []
    train(AGENT, "pendulum-v", tmp_path / "whole", events.append, **options)
    with pytest.raises(Crash):
        train(AGENT, "pendulum-v", tmp_path / "run", crash_at(int(0.6 * len(events))), **options)
    resume(tmp_path / "run")
    assert files(tmp_path / "run") == files(tmp_path / "whole")


LIKE = StoredTimestep(Timestep(jnp.zeros(1), jnp.zeros(()), jnp.zeros(1), *jnp.zeros((2,), bool)), (jnp.zeros(()),))


def filled(count):
    """A ring for 32 timesteps after `count` of them, which have their running numbers as notes."""

    def add(replay, number):
        value = number.astype(float)
        step = Timestep(value[None], value, value[None], jnp.array(False), jnp.array(False))
        return ring.add(replay, StoredTimestep(step, (value,)), number < count), None

    return jax.lax.scan(add, ring.init(LIKE, 32), jnp.arange(40))[0]


def test_windows_begin_at_every_transition_of_every_ring():
    shape, counts = WindowShape(2, 1), jnp.array([4, 20, 40])
    window = jax.jit(lambda: ring.sample(jax.vmap(filled)(counts), jax.random.key(0), 4000, shape))()
    now = np.asarray(window.note[0])[2][np.asarray(transitions(window, 2))[0]].astype(int)
    starts = [*range(3), *range(19), *range(8, 39)]  # the last ring has lost its first eight
    found = np.bincount(now, minlength=40)
    expected = 4000 / len(starts) * np.bincount(starts, minlength=40)
    assert not found[expected == 0].any()
    np.testing.assert_allclose(found, expected, atol=5 * np.sqrt(expected.max()))


def test_a_reader_stays_in_its_ring_until_it_jumps():
    """Of rings with 4, 20 and 40 timesteps, notes are the running number plus 100 for each ring before."""
    shape, counts = WindowShape(0, 3, readers=8, jump=0.0), jnp.array([4, 20, 40])
    replay = jax.vmap(filled)(counts)
    note = replay.timesteps.note[0] + 100 * jnp.arange(3.0)[:, None]
    replay = replay._replace(timesteps=replay.timesteps._replace(note=(note,)))
    read, readers = jax.jit(lambda readers, key: ring.read(replay, readers, key, 8, shape)), ring.init_readers(shape)
    last, rings, continued = None, set(), 0
    for turn in range(40):
        window, readers = read(readers, jax.random.key(turn))
        rows, goes_on = np.asarray(window.note[0]).T, np.asarray(window.reading.continues)
        np.testing.assert_array_equal(np.diff(rows), 1)  # in one ring
        assert window.exists.all()
        if last is not None:
            np.testing.assert_array_equal(rows[goes_on, 0], last[goes_on])
            np.testing.assert_array_equal(goes_on, last % 100 + shape.length < counts[(last // 100).astype(int)])
        last, continued, rings = rows[:, -1], continued + goes_on.sum(), rings | set(rows[:, 0] // 100)
    assert rings == {0, 1, 2}
    assert continued > 100


def test_the_replay_is_divided_among_the_environments():
    agent = agents.make("sac-mlp", step_start_rl=1000)
    assert schedule.capacity(agent, Options(steps=400_000, envs=4)) == 125_000
    assert schedule.capacity(agent, Options(steps=400_000, envs=4, replay_capacity=5_000)) == 1_250
    with pytest.raises(UserError, match="at least 2000"):
        schedule.capacity(agent, Options(envs=4, replay_capacity=1_000))
    with pytest.raises(UserError, match="envs=0 is impossible"):
        Options(envs=0)


# An environment that does not answer is reported, and a training says what it is doing.


@pytest.mark.parametrize("processes", ["never", pytest.param("always", marks=pytest.mark.slow)])
def test_a_slow_step_is_reported_once_while_it_goes_on(monkeypatch, processes):
    lanes = Lockstep(GymnasiumTask(Sleeping, "robot"), ["seed 0"], processes)  # made before the watch: it takes seconds
    monkeypatch.setattr(lockstep, "SLOW", 0.2)
    monkeypatch.setattr(lockstep, "LOOK_EVERY", 0.01)
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


def test_a_step_that_takes_too_long_is_a_fault_and_names_the_seed():
    lanes = Lockstep(GymnasiumTask(Stuck, "robot"), ["seed 0", "seed 1"], "always", timeout=3.0)
    lanes.reset(np.array([0, 1]))
    actions = np.array([[-1.0], [1.0]], np.float32)
    lanes.step(actions)
    lanes.step(actions)
    message = "robot (step 3): the step of seed 1 has not returned after 3 s: fix it, or allow more time with "
    began = time.monotonic()
    with pytest.raises(Fault, match=f"^{re.escape(message)}"):
        lanes.step(actions)
    lanes.close()
    assert time.monotonic() - began < 30
    assert not any(process.is_alive() for process in lanes._envs.processes)


def test_a_reset_that_takes_too_long_is_a_fault_where_steps_have_a_limit(monkeypatch):
    monkeypatch.setattr(lockstep, "RESET", 3.0)
    lanes = Lockstep(GymnasiumTask(StuckReset, "robot"), ["seed 0"], "always", timeout=0.1)
    lanes.reset(np.array([0]))
    with pytest.raises(Fault, match=r"the reset of seed 0 has not returned after 3 s: fix it, or allow more time"):
        lanes.restart(np.array([True]))
    lanes.close()
    assert not any(process.is_alive() for process in lanes._envs.processes)


UNMADE = """
import os, sys
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.lockstep import Lockstep
from wrong import Unmade

if __name__ == "__main__":
    Lockstep(GymnasiumTask(Unmade), ["seed 0", "seed 1", "seed 2"], "always")
"""


def test_a_script_ends_if_the_process_of_one_environment_ends_before_it_is_made(tmp_path):
    """Python would wait forever for the processes of the others."""
    script = tmp_path / "script.py"
    script.write_text(UNMADE)
    path = {"PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run([sys.executable, script], env=os.environ | path, timeout=100, capture_output=True, text=True)
    assert ended.returncode == 1
    assert re.search(r"the process of seed 1 \(exit code 3\) has ended before its environment was made", ended.stderr)


def test_what_cannot_be_sent_to_a_process_is_named():
    held = threading.Lock()

    def make():
        return Fine() if held else None

    with pytest.raises(UserError, match=r"robot cannot be sent to a process of its own \(TypeError: cannot pickle"):
        Lockstep(GymnasiumTask(make, "robot"), ["seed 0"], "always")


def test_environments_that_do_not_close_are_killed(monkeypatch):
    monkeypatch.setattr(lockstep, "CLOSING", 0.5)
    lanes = Lockstep(GymnasiumTask(StuckClose, "robot"), ["seed 0", "seed 1"], "always")
    lanes.reset(np.array([0, 1]))
    lanes.close()
    assert [process.exitcode for process in lanes._envs.processes] == [-signal.SIGKILL] * 2


ORPHAN = """
import os, sys, threading
import numpy as np
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.lockstep import Lockstep
from wrong import Orphan

if __name__ == "__main__":
    lanes = Lockstep(GymnasiumTask(Orphan, "robot", {"folder": sys.argv[1]}), ["seed 0"], "always")
    lanes.reset(np.array([0]))
    threading.Timer(1.0, os._exit, [0]).start()
    for _ in range(3):
        lanes.step(np.ones((1, 1), np.float32))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="it looks into /proc")
def test_an_environment_that_hangs_does_not_outlive_the_training(tmp_path):
    script, folder = tmp_path / "script.py", tmp_path / "numbers"
    folder.mkdir()
    script.write_text(ORPHAN)
    path = {"PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run([sys.executable, script, folder], env=os.environ | path, timeout=60).returncode == 0
    numbers = [each.name for each in folder.iterdir()]
    assert numbers
    for _ in range(100):
        if not any(pathlib.Path("/proc", number).exists() for number in numbers):
            return
        time.sleep(0.1)
    pytest.fail("a process is still there")


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


@pytest.mark.nightly
def test_a_training_reports_a_slow_step(monkeypatch, tmp_path):
    monkeypatch.setattr(lockstep, "SLOW", 0.2)
    monkeypatch.setattr(lockstep, "LOOK_EVERY", 0.01)
    notes = []
    agent = agents.make("sac-mlp", **SHARED, batch_size=8, pretrain_updates=0)
    options = {"steps": 12, "eval_episodes": 1, "processes": "never"}
    train(agent, GymnasiumTask(Sleeping, "robot"), tmp_path / "run", lambda event: notes.append(event.note), **options)
    assert "robot (step 3): step has not returned for 0 s: it is slow, or it hangs." in notes


@pytest.mark.nightly
@pytest.mark.parametrize("task", ["pendulum-v", GymnasiumTask(Fine)], ids=["compiled", "host"])
def test_what_is_shown_is_what_is_done(task):
    """No phase is shown that the agent does not have, and an environment acts only in a phase that says so."""
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
