"""Figures of many runs: what is drawn, and the error where nothing can be drawn."""

import numpy as np
import pytest

from beliefrl.analysis import panels
from beliefrl.analysis.groups import groups
from beliefrl.analysis.panels import dashes
from beliefrl.sweeps import sources
from beliefrl.types import UserError
from written import a_run, flat


@pytest.fixture
def two_tasks(tmp_path):
    runs = [
        a_run(tmp_path / f"{agent}-{task}", [flat(1.0, 3.0), flat(2.0, 6.0)], agent=agent, task=task)
        for agent in ("vrm", "sac-mlp")
        for task in ("pendulum", "cartpole")
    ]
    return groups(runs)


@pytest.fixture
def drawn(monkeypatch):
    """The matplotlib figures that are saved."""
    made = []
    for module in (panels, elbo):
        monkeypatch.setattr(module, "save", lambda figure, out: made.append(figure) or out)
    return made


def test_a_panel_is_a_task_and_a_line_an_agents_mean(two_tasks, drawn, tmp_path):
    panels.draw_curves(two_tasks, tmp_path / "picture")
    axes = drawn[0].axes
    assert [axis.get_title() for axis in axes] == ["pendulum", "cartpole"]
    for axis in axes:
        lines = {line.get_label(): line.get_xydata() for line in axis.lines}
        assert lines.keys() == {"vrm", "sac-mlp"}
        np.testing.assert_array_equal(lines["vrm"], [[10, 1.5], [20, 4.5]])
        (band, _) = axis.collections
        assert (band.get_paths()[0].get_extents().y0, band.get_paths()[0].get_extents().y1) == (1.0, 6.0)


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
    usual, other = panels.pooled(groups(runs), sources.drawn, sources.PAPERS)
    assert [seed for _, seed in usual.seeds] == list(range(6))
    assert sorted(seed for _, seed in other.seeds) == list(range(6))
    with pytest.raises(UserError, match="not a sensitivity study"):
        panels.pooled(groups(runs[-1:]), sources.drawn, sources.PAPERS)
