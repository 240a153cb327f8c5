"""Sweeps on a real Ray cluster of two nodes on this machine, as a user starts them. Needs the extra `sweep`."""

import contextlib
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import tempfile
import time

import pytest

from beliefrl import sweep
from beliefrl.errors import UserError
from beliefrl.sweeps.experiments import grid

pytest.importorskip("ray", reason="Ray is not installed: pip install 'beliefrl[sweep]'.")
pytestmark = pytest.mark.slow

RAY = pathlib.Path(sys.executable).parent / "ray"
SWEEP = [sys.executable, "-m", "beliefrl.cli", "sweep"]
SETTINGS = "eval_episodes=1 step_start_rl=100 pretrain_updates=5 policy_layers=[8] value_layers=[8]"


def free_port():
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return made.getsockname()[1]


def ray_command(*arguments):
    quiet = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0"}
    return subprocess.run([str(RAY), *arguments], env=quiet, capture_output=True, text=True, timeout=120)


@pytest.fixture
def alone():
    """Waits until no other test has a cluster: `ray stop` stops all clusters on this machine."""
    fcntl = pytest.importorskip("fcntl")
    with (pathlib.Path(tempfile.gettempdir()) / "beliefrl-tests-of-ray").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@pytest.fixture
def head(alone):
    """The address of a cluster of two nodes with one core each."""
    ray_command("stop", "--force")
    address = f"127.0.0.1:{free_port()}"
    port = f"--port={address.split(':')[1]}"
    started = ray_command("start", "--head", port, "--num-cpus=1", "--include-dashboard=false")
    assert started.returncode == 0, started.stderr
    joined = ray_command("start", f"--address={address}", "--num-cpus=1")
    assert joined.returncode == 0, joined.stderr
    yield address
    ray_command("stop", "--force")


def begin(out, head, line):
    """A process that runs a sweep on the cluster."""
    command = [*SWEEP, *line.split(), "--out", str(out), "--ray", head]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def rows(folder):
    return {path.parts[-3]: path.read_text() for path in folder.glob("*/metrics/seed-*.jsonl")}


def wait_until_it_learns(folder, process, begun=0):
    """Wait for an update after step `begun`."""
    while not any('"update"' in text for text in rows(folder).values()) or last_step(folder) <= begun:
        assert process.poll() is None, process.stdout.read()
        time.sleep(0.1)


LONG = "--agents sac-mlp --tasks pendulum-v --seeds 1 --steps 12000 --set eval_every=6000 checkpoint_steps=1000 "
LONG += SETTINGS


@pytest.mark.nightly
def test_a_cluster_trains_what_this_machine_would(tmp_path, head):
    line = f"--agents sac-mlp --tasks pendulum-v pendulum-p --seeds 1 --steps 300 --set eval_every=100 {SETTINGS}"
    process = begin(tmp_path / "there", head, line)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    assert "2 trainings, 2 at a time" in output  # each node has one core, so both nodes worked
    settings = {"eval_every": 100, "eval_episodes": 1, "step_start_rl": 100, "pretrain_updates": 5}
    layers = {"policy_layers": [8], "value_layers": [8]}
    sweep(grid(["sac-mlp"], ["pendulum-v", "pendulum-p"], seeds=1, steps=300, **settings, **layers), tmp_path / "here")
    there, here = rows(tmp_path / "there"), rows(tmp_path / "here")
    assert len(there) == 2
    assert sorted(there.values()) == sorted(here.values())


def last_step(folder):
    """The newest step in the log of the only training."""
    (text,) = rows(folder).values()
    return json.loads(text.rpartition("\n")[0].splitlines()[-1])["step"]  # the last line may be half written


@pytest.mark.nightly
def test_a_sweep_on_a_cluster_can_be_stopped_and_goes_on(tmp_path, head):
    begun = 0
    for line in (LONG.replace("12000", "1000000"), ""):  # far more steps than are made before it stops
        process = begin(tmp_path, head, line)
        wait_until_it_learns(tmp_path, process, begun)
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=600)
        assert process.returncode == 130, output
        assert "stopped with 0 of 1 trainings finished" in output
        (folder,) = (path.parent for path in tmp_path.glob("*/config.json"))
        assert list((folder / "checkpoints").iterdir())
        assert last_step(tmp_path) > begun
        begun = last_step(tmp_path)


@pytest.mark.nightly
def test_a_training_whose_worker_dies_goes_on_by_itself(tmp_path, head):
    process = begin(tmp_path, head, LONG)
    wait_until_it_learns(tmp_path, process)
    out = subprocess.run(["pgrep", "-f", "ray::.*train_on_node"], capture_output=True, text=True).stdout
    assert out.split()
    for worker in out.split():
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(worker), signal.SIGKILL)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    assert "1 of 1 trainings finished" in output


def test_a_missing_cluster_is_an_error(tmp_path):
    with pytest.raises(UserError, match=r"There is no Ray cluster at 127.0.0.1"):
        sweep(grid(["sac-mlp"], ["pendulum"], seeds=1), tmp_path, ray=f"127.0.0.1:{free_port()}")
