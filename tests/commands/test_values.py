"""How values on the command line are parsed, and shown in the help."""

import dataclasses
from typing import Annotated, Literal

import pytest
import tyro

from beliefrl import cli
from beliefrl.commands import COMMANDS
from beliefrl.commands.arguments import UsageError, parse


@dataclasses.dataclass(frozen=True)
class Given:
    """Options of every kind."""

    files: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="FILES")] = ()
    steps: int = 1
    most: int | None = 2
    layers: tuple[int, ...] = (8, 8)
    preset: Literal["a", "b"] | None = None


def read(line):
    return parse(Given, line.split(), "beliefrl")


@pytest.mark.parametrize(("text", "number"), [("1e4", 10_000), ("20_000", 20_000), ("7", 7), ("-3", -3), ("2.0", 2)])
def test_whole_numbers_may_be_written_short(text, number):
    assert read(f"--steps {text}").steps == number
    assert read(f"--most {text}").most == number
    assert read(f"--layers 3 {text}").layers == (3, number)


@pytest.mark.parametrize("text", ["1.5", "many", "inf", "nan", "1e-3", "1e999999", "20k"])
def test_what_is_no_whole_number_is_a_mistake(text):
    for option in ("steps", "most"):
        with pytest.raises(UsageError, match=f"^--{option} must be a whole number, not '{text}'"):
            read(f"--{option} {text}")


def test_options_may_be_none_and_lists_may_be_empty():
    assert read("--most None --preset None --layers") == Given(most=None, layers=())
    assert read("x y --preset b") == Given(files=("x", "y"), preset="b")
    with pytest.raises(UsageError, match="--preset must be one of 'a', 'b', 'None', not 'c'"):
        read("--preset c")


NAMED = {"train": "train vrm", "bench": "bench vrm", "figure": "figure curves"}


@pytest.mark.parametrize("command", sorted(set(COMMANDS) - {"tasks", "agents"}))
def test_no_help_has_gaps(capsys, command):
    with pytest.raises(SystemExit):
        cli.main([*NAMED.get(command, command).split(), "--help"])
    out = capsys.readouterr().out
    assert "usage: beliefrl" in out
    assert "(default: )" not in out
    assert "{None}" not in out


def test_the_help_names_the_choices(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "vrm", "--help"])
    assert "--processes {auto,always,never}" in capsys.readouterr().out
