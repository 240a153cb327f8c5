"""What a training shows, phase by phase: in a log, in a terminal and in a notebook."""

import errno
import io
import re
import sys
import time
import types

import numpy as np
import pytest
from rich.console import Console

from beliefrl import agents, evaluate, train
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import display as module
from beliefrl.training import screen as screens
from beliefrl.training.display import TrainingDisplay, results_table
from beliefrl.training.rollout import Episode
from beliefrl.training.schedule import Event, Phase
from beliefrl.training.screen import Notebook, Screen, Terminal
from inputs import a_run
from wrong import Fine

AGENT = agents.make("sac-mlp", step_start_rl=20, pretrain_updates=10, policy_layers=(8,), value_layers=(8,))
OPTIONS = {"steps": 40, "eval_every": 20, "eval_episodes": 1}
PHASES = ["compiling the agent", "compiling the exploration", "exploring", "compiling the pre-training"]
PHASES += ["pre-training", "compiling the learning", "learning"]


def console(**options):
    return Console(file=io.StringIO(), width=200, **options)


@pytest.fixture
def run(tmp_path):
    return a_run(tmp_path / "run", [[]], steps=100)


@pytest.fixture
def display(run):
    return TrainingDisplay(Screen(console()), run)


def said(text):
    """The lines of a log, without their times."""
    return [line.split("] ")[1] for line in text.splitlines() if re.match(r"\[[\d: s]+\] ", line)]


@pytest.mark.parametrize("phase", Phase)
def test_a_compilation_says_that_it_takes_a_while(display, phase):
    display(Event(phase, 0))
    (task,) = display.progress.tasks
    assert task.description == phase.value
    assert ("(can take a minute)" in task.fields["status"]) == phase.value.startswith("compiling")


def test_an_evaluation_does_not_begin_a_phase(display):
    for phase, step in ((Phase.EXPLORING, 0), (Phase.EXPLORING, 20), (Phase.EVALUATING, 20), (Phase.EXPLORING, 40)):
        display(Event(phase, step))
    assert said(display.screen.console.file.getvalue()) == ["exploring"]
    assert display.phase_step == 0


def test_the_time_left_of_a_resumed_pretraining_is_that_of_its_new_updates(display, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    display(Event(Phase.PRETRAINING, 0))
    for now[0], done, left in ((5.0, 4_000, ""), (15.0, 4_100, ", 1:30 left in this phase")):
        display(Event(Phase.PRETRAINING, 0, part=(done, 5_000)))
        assert display.progress.tasks[0].fields["status"] == f"{done:,}/5,000 updates{left}"


def test_a_log_gets_a_line_where_nothing_else_was_printed_for_a_minute(run, monkeypatch):
    monkeypatch.setattr(screens, "SILENCE", 0.2)
    display = TrainingDisplay(Screen(console(), patience=0.2), run)
    with display.screen:
        display(Event(Phase.COMPILING_LEARNING, 30))
        time.sleep(0.5)
        display(Event(Phase.LEARNING, 30))
        display(Event(Phase.LEARNING, 50))
        time.sleep(0.5)
    lines = said(display.screen.console.file.getvalue())
    assert "still compiling the learning" in lines
    assert lines[-1].startswith("learning: step 50/100")
    time.sleep(0.5)
    assert said(display.screen.console.file.getvalue()) == lines


def test_a_training_goes_on_if_its_output_cannot_be_written():
    class Full(io.StringIO):
        def write(self, text):
            raise OSError(errno.ENOSPC, "No space left on device")

    shown = Screen(Console(file=Full(), force_terminal=False))
    for _ in range(2):
        shown.line("step 1")
    assert shown.console.quiet


@pytest.mark.nightly
def test_a_training_from_python_shows_its_phases_and_evaluations(tmp_path, capsys):
    train(AGENT, "pendulum", tmp_path / "run", **OPTIONS)
    out = capsys.readouterr().out
    lines = said(out)
    assert [line for line in lines if not line.startswith(("step", "still"))] == PHASES
    assert [line.split(":")[0] for line in lines if line.startswith("step")] == ["step 20", "step 40"]
    assert "sac-mlp on pendulum after 40 steps" in out
    assert f"saved in {tmp_path / 'run'}:" in out


@pytest.mark.slow
def test_without_progress_nothing_is_shown_and_a_callback_gets_the_events(tmp_path, capsys):
    events = []
    run = train(AGENT, "pendulum", tmp_path / "run", callback=events.append, progress=False, **OPTIONS)
    evaluate(run, 1, progress=False)
    assert capsys.readouterr() == ("", "")
    assert [event.step for event in events if event.evaluation is not None] == [20, 40]


@pytest.mark.nightly
def test_an_evaluation_that_takes_seconds_shows_how_many_episodes_are_over(tmp_path, capsys, monkeypatch):
    run = train(AGENT, GymnasiumTask(Fine), tmp_path / "run", progress=False, **OPTIONS)
    patient = screens.screen
    monkeypatch.setattr(screens, "SILENCE", 0.0)
    monkeypatch.setattr(screens, "screen", lambda patience: patient(0.0))

    class Slow(Fine):
        def observe(self):
            time.sleep(0.05)
            return super().observe()

    evaluate(run, 2, task=GymnasiumTask(Slow))
    lines = said(capsys.readouterr().out)
    assert lines[0] == "playing 4 episodes"
    assert "2 of 4 episodes are over" in lines


def evaluated(sampled, mode):
    """The two kinds of actions of one seed in three episodes."""
    return np.stack([np.broadcast_to(sampled, 3), np.broadcast_to(mode, 3)])[None]


EVALUATION = Episode(
    evaluated(True, True), evaluated(-7.0, -3.0), evaluated(10, 10), {"success": evaluated([1.0, 0.0, 0.0], 1.0)}
)
LINE = "step 40: return -7.0 sampled, -3.0 mode; success 33% sampled, 100% mode"
RESULTS = {
    "sampled": {
        "mean": -7.0,
        "sem": 0.3,
        "seeds": [-7.3, None, -6.7],
        "success": 0.5,
        "seeds_success": [0.2, None, 0.8],
    },
    "mode": {"mean": -3.0, "sem": 0.1, "seeds": [-3.1, None, -2.9], "success": 1.0, "seeds_success": [1.0, None, 1.0]},
}


def test_a_table_of_results_has_each_number_below_the_kind_of_its_actions():
    table = results_table(RESULTS, [4, 5, 6], "title")
    headings, *rows = zip(*([column.header, *column.cells] for column in table.columns), strict=True)
    assert headings == ("seed", "sampled actions", "mode actions", "success sampled", "success mode")
    assert rows == [
        ("4", "-7.3", "-3.1", "20%", "100%"),
        ("5", "diverged", "diverged", "-", "-"),
        ("6", "-6.7", "-2.9", "80%", "100%"),
        ("mean ± S.E.M.", "-7.0 ± 0.3", "-3.0 ± 0.1", "50%", "100%"),
    ]


def test_a_terminal_keeps_the_evaluations_and_replaces_the_rest(run):
    shown = Terminal(console(force_terminal=True))
    display = TrainingDisplay(shown, run)
    with shown:
        display(Event(Phase.LEARNING, 20))
        display(Event(Phase.LEARNING, 40, evaluation=EVALUATION))
    out = shown.console.file.getvalue()
    assert LINE in out
    assert "learning\n" not in out
    assert "step 40/100" in out  # in the bar


@pytest.fixture
def cells(monkeypatch):
    """What a notebook shows: the latest content of each output."""
    made = []

    class Handle:
        def __init__(self, content):
            made.append(content)
            self.index = len(made) - 1

        def update(self, content, raw):
            made[self.index] = content

    module = types.ModuleType("IPython.display")
    module.display = lambda content, raw, display_id: Handle(content)
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    return made


def test_a_notebook_shows_the_status_the_evaluations_and_the_curve(tmp_path, cells, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a notebook's kernel does
    monkeypatch.setattr(screens, "PACE", 0.0)
    run = a_run(tmp_path / "run", [[(20, [-7.0])]], steps=100)
    display = TrainingDisplay(Notebook(console()), run)
    with display.screen:
        display(Event(Phase.LEARNING, 20))
        assert "step 20/100" in cells[0]["text/plain"]
        display(Event(Phase.LEARNING, 40, evaluation=EVALUATION))
        display(Event(Phase.LEARNING, 60))
        lines = cells[0]["text/plain"].splitlines()
        assert lines[0].endswith(LINE)
        assert "step 60/100" in lines[1]
        assert cells[1]["image/png"].startswith("iVBORw0KGgo")  # base64 of PNG
        monkeypatch.setattr(screens, "PACE", 60.0)
        display(Event(Phase.LEARNING, 80))
        assert "step 60/100" in cells[0]["text/plain"]  # not yet replaced
        display.screen.show(results_table(RESULTS, [4, 5, 6], "title"))
    assert cells[0]["text/plain"].splitlines()[0] == lines[0]
    assert "step 60/100" not in cells[0]["text/plain"]
    assert "\x1b" not in cells[0]["text/plain"]
