"""Classes by name, and the entry points of installed packages."""

import importlib
import json
import subprocess
import sys
import types

import pytest

import beliefrl
from beliefrl import agents, catalogue, imports, tasks
from beliefrl.commands import COMMANDS, find
from beliefrl.errors import UserError
from worlds import CountingAgent, installed


@pytest.fixture
def modules(tmp_path, monkeypatch):
    """Writes modules that can be imported."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def write(name, text):
        (tmp_path / f"{name}.py").write_text(text)
        importlib.invalidate_caches()

    return write


def test_a_class_is_found_by_its_path_and_has_it():
    assert imports.load("worlds:CountingAgent") is CountingAgent
    assert imports.path(CountingAgent) == "worlds:CountingAgent"


@pytest.mark.parametrize("name", ["worlds", ":", "worlds:", ":CountingAgent", ""])
def test_a_name_of_another_form_is_one_sentence(name):
    with pytest.raises(UserError, match="names no class: write MODULE:CLASS"):
        imports.load(name)


def test_a_class_that_is_not_there_gets_a_hint():
    with pytest.raises(UserError, match=r"no class worlds:CountinAgent: did you mean worlds:CountingAgent\?"):
        imports.load("worlds:CountinAgent")
    with pytest.raises(UserError, match="no class worlds:tiny: write MODULE:CLASS"):
        imports.load("worlds:tiny")


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("import no_such_thing", "ModuleNotFoundError: No module named 'no_such_thing'"),
        ("def f(:", "SyntaxError"),
        ("raise SystemExit('bye')", "SystemExit: bye"),
        ("raise RuntimeError('\\x1b[31mred\\x1b[0m\\nlines')", "RuntimeError: red lines."),
    ],
)
def test_what_a_module_raises_is_one_sentence(modules, text, phrase):
    modules("faulty_module", text)
    with pytest.raises(UserError, match="The module faulty_module cannot be imported") as raised:
        imports.load("faulty_module:Anything")
    assert phrase in str(raised.value)
    assert str(raised.value).isprintable()


def test_a_module_that_is_not_there_and_control_characters_are_one_sentence():
    with pytest.raises(UserError, match=r"The module no_such_module cannot be imported"):
        imports.load("no_such_module:Agent")
    with pytest.raises(UserError) as raised:
        imports.load("no\x1b[31m_such:Agent")
    assert str(raised.value).isprintable()


def test_a_class_of_a_script_has_the_path_that_its_file_has(monkeypatch):
    kind = type("Mine", (), {"__module__": "__main__"})
    main = types.ModuleType("__main__")
    main.__spec__, main.__file__ = None, "/somewhere/my_script.py"
    monkeypatch.setitem(sys.modules, "__main__", main)
    assert imports.path(kind) == "my_script:Mine"
    assert imports.is_named(kind, "my_script:Mine")
    assert imports.is_named(kind, "__main__:Mine")
    assert not imports.is_named(kind, "another:Mine")


def test_entry_points_are_listed_without_an_import(tmp_path, monkeypatch):
    installed(tmp_path, monkeypatch, "beliefrl.agents", mine="never_imported:Agent", vrm="never_imported:Vrm")
    assert imports.declared("beliefrl.agents", ["vrm"]) == {"mine": "never_imported:Agent"}
    assert imports.declared("beliefrl.tasks") == {}
    assert "never_imported" not in sys.modules


def test_names_that_cannot_be_distinguished_are_left_out(tmp_path, monkeypatch):
    lines = "a:b = m:A\nc d = m:A\n\x1b[31mred = m:A\nfine-1.0 = m:A [extra]\n"
    installed(tmp_path, monkeypatch, "beliefrl.agents", lines)
    assert imports.declared("beliefrl.agents") == {"fine-1.0": "m:A"}


def test_a_damaged_package_does_not_hide_the_others(tmp_path, monkeypatch):
    installed(tmp_path / "a", monkeypatch, "beliefrl.agents", mine="m:A")
    broken = installed(tmp_path / "b", monkeypatch, "beliefrl.agents", other="m:B")
    broken.write_bytes(b"[beliefrl.agents]\n\xff\xfe = m:B\n")
    assert imports.declared("beliefrl.agents") == {"mine": "m:A"}


def test_the_folder_that_one_is_in_holds_no_installed_packages(tmp_path, monkeypatch):
    """Else a folder with a run in it could bring code that runs because the run names it."""
    installed(tmp_path, monkeypatch, "beliefrl.agents", mine="m:A")
    sys.path.remove(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")
    assert imports.declared("beliefrl.agents") == {}


# What a program waits for before it can begin: modules are imported when something needs them.

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


@pytest.mark.parametrize(
    "line", ["tasks --all", "show --all", "evaluate --help", "train --help", "tune --help", "tune vmr pendulum"]
)
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
