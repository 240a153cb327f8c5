"""Trainings as separate processes on this machine; the slow tests run whole sweeps."""

import contextlib
import json
import os
import pathlib
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from beliefrl import cli, sweep
from beliefrl.errors import UserError
from beliefrl.runs.run import Run
from beliefrl.sweeps import places
from beliefrl.sweeps import progress as module
from beliefrl.sweeps.experiments import Experiment, grid
from beliefrl.sweeps.plan import Training, plan
from beliefrl.sweeps.progress import Forecast
from beliefrl.sweeps.run import SweepStatus, reason
from beliefrl.training.stop import Stopped
from inputs import a_run

QUICK = {
    "steps": 300,
    "eval_every": 100,
    "eval_episodes": 1,
    "step_start_rl": 100,
    "pretrain_updates": 5,
    "policy_layers": [8],
    "value_layers": [8],
}


def rows(folder):
    return (folder / "metrics" / "seed-0.jsonl").read_text()


def test_a_training_that_fails_frees_its_core_and_says_why(tmp_path):
    (tmp_path / "logs").mkdir()
    launcher = places.Local(tmp_path, [places.Slot("0")])
    launcher.start(Training("wrong", "vmr", "pendulum", {}, {"steps": 1, "seed": 0, "seeds": 1}))
    assert launcher.room == 0
    while not (codes := launcher.ended()):
        time.sleep(0.05)
    assert codes == {"wrong": 2}
    assert launcher.room == 1
    assert "no agent 'vmr'" in reason(tmp_path / "logs" / "wrong.log", 2)


def test_the_reason_of_a_failure_is_not_that_of_an_earlier_session(tmp_path):
    path = tmp_path / "log"
    for said in ("beliefrl: stopped at step 10\n", ""):
        with places.open_log(path) as log:
            log.write(said.encode())
    assert "stopped at step 10" in path.read_text()
    assert reason(path, 1) == "it ended with code 1 and printed nothing"
    with places.open_log(path) as log:
        log.write(b"Traceback\nValueError: odd\n")
    assert reason(path, 1) == "ValueError: odd"


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="This system cannot choose cores.")
def test_a_worker_runs_on_its_core():
    core = max(os.sched_getaffinity(0))
    argv = [str(os.getpid()), str(core), "--version"]
    code = f"import os, beliefrl.worker as w; w.main({argv}); print(os.sched_getaffinity(0))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.splitlines()[-1] == f"{{{core}}}"


@pytest.mark.skipif(sys.platform != "linux", reason="Only Linux tells a process that its parent has died.")
def test_a_worker_whose_parent_has_died_before_it_began_ends():
    command = [sys.executable, "-m", "beliefrl.worker", "0", "-", "--version"]  # process 0 is not its parent
    found = subprocess.run(command, capture_output=True, text=True)
    assert (found.returncode, found.stdout) == (128 + signal.SIGTERM, "")


def test_a_cluster_that_has_shrunk_has_no_room():
    cluster = places.Cluster.__new__(places.Cluster)
    cluster._ray = SimpleNamespace(cluster_resources=lambda: {"CPU": 2})
    cluster.has_gpus, cluster._workers = False, None
    for running, room in ((1, 1), (3, 0)):
        cluster._running = dict.fromkeys(range(running))
        assert cluster.room == room


def test_there_is_a_slot_for_each_core_and_no_more_than_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(places, "_gpus", lambda: 0)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 1, 2}, raising=False)
    one_thread = {"NPROC": "1"}
    assert places.slots() == places.slots(3) == [(core, one_thread) for core in ("1", "2", "3")]
    assert places.slots(2) == [("-", one_thread)] * 2  # another sweep may use the other core
    assert places.slots(4) == [("-", one_thread)] * 4
    assert not places.Local(tmp_path, places.slots()).has_gpus
    monkeypatch.setattr(places, "_gpus", lambda: 2)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    gpus = [("-", {"CUDA_VISIBLE_DEVICES": name}) for name in ("0", "1")]
    assert places.slots() == places.slots(3) == gpus
    assert places.slots(1) == gpus[:1]
    assert places.Local(tmp_path, places.slots()).has_gpus


def test_trainings_run_only_on_the_gpus_that_the_sweep_may_use(tmp_path, monkeypatch):
    monkeypatch.setattr(places, "_gpus", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, GPU-8f1c")
    used = [places.environment(tmp_path, slot)["CUDA_VISIBLE_DEVICES"] for slot in places.slots()]
    assert used == ["2", "GPU-8f1c"]
    assert places.slots(1) == [("-", {"CUDA_VISIBLE_DEVICES": "2"})]


def test_a_training_has_one_thread_on_a_core_and_one_gpu_on_a_gpu(tmp_path, monkeypatch):
    for name in ("NPROC", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5")
    monkeypatch.setattr(places, "_gpus", lambda: 0)
    assert {places.environment(tmp_path, slot)["NPROC"] for slot in (*places.slots(), *places.slots(999))} == {"1"}
    assert "NPROC" not in places.environment(tmp_path, places.Slot())
    monkeypatch.setattr(places, "_gpus", lambda: 1)
    on_gpu = places.environment(tmp_path, *places.slots())
    assert on_gpu["CUDA_VISIBLE_DEVICES"] == "5"
    assert "NPROC" not in on_gpu
    assert pathlib.Path(on_gpu["JAX_COMPILATION_CACHE_DIR"]).is_relative_to(tmp_path)


@pytest.mark.nightly
def test_a_sweep_is_its_trainings_and_a_failure_harms_no_other(tmp_path):
    """A seed's log is the same as that of the training alone; an environment that fails is reported at the end."""
    experiments = [
        *grid(["sac-mlp"], ["pendulum-v"], seeds=2, **QUICK),
        Experiment("sac-mlp", "gym:wheels:Raises-v0", QUICK, seeds=(0,)),
    ]
    module = tmp_path / "wheels.py"
    module.write_text(
        "import gymnasium\n"
        "class Raises(gymnasium.Env):\n"
        "    observation_space = gymnasium.spaces.Box(-1, 1, (1,))\n"
        "    action_space = gymnasium.spaces.Box(-1, 1, (1,))\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        self.steps = 0\n"
        "        return self.observation_space.sample(), {}\n"
        "    def step(self, action):\n"
        "        self.steps += 1\n"
        "        if self.steps > 150: raise RuntimeError('the wheel came off')\n"
        "        return self.observation_space.sample(), 0.0, False, False, {}\n"
        "gymnasium.register('Raises-v0', 'wheels:Raises', max_episode_steps=200)\n"
    )
    with contextlib.chdir(tmp_path):
        sys.path.insert(0, "")
        with pytest.raises(UserError, match=r"1 of 3 trainings failed.*the wheel came off"):
            sweep(experiments, "sweep", seeds_per_run=1)
        sys.path.remove("")
    alone = tmp_path / "alone"
    flags = "--steps 300 --eval-every 100 --eval-episodes 1 --step-start-rl 100 --pretrain-updates 5"
    flags += " --policy-layers 8 --value-layers 8 --seed 1"
    cli.main(f"train sac-mlp pendulum-v {flags} --out {alone}".split())
    (swept,) = (tmp_path / "sweep").glob("*seed1/metrics/seed-1.jsonl")
    assert swept.read_text() == (alone / "metrics" / "seed-1.jsonl").read_text()


@pytest.mark.slow
def test_a_sweep_that_was_stopped_goes_on_where_it_was(tmp_path):
    experiments = grid(
        ["sac-mlp"],
        ["pendulum-v"],
        seeds=2,
        **(QUICK | {"steps": 12_000, "eval_every": 6_000, "checkpoint_steps": 1_000}),
    )

    def stop(status):
        begun = [path for path in tmp_path.glob("stopped/*/metrics/seed-0.jsonl") if '"update"' in path.read_text()]
        if begun:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Stopped):
        sweep(experiments, tmp_path / "stopped", workers=1, report=stop)
    (begun,) = (tmp_path / "stopped").glob("*seed0to1")
    assert len(sweep([], tmp_path / "stopped").finished) == 1
    assert len(Run(begun).config["resumed"]) == 1
    sweep(experiments, tmp_path / "whole")
    assert rows(tmp_path / "whole" / begun.name) == rows(begun)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Only Linux tells a process that its parent has died.")
def test_trainings_stop_with_a_checkpoint_where_the_sweep_is_killed(tmp_path):
    code = (
        "import beliefrl\n"
        f"experiments = beliefrl.grid(['sac-mlp'], ['pendulum-v'], seeds=1, **{QUICK | {'steps': 100_000}})\n"
        f"beliefrl.sweep(experiments, {str(tmp_path / 'sweep')!r}, workers=1)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code])

    def logs():
        return [path.read_text() for path in (tmp_path / "sweep").glob("*/metrics/seed-0.jsonl")]

    while not any('"update"' in text for text in logs()):
        assert process.poll() is None
        time.sleep(0.2)
    process.kill()
    process.wait()
    (log,) = (tmp_path / "sweep" / "logs").iterdir()
    until = time.monotonic() + 60
    while "beliefrl resume" not in log.read_text() and time.monotonic() < until:
        time.sleep(0.2)
    assert "stopped at step" in log.read_text()


# The progress of a sweep, read from logs that are being written.


def test_the_forecast_is_what_is_left_at_the_pace_seen(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    first, second, third = plan([Experiment("vrm", "pendulum", {"steps": 100}, seeds=(0, 1, 2))])
    status = SweepStatus([], [third], {first.name: first, second.name: second})
    forecast = Forecast(tmp_path)
    forecast.watch(status)
    assert forecast.seconds_left(status) is None
    now[0] = 30.0  # seconds until learning begins
    for index, training in enumerate((first, second)):
        a_run(tmp_path / training.name, [[]], first=index, updates=[(20, {"loss": 1.0})])
    forecast.watch(status)
    assert forecast.seconds_left(status) is None
    now[0] = 70.0  # 2 s per step
    for index, training in enumerate((first, second)):
        row = {"step": 40, "kind": "update", "loss": 1.0}
        (tmp_path / training.name / "metrics" / f"seed-{index}.jsonl").write_text(json.dumps(row) + "\n")
    forecast.watch(status)
    assert [each.step for each in forecast.going.values()] == [40, 40]
    assert forecast.seconds_left(status) == (2 * 60 + 2 * 60 + 30 + 2 * 100) / 2
    status = SweepStatus([first, second], [], {third.name: third})
    forecast.watch(status)
    assert list(forecast.going) == [third.name]
    assert forecast.seconds_left(status) == 30 + 200


def test_a_continued_training_learns_from_its_first_new_update_on(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    training, waiting = plan([Experiment("vrm", "pendulum", {"steps": 100}, seeds=(0, 1))])
    run = a_run(tmp_path / training.name, [[]], updates=[(40, {"loss": 1.0})])
    forecast, status = Forecast(tmp_path), SweepStatus([], [waiting], {training.name: training})
    for now[0], step in ((0.0, 40), (20.0, 60), (60.0, 80)):  # 20 s for the start, then 2 s per step
        rows = {"step": 50, "kind": "pretrain"}, {"step": step, "kind": "update", "loss": 1.0}
        (run.folder / "metrics" / "seed-0.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        forecast.watch(status)
        (progress,) = forecast.going.values()
        assert progress.doing == ("starting" if step == 40 else "learning")
    assert progress.pace == (20.0, 2.0)


def test_what_a_training_does_is_read_off_its_last_lines(tmp_path):
    (training,) = plan([Experiment("vrm", "pendulum", {"steps": 100}, seeds=(0,))])
    forecast, status = Forecast(tmp_path), SweepStatus([], [], {training.name: training})
    forecast.watch(status)
    (progress,) = forecast.going.values()
    assert (progress.step, progress.doing) == (0, "starting")
    run = a_run(tmp_path / training.name, [[]])
    log = run.folder / "metrics" / "seed-0.jsonl"
    for row, doing in [
        ({"step": 50, "kind": "pretrain"}, "pre-training, 50 updates"),
        ({"step": 20, "kind": "update"}, "learning"),
    ]:
        log.write_text(json.dumps(row) + "\n" + '{"step": 99, "kind": "up')
        forecast.watch(status)
        assert progress.doing == doing
    assert progress.step == 20
    log.write_text(json.dumps({"step": 30, "kind": "evaluation", "sampled": [1.0, 2.0], "mode": [0.0]}) + "\n")
    forecast.watch(status)
    assert (progress.step, progress.last_return) == (30, 1.5)


def test_one_training_can_be_stopped_alone(tmp_path):
    launcher = places.Local(tmp_path, [])
    programs = {name: subprocess.Popen(["sleep", "60"]) for name in ("one", "other")}
    for name, program in programs.items():
        launcher._running[name] = program, "any"
    launcher.interrupt("one")
    programs["one"].wait(timeout=30)
    assert launcher.ended() == {"one": -signal.SIGTERM}
    launcher.stop()
    assert launcher.ended() == {"other": -signal.SIGTERM}


def test_trainings_that_finish_while_all_are_stopped_have_their_exit_codes(tmp_path):
    launcher = places.Local(tmp_path, [])
    code = "import signal, sys; signal.signal(15, lambda *_: sys.exit(0)); print(flush=True); signal.pause()"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as program:
        assert program.stdout.readline()  # from now on it finishes at SIGTERM
        launcher._running["one"] = program, "any"
        launcher.stop()
    assert (launcher.ended(), launcher.room) == ({"one": 0}, 1)
