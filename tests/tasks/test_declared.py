"""Tasks that installed packages declare as entry points."""

import dataclasses

import pytest

from beliefrl import tasks
from beliefrl.tasks.pendulum import Pendulum
from beliefrl.types import UserError
from worlds import Counting, installed


@dataclasses.dataclass(frozen=True)
class Masked(Pendulum):
    VELOCITIES = [2]
    POSITIONS = [0, 1]


@pytest.fixture
def package(tmp_path, monkeypatch):
    names = {"counts": "worlds:Counting", "masked": f"{__name__}:Masked", "pendulum": "worlds:Counting"}
    names |= {"broken": "nowhere:Task", "wrong": "worlds:CountingAgent", "lost": "worlds:Nothing"}
    installed(tmp_path, monkeypatch, "beliefrl.tasks", **names)


def test_a_task_is_made_by_name_and_has_it(package):
    task = tasks.make("counts", ends=3)
    assert task == Counting(ends=3)
    assert tasks.describe(task) == {"task": "counts", "constants": {"ends": 3, "max_steps": 7}, "observe": None}
    assert tasks.knows("counts")
    assert tasks.names()["counts"].startswith("worlds:Counting")


def test_a_task_that_says_so_has_versions_with_a_part_of_the_observation(package):
    for name, indices in (("masked-v", (2,)), ("masked-p", (0, 1))):
        task = tasks.make(name)
        assert task == tasks.observe(Masked(), indices)
        assert tasks.describe(task)["task"] == name
        assert tasks.knows(name)
    assert tasks.make("masked", observe="velocities") == tasks.make("masked-v")
    with pytest.raises(UserError, match="counts does not define which entries are velocities"):
        tasks.make("counts-v")


def test_ours_are_not_hidden(package):
    assert isinstance(tasks.make("pendulum"), Pendulum)
    assert "worlds" not in tasks.names()["pendulum"]


@pytest.mark.parametrize(
    ("name", "phrase"),
    [
        ("broken", r"broken, an entry point beliefrl\.tasks of an installed package, is broken: The module nowhere"),
        ("lost", "is broken: There is no class worlds:Nothing"),
        ("wrong", "wrong, the entry point worlds:CountingAgent, is no task: it lacks spec"),
        ("countz", r"no task 'countz': did you mean counts\?"),
    ],
)
def test_a_broken_entry_point_is_one_sentence_when_it_is_used(package, name, phrase):
    with pytest.raises(UserError, match=phrase):
        tasks.make(name)


def test_an_unknown_constant_is_refused(package):
    with pytest.raises(UserError, match="The task counts has no constant 'mass': it has ends, max_steps"):
        tasks.make("counts", mass=1)


def test_entry_points_are_not_read_for_what_is_ours(monkeypatch):
    def read(*_):
        raise AssertionError("They were read.")

    monkeypatch.setattr("beliefrl.tasks.declared", read)
    monkeypatch.setattr("beliefrl.tasks.declared_name", read)
    for name in ("pendulum-v", "target-reaching"):
        assert tasks.knows(name)
        assert tasks.describe(tasks.make(name))["task"] == name
