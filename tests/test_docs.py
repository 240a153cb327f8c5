"""The pages name commands, options, tasks and agents that exist, and say of tasks what the code says."""

import contextlib
import dataclasses
import functools
import io
import json
import os
import pathlib
import re
import runpy
import subprocess
import sys

import pytest

import beliefrl
from beliefrl import catalogue, tasks
from beliefrl.cli import COMMANDS, main
from beliefrl.errors import UserError

ROOT = pathlib.Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])


def command_lines(text):
    """Every `beliefrl COMMAND ...` of a page, in its blocks and in its sentences, as words."""
    blocks = [line for block in re.findall(r"```bash\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    inline = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    for line in [*blocks, *inline]:
        found = re.match(r"(?:.*[ /])?beliefrl ([a-z]+\b.*)", line.partition(" # ")[0])
        if found:
            yield tuple(re.split(r" (?:&|&&|\|)(?: |$)", found[1])[0].split())


@functools.cache
def help_of(command, *first):
    """What `beliefrl COMMAND FIRST --help` prints; FIRST is an agent, or the word that says which of its figures."""
    screen = io.StringIO()
    with contextlib.redirect_stdout(screen), pytest.raises(SystemExit) as ended:
        main([command, *first, "--help"])
    assert ended.value.code in (0, None)
    return screen.getvalue()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_names_commands_and_options_that_exist(page):
    for command, *words in command_lines(page.read_text()):
        assert command in COMMANDS, f"beliefrl {command}"
        options = {word.partition("=")[0] for word in words if word.startswith("--")} - {"--help"}
        named = [word for word in words[:1] if re.fullmatch(r"[a-z][\w-]*", word)]
        if command in ("train", "bench") and named:
            assert named[0] in (*catalogue.agent_names(), *(["all"] if command == "bench" else []))
        if command in ("train", "bench") and ":" in "".join(words[:1]):
            named = ["worlds:CountingAgent"]  # for the page's own, which is in no file here
        if command == "train":
            assert not words[1:2] or words[1].startswith("-") or words[1].isupper() or tasks.knows(words[1])
        assert all((ROOT / word).exists() for word in words if word.startswith("results/"))
        if options:
            known = set(re.findall(r"--[a-z][\w-]*", help_of(command, *named)))
            assert options <= known, f"beliefrl {command} {' '.join(named)} has no {options - known}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_files_that_a_page_links_to_exist(page):
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        assert "://" in target or (page.parent / target).exists(), target


def test_the_command_lines_of_a_page_are_found():
    page = "Say `beliefrl show RUN`.\n```bash\nX=1 beliefrl train vrm ant --seeds 2 &   # twice\npip list\n```"
    assert list(command_lines(page)) == [("train", "vrm", "ant", "--seeds", "2"), ("show", "RUN")]


def rows(text):
    """Of the tables of a page's text the rows that begin with a name: {name: the other cells}."""
    lines = [line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| `")]
    return {name.strip(" `"): [cell.strip() for cell in cells] for name, *cells in lines}


def entries(cell):
    """The indices that "3, 4" or "0 to 14" stand for."""
    first, _, last = cell.partition(" to ")
    return tuple(range(int(first), int(last) + 1)) if last else tuple(map(int, cell.split(", ")))


def test_the_page_of_tasks_has_every_task_as_it_is():
    table = rows((DOCS / "tasks.md").read_text())
    table = {name: row for name, row in table.items() if not any(name in constants(task) for task in tasks.TASKS)}
    assert set(table) == {*tasks.names(), *catalogue.environment_names()} - {catalogue.ANY}
    for name in tasks.names():
        _, numbers, actions, steps, indices = table[name]
        base = re.sub("-[vp]$", "", name)
        velocities, positions = tasks.masks(tasks.TASKS.get(base) or catalogue.ROBOTS[base])
        seen = {"-v": velocities, "-p": positions}.get(name[-2:]) or tuple(sorted(velocities + positions))
        if seen:
            assert entries(indices) == seen, name
        assert len(entries(indices)) == int(numbers), name
        if base in tasks.TASKS:
            assert tasks.make(name).spec[:3] == (int(numbers), int(actions), int(steps)), name
    for known in catalogue.GYMNASIUMS:
        _, velocities, numbers = table[catalogue.PREFIX + known.id]
        assert entries(velocities) == known.velocities
        assert int(numbers) == len(known.velocities + known.positions)


HEADINGS = {"pendulum": "Pendulum", "cartpole": "CartPole", "target-reaching": "Sequential target reaching"}


def constants(name):
    """The table of a task's constants: {constant: (default, from, to)}, as the page writes them."""
    section = (DOCS / "tasks.md").read_text().partition(f"## {HEADINGS[name]}\n")[2].partition("\n## ")[0]
    return {constant: row[:3] for constant, row in rows(section).items()}


@pytest.mark.parametrize("name", tasks.TASKS)
def test_the_page_of_tasks_has_every_constant_and_its_default(name):
    table = constants(name)
    task = tasks.TASKS[name]()
    assert list(table) == [field.name for field in dataclasses.fields(task)]
    for constant, (default, _, _) in table.items():
        assert json.loads(default) == pytest.approx(json.loads(json.dumps(getattr(task, constant))), rel=1e-4)


@pytest.mark.parametrize(("name", "constant"), [(name, each) for name in tasks.TASKS for each in constants(name)])
def test_the_ranges_on_the_page_of_tasks_are_those_of_the_code(name, constant, unchecked):
    task, (_, low, high) = tasks.TASKS[name](), constants(name)[constant]
    dependent = {"`field`": 15.0, "half of `target_square`²": 8.0}  # with the other constants' defaults
    bounds = [(float(low), -1), *([(dependent.get(high) or float(high), 1)] if high else [])]

    def value(number):
        kind = type(getattr(task, constant))
        return (number,) * 3 if kind is tuple else kind(number)

    for bound, outwards in bounds:
        beyond = bound + outwards * (1 if constant == "max_steps" else 1e-3 * abs(bound) or 1e-3)
        if constant not in ("field", "target_square"):  # the ranges of others depend on these
            tasks.make(name, **{constant: value(bound)})
        with pytest.raises(UserError, match=f"^{constant}="):
            tasks.make(name, **{constant: value(beyond)})


def test_the_page_of_agents_has_every_agent():
    text = (DOCS / "agents" / "README.md").read_text()
    assert all(f"`{name}`" in text for name in catalogue.agent_names())


def test_every_public_name_is_in_the_api():
    listed = set(re.findall(r"^\.\. auto\w+:: (\w+)$", (DOCS / "api.md").read_text(), re.MULTILINE))
    assert listed == set(beliefrl.__all__)


def test_every_example_is_shown():
    shown = re.findall(r"{literalinclude} \.\./examples/(\S+)", (DOCS / "examples.md").read_text())
    assert sorted(shown) == sorted(path.name for path in (ROOT / "examples").glob("*.py"))


def test_the_picture_of_the_parts_is_drawn_from_the_imports():
    house = runpy.run_path(str(DOCS / "house.py"))
    assert house["PICTURE"].read_text() == house["draw"](house["read"]())


README = (ROOT / "README.md").read_text()


def commands():
    """The lines of the README's shell blocks."""
    blocks = re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
    return [line for block in blocks for line in block.splitlines()]


def test_ci_runs_the_readmes_test_command():
    (line,) = (line for line in commands() if line.endswith("/pytest"))
    assert line in (ROOT / ".ci" / "run").read_text()


def test_one_command_builds_the_pages():
    command = "sphinx-build -W --keep-going docs docs/_build"
    for file in ("README.md", "CONTRIBUTING.md", ".ci/run"):
        assert command in (ROOT / file).read_text()


# The examples run unchanged with --quick, a second time as well.

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


NIGHTLY = tuple(name for name in PHRASES if name[:2] not in ("01", "05"))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.nightly if name in NIGHTLY else pytest.mark.slow) for name in PHRASES],
)
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
