"""Summaries of evaluations, against NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl.training.evaluation import evaluate, summary
from beliefrl.training.rollout import Episode
from beliefrl.types import UserError

TOTAL = np.array([[[1.0, 2.0], [10.0, 30.0]], [[3.0, 6.0], [-10.0, -30.0]], [[0.0, 3.0], [0.0, 6.0]]], np.float32)
SUCCESS = np.array([[[1, 0], [1, 1]], [[0, 0], [0, 1]], [[1, 1], [0, 0]]], bool)  # (seed, mode, episodes)


def episode(total, success):
    return Episode(jnp.ones(total.shape, bool), jnp.array(total), jnp.ones(total.shape, int), jnp.array(success))


def test_means_and_standard_errors_are_over_seeds():
    table = summary(episode(TOTAL, SUCCESS), has_success=True)
    assert list(table) == ["sampled", "mode"]
    for mode, seeds in {"sampled": [1.5, 4.5, 1.5], "mode": [20.0, -20.0, 3.0]}.items():
        assert table[mode]["seeds"] == seeds
        assert table[mode]["mean"] == pytest.approx(np.mean(seeds))
        assert table[mode]["sem"] == pytest.approx(np.std(seeds, ddof=1) / np.sqrt(3))


def test_success_is_a_rate():
    table = summary(episode(TOTAL, SUCCESS), has_success=True)
    assert table["sampled"]["seeds_success"] == [0.5, 0.0, 1.0]
    assert table["sampled"]["success"] == 0.5
    assert table["mode"]["seeds_success"] == [1.0, 0.5, 0.0]


def test_one_seed_has_no_standard_error():
    table = summary(episode(TOTAL[:1], SUCCESS[:1]), has_success=True)
    assert table["sampled"]["sem"] is None
    assert table["sampled"]["mean"] == 1.5


def test_a_task_without_success_reports_none():
    table = summary(episode(TOTAL, SUCCESS), has_success=False)
    assert table["mode"]["success"] is None
    assert table["mode"]["seeds_success"] is None


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"episodes": 10**9}, {"seed": -1}, {"seed": 10**20}])
def test_impossible_numbers_are_refused_by_name(wrong):
    with pytest.raises(UserError, match=next(iter(wrong))):
        evaluate("nowhere", **wrong)
