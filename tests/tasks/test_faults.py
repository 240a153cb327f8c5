"""Missing and faulty sensors: what the agent sees, what is applied, and what a run records."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import TaskEnvironment, cli, evaluate, load, play, task_of, tasks, train
from beliefrl.errors import UserError
from beliefrl.runs.run import Run
from beliefrl.tasks import make, observe, with_faults
from beliefrl.tasks.faults import Faults
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.seen_environment import Environment
from beliefrl.types import Spec
from worlds import Counter, Counting, saved, tiny

KEY = jax.random.key(3)
STEPS = 4000


@dataclasses.dataclass(frozen=True)
class Echo:
    """Observes 5 and the action that was applied last, which it also pays."""

    spec = Spec(obs_dim=2, action_dim=1, max_steps=9)

    def reset(self, key):
        return jnp.zeros(()), jnp.array([5.0, 0.0])

    def step(self, state, action, key):
        return action[0], jnp.stack([jnp.array(5.0), action[0]]), action[0], jnp.array(False)


class HostEcho(Counter):
    """The same as a Gymnasium environment."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([5.0, 0.0], np.float32), {}

    def step(self, action):
        return np.array([5.0, action[0] / 2], np.float32), float(action[0] / 2), False, False, {}


@partial(jax.jit, static_argnums=0)
def compiled_episode(task, key, actions):
    """Observations (time + 1, obs) and rewards (time,)."""
    key_reset, key_steps = jax.random.split(key)
    state, first = task.reset(key_reset)

    def step(state, inputs):
        state, obs, reward, _ = task.step(state, *inputs)
        return state, (obs, reward)

    obs, reward = jax.lax.scan(step, state, (actions, jax.random.split(key_steps, len(actions))))[1]
    return jnp.concatenate([first[None], obs]), reward


def episode(kind, faults, actions):
    """The same of Echo with faults, in JAX or on the host."""
    if kind == "compiled":
        return [np.asarray(part) for part in compiled_episode(with_faults(Echo(), faults), KEY, actions)]
    environment = GymnasiumTask(HostEcho, max_steps=STEPS + 1, faults=faults).environment()
    first, _ = environment.reset(seed=3)
    steps = [environment.step(action)[:2] for action in np.asarray(actions)]
    return [np.stack([first, *(obs for obs, _ in steps)]), np.array([reward for _, reward in steps])]


ACTIONS = jnp.linspace(-1, 1, STEPS)[:, None]
both = pytest.mark.parametrize("kind", ["compiled", "host"])


@both
def test_noise_and_losses_are_as_frequent_and_as_large_as_asked_for(kind):
    faults = Faults(noise=(0.5, 0.0), flicker=0.3, flicker_flag=True, dropout=0.2)
    obs, reward = episode(kind, faults, ACTIONS)
    lost = obs[:, 2] == 1
    assert abs(lost.mean() - 0.3) < 0.03
    assert abs((lost[1:] & lost[:-1]).mean() - 0.09) < 0.02  # independent at each step
    assert not obs[lost].any(axis=0)[:2].any()
    kept = obs[~lost]
    assert not kept[:, 2].any()
    dropped = kept[:, :2] == 0
    np.testing.assert_allclose(dropped.mean(axis=0), 0.2, atol=0.03)
    assert abs(dropped.all(axis=1).mean() - 0.04) < 0.015  # each entry by itself
    measured = kept[~dropped[:, 0], 0]
    assert abs(measured.mean() - 5) < 0.04
    assert abs(measured.std() - 0.5) < 0.03
    exact = obs[1:, 1] != 0
    np.testing.assert_allclose(obs[1:, 1][exact], ACTIONS[exact, 0], atol=1e-6)
    np.testing.assert_allclose(reward, ACTIONS[:, 0], atol=1e-6)  # rewards are true


@both
def test_a_delay_repeats_the_first_observation(kind):
    obs, reward = episode(kind, Faults(delay=3), ACTIONS[:9])
    seen = [0.0, 0.0, 0.0, 0.0, *np.asarray(ACTIONS[:6, 0])]
    np.testing.assert_allclose(obs[:, 1], seen, atol=1e-6)
    np.testing.assert_allclose(reward, ACTIONS[:9, 0], atol=1e-6)


@both
def test_a_sticky_action_is_the_one_that_was_applied_before(kind):
    _, applied = episode(kind, Faults(sticky=0.25), ACTIONS)
    before = np.concatenate([[0.0], applied[:-1]])
    repeats = np.abs(applied - before) < 1e-6
    assert abs(repeats.mean() - 0.25) < 0.03
    np.testing.assert_allclose(applied[~repeats], ACTIONS[~repeats, 0], atol=1e-6)


def test_without_faults_it_is_the_same_task():
    for task in (make("pendulum-v"), GymnasiumTask(Counter)):
        assert with_faults(task, Faults(noise=(0.0, 0.0))) is task
    assert make("pendulum-v", faults=Faults()) == make("pendulum-v", faults={"delay": 0}) == make("pendulum-v")
    assert "faults" not in tasks.describe(make("pendulum-v"))
    assert type(make("gym:Pendulum-v1").environment()) is Environment


class Whole(Echo):
    """Observes integers."""

    def reset(self, key):
        return jnp.zeros(()), jnp.array([5, 0])

    def step(self, state, action, key):
        return action[0], jnp.array([5, 1]), action[0], jnp.array(False)


def test_integers_are_observed_with_the_noise_that_was_asked_for(unchecked):
    obs, _ = compiled_episode(with_faults(Whole(), Faults(noise=(0.5, 0.0), flicker_flag=True)), KEY, ACTIONS)
    assert abs(obs[:, 0].std() - 0.5) < 0.03
    assert (obs[1:, 1] == 1).all()
    assert (obs[:, 2] == 0).all()
    for task in (Whole(), with_faults(Whole(), Faults(noise=0.5))):
        environment = TaskEnvironment(task)
        assert environment.observation_space.contains(environment.reset(seed=0)[0])
        assert environment.observation_space.contains(environment.step([0.0])[0])


def test_faulty_sensors_do_not_change_the_true_episode():
    bare, faults = make("pendulum"), Faults(noise=0.1, flicker=0.5, delay=2)
    true, faulty = (compiled_episode(with_faults(bare, each), KEY, ACTIONS[:30]) for each in (Faults(), faults))
    np.testing.assert_allclose(faulty[1], true[1], rtol=1e-5)  # two programs, which round differently
    assert (np.asarray(faulty[0]) != np.asarray(true[0])).any(axis=1).all()


@pytest.mark.slow
def test_a_task_among_others_is_the_same_as_alone():
    task, keys = make("pendulum", faults=Faults(0.1, 0.2, True, 0.2, 2, 0.3)), jax.random.split(KEY, 4)
    together = jax.jit(jax.vmap(lambda key: compiled_episode(task, key, ACTIONS[:60])))(keys)
    for index, key in enumerate(keys):
        for ours, alone in zip(together, compiled_episode(task, key, ACTIONS[:60]), strict=True):
            np.testing.assert_allclose(ours[index], alone, rtol=1e-5, atol=1e-6)  # they round differently


@pytest.mark.parametrize("name", ["pendulum", "gym:Pendulum-v1"])
def test_faults_apply_to_the_selected_entries(name):
    task = make(name, observe=[2, 0], faults=Faults(noise=(0.0, 3.0), flicker_flag=True))
    assert task.spec == make(name).spec._replace(obs_dim=3)
    assert tasks.entries(task) == (2, 0, 3)
    assert tasks.entry_names(task)[-1] == "lost"
    assert tasks.describe(task)["observe"] == [2, 0]
    assert tasks.describe(task)["faults"] == {"noise": (0.0, 3.0), "flicker_flag": True}
    bare = dataclasses.replace(task, faults=Faults())
    first, true = (TaskEnvironment if name == "pendulum" else GymnasiumTask.environment, bare)
    seen, clean = (first(each).reset(seed=0)[0] for each in (task, true))
    assert seen[0] == clean[0]
    assert abs(seen[1]) != abs(clean[1])
    with pytest.raises(UserError, match="select the entries first"):
        observe(task, (0,))
    with pytest.raises(UserError, match="has faults already"):
        with_faults(task, Faults(noise=0.1))


def test_pictures_and_success_are_of_the_true_state():
    environment = TaskEnvironment(make("pendulum", faults=Faults(flicker=1.0, delay=3)), "rgb_array")
    true = TaskEnvironment("pendulum", "rgb_array")
    for each in (environment, true):
        each.reset(seed=0)
        obs = each.step(np.array([1.0]))[0]
        assert obs.any() == (each is true)
    np.testing.assert_array_equal(environment.render(), true.render())
    assert environment.states == true.states
    counting = TaskEnvironment(with_faults(Counting(), Faults(delay=7)))
    counting.reset(seed=0)
    assert [counting.step(np.zeros(1))[-1]["is_success"] for _ in range(5)] == [False] * 4 + [True]


@pytest.mark.parametrize("kind", [pytest.param("compiled", marks=pytest.mark.slow), "host"])
def test_runs_are_evaluated_and_played_with_their_faults(kind, tmp_path):
    faults = Faults(sticky=1.0, flicker_flag=True)
    task = GymnasiumTask(HostEcho, max_steps=9, faults=faults) if kind == "host" else with_faults(Echo(), faults)
    run = saved(tmp_path / "run", "sac-mlp", task)
    assert run.config["faults"] == {"flicker_flag": True, "sticky": 1.0}
    assert evaluate(run, episodes=1, task=task, progress=False)["sampled"]["mean"] == 0.0
    other = dataclasses.replace(task, faults=Faults(flicker_flag=True))
    assert evaluate(run, episodes=1, task=other, progress=False)["sampled"]["mean"] != 0.0
    steps = play(run, steps=3, sampled=True, task=task).steps
    assert steps.obs.shape == (4, 3)
    assert steps.prev_action[1:].all()  # the agent remembers the action that it chose
    assert not steps.obs[:, 1].any()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("flag", [1, 1.0, "yes"])
def test_a_flag_is_true_or_false(flag):
    with pytest.raises(UserError, match=r"flicker_flag=.* is impossible: it must be"):
        tasks.make("pendulum", faults={"flicker_flag": flag})


def test_a_seed_of_an_evaluation_is_a_sequence_of_faults():
    task = make("gym:Pendulum-v1", faults=Faults(noise=0.1, flicker=0.3))

    def seen(seed):
        environment = task.environment()
        start, later = environment.reset(seed=seed)[0], environment.step(np.zeros(1))[0]
        return np.stack([start, later, environment.reset()[0]])

    np.testing.assert_array_equal(seen(1), seen(1))
    assert (seen(1) != seen(2)).any()


def test_the_command_line_makes_and_records_faults(tmp_path, monkeypatch, capsys):
    given = []
    monkeypatch.setattr("beliefrl.training.train.train", lambda *args, **options: given.append(args[1]))
    line = "train sac-mlp pendulum --observe 2 0 --noise 0.1 0.2 --flicker 0.3 --flicker-flag --delay 1 --sticky 0.1"
    cli.main(line.split())
    cli.main(["train", "sac-mlp", "pendulum", "--noise", "0.1", "--dropout", "0.2"])
    cli.main(["train", "sac-mlp", "pendulum"])
    task = make("pendulum", [2, 0], Faults((0.1, 0.2), flicker=0.3, flicker_flag=True, delay=1, sticky=0.1))
    assert given == [task, make("pendulum", faults={"noise": 0.1, "dropout": 0.2}), make("pendulum")]
    run = saved(tmp_path / "run", "sac-mlp", task)
    assert Run(run.folder).config["faults"]["noise"] == [0.1, 0.2]
    assert task_of(run) == task
    assert load(run).spec.obs_dim == 3
    cli.main(["show", str(run.folder)])
    assert "flicker=0.3" in capsys.readouterr().out


def test_a_run_does_not_go_on_with_other_faults(tmp_path):
    agent = tiny("sac-mlp")
    for before, after in ((Faults(noise=0.1), Faults()), (Faults(), Faults(delay=1))):
        run = saved(tmp_path / str(before.noise), "sac-mlp", make("pendulum", faults=before))
        with pytest.raises(UserError, match=r"was trained with faults=.*, not .*: choose another --out"):
            train(agent, make("pendulum", faults=after), run.folder, resume=True, steps=100, seed=4)


@pytest.mark.parametrize(
    ("given", "phrase"),
    [
        ({"noise": -0.1}, "noise=-0.1 is impossible"),
        ({"noise": float("nan")}, "noise=nan is impossible"),
        ({"noise": ()}, "noise=() is impossible"),
        ({"noise": "much"}, "noise=much is impossible"),
        ({"noise": [0.1, 0.2]}, "noise=0.1 0.2 has 2 deviations, but the observation has 3 entries"),
        ({"flicker": 1.01}, "flicker=1.01 is impossible: it must be a number from 0 to 1"),
        ({"dropout": -1e-9}, "it must be a number from 0 to 1"),
        ({"sticky": True}, "sticky=True is impossible"),
        ({"delay": -1}, "delay=-1 is impossible: it must be a whole number from 0 to 10000"),
        ({"delay": 1.0}, "delay=1.0 is impossible"),
        ({"delay": 10_001}, "it must be a whole number from 0 to 10000"),
        ({"flicker_flag": "yes"}, "flicker_flag='yes' is impossible"),
        ({"fog": 1}, "There is no fault 'fog': there is noise, flicker"),
    ],
)
@pytest.mark.parametrize("name", ["pendulum", "gym:Pendulum-v1"])
def test_impossible_faults_are_a_sentence(unchecked, name, given, phrase):
    with pytest.raises(UserError) as error:
        _ = make(name, faults=given).spec
    assert phrase in str(error.value)
