"""Groups of runs: which seeds belong to one line of a figure, and which do not."""

import json
import math
import shutil

import numpy as np
import pytest

from beliefrl.analysis.aggregate import (
    BOUNDS,
    draw_aggregate,
    interquartile_mean,
    interval,
    known_bounds,
    notes,
    profile,
    scores,
)
from beliefrl.analysis.groups import find, groups, is_finished, last_step, left_out
from beliefrl.analysis.labels import task_label
from beliefrl.analysis.results import cut
from beliefrl.errors import UserError
from beliefrl.runs.run import Run
from beliefrl.tasks import describe, make
from inputs import a_run, flat


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
        a_run(tmp_path / "e", [flat(1.0)], settings=usual, faults={"noise": [0.1], "delay": 2}),
    ]
    assert labels(groups(made)) == [
        ("pendulum-v", "vrm gamma=0.99", [0]),
        ("pendulum-v", "vrm gamma=0.9", [0]),
        ("pendulum-v", "sac-mlp", [0]),
        ("pendulum observe 0 2", "vrm gamma=0.99", [0]),
        ("pendulum-v noise=[0.1] delay=2", "vrm gamma=0.99", [0]),
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


def test_a_run_older_than_a_setting_has_what_it_had_in_effect_where_that_is_known(tmp_path):
    made = [
        a_run(tmp_path / "old", [flat(1.0)], settings={"gamma": 0.99}),
        a_run(tmp_path / "new", [flat(1.0)], settings={"gamma": 0.99, "normalise": True}),
        a_run(tmp_path / "without", [flat(1.0)], settings={"gamma": 0.99, "normalise": False}, first=1),
    ]
    defaults, before = {"vrm": {"gamma": 0.99, "normalise": True}}, {"vrm": {"normalise": False}}
    assert labels(groups(made, defaults, before)) == [
        ("pendulum-v", "vrm normalise=False", [0, 1]),
        ("pendulum-v", "vrm", [0]),
    ]


TWICE = ("pendulum-v steps_per_action=2", "steps of the agent")


def test_constants_of_a_task_set_it_apart_from_the_same_task_only(tmp_path):
    made = [
        a_run(tmp_path / "a", [flat(1.0)], constants={"length": 1.0}),
        a_run(tmp_path / "b", [flat(1.0)], constants={"length": 2.0}),
        a_run(tmp_path / "c", [flat(1.0)], task="cartpole", constants={"track": 2.4}),
    ]
    assert [group.task for group in groups(made)] == ["pendulum-v", "pendulum-v length=2", "cartpole track=2.4"]


@pytest.mark.parametrize("name", ["pendulum-v", "cartpole", "cartpole-p", "target-reaching"])
def test_a_task_with_its_default_constants_has_only_its_name(name, tmp_path):
    run = a_run(tmp_path / "a", [flat(1.0)], task=name, constants=describe(make(name))["constants"])
    assert task_label(run) == name


def test_other_constants_are_named_also_if_all_runs_have_them(tmp_path):
    given = {"pendulum": {"mass": 1.5}, "gym:Arm-v0": {"stiffness": 0.3, "measures": ["success"]}}
    robot = {"include_cfrc_ext_in_observation": False}
    runs = [a_run(tmp_path / name, [flat(1.0)], task=name, constants=constants) for name, constants in given.items()]
    ant = a_run(tmp_path / "ant", [flat(1.0)], task="mujoco-ant-v", constants=robot)
    theirs = a_run(tmp_path / "theirs", [flat(1.0)], task="my-task", constants={"length": 2.0, "steps_per_action": 2})
    assert list(map(task_label, [*runs, ant, theirs])) == [
        "pendulum mass=1.5",
        "gym:Arm-v0 stiffness=0.3",
        "mujoco-ant-v",
        "my-task steps_per_action=2",
    ]


def test_action_repeat_is_named_with_the_task_and_its_steps_are_those_of_the_agent(tmp_path):
    once, twice = [
        a_run(tmp_path / str(times), [flat(1.0)], constants={"length": 1.0, "steps_per_action": times})
        for times in (1, 2)
    ]
    assert [(group.task, group.axis) for group in groups([twice])] == [TWICE]
    assert [(group.task, group.axis) for group in groups([once, twice])] == [("pendulum-v", "environment steps"), TWICE]


def test_runs_with_other_time_limits_are_other_tasks(tmp_path):
    """The limit of a Gymnasium environment is no constant. Runs before it was recorded are apart, too."""
    name = "gym:Arm-v0"
    made = [
        a_run(tmp_path / str(limit), [flat(1.0)], task=name, max_steps=limit)
        if limit
        else a_run(tmp_path / "old", [flat(1.0)], task=name)
        for limit in (500, 200, None)
    ]
    assert [group.task for group in groups(made)] == [f"{name} max_steps=500", f"{name} max_steps=200", name]
    assert [group.task for group in groups([made[0], made[2]])] == [name]


def test_a_function_as_a_setting_is_the_same_in_every_process(tmp_path):
    made = [
        a_run(tmp_path / str(n), [flat(1.0)], first=n, agent="own:Agent", settings={"act": f"<function {name}>"})
        for n, name in enumerate(["tanh at 0x7f57a0", "tanh at 0x000001C2F0", "relu at 0x7f57a0"])
    ]
    assert [(group.label, len(group.seeds)) for group in groups(made)] == [
        ("own:Agent act=<function tanh>", 2),
        ("own:Agent act=<function relu>", 1),
    ]


@pytest.mark.parametrize(
    ("task", "named"), [("gym:Arm-v0", "gym:Arm-v0 noise=[1] mass=2 span=[1, 2.5]"), ("my-task", "my-task noise=[1]")]
)
def test_settings_that_are_written_differently_are_the_same(tmp_path, task, named):
    ways = [
        ({"mass": 2, "span": [1, 2.5]}, {"noise": [1]}, 1, {"stop_at": -200, "init_from": "runs/a"}),
        ({"span": [1.0, 2.5], "mass": 2.0}, {"noise": [1.0]}, 1.0, {"stop_at": -200.0, "init_from": "runs/a/"}),
    ]
    made = []
    for seed, (constants, faults, gamma, options) in enumerate(ways):
        of = {"task": task, "constants": constants, "faults": faults, "settings": {"gamma": gamma}, "first": seed}
        made.append(a_run(tmp_path / str(seed), [flat(1.0)], **of))
        made[-1].config["options"] |= options
    assert labels(groups(made)) == [(named, "vrm stop_at=-200 init_from=runs/a", [0, 1])]


def test_constants_in_another_order_are_the_same(tmp_path):
    """They differ from those of a third run, so they are named."""
    first, other = {"mass": 2, "length": 3}, {"mass": 1, "length": 1}
    made = [
        a_run(tmp_path / str(seed), [flat(1.0)], task="my-task", constants=dict(constants), first=seed)
        for seed, constants in enumerate([first.items(), reversed(first.items()), other.items()])
    ]
    assert labels(groups(made)) == [
        ("my-task length=3 mass=2", "vrm", [0, 1]),
        ("my-task length=1 mass=1", "vrm", [2]),
    ]


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
    np.testing.assert_array_equal(group.curve().seeds, [[1, 2], [4, 5]])


def test_runs_are_found_however_deep(tmp_path):
    a_run(tmp_path / "sweep" / "vrm-seed0", [flat(1.0)])
    a_run(tmp_path / "sweep" / "deep" / "vrm-seed1", [flat(1.0)], first=1)
    (tmp_path / "sweep" / "config.json").write_text("not a run's")
    both = find([tmp_path / "sweep"]).runs
    assert [run.folder.name for run in both] == ["vrm-seed1", "vrm-seed0"]
    assert len(find([tmp_path / "sweep", tmp_path / "sweep" / "vrm-seed0"]).runs) == 2


@pytest.mark.parametrize("name", ["checkpoints", "metrics", "tensorboard", "wandb"])
def test_a_run_may_have_any_name_but_inside_a_run_there_are_no_others(tmp_path, name):
    run = a_run(tmp_path / name, [flat(1.0)])
    a_run(run.folder / "checkpoints" / "copy", [flat(1.0)])
    assert [run.folder.name for run in find([tmp_path]).runs] == [name]


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
    a_run(tmp_path / "other", [flat(1.0)])
    found = find([tmp_path])
    assert [run.folder.name for run in found.runs] == ["other", "run"]
    assert "metrics lacks the log of seed 0" in found.damage[0]


@pytest.mark.parametrize("name", ["missing", "empty", "x" * 300])
def test_a_folder_without_runs_is_an_error(tmp_path, name):
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


def test_runs_with_other_options_are_groups_of_their_own_and_a_repetition_is_named(tmp_path):
    runs = [a_run(tmp_path / name, [flat(1.0), flat(2.0)]) for name in ("a", "b", "c")]
    runs[1].config["options"] |= {"envs": 8, "precision": "bfloat16"}
    made = groups(runs)
    assert [group.label for group in made] == ["vrm", "vrm envs=8 precision=bfloat16"]
    (repeated,) = left_out(runs, made)
    assert repeated == f"left out: {tmp_path / 'c'}, seed 0 1: another run has the same settings and seed"


def test_a_repetition_that_diverged_is_named_as_such(tmp_path):
    """The run that went further counts, so a failure would be hidden."""
    lost = a_run(tmp_path / "a", [flat(1.0), flat(1.0)], diverged=[1])
    whole = a_run(tmp_path / "b", [flat(1.0, 2.0), flat(1.0, 2.0)])
    (sentence,) = left_out([lost, whole], groups([lost, whole]))
    again = f"left out: {lost.folder}, seed 0 1: another run has the same settings and seed"
    assert sentence == f"{again}. In {lost.folder}, seed 1 diverged"


# Aggregates over tasks, against their definitions (Agarwal et al. 2021).


def test_the_interquartile_mean_leaves_out_the_best_and_the_worst_quarter_of_all_runs():
    tasks = [np.array([-100.0, 0.2]), np.array([0.4, 100.0])]
    assert interquartile_mean(tasks) == pytest.approx(0.3)
    drawn = np.random.default_rng(0).normal(size=(5, 8))
    middle = np.sort(drawn.ravel())[10:30]
    assert interquartile_mean(list(drawn)) == pytest.approx(middle.mean())


def test_a_profile_is_the_fraction_of_runs_above_each_score():
    tasks = [np.array([0.1, 0.6]), np.array([0.6, 1.0])]
    np.testing.assert_array_equal(profile(tasks, np.array([0.0, 0.1, 0.5, 0.6, 1.0])), [1.0, 0.75, 0.75, 0.25, 0.0])


def test_seeds_are_drawn_anew_within_each_task():
    """Scores differ between tasks, not seeds: the interval has zero width only if each task keeps its weight."""
    low, high = interval(lambda drawn: np.mean(np.concatenate(drawn)), [np.zeros(3), np.ones(3)])
    assert low == high == 0.5


def test_an_interval_covers_the_truth_as_often_as_it_says():
    """Of 200 samples of 40 numbers, the mean's interval misses 0 in about 5 %; over 11 % is all but impossible."""
    random = np.random.default_rng(1)
    missed = 0
    for _ in range(200):
        low, high = interval(lambda drawn: np.mean(drawn[0]), [random.normal(size=40)], resamples=200)
        missed += not low <= 0 <= high
    assert 0 < missed < 22


def test_scores_are_between_a_random_policy_and_a_good_one(tmp_path):
    low, high = BOUNDS["pendulum"]
    runs = [
        a_run(tmp_path / "a", [flat(0.0, low), flat(0.0, high)], task="pendulum-v"),
        a_run(tmp_path / "b", [flat(50.0), flat(100.0)], task="gym:Robot-v0"),
    ]
    first, second = scores(groups(runs))["vrm"]
    np.testing.assert_allclose(first, [0.0, 1.0])
    np.testing.assert_allclose(second, [50 / 75, 100 / 75])


@pytest.mark.parametrize(("diverged", "expected"), [([1], [1.0, 0.0]), ([0, 1], [0.0, 0.0])])
def test_a_seed_that_diverged_scores_0_whatever_it_had_before(tmp_path, diverged, expected):
    run = a_run(tmp_path / "a", [flat(-150.0), flat(-150.0)], task="pendulum", diverged=diverged)
    np.testing.assert_allclose(scores(groups([run]))["vrm"], [expected])


def test_a_task_on_which_all_seeds_diverged_at_once_still_counts(tmp_path):
    runs = [
        a_run(tmp_path / "a", [flat(-150.0)], task="pendulum"),
        a_run(tmp_path / "b", [[]], task="pendulum", agent="slac", diverged=[0]),
    ]
    table = scores(groups(runs))
    np.testing.assert_allclose(table["vrm"], [[1.0]])
    np.testing.assert_allclose(table["slac"], [[0.0]])


def test_bounds_are_of_a_task_its_masked_versions_and_its_faults_but_not_of_other_constants():
    for name in ("pendulum", "pendulum-v", "pendulum-p", "pendulum-v noise=0.1", "pendulum steps_per_action=2"):
        assert known_bounds(name) == BOUNDS["pendulum"]
    for name in ("pendulum max_steps=400", "cartpole max_theta=0.1"):
        assert known_bounds(name) is None
    assert known_bounds("cartpole-swing-up") is None


def test_only_tasks_that_all_agents_have_count(tmp_path):
    runs = [
        a_run(tmp_path / "a", [flat(-150.0)], task="pendulum"),
        a_run(tmp_path / "b", [flat(1000.0)], task="cartpole"),
        a_run(tmp_path / "c", [flat(500.0)], agent="slac", task="cartpole"),
    ]
    assert {label: len(tasks) for label, tasks in scores(groups(runs)).items()} == {"vrm": 1, "slac": 1}
    with pytest.raises(UserError, match="no task on which all of these agents have an evaluation at the same step"):
        scores(groups([runs[0], runs[2]]))


def test_agents_are_compared_at_the_last_step_that_all_of_them_have(tmp_path):
    runs = [
        a_run(tmp_path / "a", [flat(-900.0, -150.0, -900.0)], task="pendulum"),
        a_run(tmp_path / "b", [flat(-900.0, -150.0)], task="pendulum", agent="slac"),
    ]
    table = scores(groups(runs))
    np.testing.assert_allclose([table["vrm"][0], table["slac"][0]], 1.0)


def test_what_the_scores_leave_out_is_named(tmp_path):
    runs = [
        a_run(tmp_path / "a", [flat(-150.0)], task="pendulum"),
        a_run(tmp_path / "b", [flat(1000.0)], task="cartpole"),
        a_run(tmp_path / "c", [flat(500.0), flat(400.0)], agent="slac", task="cartpole"),
    ]
    assert notes(groups(runs)) == [
        "left out: pendulum: not all agents have an evaluation at the same step there",
    ]
    assert notes(groups(runs[:2])) == []
    runs.append(a_run(tmp_path / "d", [flat(-150.0, -140.0)], agent="slac", task="pendulum"))
    assert notes(groups(runs)) == [
        "pendulum is compared at step 10, the last that all agents have; one has 20",
        "an agent with more seeds on one task than on another counts that task more",
    ]


def test_a_curve_that_ends_early_names_the_run_that_ends_it(tmp_path):
    long, short = (
        a_run(tmp_path / name, [flat(*returns)], first=first)
        for first, (name, returns) in enumerate({"long": (1.0, 2.0, 3.0), "short": (1.0,)}.items())
    )
    (sentence,) = left_out([long, short], groups([long, short]))
    ends = f"{short.folder}, seed 1, ends at 10, and another seed at 30"
    assert sentence == f"vrm on pendulum-v ends at step 10, the last that all of its seeds have: {ends}"
    assert left_out([long], groups([long])) == []


def test_runs_that_end_at_a_return_are_a_group_of_their_own(tmp_path):
    whole, until = a_run(tmp_path / "a", [flat(1.0)]), a_run(tmp_path / "b", [flat(1.0)], first=1)
    config = until.config | {"options": until.config["options"] | {"stop_at": 0.5}}
    (until.folder / "config.json").write_text(json.dumps(config))
    assert [group.label for group in groups([whole, Run(until.folder)])] == ["vrm", "vrm stop_at=0.5"]


def test_the_picture_is_made_of_one_seed_too(tmp_path):
    runs = [a_run(tmp_path / "a", [flat(-150.0)], task="pendulum")]
    assert draw_aggregate(groups(runs), tmp_path / "picture").stat().st_size > 10_000
    assert (tmp_path / "picture.pdf").read_bytes().startswith(b"%PDF")


def test_a_diverged_seed_scores_lowest_where_all_returns_are_negative(tmp_path):
    """The task has no known bounds, so its scores come from the returns of these runs."""
    name = "gym:Own-v0"
    good = a_run(tmp_path / "a", [flat(-160.0), flat(-170.0)], task=name)
    bad = a_run(tmp_path / "b", [flat(-300.0), flat(-1.0)], task=name, agent="slac", diverged=[1])
    (ours,), (theirs,) = scores(groups([good, bad])).values()
    assert ours[0] > ours[1] > theirs[0] == theirs[1] == 0.0
    assert ours.mean() == pytest.approx(1.0)


def test_a_seed_that_stopped_at_its_return_keeps_its_last_value(tmp_path):
    rows = [flat(-900.0, -200.0), flat(-900.0, -800.0, -700.0, -100.0)]
    options = {"stop_at": -250.0, "stop_patience": 1}
    runs = [a_run(tmp_path / str(n), [each], first=n, steps=100) for n, each in enumerate(rows)]
    for run in runs:
        config = json.loads((run.folder / "config.json").read_text())
        config["options"] |= options
        (run.folder / "config.json").write_text(json.dumps(config))
    (group,) = groups(find([tmp_path]).runs)
    np.testing.assert_array_equal(group.final(), [-200.0, -100.0])
    np.testing.assert_array_equal(group.curve().seeds[0], [-900, -200, -200, -200])


def test_a_measure_that_is_nan_in_an_episode_does_not_count_there(tmp_path):
    run = a_run(tmp_path / "a", [flat(1.0)])
    log = next((run.folder / "metrics").iterdir())
    row = {"step": 20, "kind": "evaluation", "sampled": [1.0, 2.0], "mode": [1.0, 2.0], "sampled_time": [3.0, math.nan]}
    log.write_text(json.dumps(row) + "\n")
    (group,) = groups([run])
    assert group.final("sampled_time") == 3.0


def test_seeds_without_a_common_evaluation_are_named(tmp_path):
    one = a_run(tmp_path / "one", [flat(1.0, 2.0)])
    other = a_run(tmp_path / "other", [[(11, [1.0]), (21, [2.0])]], first=1)
    assert left_out([one, other], groups([one, other])) == [
        "left out: vrm on pendulum-v: its seeds have no evaluation at the same step"
    ]


def test_runs_are_found_through_links_and_a_link_in_a_circle_ends(tmp_path):
    a_run(tmp_path / "there" / "one", [flat(1.0)])
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "first").symlink_to(tmp_path / "there" / "one")
    (tmp_path / "links" / "circle").symlink_to(tmp_path / "links")
    assert len(find([tmp_path / "links"]).runs) == 1


def test_of_two_runs_of_a_seed_the_latest_counts_until_an_earlier_step_too(tmp_path):
    made = [
        a_run(tmp_path / name, [flat(value, value)], started=f"2026-01-0{day}T00:00:00+00:00")
        for name, value, day in (("z", 1.0, 1), ("a", 2.0, 2))
    ]
    (group,) = groups([cut(run, 10) for run in made])
    assert group.final().tolist() == [2.0]
