"""The examples run unchanged, with fewer steps."""

import os
import pathlib
import subprocess
import sys

import pytest

EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"
FEW = {
    "00_quick_start.py": (["--steps", "300", "--seeds", "1"], "return with mode actions"),
    "01_your_own_environment.py": (["--steps", "300"], "m from the mark"),
    "02_a_task_in_jax.py": (["--steps", "300"], "return per seed"),
    "03_a_new_agent.py": (["--steps", "300"], "seed 1: return at each evaluation {300:"),
    "06_many_trainings.py": (["--steps", "300", "--seeds", "1"], "4 trainings are finished"),
    "05_train_elsewhere.py": (["--steps", "1024", "--episodes", "1"], "Return after 1024 steps"),
}


def output(folder, *command):
    """The output of a program, which must succeed."""
    environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *map(str, command)], cwd=folder, env=environment, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_run_here():
    assert {path.name for path in EXAMPLES.glob("*.py")} == {*FEW, "04_deploying.py"}


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW)
def test_an_example_runs(tmp_path, name):
    if name.startswith("05"):
        pytest.importorskip("sb3_contrib")
    options, phrase = FEW[name]
    assert phrase in output(tmp_path, EXAMPLES / name, *options)


@pytest.mark.slow
def test_deploying_runs_on_what_was_trained(tmp_path):
    words = "-m beliefrl.cli train sac-lstm gym:Pendulum-v1 --observe 2 --steps 100 --eval-episodes 1 --out run"
    output(tmp_path, *words.split())
    printed = output(tmp_path, EXAMPLES / "04_deploying.py", "run", "--episodes", "1")
    assert printed.startswith("<Policy sac-lstm on gym:Pendulum-v1: observation (1,), action (1,), seed 0>\n")
    file, policy = printed.splitlines()[-1].split(" and the policy's: ")
    assert file.removeprefix("the file's first action: ") == policy
