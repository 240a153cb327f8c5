"""Aggregates over tasks, against their definitions (Agarwal et al. 2021)."""

import numpy as np
import pytest

from beliefrl.analysis.aggregate import BOUNDS, draw_aggregate, interquartile_mean, interval, profile, scores
from beliefrl.analysis.groups import groups
from beliefrl.types import UserError
from written import a_run, flat


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


def test_only_tasks_that_all_agents_have_count(tmp_path):
    runs = [
        a_run(tmp_path / "a", [flat(-150.0)], task="pendulum"),
        a_run(tmp_path / "b", [flat(1000.0)], task="cartpole"),
        a_run(tmp_path / "c", [flat(500.0)], agent="slac", task="cartpole"),
    ]
    assert {label: len(tasks) for label, tasks in scores(groups(runs)).items()} == {"vrm": 1, "slac": 1}
    with pytest.raises(UserError, match="no task that all of these agents have"):
        scores(groups([runs[0], runs[2]]))


def test_the_picture_is_made_of_one_seed_too(tmp_path):
    runs = [a_run(tmp_path / "a", [flat(-150.0)], task="pendulum")]
    assert draw_aggregate(groups(runs), tmp_path / "picture").stat().st_size > 10_000
    assert (tmp_path / "picture.pdf").read_bytes().startswith(b"%PDF")
