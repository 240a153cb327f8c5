"""Missing and faulty sensors: what the agent sees, what is applied, and what a run records."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import TaskEnvironment, cli, evaluate, load, play, task_of, tasks
from beliefrl.runs.run import Run
from beliefrl.tasks import make, observe, with_faults
from beliefrl.tasks.faults import Faults
from beliefrl.tasks.gymnasium import Environment, GymnasiumTask
from beliefrl.types import Spec, UserError
from worlds import Counter, Counting, saved

KEY = jax.random.key(3)
STEPS = 4000


@dataclasses.dataclass(frozen=True)
class Echo:
    """Observes 5 and the action that was applied last, which it also pays."""

    spec = Spec(obs_dim=2, action_dim=1, max_steps=STEPS)

    def reset(self, key):
        return jnp.zeros(()), jnp.array([5.0, 0.0])

    def step(self, state, action, key):
        return action[0], jnp.stack([jnp.array(5.0), action[0]]), action[0], jnp.array(False)

    def success(self, state):
        return jnp.array(False)


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
    environment = GymnasiumTask(HostEcho, max_steps=STEPS, faults=faults).environment()
    first, _ = environment.reset(seed=3)
    steps = [environment.step(action)[:2] for action in np.asarray(actions)]
    return [np.stack([first, *(obs for obs, _ in steps)]), np.array([reward for _, reward in steps])]


ACTIONS = jnp.linspace(-1, 1, STEPS)[:, None]
both = pytest.mark.parametrize("kind", ["compiled", "host"])


@both
def test_noise_has_the_deviation_of_each_entry(kind):
    obs, reward = episode(kind, Faults(noise=(0.5, 0.0)), ACTIONS)
    assert abs(obs[:, 0].mean() - 5) < 0.03
    assert abs(obs[:, 0].std() - 0.5) < 0.03
    assert abs(np.corrcoef(obs[1:, 0], obs[:-1, 0])[0, 1]) < 0.06  # independent at each step
    np.testing.assert_allclose(obs[1:, 1], ACTIONS[:, 0], atol=1e-6)
    np.testing.assert_allclose(reward, ACTIONS[:, 0], atol=1e-6)


@both
def test_lost_observations_are_zeros_with_a_flag(kind):
    obs, reward = episode(kind, Faults(noise=0.1, flicker=0.3, flicker_flag=True), ACTIONS)
    lost = obs[:, 2] == 1
    assert abs(lost.mean() - 0.3) < 0.03
    assert not obs[lost, :2].any()
    assert (obs[~lost, 0] > 4).all()
    assert not obs[~lost, 2].any()
    np.testing.assert_allclose(reward, ACTIONS[:, 0], atol=1e-6)  # rewards are never lost


@both
def test_each_entry_is_lost_by_itself(kind):
    lost = episode(kind, Faults(dropout=0.2), jnp.ones((STEPS, 1)))[0][1:] == 0
    np.testing.assert_allclose(lost.mean(axis=0), 0.2, atol=0.03)
    assert abs(lost.all(axis=1).mean() - 0.04) < 0.015


@both
@pytest.mark.parametrize("delay", [1, 3])
def test_a_delay_repeats_the_first_observation(kind, delay):
    obs, reward = episode(kind, Faults(delay=delay), ACTIONS[:9])
    seen = [0.0] * (delay + 1) + [float(action) for action in ACTIONS[: 9 - delay, 0]]
    np.testing.assert_allclose(obs[:, 1], seen, atol=1e-6)
    np.testing.assert_allclose(reward, ACTIONS[:9, 0], atol=1e-6)


@both
def test_a_sticky_action_is_the_one_that_was_applied_before(kind):
    _, applied = episode(kind, Faults(sticky=0.25), ACTIONS)
    before = np.concatenate([[0.0], applied[:-1]])
    repeats = np.abs(applied - before) < 1e-6
    assert abs(repeats.mean() - 0.25) < 0.03
    np.testing.assert_allclose(applied[~repeats], ACTIONS[~repeats, 0], atol=1e-6)
    assert not episode(kind, Faults(sticky=1.0), ACTIONS[:5])[1].any()


@both
def test_a_certain_fault_happens_at_every_step(kind):
    for faults in (Faults(flicker=1.0), Faults(dropout=1.0)):
        assert not episode(kind, faults, ACTIONS[:50])[0].any()


def test_without_faults_it_is_the_same_task():
    for task in (make("pendulum-v"), GymnasiumTask(Counter)):
        assert with_faults(task, Faults(noise=(0.0, 0.0))) is task
    assert make("pendulum-v", faults=Faults()) == make("pendulum-v", faults={"delay": 0}) == make("pendulum-v")
    assert "faults" not in tasks.describe(make("pendulum-v"))
    assert type(make("gym:Pendulum-v1").environment()) is Environment


def test_faulty_sensors_do_not_change_the_true_episode():
    bare, faults = make("target-reaching"), Faults(noise=0.1, flicker=0.5, delay=2)
    actions = jax.random.uniform(KEY, (30, 2), minval=-1)
    true, faulty = (compiled_episode(with_faults(bare, each), KEY, actions) for each in (Faults(), faults))
    np.testing.assert_array_equal(faulty[1], true[1])
    assert (np.asarray(faulty[0]) != np.asarray(true[0])).any(axis=1).all()


def test_a_task_among_others_is_the_same_as_alone():
    task, keys = make("pendulum", faults=Faults(0.1, 0.2, True, 0.2, 2, 0.3)), jax.random.split(KEY, 4)
    together = jax.jit(jax.vmap(lambda key: compiled_episode(task, key, ACTIONS[:60])))(keys)
    for index, key in enumerate(keys):
        for ours, alone in zip(together, compiled_episode(task, key, ACTIONS[:60]), strict=True):
            np.testing.assert_allclose(ours[index], alone, rtol=1e-6, atol=1e-6)
            np.testing.assert_array_equal(ours[index] == 0, alone == 0)


@pytest.mark.parametrize("name", ["pendulum", "gym:Pendulum-v1"])
def test_faults_apply_to_the_selected_entries(name):
    task = make(name, observe=[2, 0], faults=Faults(noise=(0.0, 3.0), flicker_flag=True))
    assert task.spec == make(name).spec._replace(obs_dim=3)
    assert tasks.entries(task) == (2, 0, 3)
    assert tasks.entry_names(task)[-1] == "lost"
    assert tasks.describe(task)["observe"] == [2, 0]
    assert tasks.describe(task)["faults"] == {"noise": (0.0, 3.0), "flicker_flag": True}
    bare = tasks.without_faults(task)
    first, true = (TaskEnvironment if name == "pendulum" else GymnasiumTask.environment, bare)
    seen, clean = (first(each).reset(seed=0)[0] for each in (task, true))
    assert seen[0] == clean[0]
    assert abs(seen[1]) != abs(clean[1])
    with pytest.raises(UserError, match="select the entries first"):
        observe(task, (0,))
    with pytest.raises(UserError, match="has faults already"):
        with_faults(task, Faults(noise=0.1))


def test_pictures_and_success_are_of_the_true_state():
    environment = TaskEnvironment(make("target-reaching", faults=Faults(flicker=1.0, delay=3)), "rgb_array")
    true = TaskEnvironment("target-reaching", "rgb_array")
    for each in (environment, true):
        each.reset(seed=0)
        each.step(np.array([1.0, 0.5]))
    np.testing.assert_array_equal(environment.render(), true.render())
    np.testing.assert_array_equal(environment.states[-1].position, true.states[-1].position)
    task = with_faults(Counting(), Faults(delay=2))
    state, _ = task.reset(KEY)
    for _ in range(5):
        state, *_ = task.step(state, jnp.zeros(1), KEY)
    assert task.success(state)


@both
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


def test_a_seed_of_an_evaluation_is_a_sequence_of_faults():
    task = make("gym:Pendulum-v1", faults=Faults(noise=0.1, flicker=0.3))

    def seen(seed):
        environment = task.environment()
        start, later = environment.reset(seed=seed)[0], environment.step(np.zeros(1))[0]
        return np.stack([start, later, environment.reset()[0]])

    np.testing.assert_array_equal(seen(1), seen(1))
    assert (seen(1) != seen(2)).any()


SMALL = "--step-start-rl 4 --pretrain-updates 1 --policy-layers 8 --value-layers 8 --eval-episodes 1 --steps 6"
LINE = f"train sac-mlp pendulum --observe 2 0 {SMALL} --noise 0.1 0.2 --flicker 0.3 --flicker-flag --out run --resume"


def test_a_run_records_its_faults(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    cli.main(LINE.split())
    run = Run("run")
    assert run.config["faults"] == {"noise": [0.1, 0.2], "flicker": 0.3, "flicker_flag": True}
    faults = Faults(noise=(0.1, 0.2), flicker=0.3, flicker_flag=True)
    assert task_of(run) == make("pendulum", [2, 0], faults)
    assert load(run).spec.obs_dim == 3
    cli.main(LINE.split())
    for line in (LINE.replace("0.1 0.2", "0.1"), LINE.replace("--noise 0.1 0.2 --flicker 0.3 --flicker-flag", "")):
        with pytest.raises(SystemExit):
            cli.main(line.split())
        assert "run was trained with faults={'noise': [0.1, 0.2]" in capsys.readouterr().err
    cli.main(["show", "run"])
    assert "flicker=0.3" in capsys.readouterr().out


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
