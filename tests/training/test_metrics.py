"""Which metrics end a seed, and that no two share a name."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import pytest

import beliefrl
from beliefrl.training import phases
from beliefrl.types import UserError
from worlds import Counting, CountingAgent


class Undefined(CountingAgent):
    """Returns a metric that is NaN."""

    def update(self, state, batch, key):
        return state, {"ratio": jnp.array(jnp.nan), "count": jnp.ones(())}


class Diverging(Undefined):
    losses: ClassVar = ("ratio",)


OPTIONS = {"steps": 14, "seeds": 1, "eval_every": 14, "eval_episodes": 1}


def test_a_metric_that_is_no_loss_may_be_undefined_and_a_loss_may_not(tmp_path):
    run = beliefrl.train(Undefined(), Counting(), tmp_path / "undefined", **OPTIONS)
    (row,) = run.rows(0, "update")
    assert row["count"] == 1
    assert "ratio" not in row
    with pytest.raises(UserError, match=r"All seeds have diverged; .*ratio is not finite"):
        beliefrl.train(Diverging(), Counting(), tmp_path / "diverging", **OPTIONS)


class Twice(CountingAgent):
    def begin_cycle(self, state, windows, key):
        state, batches, _ = super().begin_cycle(state, windows, key)
        return state, batches, {"valid": jnp.zeros(())}


def test_two_metrics_of_one_name_are_refused():
    agent = Twice()
    seed = phases.begin(agent, Counting(), 100, jax.random.key(0))
    with pytest.raises(UserError, match="both return a metric 'valid'"):
        jax.eval_shape(lambda seed: phases.learn_cycle(agent, seed, jnp.array(10)), seed)
