"""A full disk: one sentence that says how to go on, whichever file has no room, and nothing stays held."""

import os
import subprocess
import sys

import pytest

FILES = {  # where a file begins to have no room: which function of which class is called then
    "metrics": "beliefrl.runs.run.Recorder.log",
    "tensorboard": "beliefrl.runs.trackers.TensorBoard.flush",
    "checkpoint": "beliefrl.runs.checkpoint.Checkpoints.save",
    "agent": "beliefrl.runs.run.Recorder.save",
    "results": "beliefrl.runs.run.Recorder.finish",
}
LIMITED = """
import importlib, resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
module, kind, name = sys.argv[1].rsplit(".", 2)
kind = getattr(importlib.import_module(module), kind)
real = getattr(kind, name)
def limited(*given, **named):
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, resource.RLIM_INFINITY))  # no file may grow beyond 10 bytes
    return real(*given, **named)
setattr(kind, name, limited)
from beliefrl import train
from beliefrl import UserError, agents
from beliefrl.runs.run import Recorder
small = dict(step_start_rl=20, pretrain_updates=5, batch_size=8, policy_layers=(8,), value_layers=(8,))
agent = agents.make("sac-mlp", **small)
try:
    train(agent, "pendulum-v", "run", steps=40, checkpoint_steps=20, eval_every=20, eval_episodes=1)
except UserError as error:
    print(error, file=sys.stderr)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
Recorder("run", None).close()  # it is locked no more
"""


@pytest.mark.parametrize(
    "file", ["metrics", *(pytest.param(name, marks=pytest.mark.slow) for name in FILES if name != "metrics")]
)
def test_a_disk_that_is_full_is_one_sentence(tmp_path, file):
    command = [sys.executable, "-c", LIMITED, FILES[file]]
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert "cannot be written (File too large): fix that, then `beliefrl resume run` goes on." in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.returncode == 0
