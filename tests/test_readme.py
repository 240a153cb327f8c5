import pathlib
import re

from beliefrl import agents, tasks
from beliefrl.cli import COMMANDS

ROOT = pathlib.Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def commands():
    """The lines of the README's shell blocks."""
    blocks = re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
    return [line for block in blocks for line in block.splitlines()]


def test_ci_runs_the_readmes_test_command():
    (line,) = (line for line in commands() if line.endswith("/pytest"))
    assert line in (ROOT / ".ci" / "run").read_text()


def test_the_readme_names_commands_agents_and_tasks_that_exist():
    lines = re.findall(r"beliefrl (\w+)(?: +(\S+))?(?: +([a-z][\w:-]*))?", "\n".join(commands()))
    assert lines
    for command, agent, task in lines:
        assert command in COMMANDS
        if command in ("train", "bench"):
            assert agent in (*agents.names(), *(["all"] if command == "bench" else []))
        if command == "train" and task:
            assert tasks.knows(task)
