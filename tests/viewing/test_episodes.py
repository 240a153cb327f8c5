"""An episode of a trained agent: the recorded time steps, the agent's actions, the requested frames."""

import jax
import numpy as np
import pytest

import beliefrl
from beliefrl import tasks
from beliefrl.policy import Policy
from beliefrl.tasks.drawing import paint
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.types import UserError
from beliefrl.viewing.episodes import Player
from worlds import Counter, Counting, CountingAgent, begun, saved, tiny

TASK = tasks.make("pendulum-p", max_steps=6)


def player(task=TASK, name="sac-lstm", rendered=False):
    return Player(tiny(name), task, begun(name, task.spec, jax.random.key(0)), rendered=rendered)


@pytest.mark.parametrize(("ends", "last"), [(1000, 7), (4, 4)])
def test_every_timestep_is_where_it_belongs(ends, last):
    agent, task = CountingAgent(), Counting(ends)
    steps, total, measures, frames = Player(agent, task, agent.init(jax.random.key(0), task.spec)).play()
    assert steps.obs.ravel().tolist() == list(range(last + 1))
    assert steps.reward.tolist() == list(range(last + 1))  # what came with the count
    assert steps.prev_action.ravel().tolist() == [0.0] + [0.5] * last
    assert steps.is_first.tolist() == [True] + [False] * last
    assert steps.terminated.tolist() == [False] * last + [ends == 4]
    assert total == sum(range(last + 1))
    assert measures == {"success": float(last >= 5)}
    assert frames == {}


@pytest.mark.parametrize("name", ["sac-lstm", "sac-mlp"])
def test_mode_actions_are_those_of_the_policy(name):
    playing = player(name=name)
    steps = playing.play(3).steps
    policy, memory = Policy(playing.agent, TASK.spec, playing._state), None
    for t in range(6):
        action, memory = policy.predict(steps.obs[t], steps.reward[t], memory)
        np.testing.assert_allclose(steps.prev_action[t + 1], action, rtol=1e-5, atol=1e-6)


def test_a_seed_is_an_episode():
    with player() as playing:
        mode, again, other = (playing.play(seed) for seed in (3, 3, 4))
        sample, sample_again = (playing.play(3, sampled=True) for _ in range(2))
    for one, two in ((mode, again), (sample, sample_again)):
        jax.tree.map(np.testing.assert_array_equal, one, two)
    assert not np.allclose(mode.steps.obs, other.steps.obs)
    np.testing.assert_array_equal(mode.steps.obs[0], sample.steps.obs[0])
    assert not np.allclose(mode.steps.prev_action, sample.steps.prev_action)


def test_frames_are_of_the_timesteps_asked_for_and_the_last():
    with player(rendered=True) as playing:
        frames = playing.play(0, at={0, 2}).frames
        assert list(frames) == [0, 2, 6]
        np.testing.assert_array_equal(frames[6], paint(playing.environment._picture()))
        assert not np.array_equal(frames[0], frames[6])
        watched = []
        kept = playing.play(0, steps=3, at=range(0, 100, 2), watch=watched.append)
    assert [frame.time for frame in watched] == [0, 2, 3]
    np.testing.assert_array_equal(watched[1].pixels, frames[2])
    assert watched[2].total == pytest.approx(kept.total)
    assert kept.frames == {}


def test_a_gymnasium_environment_is_played_and_seen_in_the_same_way():
    with player(GymnasiumTask(Counter, arguments={"ends": 4}), "sac-mlp", rendered=True) as playing:
        steps, total, measures, frames = playing.play(at=range(100))
    assert steps.obs[:, 1].tolist() == [0, 1, 2, 3, 4]
    assert steps.terminated.tolist() == [False] * 4 + [True]
    assert total == 10
    assert measures == {}
    assert {time: frame[0, 0, 0] for time, frame in frames.items()} == {0: 0, 1: 10, 2: 20, 3: 30, 4: 40}


class Blind(Counter):
    def __init__(self, ends=9):
        super().__init__(None, ends)


class Broken(Counter):
    def render(self):
        raise RuntimeError("no screen")


class Grey(Counter):
    def render(self):
        return np.zeros((20, 30))


@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        (GymnasiumTask(Blind), r"Blind cannot be rendered: give it a render_mode='rgb_array' \(.*TypeError"),
        (GymnasiumTask(Broken), "Broken cannot be rendered here: RuntimeError: no screen"),
        (GymnasiumTask(Grey), r"Grey renders float64 of shape \(20, 30\), but rgb_array must be uint8"),
        (Counting(), "Counting cannot be rendered: give it a method draw"),
    ],
)
def test_what_cannot_be_played_is_an_error_in_one_sentence(task, sentence):
    with pytest.raises(UserError, match=sentence), player(task, "sac-mlp", rendered=True) as playing:
        playing.play(at=(0,))


def test_a_runs_seed_is_played_by_its_number(tmp_path):
    run = saved(tmp_path / "run", "sac-mlp", TASK, seeds=2)
    first, same, second = (beliefrl.play(run, seed) for seed in (None, 4, 5))
    np.testing.assert_array_equal(first.steps.prev_action, same.steps.prev_action)
    assert not np.allclose(first.steps.prev_action, second.steps.prev_action)
    with pytest.raises(UserError, match="has no seed 6: it has 4, 5"):
        beliefrl.play(run, 6)
