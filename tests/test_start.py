"""What a program waits for before it can begin: modules are imported when something needs them."""

import json
import subprocess
import sys

import pytest

import beliefrl
from beliefrl import agents, catalogue, tasks
from beliefrl.commands import COMMANDS, find

REPORT = """
import json, sys
try:
    {code}
except SystemExit:
    pass
print()
print(json.dumps([name for name in ("gymnasium", "jax", "matplotlib", "numpy", "tyro") if name in sys.modules]))
"""


def imported(code):
    """Which of the slow libraries a program has imported when it has run `code`."""
    command = [sys.executable, "-c", REPORT.format(code=code)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("line", ["--help", "--version", "tasks", "agents", "trian"])
def test_lists_and_help_import_nothing_slow(line):
    assert imported(f"from beliefrl import cli; cli.main({line.split()})") == []


@pytest.mark.parametrize("line", ["tasks --all", "show --all", "evaluate --help", "train --help", "train vmr pendulum"])
def test_options_are_checked_without_jax(line):
    assert imported(f"from beliefrl import cli; cli.main({line.split()})") == ["tyro"]


def test_an_import_of_the_library_imports_nothing_slow():
    assert imported("import beliefrl; dir(beliefrl)") == []


def test_the_library_has_every_name_that_it_offers():
    assert set(beliefrl.__all__) == set(beliefrl._HOMES)
    for name in beliefrl.__all__:
        assert getattr(beliefrl, name) is not None
        assert name in dir(beliefrl)
    assert beliefrl.viewing.films.film is beliefrl.film
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = beliefrl.trian


@pytest.mark.parametrize("order", ["beliefrl, gymnasium", "gymnasium, beliefrl", "beliefrl, gymnasium.envs"])
def test_gymnasium_knows_our_tasks_whichever_is_imported_first(order):
    assert imported(f"import {order}; gymnasium.spec('BeliefRL/PendulumV-v0')") == ["gymnasium", "numpy"]


def test_gymnasium_knows_our_tasks_after_another_module_looked_for_it():
    look = "import beliefrl, importlib.util; importlib.util.find_spec('gymnasium')"
    assert imported(f"{look}; import gymnasium; gymnasium.spec('BeliefRL/CartPole-v0')") == ["gymnasium", "numpy"]


def test_what_is_read_from_the_source_of_a_class_is_what_the_class_has():
    paths = [*catalogue.TASKS.values(), *(agent.path for agent in catalogue.AGENTS.values())]
    for kind, path in zip([*tasks.TASKS.values(), *map(type, agents.AGENTS.values())], paths, strict=True):
        read = dict(catalogue.written(path))
        assert read.pop("__doc__") == kind.__doc__.split("\n")[0]
        assert read == {name: getattr(kind, name) for name in read}
    for path, task in zip(catalogue.TASKS.values(), tasks.TASKS.values(), strict=True):
        read = catalogue.written(path)
        assert read["max_steps"] == task().spec.max_steps
        assert (read.get("VELOCITIES", ()), read.get("POSITIONS", ())) == tasks.masks(task)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_found(command):
    assert callable(find(command))
