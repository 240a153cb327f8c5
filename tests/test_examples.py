"""The examples run unchanged with --quick, a second time as well."""

import json
import os
import pathlib
import re
import subprocess
import sys

import pytest

EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"
PHRASES = {
    "00_quick_start.py": "return with mode actions",
    "01_your_own_environment.py": "m from the mark",
    "02_a_task_in_jax.py": "return without memory, per seed",
    "03_a_new_agent.py": "seed 1: return at each evaluation {600:",
    "04_deploying.py": "returns in your own loop",
    "05_train_elsewhere.py": "Return after 2048 steps",
    "06_many_trainings.py": "2 trainings are finished",
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
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(PHRASES)


@pytest.mark.parametrize("name", PHRASES)
def test_an_example_says_what_quick_does(name):
    assert f"python examples/{name} --quick  " in (EXAMPLES / name).read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", PHRASES)
def test_an_example_runs_and_can_be_started_again(tmp_path, name):
    if name.startswith("05"):
        pytest.importorskip("sb3_contrib")
    again = name[:2] in ("00", "03")  # one makes a new folder, one resumes
    for _ in range(1 + again):
        assert PHRASES[name] in output(tmp_path, EXAMPLES / name, "--quick")


@pytest.mark.slow
def test_deploying_runs_on_what_was_trained(tmp_path):
    words = "-m beliefrl.cli train sac-lstm gym:Pendulum-v1 --observe 2 --steps 100 --eval-episodes 1 --out run"
    output(tmp_path, *words.split())
    printed = output(tmp_path, EXAMPLES / "04_deploying.py", "run", "--episodes", "1")
    assert printed.startswith("<Policy sac-lstm on gym:Pendulum-v1: observation (1,), action (1,), seed 0>\n")
    file, policy = printed.splitlines()[-1].split(" and the policy's: ")
    assert file.removeprefix("the file's first action: ") == policy


def test_the_notebook_keeps_what_it_printed_and_no_path_of_a_machine():
    cells = json.loads((EXAMPLES / "tutorial.ipynb").read_text())["cells"]
    ran = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in ran] == list(range(1, len(ran) + 1))
    outputs = [output for cell in ran for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error" or output.get("name") == "stderr"]
    said = json.dumps([output.get("text") or output["data"].get("text/plain") for output in outputs])
    assert "step 1,000: return" in said
    assert not re.search(r"(?<![\w.])/(tmp|home|root|work|usr|opt)/|https?://", said)
