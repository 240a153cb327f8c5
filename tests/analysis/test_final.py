"""The table of final results, for runs with known returns and times."""

import pytest

from beliefrl.analysis.final import rows, write_final
from beliefrl.analysis.groups import groups
from beliefrl.analysis.tables import Column, latex, markdown
from beliefrl.cli import main
from written import HOUR, a_run, flat


def test_a_row_tells_returns_with_their_spread_and_when_the_task_was_solved(tmp_path):
    made = [a_run(tmp_path / "a", [flat(100, 960, 500), flat(100, 980, 700)], task="cartpole", **HOUR)]
    ((task, agent, seeds, steps, sampled, mode, solved, time),) = rows(groups(made))
    assert (task, agent, seeds, steps) == ("`cartpole`", "`vrm`", "0 to 1", "30")
    assert sampled == "600.0 ± 100.0"
    assert mode == "7.0 ± 0.0"
    assert solved == "20"  # the mean over seeds is 970 there
    assert time == "0.50 h"


@pytest.mark.parametrize(("task", "enough"), [("cartpole-p", 955.0), ("target-reaching", 134.0)])
def test_a_task_is_solved_by_the_mean_over_seeds(tmp_path, task, enough):
    (row,) = rows(groups([a_run(tmp_path / "a", [flat(-1500, enough)], task=task)]))
    assert row[6] == "20"
    (row,) = rows(groups([a_run(tmp_path / "b", [flat(-1500, enough), flat(-1500, enough - 50)], task=task)]))
    assert row[6] == "no"


def test_of_a_task_without_a_known_good_return_nobody_says_that_it_is_solved(tmp_path):
    (row,) = rows(groups([a_run(tmp_path / "a", [flat(10, 2000)], task="hopper-v")]))
    assert row[6] == "-"


def test_success_is_told_where_a_task_has_it_and_an_unknown_time_is_unknown(tmp_path):
    seed = [(10, [1.0, 3.0], [True, False])]
    (row,) = rows(groups([a_run(tmp_path / "a", [seed], task="target-reaching")]))
    assert row[4] == "2.0; success 50%"
    assert row[5] == "7.0; success 100%"
    assert row[7] == "unknown"


def test_runs_without_an_evaluation_are_not_in_it(tmp_path):
    assert rows(groups([a_run(tmp_path / "a", [[]])])) == []


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
