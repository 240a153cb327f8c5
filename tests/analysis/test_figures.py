"""Learning curves and tables of a run, and figures of many runs, from files that are written by hand."""

import json
import math
import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from safetensors.numpy import save_file

from beliefrl.analysis import aggregate, panels
from beliefrl.analysis.figures import curve_figure, draw_curve, standard_error
from beliefrl.analysis.groups import Curve, groups
from beliefrl.analysis.panels import dashes, spread
from beliefrl.analysis.results import cut
from beliefrl.analysis.tables import (
    COSTS,
    TIMED_STEPS,
    Column,
    cost_row,
    costs,
    final_rows,
    latex,
    markdown,
    wall_clock,
    write_costs,
    write_final,
)
from beliefrl.cli import main
from beliefrl.errors import UserError
from beliefrl.sweeps import sources
from inputs import HOUR, TWO_SEEDS, a_run, flat

TWICE = {"steps_per_action": 2}


def with_success(seeds):
    """The same evaluations, with success in the first of two episodes."""
    return [[(step, returns, [True, False]) for step, returns in rows] for rows in seeds]


def evaluations(run, name):
    (group,) = groups([run])
    return group.curve(name)


def test_evaluations_are_every_seeds_means(tmp_path):
    steps, seeds = evaluations(a_run(tmp_path, TWO_SEEDS), "sampled")
    np.testing.assert_array_equal(steps, [10, 20])
    np.testing.assert_array_equal(seeds, [[1.5, 4.0], [1.5, 7.0]])


def test_success_is_read_as_a_rate(tmp_path):
    _, seeds = evaluations(a_run(tmp_path, with_success(TWO_SEEDS)), "sampled_success")
    np.testing.assert_array_equal(seeds, np.full((2, 2), 0.5))


def test_standard_error_is_over_seeds():
    seeds = np.array([[1.0, 4.0], [2.0, 0.0], [6.0, 5.0]])
    np.testing.assert_allclose(standard_error(seeds), np.std(seeds, axis=0, ddof=1) / np.sqrt(3))
    assert np.isnan(standard_error(seeds[:1])).all()


def size(picture):
    """Width and height of a PNG, in pixels."""
    content = picture.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(content[16:20]), int.from_bytes(content[20:24])


def test_the_curve_is_a_picture_in_the_runs_folder(tmp_path):
    picture = draw_curve(a_run(tmp_path, TWO_SEEDS))
    assert picture == tmp_path / "curve.png"
    assert min(size(picture)) > 100
    picture.unlink()
    assert draw_curve(tmp_path) == picture
    assert picture.exists()


@pytest.mark.parametrize(
    ("path", "phrase"), [("no/curve.png", "there is no folder"), ("curve.txt", "must end in .png or .pdf")]
)
def test_a_curve_that_cannot_be_written_is_one_sentence(tmp_path, path, phrase):
    with pytest.raises(UserError, match=phrase):
        draw_curve(a_run(tmp_path, TWO_SEEDS), tmp_path / path)


def test_one_seed_has_a_curve_too(tmp_path):
    assert min(size(draw_curve(a_run(tmp_path, TWO_SEEDS[:1]), tmp_path / "other.png"))) > 100


def test_success_has_a_panel_of_its_own(tmp_path):
    (tmp_path / "with").mkdir()
    (tmp_path / "without").mkdir()
    width, height = size(draw_curve(a_run(tmp_path / "without", TWO_SEEDS)))
    assert size(draw_curve(a_run(tmp_path / "with", with_success(TWO_SEEDS)))) == (2 * width, height)


@pytest.mark.parametrize("seeds", [[[]], [TWO_SEEDS[0], []]], ids=["no seed", "one of two seeds"])
def test_there_is_no_curve_without_evaluations(tmp_path, seeds):
    with pytest.raises(UserError, match="no evaluation"):
        draw_curve(a_run(tmp_path, seeds))
    assert not (tmp_path / "curve.png").exists()


# The table of final results, for runs with known returns and times.


def test_a_row_tells_returns_with_their_spread_and_when_the_task_was_solved(tmp_path):
    made = [a_run(tmp_path / "a", [flat(100, 960, 500), flat(100, 980, 700)], task="cartpole", **HOUR)]
    ((task, agent, seeds, steps, sampled, mode, solved, time),) = final_rows(groups(made))
    assert (task, agent, seeds, steps) == ("cartpole", "vrm", "0 to 1", "30")
    assert sampled == "600.0 ± 100.0"
    assert mode == "7.0 ± 0.0"
    assert solved == "20"  # the mean over seeds is 970 there
    assert time == "0.50 h"


@pytest.mark.parametrize(("task", "enough"), [("cartpole-p", 955.0), ("target-reaching", 134.0)])
def test_a_task_is_solved_by_the_mean_over_seeds(tmp_path, task, enough):
    (row,) = final_rows(groups([a_run(tmp_path / "a", [flat(-1500, enough)], task=task)]))
    assert row[6] == "20"
    (row,) = final_rows(groups([a_run(tmp_path / "b", [flat(-1500, enough), flat(-1500, enough - 50)], task=task)]))
    assert row[6] == "no"


def test_of_a_task_without_a_known_good_return_nobody_says_that_it_is_solved(tmp_path):
    (row,) = final_rows(groups([a_run(tmp_path / "a", [flat(10, 2000)], task="hopper-v")]))
    assert row[6] == "-"


def test_success_is_shown_where_a_task_has_it_and_an_unknown_time_is_unknown(tmp_path):
    seed = [(10, [1.0, 3.0], [True, False])]
    (row,) = final_rows(groups([a_run(tmp_path / "a", [seed], task="target-reaching")]))
    assert row[4] == "2.0; success 50%"
    assert row[5] == "7.0; success 100%"
    assert row[7] == "unknown"


def test_a_seed_that_diverged_does_not_count_in_a_row_and_is_named(tmp_path):
    """It has an evaluation from before."""
    two = [flat(100, 960), flat(100, 500)]
    (row,) = final_rows(groups([a_run(tmp_path / "one", two, task="cartpole", diverged=[1])]))
    assert row[4:6] == ("960.0 (1 of 2 diverged)", "7.0 (1 of 2 diverged)")
    (row,) = final_rows(groups([a_run(tmp_path / "all", two, task="cartpole", diverged=[0, 1])]))
    assert row[4:6] == ("diverged", "diverged")


def test_a_return_that_is_not_finite_does_not_count_in_a_row_and_is_named(tmp_path):
    seeds = [flat(100, 960), flat(100, math.nan), flat(100, math.inf)]
    (row,) = final_rows(groups([a_run(tmp_path / "some", seeds, task="cartpole")]))
    assert row[4:6] == ("960.0 (2 of 3 not finite)", "7.0 ± 0.0")
    (row,) = final_rows(groups([a_run(tmp_path / "all", seeds[1:], task="cartpole")]))
    assert row[4] == "- (2 of 2 not finite)"
    (row,) = final_rows(groups([a_run(tmp_path / "both", seeds[1:], task="cartpole", diverged=[0])]))
    assert row[4] == "- (1 of 2 diverged) (1 of 2 not finite)"


def test_a_measure_that_is_nan_in_all_episodes_has_an_empty_panel(tmp_path, drawn):
    """Warnings are errors in the tests."""
    run = a_run(tmp_path / "a", with_success([flat(1.0, 2.0)]))
    log = run.folder / "metrics" / "seed-0.jsonl"
    log.write_text(re.sub(r'(_success": )\[[^]]*]', r"\1[NaN]", log.read_text()))
    panels.draw_curves(groups([run]), tmp_path / "curves")
    for figure in (curve_figure(run), *drawn):
        returns, success = figure.axes
        assert np.isfinite(returns.lines[0].get_ydata()).all()
        assert np.isnan(success.lines[0].get_ydata()).all()


def test_a_measure_that_only_some_runs_have_is_not_in_a_row(tmp_path):
    runs = [a_run(tmp_path / "a", with_success([flat(1.0)])), a_run(tmp_path / "b", [flat(3.0)], first=1)]
    (row,) = final_rows(groups(runs))
    assert row[4] == "2.0 ± 1.0"


def test_runs_without_an_evaluation_are_not_in_it(tmp_path):
    assert final_rows(groups([a_run(tmp_path / "a", [[]])])) == []


def test_the_command_writes_markdown_and_latex(tmp_path, capsys):
    run = a_run(tmp_path / "a", [flat(-150.0)])
    main(["figure", "table", str(run.folder), "-o", str(tmp_path / "table.md")])
    text = (tmp_path / "table.md").read_text()
    assert text in capsys.readouterr().out
    assert text == write_final(groups([run]), tmp_path / "other").read_text()
    assert r"-150.0 &" in (tmp_path / "table.tex").read_text()


def test_what_would_break_a_table_is_escaped():
    columns = [Column("a"), Column("b", is_number=True)]
    assert markdown(columns, [("x|y", "1")]) == "| a | b |\n| --- | ---: |\n| x\\|y | 1 |\n"
    assert r"a\_b & 5\% $\pm$ 1 \\" in latex(columns, [("a_b", "5% ± 1")])
    assert r"\#1 & a \& b \\" in latex(columns, [("#1", "a & b")])
    assert r"\{1\} & \textbackslash{}x \^{} \~{} \$ \\" in latex(columns, [("{1}", r"\x ^ ~ $")])


@pytest.mark.parametrize("command", ["figure table", "report"])
def test_a_folder_in_place_of_a_file_is_one_sentence(tmp_path, capsys, command, monkeypatch):
    run = a_run(tmp_path / "a", [flat(-150.0)])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), str(run.folder), "-o", "."])
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


# The table of the cost of training, for runs with known times and sizes.

SESSIONS = {
    "started": "2026-01-01T10:00:00+00:00",
    "ended": "2026-01-01T10:01:00+00:00",
    "resumed": [{"started": "2026-01-02T00:00:00+00:00", "ended": "2026-01-02T00:00:40+00:00"}],
}


@pytest.fixture
def run(tmp_path):
    """Two seeds, 20 steps each, 100 seconds."""
    made = a_run(tmp_path / "a", [flat(1.0, 2.0), flat(1.0, 2.0)], agent="sac_mlp", **SESSIONS)
    arrays = {
        ".actor.weight": np.zeros((2, 3, 4)),
        ".actor.bias": np.zeros((2, 3)),
        ".learned_optimiser": np.zeros((2, 5)),
    }
    save_file(arrays, made.folder / "agent.safetensors")
    return made


def test_wall_clock_is_the_sum_of_the_sessions(run, tmp_path):
    assert wall_clock(run) == 100
    killed = {**SESSIONS, "resumed": [{"started": "2026-01-02T00:00:00+00:00"}]}
    assert wall_clock(a_run(tmp_path / "b", [flat(1.0)], **killed)) is None


def test_costs_are_of_one_seed(run):
    (cost,) = costs(groups([run]))
    assert cost.seconds == pytest.approx(100 / 20 / 2 * TIMED_STEPS)
    assert cost.parameters == 20  # every array that is saved, whatever its name
    assert cost.steps == 20


def test_the_table_is_markdown_and_latex(run, tmp_path):
    table = COSTS, [cost_row(cost) for cost in costs(groups([run]))]
    assert markdown(*table).splitlines()[-1] == "| sac_mlp | pendulum-v | 69.44 h | 0.00 M | 20 |"
    assert r"sac\_mlp & pendulum-v & 69.44 h & 0.00 M & 20 \\" in latex(*table)
    assert write_costs(groups([run]), tmp_path / "table").read_text() == markdown(*table)
    assert (tmp_path / "table.tex").read_text() == latex(*table)


def test_what_is_not_known_is_said_to_be_unknown(tmp_path):
    (cost,) = costs(groups([a_run(tmp_path / "a", [flat(1.0)])]))
    assert (cost.seconds, cost.parameters) == (None, None)
    assert "| unknown | unknown |" in markdown(COSTS, [cost_row(cost)])


def test_sessions_that_are_no_sessions_have_no_time(tmp_path):
    for index, session in enumerate(({}, {"started": 5, "ended": 6}, {"started": "today", "ended": "later"})):
        assert wall_clock(a_run(tmp_path / f"{index}", [flat(1.0)], **{**SESSIONS, "resumed": [session]})) is None


# Figures of many runs: what is drawn, and the error where nothing can be drawn.


MEANS = {  # over two seeds, whose returns are 1 less and 1 more
    "pendulum": {"vrm": [2.0, 5.0], "sac-mlp": [3.0, 7.0]},
    "cartpole": {"vrm": [20.0, 50.0], "sac-mlp": [30.0, 70.0]},
}


@pytest.fixture
def two_tasks(tmp_path):
    runs = []
    for task, agents in MEANS.items():
        for agent, (first, last) in agents.items():
            seeds = [flat(first - 1, last - 1), flat(first + 1, last + 1)]
            runs.append(a_run(tmp_path / f"{agent}-{task}", seeds, agent=agent, task=task))
    return groups(runs)


@pytest.fixture
def drawn(monkeypatch):
    """The matplotlib figures that are saved."""
    made = []
    monkeypatch.setattr(panels, "save", lambda figure, out: made.append(figure) or out)
    return made


def test_a_panel_is_a_task_and_a_line_an_agents_mean_with_its_standard_error(two_tasks, drawn, tmp_path):
    panels.draw_curves(two_tasks, tmp_path / "picture")
    axes = drawn[0].axes
    assert [axis.get_title() for axis in axes] == [*MEANS]
    for axis, means in zip(axes, MEANS.values(), strict=True):
        assert {line.get_label(): line.get_ydata().tolist() for line in axis.lines} == means
        assert all(line.get_xdata().tolist() == [10, 20] for line in axis.lines)
        bands = [band.get_paths()[0].get_extents() for band in axis.collections]
        assert [(band.y0, band.y1) for band in bands] == [(low - 1, high + 1) for low, high in means.values()]


def test_lines_of_one_agent_differ_in_their_dashes_and_the_plain_one_is_solid():
    labels = ["mine lr=1", "vrm z_size=8", "vrm", "mine", "vrm z_size=4", "slac"]
    assert list(dashes(labels).items()) == list(zip(labels, [1, 1, 0, 0, 2, 0], strict=True))


def test_the_dashes_of_a_line_are_those_of_its_legend(drawn, tmp_path):
    runs = [
        a_run(tmp_path / f"{gamma}", [flat(1.0, 3.0)], agent="vrm", settings={"gamma": gamma}) for gamma in (0.9, 0.99)
    ]
    panels.draw_curves(groups(runs), tmp_path / "picture")
    style = {line.get_label(): line.get_linestyle() for line in drawn[0].axes[0].lines}
    assert style == {line.get_label(): line.get_linestyle() for line in drawn[0].legends[0].get_lines()}
    assert len(set(style.values())) == 2


@pytest.mark.parametrize("tasks", [("pendulum",), ("pendulum", "cartpole", "cartpole-v")])
def test_a_legend_is_as_wide_as_its_figure_at_most_and_hides_no_panel(drawn, tmp_path, tasks):
    few = {f"setting_{number}": number for number in range(8)}
    settings = few, {**few, "setting_0": 9}, dict.fromkeys(few, 100_000)
    runs = [
        a_run(tmp_path / f"{task}-{number}", [flat(1.0, 3.0)], agent="vrm", task=task, settings=each)
        for task in tasks
        for number, each in enumerate(settings)
    ]
    panels.draw_curves(groups(runs), tmp_path / "picture")
    (figure,) = drawn
    figure.canvas.draw()
    legend, whole = figure.legends[0].get_window_extent(), figure.bbox
    assert whole.x0 <= legend.x0 < legend.x1 <= whole.x1
    assert all(axis.get_window_extent().y0 > legend.y1 for axis in figure.axes)
    assert all(axis.get_window_extent().height > whole.height / 3 for axis in figure.axes)


def test_both_files_are_written(two_tasks, tmp_path):
    path = panels.draw_curves(two_tasks, tmp_path / "picture.pdf")
    assert path == tmp_path / "picture.png"
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF")


def test_nothing_to_draw_is_an_error(tmp_path):
    with pytest.raises(UserError, match="no curve to draw"):
        panels.draw_curves(groups([a_run(tmp_path / "a", [[]])]), tmp_path / "picture")


def test_the_models_loss_is_the_mean_since_the_evaluation_before(tmp_path, drawn):
    updates = [(5, {"negative_elbo": 8.0}), (10, {"negative_elbo": 6.0}), (15, {"negative_elbo": 1.0})]
    (group,) = groups([a_run(tmp_path / "a", [flat(1.0, 2.0)], updates=updates)])
    loss = panels.model_loss(group)
    np.testing.assert_array_equal(loss.steps, [10, 20])
    np.testing.assert_array_equal(loss.seeds, [[7.0, 1.0]])
    panels.draw_elbo([group], tmp_path / "picture")
    left, right = drawn[0].axes
    np.testing.assert_array_equal(left.lines[0].get_ydata(), [1.0, 2.0])
    np.testing.assert_array_equal(right.lines[0].get_ydata(), [7.0, 1.0])


def test_the_dashes_of_a_models_loss_are_those_of_its_legend(tmp_path, drawn):
    updates = [(5, {"negative_elbo": 8.0}), (15, {"negative_elbo": 6.0})]
    panels.draw_elbo(groups([a_run(tmp_path / "a", [flat(1.0, 2.0)], updates=updates)]), tmp_path / "picture")
    (entry,) = [line for line in drawn[0].legends[0].get_lines() if "dashed" in line.get_label()]
    assert drawn[0].axes[1].lines[0].get_linestyle() == entry.get_linestyle() == "--"


def test_a_seed_without_updates_does_not_hide_the_loss_of_the_others(tmp_path):
    updates = [(5, {"negative_elbo": 8.0}), (15, {"negative_elbo": 6.0})]
    runs = [
        a_run(tmp_path / "a", [flat(1.0, 2.0)], updates=updates),
        a_run(tmp_path / "b", [[]], first=1, diverged=[1]),
    ]
    (group,) = groups(runs)
    np.testing.assert_array_equal(panels.model_loss(group).seeds, [[8.0, 6.0], [np.nan, np.nan]])


@pytest.mark.parametrize(("constants", "label"), [({}, "environment steps"), (TWICE, "steps of the agent")])
def test_the_axis_says_whose_steps_are_counted(tmp_path, monkeypatch, constants, label):
    run, drawn = a_run(tmp_path, TWO_SEEDS, constants=constants), []
    monkeypatch.setattr(panels, "save", lambda made, out: drawn.append(made) or out)
    panels.draw_curves(groups([run]), tmp_path / "curves")
    assert [axis.get_xlabel() for made in (*drawn, curve_figure(run)) for axis in made.axes] == [label] * 2


def test_a_bar_has_the_label_of_its_agent_and_a_profile_falls(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(aggregate, "save", lambda figure, out: made.append(figure) or out)
    runs = [
        a_run(tmp_path / agent, [flat(value)], agent=agent, task="cartpole")
        for agent, value in (("vrm", 900.0), ("slac", 200.0))
    ]
    aggregate.draw_aggregate(groups(runs), tmp_path / "picture")
    left, right = made[0].axes
    names = {tick: text.get_text() for tick, text in zip(left.get_yticks(), left.get_yticklabels(), strict=True)}
    middles = {names[round(float(np.mean(line.get_ydata())))]: line.get_xdata()[0] for line in left.lines}
    assert middles["vrm"] > 0.8 > 0.3 > middles["slac"]
    assert all(line.get_ydata()[0] == 1.0 and line.get_ydata()[-1] == 0.0 for line in right.lines)


def test_a_curve_draws_each_measure_with_its_actions_and_names_the_task(tmp_path):
    """In these runs the mode has a return of 7 and success in every episode."""
    run = a_run(tmp_path / "a", with_success(TWO_SEEDS))
    run.config |= {"observe": [0], "faults": {"noise": 0.3}}
    returns, success = curve_figure(run).axes
    for axis, sampled, mode in ((returns, [1.5, 5.5], [7.0, 7.0]), (success, [0.5, 0.5], [1.0, 1.0])):
        means = {line.get_label(): line.get_ydata().tolist() for line in axis.lines if "actions" in line.get_label()}
        assert means == {"sampled actions": sampled, "mode actions": mode}
    assert returns.get_title(loc="left") == "vrm on pendulum-v observe 0 noise=0.3, mean and S.E.M. of 2 seeds"


@pytest.mark.parametrize("count", [1, 2])
def test_a_single_evaluation_can_be_seen(count):
    axis = Figure().subplots()
    panels.draw_line(axis, Curve(np.arange(count), np.ones((3, count))), "black", "vrm")
    assert (axis.lines[0].get_marker() == "o") == (count == 1)


def test_agents_without_a_model_have_no_such_figure(two_tasks, tmp_path):
    with pytest.raises(UserError, match="model that keeps learning"):
        panels.draw_elbo(two_tasks, tmp_path / "picture")


def test_sensitivity_compares_the_papers_settings_with_those_drawn_for_each_seed(tmp_path):
    runs = []
    for seed in range(6):
        runs.append(a_run(tmp_path / f"papers-{seed}", [flat(1.0)], first=seed, settings=sources.PAPERS))
        if sources.drawn(seed) != sources.PAPERS:
            runs.append(a_run(tmp_path / f"drawn-{seed}", [flat(2.0)], first=seed, settings=sources.drawn(seed)))
    runs.append(a_run(tmp_path / "other", [flat(3.0)], first=99, settings={**sources.PAPERS, "seq_len": 7}))
    runs.append(a_run(tmp_path / "gamma", [flat(4.0)], first=0, settings={**sources.PAPERS, "gamma": 0.5}))
    papers = {**sources.PAPERS, "gamma": 0.99}
    usual, other = panels.pooled(groups(runs), sources.drawn, papers)
    assert {run.folder.name for run, _ in usual.seeds} == {f"papers-{seed}" for seed in range(6)}
    assert [seed for _, seed in usual.seeds] == list(range(6))
    assert sorted(seed for _, seed in other.seeds) == list(range(6))
    with pytest.raises(UserError, match="not a sensitivity study"):
        panels.pooled(groups(runs[-1:]), sources.drawn, sources.PAPERS)


def test_a_row_of_a_group_that_diverged_before_its_first_evaluation(tmp_path):
    good = a_run(tmp_path / "good", [flat(5.0)])
    bad = a_run(tmp_path / "bad", [[]], agent="slac", diverged=[0])
    rows = final_rows(groups([good, bad]))
    assert [row[1] for row in rows] == ["vrm", "slac"]
    assert rows[1][3:7] == ("-", "diverged", "diverged", "no")


def test_seeds_that_are_missing_are_not_counted_in_a_row(tmp_path):
    runs = [a_run(tmp_path / str(seed), [flat(5.0)], first=seed) for seed in (0, 7)]
    assert final_rows(groups(runs))[0][2] == "0 7"
    assert final_rows(groups([*runs, a_run(tmp_path / "1", [flat(5.0)], first=1)]))[0][2] == "0 1 7"


def test_the_time_until_an_earlier_step_is_unknown(tmp_path):
    times = {"started": "2026-01-01T00:00:00+00:00", "ended": "2026-01-01T01:00:00+00:00"}
    run = a_run(tmp_path / "one", [flat(1.0, 2.0)], **times)
    assert wall_clock(run) == wall_clock(cut(run, 20)) == 3600.0
    assert wall_clock(cut(run, 10)) is None
    assert final_rows(groups([cut(run, 10)]))[0][-1] == "unknown"


def test_the_time_until_the_last_step_is_known_after_a_long_pre_training(tmp_path):
    run = a_run(tmp_path / "one", [flat(1.0)], **HOUR)
    log = run.folder / "metrics" / "seed-0.jsonl"
    log.write_text(json.dumps({"step": 2000, "kind": "pretrain", "pretrain_loss": 1.0}) + "\n" + log.read_text())
    assert wall_clock(cut(run, 10)) == 3600.0


@pytest.mark.parametrize("name", ["table.v1", "numbers.csv"])
def test_another_ending_of_a_table_is_one_sentence(tmp_path, name):
    with pytest.raises(UserError, match=r"a table is written as .md and .tex, so its name must end in one of them"):
        write_final(groups([a_run(tmp_path / "one", [flat(1.0)])]), tmp_path / name)
    with pytest.raises(UserError, match="The table would be empty"):
        write_final([], tmp_path / "table.md")


def test_a_name_that_is_too_long_is_one_sentence(tmp_path):
    with pytest.raises(UserError, match="cannot be written"):
        write_final(groups([a_run(tmp_path / "one", [flat(1.0)])]), tmp_path / ("x" * 300))


def test_a_legend_says_how_many_seeds_have_diverged(tmp_path):
    made = groups([a_run(tmp_path / "one", [flat(1.0), flat(2.0), flat(3.0)], diverged=[1])])
    assert spread(made) == "mean and S.E.M. of 3 seeds; 1 diverged, and is not in the later means"
    title = curve_figure(made[0].runs[0]).axes[0].get_title(loc="left")
    assert title.endswith("mean and S.E.M. of 3 seeds, 1 diverged")
