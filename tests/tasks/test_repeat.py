"""Action repeat: what a step of the agent is, when it ends, and what a run records."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import GymnasiumTask, TaskEnvironment, cli, evaluate, play, task_of, train, with_action_repeat
from beliefrl.errors import UserError
from beliefrl.runs.run import Run
from beliefrl.tasks import describe, entry_names, full, make, observe, steps_per_action, with_faults
from beliefrl.tasks.faults import Faults
from beliefrl.viewing.episodes import pace_of, playable
from worlds import Counter, Counting, saved, tiny

KEY, ZERO = jax.random.key(3), np.zeros(1)


def steps(kind, count, **limits):
    """(observation, reward, terminated, truncated) of steps in a task that counts, with an action repeat of 3."""
    if kind == "compiled":
        task = with_action_repeat(Counting(**limits), 3)
        environment = TaskEnvironment(task)
    else:
        ends, limit = limits.get("ends", 1000), limits.get("max_steps")
        task = GymnasiumTask(Counter, arguments={"ends": ends}, max_steps=limit, steps_per_action=3)
        environment = task.environment()
    environment.reset(seed=0)
    rows = [environment.step(ZERO)[:4] for _ in range(count)]
    return [(float(obs[0]), reward, terminated, truncated) for obs, reward, terminated, truncated in rows]


both = pytest.mark.parametrize("kind", ["compiled", "host"])


@both
def test_a_step_has_the_last_observation_and_the_sum_of_the_rewards(kind):
    assert steps(kind, 2, max_steps=100) == [(3.0, 6.0, False, False), (6.0, 15.0, False, False)]


@both
def test_nothing_happens_after_the_end_of_an_episode(kind):
    assert steps(kind, 2, ends=5)[1] == (5.0, 9.0, True, False)


def test_an_episode_of_an_environment_has_as_many_steps_as_without():
    assert steps("host", 3, max_steps=7)[2] == (7.0, 7.0, False, True)


@both
def test_the_time_limit_is_counted_in_actions(kind):
    task = Counting(max_steps=7) if kind == "compiled" else GymnasiumTask(Counter, max_steps=7)
    assert [with_action_repeat(task, times).spec.max_steps for times in (1, 3, 7, 8)] == [7, 3, 1, 1]


@dataclasses.dataclass(frozen=True)
class Random(Counting):
    """Pays a random number."""

    def step(self, state, action, key):
        state, obs, _, terminated = super().step(state, action, key)
        return state, obs, jax.random.uniform(key), terminated


def test_each_step_of_the_task_has_its_own_randomness():
    task = with_action_repeat(Random(), 2)
    reward = task.step(jnp.array(0), jnp.zeros(1), KEY)[2]
    one, two = (jax.random.uniform(key) for key in jax.random.split(KEY))
    np.testing.assert_allclose(reward, one + two, rtol=1e-6)


class Falling(Counter):
    """Fails at its fifth step."""

    def step(self, action):
        if self.steps == 4:
            raise RuntimeError("fell")
        return super().step(action)


def test_a_message_counts_actions():
    environment = GymnasiumTask(Falling, max_steps=9, steps_per_action=3).environment()
    environment.reset(seed=0)
    environment.step(ZERO)
    with pytest.raises(UserError, match=r"Falling \(step 2\): step raised"):
        environment.step(ZERO)


class Flagged(Counting):
    """Pays True."""

    def step(self, state, action, key):
        state, obs, _, terminated = super().step(state, action, key)
        return state, obs, jnp.array(True), terminated


def test_rewards_are_summed_as_numbers():
    assert with_action_repeat(Flagged(), 3).step(jnp.array(0), jnp.zeros(1), KEY)[2] == 3.0


NAMES = ["pendulum", "pendulum-v", "gym:Pendulum-v1"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("faults", [None, Faults(noise=0.1)])
def test_it_is_one_of_the_constants_of_a_task(name, faults):
    task = make(name, faults=faults, steps_per_action=2)
    found = describe(task)
    assert found == describe(with_action_repeat(make(name, faults=faults), 2))
    assert found["constants"]["steps_per_action"] == steps_per_action(task) == 2
    again = make(found["task"], found["observe"], found.get("faults"), **found["constants"])
    assert (describe(again), again.spec) == (found, task.spec)
    assert "steps_per_action" not in describe(with_action_repeat(task, 1))["constants"]


@pytest.mark.parametrize("name", NAMES)
def test_it_is_replaced_not_multiplied(name):
    twice = make(name, steps_per_action=2)
    for times in (1, 3):
        assert describe(with_action_repeat(twice, times)) == describe(make(name, steps_per_action=times))


def test_entries_can_be_selected_and_have_their_names():
    task = observe(make("pendulum", steps_per_action=2), (2, 0))
    assert task == make("pendulum", [2, 0], steps_per_action=2)
    assert entry_names(task) == entry_names(make("pendulum", [2, 0]))
    assert steps_per_action(full(task)) == 2


def test_faults_apply_to_the_steps_of_the_agent():
    environment = TaskEnvironment(with_action_repeat(with_faults(Counting(), Faults(delay=1)), 3))
    environment.reset(seed=0)
    assert [float(environment.step(ZERO)[0][0]) for _ in range(2)] == [0.0, 3.0]


def test_measures_are_those_of_the_last_state():
    environment = TaskEnvironment(with_action_repeat(Counting(max_steps=100), 3))
    environment.reset(seed=0)
    assert [environment.step(ZERO)[-1]["is_success"] for _ in range(2)] == [False, True]


@pytest.mark.parametrize("task", [make("pendulum"), GymnasiumTask(Counter, max_steps=9)], ids=["compiled", "host"])
def test_a_video_of_it_has_fewer_steps_per_second(task):
    once, twice = (pace_of(playable(with_action_repeat(task, times), rendered=True)) for times in (1, 2))
    assert twice == once / 2


def test_a_task_with_it_can_be_drawn():
    true, repeated = (TaskEnvironment(make("pendulum", steps_per_action=times), "rgb_array") for times in (1, 2))
    for environment, count in ((true, 3), (repeated, 2)):
        environment.reset(seed=0)
        for _ in range(count - 1):
            environment.step(ZERO)
    np.testing.assert_allclose(true.states[2], repeated.states[1], rtol=1e-6)
    assert repeated.render().shape == true.render().shape


@both
def test_a_run_is_evaluated_and_played_with_it(kind, tmp_path):
    name = "pendulum-v" if kind == "compiled" else "gym:Pendulum-v1"
    run = saved(tmp_path / "run", "sac-mlp", make(name, steps_per_action=50))
    assert steps_per_action(task_of(run)) == 50
    played = play(run)
    assert len(played.steps.reward) == 1 + 200 // 50
    assert evaluate(run, episodes=1, progress=False)["mode"]["mean"] < -50  # the sum over 200 steps


def test_a_task_of_ones_own_must_have_the_same(tmp_path):
    task = GymnasiumTask(Counter, max_steps=9, steps_per_action=2)
    run = saved(tmp_path / "run", "sac-mlp", task)
    assert len(play(run, task=task).steps.reward) == 6
    with pytest.raises(UserError, match=r"was trained with steps_per_action=2, and the given task has 1"):
        play(run, task=Counter)


def test_the_command_line_makes_and_shows_it(tmp_path, monkeypatch, capsys):
    given = []
    monkeypatch.setattr("beliefrl.training.train.train", lambda *args, **options: given.append(args[1]))
    cli.main(["train", "sac-mlp", "pendulum", "--constants", "steps_per_action=2", "mass=2.0"])
    assert given == [make("pendulum", steps_per_action=2, mass=2.0)]
    run = saved(tmp_path / "run", "sac-mlp", given[0])
    cli.main(["show", str(run.folder)])
    assert "steps_per_action=2" in capsys.readouterr().out


def test_a_run_does_not_go_on_with_another(tmp_path):
    run = saved(tmp_path / "run", "sac-mlp", make("pendulum"))
    with pytest.raises(UserError, match=r"was trained with constants=.*, not .*: choose another --out"):
        train(tiny("sac-mlp"), make("pendulum", steps_per_action=2), run.folder, resume=True, steps=100, seed=4)
    assert "steps_per_action" not in Run(run.folder).config["constants"]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("times", [0, -1, 1.5, "two", True, 10_001])
@pytest.mark.parametrize("name", ["pendulum-v", "gym:Pendulum-v1"])
def test_an_impossible_number_is_a_sentence(name, times):
    with pytest.raises(UserError, match=r"steps_per_action=.* is impossible: it must be a whole number"):
        make(name, steps_per_action=times)


@pytest.mark.parametrize("task", [Counting, "pendulum", None])
def test_only_a_task_can_have_it(task):
    with pytest.raises(UserError, match="give a task"):
        with_action_repeat(task, 2)


def test_an_environment_by_name_does_not_take_it():
    with pytest.raises(UserError, match="steps_per_action cannot be given here"):
        TaskEnvironment("pendulum", steps_per_action=2)
