"""The commands `beliefrl figure` and `beliefrl report` on folders of runs: what they select, draw and print."""

import json
import re

import pytest

from beliefrl import agents
from beliefrl.analysis import aggregate, panels
from beliefrl.cli import main
from beliefrl.runs.run import Run
from beliefrl.sweeps import sources
from inputs import a_run, flat


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """An empty folder for runs, in the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


@pytest.fixture
def drawn(monkeypatch):
    """The matplotlib figures that are saved."""
    made = []
    for module in (panels, aggregate):
        monkeypatch.setattr(module, "save", lambda figure, out: made.append(figure) or out.with_suffix(".png"))
    return made


def lines(axis):
    """The returns of each line by its label."""
    return {line.get_label(): line.get_ydata().tolist() for line in axis.lines}


@pytest.mark.parametrize("kind", ["curves", "ablation", "aggregate"])
def test_a_figure_is_one_command(runs, capsys, kind):
    a_run(runs / "done", [flat(1.0, 2.0)], task="pendulum")
    a_run(runs / "going", [flat(1.0)], task="cartpole", steps=20)
    main(["figure", kind, "runs", "-o", "picture"])
    out = capsys.readouterr().out
    assert "left out: runs/going is not finished" in out
    assert "written to picture.png and picture.pdf" in out
    assert (runs.parent / "picture.png").exists()
    main(["figure", kind, "runs", "--tasks", "pendulum"])
    assert "left out" not in capsys.readouterr().out
    assert (runs.parent / f"{kind}.pdf").exists()


def test_a_run_that_has_not_begun_does_not_hide_the_others_of_its_group(runs, drawn, capsys):
    a_run(runs / "done", [flat(1.0, 2.0)])
    a_run(runs / "begun", [[]], first=1, steps=20)
    for options in ([], ["--unfinished"]):
        main(["figure", "curves", "runs", *options])
        assert "left out: runs/begun has no evaluation of every seed yet" in capsys.readouterr().out.splitlines()
        assert lines(drawn.pop().axes[0]) == {"vrm": [1.0, 2.0]}
    with pytest.raises(SystemExit):
        main(["figure", "curves", "runs", "--names", "begun"])
    message = "None of the 2 runs is both selected and evaluated with every seed: select others."
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("options", [[], ["--unfinished"]])
def test_a_figure_reads_a_log_once_so_that_all_of_it_is_of_one_moment_of_a_training(runs, drawn, monkeypatch, options):
    read = []
    rows = Run.rows
    monkeypatch.setattr(Run, "rows", lambda run, seed, kind=None: read.append(seed) or rows(run, seed, kind))
    a_run(runs / "done", [flat(1.0, 2.0), flat(3.0, 4.0)])
    main(["figure", "curves", "runs", *options])
    assert sorted(read) == [0, 1]


def test_the_cost_table_is_printed_and_written(runs, capsys):
    a_run(runs / "done", [flat(1.0, 2.0)])
    main(["figure", "scalability", "runs"])
    assert (runs.parent / "scalability.md").read_text() in capsys.readouterr().out
    assert (runs.parent / "scalability.tex").exists()


def test_ablations_are_compared_with_vrm_and_with_no_other_agent(runs, drawn):
    for agent, value in (("vrm", 1.0), ("vrm-keep", 2.0), ("slac", 3.0)):
        a_run(runs / agent, [flat(value)], agent=agent)
    main(["figure", "ablation", "runs"])
    main(["figure", "curves", "runs"])
    ablation, curves = (lines(figure.axes[0]) for figure in drawn)
    assert ablation == {"vrm": [1.0], "vrm-keep": [2.0]}
    assert curves == ablation | {"slac": [3.0]}


def test_agents_and_tasks_are_chosen(runs, capsys):
    for agent in ("vrm", "slac"):
        for task in ("pendulum", "cartpole"):
            a_run(runs / f"{agent}-{task}", [flat(1.0)], agent=agent, task=task)
    main(["figure", "table", "runs", "--agents", "slac", "--tasks", "cartpole"])
    rows = capsys.readouterr().out.splitlines()[2:-1]
    assert [row.split(" | ")[:2] for row in rows] == [["| cartpole", "slac"]]


# In these runs the mode has a return of 7 in every evaluation.


@pytest.mark.parametrize(("actions", "returns"), [("sampled", [1.0, 2.0]), ("mode", [7.0, 7.0])])
@pytest.mark.parametrize(("kind", "label"), [("curves", "vrm"), ("elbo", "return")])
def test_returns_are_those_of_the_chosen_actions(runs, drawn, kind, label, actions, returns):
    a_run(runs / "one", [flat(1.0, 2.0)], updates=[(5, {"negative_elbo": 8.0}), (15, {"negative_elbo": 6.0})])
    main(["figure", kind, "runs", "--actions", actions])
    (figure,) = drawn
    assert lines(figure.axes[0]) == {label: returns}
    assert figure.legends[0].get_title().get_text() == "1 seed each" + ("; mode actions" if actions == "mode" else "")


@pytest.mark.parametrize(("actions", "score"), [("sampled", 0.5), ("mode", 0.7)])
def test_scores_are_those_of_the_chosen_actions(runs, drawn, monkeypatch, actions, score):
    monkeypatch.setitem(aggregate.BOUNDS, "cartpole", (0.0, 10.0))
    a_run(runs / "one", [flat(5.0)], task="cartpole")
    main(["figure", "aggregate", "runs", "--actions", actions])
    (figure,) = drawn
    assert figure.axes[0].lines[0].get_xdata() == pytest.approx([score, score])
    assert ("; mode actions; " in figure.legends[0].get_title().get_text()) == (actions == "mode")


def test_a_sensitivity_study_has_a_line_for_the_papers_settings_and_one_for_those_drawn(runs, drawn):
    """The settings drawn for seed 0 are the paper's, so its run is in both lines."""
    papers = agents.defaults()["vrm"] | sources.PAPERS
    trained = {"first": (0, {}, 2.0), "second": (1, {}, 4.0), "drawn": (1, sources.drawn(1), 8.0)}
    for name, (seed, settings, value) in (trained | {"other": (0, {"gamma": 0.5}, 100.0)}).items():
        a_run(runs / name, [flat(value)], first=seed, settings=papers | settings)
    main(["figure", "sensitivity", "runs"])
    (figure,) = drawn
    assert lines(figure.axes[0]) == {"vrm, the paper's settings": [3.0], "vrm, drawn settings": [5.0]}


def test_a_figure_names_what_it_leaves_out(runs, drawn, capsys):
    a_run(runs / "first", [flat(1.0)], task="pendulum", started="2026-01-01T00:00:00+00:00")
    a_run(runs / "again", [flat(1.0)], task="pendulum", started="2026-01-02T00:00:00+00:00")
    a_run(runs / "other", [flat(1.0)], task="cartpole", agent="slac")
    a_run(runs / "both", [flat(1.0)], task="cartpole")
    twice = "left out: runs/first, seed 0: another run has the same settings and seed"
    alone = "left out: pendulum: not all agents have an evaluation at the same step there"
    for kind, notes in (("curves", [twice]), ("aggregate", [twice, alone]), ("table", [twice])):
        main(["figure", kind, "runs"])
        printed = capsys.readouterr().out.splitlines()
        assert [line for line in printed if not line.startswith(("|", "written"))] == notes


def test_text_of_a_run_sends_nothing_to_the_terminal(runs, drawn, capsys):
    name = "a\x1b[31mred\nother"
    a_run(runs / "first", [flat(1.0)], task=name, diverged=[0])
    log = a_run(runs / "again\x1b[2J", [[]], task=name, agent=name, diverged=[0]).folder / "metrics" / "seed-0.jsonl"
    log.write_text("scribble\n" + log.read_text())
    for kind in ("curves", "table"):
        main(["figure", kind, "runs"])
        printed = capsys.readouterr().out
        assert "left out: ared other on ared other: all seeds have diverged" in printed
        assert "\x1b" not in printed
    main(["report", "runs"])
    assert "\x1b" not in capsys.readouterr().out


def test_a_report_is_one_command(runs, capsys):
    done = a_run(runs / "done", [flat(1.0, 2.0)])
    log = done.folder / "metrics" / "seed-0.jsonl"
    log.write_text("scribble\n" + log.read_text())
    a_run(runs / "going", [flat(3.0)], steps=20, agent="slac")
    for options, shown in (([], ["vrm"]), (["--unfinished"], ["slac", "vrm"])):
        main(["report", "runs", "-o", "page.html", *options])
        assert capsys.readouterr().out.splitlines() == [
            "damaged: Line 1 of runs/done/metrics/seed-0.jsonl is damaged and left out.",
            "written to page.html: open it in a browser",
        ]
        found = re.search(r'id="data">(.*?)</script>', (runs.parent / "page.html").read_text(), re.DOTALL)
        assert sorted(group["label"] for group in json.loads(found[1])["groups"]) == shown
