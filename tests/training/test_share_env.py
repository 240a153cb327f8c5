"""Evaluations in the environment of the training, because there is no other."""

from functools import partial

import jax
import numpy as np
import pytest

from beliefrl import UserError, evaluate, resume, train
from beliefrl.runs.checkpoint import listed
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.host_evaluation import Evaluation
from beliefrl.training.lockstep import Lockstep
from worlds import tiny
from wrong import Fine

AGENT = tiny("sac-mlp", step_start_rl=20, batch_size=8, pretrain_updates=5)


class Paying(Fine):
    """The reward is the action."""

    def reward(self):
        return float(self.action[0])


class Only(Paying):
    """There is one robot: a second environment cannot be made before the first is closed."""

    is_taken, is_stuck = False, False

    def __init__(self):
        if Only.is_taken:
            raise RuntimeError("the robot is taken")
        Only.is_taken = True
        super().__init__()

    def reset(self, *, seed=None, options=None):
        if Only.is_stuck:
            raise RuntimeError("the robot is stuck")
        return super().reset(seed=seed, options=options)

    def close(self):
        Only.is_taken = False


@pytest.fixture(autouse=True)
def free():
    Only.is_taken = Only.is_stuck = False


def test_the_returns_are_those_of_other_environments():
    task, seeds = GymnasiumTask(Paying), [3, 4]
    make = partial(Lockstep, task)
    keys = jax.random.split(jax.random.key(1), 2)
    states = jax.vmap(lambda key: AGENT.init(key, task.spec))(keys)
    own = Evaluation(AGENT, task, seeds, make)
    there = own.play(states, keys, 3)
    own.close()
    lanes, counts = make(["a", "b"]), []
    here = Evaluation(AGENT, task, seeds, make, lanes).play(states, keys, 3, counts.append)
    lanes.close()
    assert there.episode_return.shape == here.episode_return.shape == (2, 2, 3)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), here, there)
    assert len(np.unique(here.episode_return.round(3))) == 12
    assert counts == [2, 4, 6, 8, 10, 12]


@pytest.mark.slow
def test_one_environment_is_enough_and_an_evaluation_ends_its_episode(tmp_path):
    options = {"steps": 50, "eval_every": 25, "eval_episodes": 2, "progress": False}
    run = train(AGENT, Only, tmp_path / "run", share_env=True, **options)
    assert not Only.is_taken
    assert [row["step"] for row in run.rows(0, "evaluation")] == [25, 50]
    ends = [row for row in run.rows(0, "episode") if row["length"] == 10]
    assert len(ends) == len(list(run.rows(0, "episode"))) == 4  # at 10, 20, 35 and 45 steps
    assert evaluate(run, 2, task=Only)["episodes"] == 2
    assert not Only.is_taken
    with pytest.raises(UserError, match="the robot is taken"):
        train(AGENT, Only, tmp_path / "other", **options)


@pytest.mark.slow
def test_if_the_reset_after_an_evaluation_fails_what_was_learned_is_kept(tmp_path):
    def stick(event):
        Only.is_stuck = Only.is_stuck or event.evaluation is not None

    options = {"steps": 50, "eval_every": 25, "eval_episodes": 2, "progress": False, "share_env": True}
    with pytest.raises(UserError, match="the robot is stuck"):
        train(AGENT, Only, tmp_path / "run", stick, **options)
    assert listed(tmp_path / "run")[-1].name.endswith("-step-25")
    Only.is_stuck = False
    run = resume(tmp_path / "run", task=Only, progress=False)
    assert [row["step"] for row in run.rows(0, "evaluation")] == [25, 50]
