"""Sweeps on a real Ray cluster of two nodes on this machine. Needs the extra `sweep`."""

import contextlib
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time

import pytest

from beliefrl import sweep
from beliefrl.stop import Stopped
from beliefrl.sweeps.plan import grid
from beliefrl.types import UserError

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'beliefrl[sweep]'.")
pytestmark = pytest.mark.slow

QUICK = {
    "steps": 300,
    "eval_every": 100,
    "eval_episodes": 1,
    "step_start_rl": 100,
    "pretrain_updates": 5,
    "policy_layers": [8],
    "value_layers": [8],
}
RAY = pathlib.Path(sys.executable).parent / "ray"


def free_port():
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return made.getsockname()[1]


def ray_command(*arguments):
    quiet = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0"}
    return subprocess.run([str(RAY), *arguments], env=quiet, capture_output=True, text=True, timeout=120)


@pytest.fixture
def head():
    """The address of a cluster of two nodes with one core each."""
    ray_command("stop", "--force")
    address = f"127.0.0.1:{free_port()}"
    started = ray_command(
        *("start", "--head", f"--port={address.split(':')[1]}", "--num-cpus=1", "--include-dashboard=false")
    )
    assert started.returncode == 0, started.stderr
    joined = ray_command("start", f"--address={address}", "--num-cpus=1")
    assert joined.returncode == 0, joined.stderr
    yield address
    ray.shutdown()
    ray_command("stop", "--force")


def rows(folder):
    return {path.parts[-3]: path.read_text() for path in folder.glob("*/metrics/seed-*.jsonl")}


def test_a_cluster_trains_what_this_machine_would(tmp_path, head):
    experiments = grid(["sac-mlp"], ["pendulum-v", "pendulum-p"], seeds=1, **QUICK)
    at_a_time = []
    sweep(experiments, tmp_path / "there", ray=head, report=lambda status: at_a_time.append(len(status.running)))
    assert max(at_a_time) == 2  # a node has one core, so both were at work
    sweep(experiments, tmp_path / "here")
    assert rows(tmp_path / "there") == rows(tmp_path / "here")
    assert len(rows(tmp_path / "there")) == 2


def test_a_sweep_on_a_cluster_can_be_stopped_and_goes_on(tmp_path, head):
    experiments = grid(["sac-mlp"], ["pendulum-v"], seeds=1, **(QUICK | {"steps": 1500, "checkpoint_steps": 100}))

    def stop(status):
        if any('"update"' in text for text in rows(tmp_path / "sweep").values()):
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Stopped):
        sweep(experiments, tmp_path / "sweep", ray=head, report=stop)
    (folder,) = (path.parent for path in (tmp_path / "sweep").glob("*/config.json"))
    assert not (folder / "results.json").exists()
    assert list((folder / "checkpoints").iterdir())
    assert len(sweep([], tmp_path / "sweep", ray=head).finished) == 1


def test_a_training_whose_worker_dies_goes_on_by_itself(tmp_path, head):
    experiments = grid(["sac-mlp"], ["pendulum-v"], seeds=1, **(QUICK | {"steps": 1500, "checkpoint_steps": 100}))
    killed = []

    def kill(status):
        if not killed and any('"update"' in text for text in rows(tmp_path / "sweep").values()):
            out = subprocess.run(["pgrep", "-f", "ray::.*train_there"], capture_output=True, text=True).stdout
            for process in out.split():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(process), signal.SIGKILL)
                killed.append(process)

    status = sweep(experiments, tmp_path / "sweep", ray=head, report=kill)
    assert killed
    assert len(status.finished) == 1


def test_where_there_is_no_cluster_is_told(tmp_path):
    before = time.monotonic()
    with pytest.raises(UserError, match=r"There is no Ray cluster at 127.0.0.1"):
        sweep(grid(["sac-mlp"], ["pendulum"], seeds=1), tmp_path, ray=f"127.0.0.1:{free_port()}")
    assert time.monotonic() > before
