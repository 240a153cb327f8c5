"""Groups of runs: which seeds belong to one line of a figure, and which do not."""

import json
import shutil

import numpy as np
import pytest

from beliefrl.analysis.groups import find, groups, is_finished, last_step
from beliefrl.types import UserError
from written import a_run, flat


def labels(made):
    return [(group.task, group.label, [seed for _, seed in group.seeds]) for group in made]


def test_seeds_of_the_same_settings_are_one_line_however_they_were_run(tmp_path):
    one = a_run(tmp_path / "one", [flat(1.0, 2.0), flat(3.0, 4.0)])
    two = a_run(tmp_path / "two", [flat(5.0, 6.0)], first=2)
    (group,) = groups([one, two])
    assert labels([group]) == [("pendulum-v", "vrm", [0, 1, 2])]
    np.testing.assert_array_equal(group.curve().seeds, [[1, 2], [3, 4], [5, 6]])
    assert group.runs == [one, two]


def test_agents_tasks_and_settings_are_apart_and_named_by_what_differs(tmp_path):
    usual = {"gamma": 0.99, "tau": 0.005}
    made = [
        a_run(tmp_path / "a", [flat(1.0)], settings=usual),
        a_run(tmp_path / "b", [flat(1.0)], settings={**usual, "gamma": 0.9}),
        a_run(tmp_path / "c", [flat(1.0)], agent="sac-mlp", settings={"tau": 0.1}),
        a_run(tmp_path / "d", [flat(1.0)], task="pendulum", settings=usual, observe=[0, 2]),
    ]
    assert labels(groups(made)) == [
        ("pendulum-v", "vrm gamma=0.99", [0]),
        ("pendulum-v", "vrm gamma=0.9", [0]),
        ("pendulum-v", "sac-mlp", [0]),
        ("pendulum observe 0 2", "vrm gamma=0.99", [0]),
    ]


def test_a_run_older_than_a_setting_has_its_default_and_defaults_are_not_named(tmp_path):
    made = [
        a_run(tmp_path / "old", [flat(1.0)], settings={"gamma": 0.99}),
        a_run(tmp_path / "new", [flat(1.0)], settings={"gamma": 0.99, "n_step": 1}, first=1),
        a_run(tmp_path / "other", [flat(1.0)], settings={"gamma": 0.99, "n_step": 5}),
    ]
    assert labels(groups(made, {"vrm": {"gamma": 0.99, "n_step": 1}})) == [
        ("pendulum-v", "vrm", [0, 1]),
        ("pendulum-v", "vrm n_step=5", [0]),
    ]


def test_constants_of_a_task_set_it_apart_from_the_same_task_only(tmp_path):
    made = [
        a_run(tmp_path / "a", [flat(1.0)], constants={"length": 1.0}),
        a_run(tmp_path / "b", [flat(1.0)], constants={"length": 2.0}),
        a_run(tmp_path / "c", [flat(1.0)], task="cartpole", constants={"track": 2.4}),
    ]
    assert [group.task for group in groups(made)] == ["pendulum-v length=1.0", "pendulum-v length=2.0", "cartpole"]


def test_a_seed_run_twice_counts_once_as_far_as_it_went(tmp_path):
    short, long = a_run(tmp_path / "short", [flat(1.0)]), a_run(tmp_path / "long", [flat(1.0, 2.0)])
    for runs in ([short, long], [long, short]):
        (group,) = groups(runs)
        assert group.seeds == ((long, 0),)


def test_of_runs_that_went_as_far_the_latest_counts(tmp_path):
    old = a_run(tmp_path / "a", [flat(1.0)], started="2026-01-01T00:00:00+00:00")
    new = a_run(tmp_path / "b", [flat(2.0)], started="2026-02-01T00:00:00+00:00")
    for runs in ([old, new], [new, old]):
        assert groups(runs)[0].seeds == ((new, 0),)


def test_a_curve_goes_as_far_as_all_seeds_have_come(tmp_path):
    (group,) = groups([a_run(tmp_path / "a", [flat(1.0, 2.0, 3.0), flat(4.0, 5.0)])])
    np.testing.assert_array_equal(group.curve().steps, [10, 20])


def test_runs_are_found_however_deep(tmp_path):
    a_run(tmp_path / "sweep" / "vrm-seed0", [flat(1.0)])
    a_run(tmp_path / "sweep" / "deep" / "vrm-seed1", [flat(1.0)], first=1)
    (tmp_path / "sweep" / "config.json").write_text("not a run's")
    both = find([tmp_path / "sweep"]).runs
    assert [run.folder.name for run in both] == ["vrm-seed1", "vrm-seed0"]
    assert len(find([tmp_path / "sweep", tmp_path / "sweep" / "vrm-seed0"]).runs) == 2


def test_a_run_that_cannot_be_read_is_left_out_and_named(tmp_path):
    good, bad = a_run(tmp_path / "good", [flat(1.0)]).folder, a_run(tmp_path / "bad", [flat(1.0)]).folder
    (bad / "config.json").write_text("{")
    found = find([good, bad])
    assert [run.folder for run in found.runs] == [good]
    (why,) = found.damage
    assert f"{bad}/config.json cannot be read" in why
    with pytest.raises(UserError, match="cannot be read"):
        find([bad])


def test_a_run_without_its_logs_is_still_a_run(tmp_path):
    run = a_run(tmp_path / "run", [flat(1.0)])
    shutil.rmtree(run.folder / "metrics")
    found = find([run.folder])
    assert len(found.runs) == 1
    assert "metrics lacks the log of seed 0" in found.damage[0]


@pytest.mark.parametrize("name", ["missing", "empty", "x" * 300])
def test_a_folder_without_runs_is_told(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"There is no (folder|run in)"):
        find([tmp_path / name])


def test_a_run_is_finished_when_every_seed_was_evaluated_at_the_end_or_has_diverged(tmp_path):
    rows = [flat(1.0, 2.0), flat(1.0)]
    assert not is_finished(a_run(tmp_path / "a", rows, steps=20))
    diverged = a_run(tmp_path / "b", rows, steps=20)
    with (tmp_path / "b" / "metrics" / "seed-1.jsonl").open("a") as log:
        log.write(json.dumps({"step": 15, "kind": "diverged", "why": "loss"}) + "\n")
    assert is_finished(diverged)
    assert [last_step(diverged, seed) for seed in (0, 1)] == [20, 10]
    (group,) = groups([diverged])
    np.testing.assert_array_equal(group.curve().seeds, [[1, 2], [1, np.nan]])


@pytest.mark.parametrize(
    ("line", "patience", "reached"),
    [(2.0, 1, True), (2.1, 1, False), (2.0, 2, False), (1.0, 2, True), (1.0, 3, False), (None, 1, False)],
)
def test_a_run_is_finished_when_the_last_evaluations_of_every_seed_reach_the_line(tmp_path, line, patience, reached):
    run = a_run(tmp_path / "a", [flat(5.0, 5.0), flat(1.0, 2.0)], steps=100)
    assert run.reached(line, patience) == reached
    run.config["options"] |= {"stop_at": line, "stop_patience": patience}
    assert is_finished(run) == reached


def test_runs_that_start_from_others_are_a_group_of_their_own(tmp_path):
    runs = [a_run(tmp_path / name, [flat(1.0)]) for name in ("a", "b")]
    runs[1].config["options"]["init_from"] = "runs/a"
    assert [group.label for group in groups(runs)] == ["vrm", "vrm init_from=runs/a"]
