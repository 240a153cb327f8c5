"""What a training shows, phase by phase."""

import io

import pytest
from beliefrl.commands.display import TrainingDisplay
from rich.console import Console

from beliefrl.training.schedule import Event, Phase


@pytest.fixture
def display():
    return TrainingDisplay(Console(file=io.StringIO(), width=200), steps=100)


@pytest.mark.parametrize("phase", Phase)
def test_a_compilation_says_that_it_takes_a_while(display, phase):
    display(Event(phase, 0))
    (task,) = display.progress.tasks
    assert task.description == phase.value
    assert ("(a minute at most)" in task.fields["status"]) == phase.value.startswith("compiling")


def test_an_evaluation_does_not_begin_a_phase(display):
    for phase, step in ((Phase.EXPLORING, 0), (Phase.EXPLORING, 20), (Phase.EVALUATING, 20), (Phase.EXPLORING, 40)):
        display(Event(phase, step))
    lines = display.console.file.getvalue().splitlines()
    assert [line.split("] ")[1] for line in lines] == ["exploring"]
    assert display.phase_step == 0
