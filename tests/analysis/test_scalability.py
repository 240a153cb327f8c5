"""The table of the cost of training, for runs with known times and sizes."""

import numpy as np
import pytest
from safetensors.numpy import save_file

from beliefrl.analysis.groups import groups
from beliefrl.analysis.scalability import COLUMNS, STEPS, cells, costs, wall_clock, write_costs
from beliefrl.analysis.tables import latex, markdown
from written import a_run, flat

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
    assert cost.seconds == pytest.approx(100 / 20 / 2 * STEPS)
    assert cost.parameters == 20  # every array that is saved, whatever its name
    assert cost.steps == 20


def test_the_table_is_markdown_and_latex(run, tmp_path):
    table = COLUMNS, [cells(cost) for cost in costs(groups([run]))]
    assert markdown(*table).splitlines()[-1] == "| sac_mlp | pendulum-v | 69.44 h | 0.00 M | 20 |"
    assert r"sac\_mlp & pendulum-v & 69.44 h & 0.00 M & 20 \\" in latex(*table)
    assert write_costs(groups([run]), tmp_path / "table").read_text() == markdown(*table)
    assert (tmp_path / "table.tex").read_text() == latex(*table)


def test_what_is_not_known_is_said_to_be_unknown(tmp_path):
    (cost,) = costs(groups([a_run(tmp_path / "a", [flat(1.0)])]))
    assert (cost.seconds, cost.parameters) == (None, None)
    assert "| unknown | unknown |" in markdown(COLUMNS, [cells(cost)])


def test_sessions_that_are_no_sessions_have_no_time(tmp_path):
    for index, session in enumerate(({}, {"started": 5, "ended": 6}, {"started": "today", "ended": "later"})):
        assert wall_clock(a_run(tmp_path / f"{index}", [flat(1.0)], **{**SESSIONS, "resumed": [session]})) is None
