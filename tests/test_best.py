"""The best agent of each seed: with best=True it acts everywhere, and with init_best a training starts from it."""

import jax
import numpy as np
import pytest

from beliefrl import evaluate, load, play, tasks, video
from beliefrl.errors import UserError
from beliefrl.runs import arrays, best
from beliefrl.runs.options import Options
from beliefrl.training import initial
from worlds import saved, tiny

TASK = tasks.make("pendulum-p", max_steps=5)
AGENT = tiny("sac-mlp")
LATE, EARLY = AGENT.step_start_rl + 1, AGENT.step_start_rl


@pytest.fixture
def run(tmp_path):
    """A run of the seeds 4 and 5 with other agents in best.safetensors: seed 4 before its pre-training, 5 after it."""
    made = saved(tmp_path / "run", "sac-mlp", TASK, seeds=2)
    first, second = (
        jax.vmap(lambda key: AGENT.init(key, TASK.spec))(jax.random.split(jax.random.key(key), 2)) for key in (1, 2)
    )
    best.save(made.folder, AGENT.networks(first), EARLY, [-3.0, -7.0])
    best.save(made.folder, AGENT.networks(second), LATE, [-4.0, -2.0])
    return made


@pytest.fixture
def only_best(run, tmp_path):
    """A run that has saved the same agents at its last evaluation."""
    made = saved(tmp_path / "other", "sac-mlp", TASK, seeds=2)
    (made.folder / "agent.safetensors").write_bytes(run.agents(best=True).read_bytes())
    return made


@pytest.mark.parametrize(
    "acts",
    [
        lambda run, **best: load(run, seed=5, **best).predict([0.1, 0.2])[0],
        lambda run, **best: play(run, seed=5, **best).total,
        lambda run, **best: evaluate(run, 2, progress=False, **best)["mode"]["returns"],
        lambda run, **best: video(run, run.folder / "film.gif", seed=5, **best)[0].total,
    ],
    ids=["load", "play", "evaluate", "video"],
)
def test_the_best_agent_acts_if_it_is_asked_for(run, only_best, acts):
    wanted = acts(only_best)
    np.testing.assert_array_equal(acts(run, best=True), wanted)
    assert not np.array_equal(acts(run), wanted)


def test_a_training_starts_from_the_best_agent_of_its_seed(run):
    networks, origin = initial.taken(run, Options(init_from=run.shown, init_best=True, seed=5), AGENT, TASK.spec)
    there, last = arrays.load(run.agents(best=True)), arrays.load(run.agents())
    for name, array in networks.items():
        np.testing.assert_array_equal(array, there[name][[1]])
    assert any(not np.array_equal(array, last[name][[1]]) for name, array in networks.items())
    assert origin["best"]
    assert origin["seeds"] == {5: {"seed": 5, "step": LATE, "return": -2.0}}


def test_a_best_agent_from_before_the_pretraining_is_refused(run):
    with pytest.raises(UserError, match=rf"its agent was saved at step {EARLY:,}, before the pre-training"):
        initial.taken(run, Options(init_from=run.shown, init_best=True, seed=4), AGENT, TASK.spec)
    initial.taken(run, Options(seed=4), AGENT, TASK.spec)
