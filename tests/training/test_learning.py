"""Agents learn tasks, from the command to the last evaluation, with their default settings: minutes each.

VRM takes five minutes to its first solved task; what it reaches is in docs/results, and `test_probes` has it learn
small worlds that need memory.
"""

import json
import os
import subprocess
import sys

import pytest

LEARNED = {  # agent, task, steps, a return that says the task was learned
    "sac-mlp": ("pendulum", 4_000, -300),
}


@pytest.mark.slow
@pytest.mark.parametrize("agent", LEARNED)
def test_it_learns(agent, tmp_path):
    task, steps, enough = LEARNED[agent]
    run = tmp_path / "run"
    options = ["--steps", steps, "--eval-every", steps, "--eval-episodes", 20, "--out", run]
    command = [sys.executable, "-m", "beliefrl.cli", "train", agent, task, *map(str, options)]
    environment = {name: value for name, value in os.environ.items() if name != "JAX_DISABLE_MOST_OPTIMIZATIONS"}
    subprocess.run(command, check=True, timeout=1500, env=environment)
    assert json.loads((run / "results.json").read_text())["sampled"]["mean"] > enough
