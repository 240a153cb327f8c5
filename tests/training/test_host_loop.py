"""Training on the host's environments: equal to the compiled loop, in processes or not; and faults lose nothing."""

import dataclasses
import os
import re
import signal
import sys
from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from beliefrl import agents, cli, evaluate, load, resume, tasks, train
from beliefrl.errors import Fault, UserError
from beliefrl.runs.options import Options
from beliefrl.runs.run import Run
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.pendulum import Pendulum, PendulumState
from beliefrl.training import host_loop, initial, lockstep, phases, rounds, session
from beliefrl.training.lockstep import Lockstep
from worlds import MODELS, SEQUENCES, SHARED, Alternating, Counting, CountingAgent, CountingState, leaves, trained
from wrong import Closing, Fine, Killed, Raising

SMALL = {"vrm": MODELS | SEQUENCES, "sac-mlp": {"batch_size": 8, "pretrain_updates": 10, "standardise": True}}


@dataclasses.dataclass(frozen=True)
class Hanging(Pendulum):
    """Begins at one state, so that no random number is the task's."""

    def reset(self, key):
        state = PendulumState(jnp.array(3.0), jnp.array(0.5))
        return state, self.observation(state)


class Wrapped(gymnasium.Env):
    """A JAX task as a Gymnasium environment."""

    def __init__(self, task):
        self.task = task
        spec = task.spec
        self.observation_space = spaces.Box(-np.inf, np.inf, (spec.obs_dim,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (spec.action_dim,), np.float32)
        self._step = jax.jit(task.step)

    def reset(self, *, seed=None, options=None):
        self.time, (self.state, obs) = 0, self.task.reset(jax.random.key(0))
        return np.asarray(obs), {}

    def _measures(self):
        return {"is_success": bool(self.task.measures(self.state)["success"])} if self.task.spec.measures else {}

    def step(self, action):
        self.state, obs, reward, terminated = self._step(self.state, jnp.asarray(action), jax.random.key(0))
        self.time += 1
        end = bool(terminated), self.time >= self.task.spec.max_steps
        return np.asarray(obs), float(reward), *end, self._measures()


CAPACITY = 4321  # no other array has this size


@pytest.mark.slow
def test_no_step_copies_the_replay():
    """A copy takes longer than the updates if the replay is large."""
    agent = agents.make("sac-mlp", **SMALL["sac-mlp"])
    task = GymnasiumTask(lambda: Wrapped(Hanging()), max_steps=200)
    program = host_loop.program(agent, task, CAPACITY, 1, [0], partial(Lockstep, task))
    seeds = program.begin(jax.random.split(jax.random.key(0), 1))
    program.explore(seeds, 0, 0)
    program.learn(seeds, 0, 0)
    loop = program.learn.__self__
    for compiled in (loop._go_on, loop._learn):
        lines = [line for line in compiled.as_text().splitlines() if str(CAPACITY) in line]
        assert lines
        assert not [line for line in lines if " copy(" in line]
    program.close()


@pytest.mark.parametrize(
    ("name", "envs"),
    [
        pytest.param("sac-mlp", 1, marks=pytest.mark.slow),
        pytest.param("sac-mlp", 2, marks=pytest.mark.nightly),
        pytest.param("vrm", 1, marks=pytest.mark.nightly),
    ],
)
def test_the_host_loop_learns_what_the_compiled_loop_learns(name, envs):
    agent, task = agents.make(name, **SHARED, **SMALL[name]), Hanging(max_steps=9)
    keys = jax.random.split(jax.random.key(0), 2)
    stretches = {"learn": (10 * envs, 20 * envs), "cycle": rounds.round_length(agent, envs)}
    there, log = trained(phases.compile_program(agent, task, 100, 2, envs), keys, **stretches)
    wrapped = GymnasiumTask(Wrapped, "wrapped", {"task": task})
    program = host_loop.program(agent, wrapped, 100, 2, range(2), partial(Lockstep, wrapped), envs=envs)
    here, log_here = trained(program, keys, **stretches)
    program.close()
    theirs = there._replace(actor=there.actor._replace(task_state=()))
    for ours, their in zip(leaves(here), leaves(theirs), strict=True):
        np.testing.assert_allclose(ours, their, rtol=1e-3, atol=1e-4)
    for metric, values in log[-1].metrics.items():
        np.testing.assert_allclose(log_here[-1].metrics[metric], values, rtol=1e-2, atol=1e-3)
    for one, other in zip(log, log_here, strict=True):
        for ours, their in zip(*map(jax.tree.leaves, (other.episodes, one.episodes)), strict=True):
            np.testing.assert_allclose(ours[other.episodes.done], their[one.episodes.done], rtol=1e-4)


def test_every_window_is_unbroken_in_time():
    task = Counting()
    wrapped = GymnasiumTask(Wrapped, "counting", {"task": task}, measures=("success",))
    program = host_loop.program(CountingAgent(), wrapped, 60, 3, range(2), partial(Lockstep, wrapped))
    seeds = program.begin(jax.random.split(jax.random.key(0), 2))
    seeds, log = program.explore(seeds, 0, 10)
    assert log.episodes.done.sum() == 2  # of seven steps each
    seeds, _ = program.pretrain(seeds, 0, 3)
    seeds = program.refresh(seeds)
    seeds, log = program.learn(seeds, 10, 20)
    assert np.all(log.metrics["valid"] > 0)
    assert not np.any(log.metrics["broken"])
    np.testing.assert_allclose(log.episodes.episode_return[log.episodes.done], 28.0)
    assert np.all(log.episodes.measures["success"][log.episodes.done])
    result = program.evaluate(seeds.state, seeds.key)
    np.testing.assert_allclose(result.episode_return, np.full((2, 2, 3), 28.0))
    assert result.done.all()
    program.close()


@pytest.mark.parametrize(("ends", "limit", "where"), [(4, 1000, [4, 9]), (1000, 4, []), (4, 4, [4, 9])])
def test_a_stored_timestep_is_terminal_where_the_task_ended_and_not_at_the_limit(ends, limit, where):
    task = GymnasiumTask(Wrapped, "counting", {"task": Counting(ends, limit)}, measures=("success",))
    program = host_loop.program(CountingAgent(), task, 60, 1, [0], partial(Lockstep, task))
    seeds, _ = program.explore(program.begin(jax.random.split(jax.random.key(0), 1)), 0, 10)
    program.close()
    step = jax.tree.map(lambda leaf: leaf[0, : int(seeds.replay.added[0])], seeds.replay.timesteps.step)
    assert np.flatnonzero(step.is_first).tolist() == [0, 5, 10]
    assert np.flatnonzero(step.terminated).tolist() == where


class Perceiving(CountingAgent):
    """Its first action says whether it perceives a reward or an action before it."""

    def act(self, state, memory, step, key, explore):
        before = jnp.abs(step.reward) + jnp.abs(step.prev_action[0])
        return jnp.where(step.is_first, 0.25 + before, 0.5)[None], memory


def test_evaluated_episodes_begin_without_reward_and_action():
    """The return is minus the first action."""
    task = GymnasiumTask(Wrapped, "alternating", {"task": Alternating(max_steps=3)}, measures=("success",))
    program = host_loop.program(Perceiving(), task, 60, 3, [0], partial(Lockstep, task))
    result = program.evaluate(CountingState(jnp.zeros(1), jnp.zeros(1)), jax.random.split(jax.random.key(0), 1))
    program.close()
    np.testing.assert_array_equal(result.episode_return, np.full((1, 2, 3), -0.25))


def played(lanes, steps=25):
    seen = [lanes.reset(np.array([3, 4]))]
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, 2, 1)).astype(np.float32)
    for action in actions:
        obs, reward, terminated, truncated, measures = lanes.step(action)
        done = terminated | truncated
        seen += [obs, reward, done, *measures.values()]
        if done.any():
            seen.append(lanes.restart(done))
    lanes.close()
    return seen


@pytest.mark.parametrize("task", [GymnasiumTask(Fine), tasks.make("gym:Pendulum-v1")], ids=lambda task: task.name)
def test_processes_of_their_own_change_nothing_and_end(task):
    alone, apart = Lockstep(task, ["a", "b"], "never"), Lockstep(task, ["a", "b"], "always")
    assert not alone.apart
    assert apart.apart
    workers = apart._envs.processes
    for ours, theirs in zip(played(alone), played(apart), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert not any(worker.is_alive() for worker in workers)


@pytest.mark.parametrize(
    ("make", "phrase"),
    [
        (Raising, r"robot \(seed [01], step 3\): step raised ValueError: out of range\.$"),  # whichever is heard last
        (Killed, r"robot \(step 3\): the process of seed [01] \(exit code -9\)"),
    ],
)
def test_a_fault_in_a_process_of_its_own_is_reported_too(make, phrase):
    lanes = Lockstep(GymnasiumTask(make, "robot"), ["seed 0", "seed 1"], "always")
    lanes.reset(np.array([0, 1]))
    with pytest.raises(Fault) as error:  # noqa: PT012
        for _ in range(5):
            lanes.step(np.zeros((2, 1), np.float32))
    lanes.close()
    assert re.match(phrase, str(error.value))


@pytest.mark.parametrize("processes", ["never", "always"])
def test_after_a_fault_every_environment_is_closed(tmp_path, processes):
    lanes = Lockstep(GymnasiumTask(Closing, "robot", {"folder": str(tmp_path)}), ["seed 0", "seed 1"], processes)
    lanes.reset(np.array([0, 1]))
    with pytest.raises(Fault, match="out of range"):  # noqa: PT012
        for _ in range(3):
            lanes.step(np.array([[1.0], [-1.0]], np.float32))
    lanes.close()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_signal_for_all_processes_does_not_end_the_environments():
    """A scheduler may send SIGTERM to each process of a job. The training then saves, and still needs them."""
    lanes = Lockstep(GymnasiumTask(Fine), ["a", "b"], "always")
    lanes.reset(np.array([0, 1]))
    workers = lanes._envs.processes
    for worker in workers:
        os.kill(worker.pid, signal.SIGTERM)
    lanes.step(np.zeros((2, 1), np.float32))
    lanes.close()
    assert not any(worker.is_alive() for worker in workers)


def test_processes_that_share_one_core_do_not_pay(monkeypatch):
    monkeypatch.setattr(lockstep, "step_seconds", lambda task: 1.0)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    for free, pays in (({3}, False), ({3, 5}, True)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda process, free=free: free, raising=False)
        assert lockstep._pays(GymnasiumTask(Fine), 2) == pays


class Late(Fine):
    """Fails at its 27th step in all."""

    steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps == 27:
            raise RuntimeError("the battery is empty")
        return super().step(action)


def few(**changes):
    return {"steps": 40, "eval_every": 20, "eval_episodes": 2, "seeds": 2, "seed": 5} | changes


@pytest.mark.parametrize(
    "episodes", [pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.nightly)]
)
def test_a_training_goes_on_from_a_fault(tmp_path, episodes):
    """With two episodes its environment fails at step 27 of the training, with three in the first evaluation."""
    agent, notes = agents.make("sac-mlp", **SHARED, **SMALL["sac-mlp"]), []
    where = "seed 5" if episodes == 2 else "evaluation of seed 5"
    with pytest.raises(UserError, match=rf"robot \({where}, step 27\): step raised RuntimeError"):
        train(agent, GymnasiumTask(Late, "robot"), tmp_path / "run", **few(eval_episodes=episodes))
    run = resume(tmp_path / "run", task=GymnasiumTask(Fine, "robot"), callback=lambda event: notes.append(event.note))
    assert f"goes on from the checkpoint of step {26 if episodes == 2 else 20}" in notes
    for seed in (5, 6):
        assert [row["step"] for row in run.rows(seed, "evaluation")] == [20, 40]
        steps = [row["step"] for row in run.rows(seed, "update")]
        assert (steps[0], steps[-1]) == ((26, 40) if episodes == 2 else (40, 40))


class Huge(Fine):
    """Its 27th step in all returns one huge number, in a range without bounds."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    steps = 0

    def __init__(self, part):
        self.part = part

    def step(self, action):
        self.steps += 1
        result = list(super().step(action))
        if self.steps == 27:
            result[self.part] = result[self.part] * 0 - 1e25
        return tuple(result)


@pytest.mark.slow
@pytest.mark.parametrize(("part", "phrase"), [(0, r"entry 0 of the observation is -9\.99"), (1, "the reward is -1e")])
def test_a_training_goes_on_from_one_huge_number(tmp_path, part, phrase):
    agent = agents.make("sac-mlp", **SHARED, **SMALL["sac-mlp"])
    with pytest.raises(UserError, match=rf"robot \(seed 5, step 27\): {phrase}"):
        train(agent, GymnasiumTask(Huge, "robot", {"part": part}), tmp_path / "run", **few(seeds=1))
    run = resume(tmp_path / "run", task=GymnasiumTask(Fine, "robot"))
    assert [row["step"] for row in run.rows(5, "evaluation")] == [20, 40]
    assert not run.has_diverged(5)


class Wider(Fine):
    """The same with other bounds of the action."""

    action_space = spaces.Box(-2.0, 60.0, (1,), np.float32)


class Moving(Fine):
    """Changes the working directory, as simulators do that look for their files."""

    def reset(self, *, seed=None, options=None):
        os.chdir("/")
        return super().reset(seed=seed, options=options)


@pytest.mark.slow
def test_a_run_is_where_it_was_said_to_be_and_is_not_opened_with_other_actions(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agent = agents.make("sac-mlp", **SHARED, **SMALL["sac-mlp"])
    train(agent, GymnasiumTask(Moving, "robot"), "run", **few(steps=20, eval_every=20))
    assert (tmp_path / "run" / "results.json").exists()
    monkeypatch.chdir(tmp_path)
    load("run", task=GymnasiumTask(Fine, "robot"))
    for other in (resume, load):
        with pytest.raises(UserError, match=r"upper bounds of the actions before: \[6.0\], now: \[60"):
            other("run", task=GymnasiumTask(Wider, "robot"))


class Single(Fine):
    """At most two at a time, one for each seed: there is none left for evaluations."""

    count = 0

    def __init__(self):
        if Single.count == 2:
            raise OSError("the port is in use")
        Single.count += 1

    def close(self):
        Single.count -= 1


@pytest.mark.slow
def test_an_environment_that_cannot_be_made_for_an_evaluation_is_a_fault(tmp_path):
    agent, notes = agents.make("sac-mlp", **SHARED, **SMALL["sac-mlp"]), []
    with pytest.raises(UserError, match="the port is in use"):
        train(agent, GymnasiumTask(Single, "robot"), tmp_path / "run", **few(checkpoint_steps=0, eval_every=30))
    resume(tmp_path / "run", task=GymnasiumTask(Fine, "robot"), callback=lambda event: notes.append(event.note))
    assert "goes on from the checkpoint of step 30" in notes


@pytest.mark.slow
def test_what_was_learned_before_a_fault_is_kept(tmp_path):
    agent = agents.make("sac-mlp", **SHARED, **SMALL["sac-mlp"])
    task = GymnasiumTask(Late, "robot")
    with pytest.raises(UserError, match=r"robot \(seed 5, step 27\): step raised RuntimeError: the battery is empty\."):
        train(agent, task, tmp_path / "run", **few())
    run = Run(tmp_path / "run")
    for seed in (5, 6):
        assert [row["step"] for row in run.rows(seed, "evaluation")] == [20]
        assert [row["length"] for row in run.rows(seed, "episode")] == [10, 10]
        assert [row["step"] for row in run.rows(seed, "update")][-1] == 26  # as far as it came
    _, origin = initial.taken(run, Options(seed=5), agent, GymnasiumTask(Fine).spec)
    assert origin["seeds"][5] == {"seed": 5, "step": 26}
    action, _ = load(run, task=Fine).predict(np.zeros(2))
    with pytest.raises(UserError, match="on all entries of the observation, and the given task shows entries 1 0"):
        load(run, task=GymnasiumTask(Fine, indices=(1, 0)))
    assert np.all(np.abs(action) <= 1)


@pytest.mark.parametrize("own_process", [False, True])
def test_a_training_changes_only_a_process_of_its_own(monkeypatch, tmp_path, own_process):
    """From Python it leaves the allocator alone and starts no processes, even where the command line is imported."""
    changed = set()
    monkeypatch.setattr(sys, "argv", ["beliefrl"])
    monkeypatch.setattr(host_loop, "keep_memory", lambda: changed.add("allocator"))
    monkeypatch.setattr(lockstep, "_pays", lambda task, lanes: changed.add("processes"))
    agent = agents.make("sac-mlp", **SHARED, **SMALL["sac-mlp"])
    train(agent, GymnasiumTask(Fine), tmp_path / "run", own_process=own_process, **few(steps=5, eval_episodes=1))
    assert changed == ({"allocator", "processes"} if own_process else set())


def test_the_command_line_has_a_process_of_its_own(monkeypatch, tmp_path):
    said = []

    def run(self, *_, **__):
        said.append(self.own_process)
        self.recorder.close()
        raise UserError("That is enough.")

    monkeypatch.setattr(session.Session, "run", run)
    for line in ("train sac-mlp pendulum-v --out", "resume"):
        with pytest.raises(SystemExit):
            cli.main([*line.split(), str(tmp_path / "run")])
    assert said == [True, True]


@pytest.mark.slow
def test_a_run_on_an_environment_is_evaluated_again(tmp_path):
    agent = agents.make("sac-mlp", **SHARED, **SMALL["sac-mlp"])
    run = train(agent, "gym:Pendulum-v1", tmp_path / "run", **few(steps=25, eval_every=25))
    assert run.config["task"] == "gym:Pendulum-v1"
    assert len(list(run.rows(5, "episode"))) == 0
    results = evaluate(run, episodes=1)
    assert results == evaluate(run, episodes=1)
    assert results["sampled"]["seeds"] != results["mode"]["seeds"]
    assert all(-2000 < total < 0 for total in results["mode"]["seeds"])
