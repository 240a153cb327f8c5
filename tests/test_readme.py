import pathlib
import re

ROOT = pathlib.Path(__file__).parent.parent
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
