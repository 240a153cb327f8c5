"""Our tasks in Gymnasium: the same steps, Gymnasium's time limit, its checker, pictures."""

import dataclasses
import sys
from unittest import mock

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from beliefrl import tasks
from beliefrl.catalogue import register, registered_ids
from beliefrl.errors import UserError
from beliefrl.tasks.environment import TaskEnvironment
from worlds import Counting

register()


@pytest.fixture(autouse=True)
def _no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def play(env, actions, seed=0):
    """Observations, rewards and ends of an episode's beginning."""
    first, _ = env.reset(seed=seed)
    return [first, *(env.step(action)[:4] for action in actions)]


def actions_for(env, steps, seed=0):
    shape = env.action_space.shape
    return np.random.default_rng(seed).uniform(-1, 1, (steps, *shape)).astype(np.float32)


def test_every_task_and_every_mask_has_an_id():
    assert registered_ids() == {
        "BeliefRL/Pendulum-v0": "pendulum",
        "BeliefRL/PendulumV-v0": "pendulum-v",
        "BeliefRL/PendulumP-v0": "pendulum-p",
        "BeliefRL/CartPole-v0": "cartpole",
        "BeliefRL/CartPoleV-v0": "cartpole-v",
        "BeliefRL/CartPoleP-v0": "cartpole-p",
        "BeliefRL/TargetReaching-v0": "target-reaching",
    }


def test_registering_twice_changes_nothing():
    before = dict(gymnasium.registry)
    register()
    assert dict(gymnasium.registry) == before


# Gymnasium warns of every observation without bounds, its own CartPole's and MuJoCo's too.
@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is -?infinity")
@pytest.mark.parametrize("identifier", registered_ids())
def test_gymnasiums_checker_passes(identifier):
    check_env(gymnasium.make(identifier).unwrapped)


@pytest.mark.parametrize("name", ["pendulum-v", "cartpole", "target-reaching"])
def test_its_steps_are_the_tasks_own(name):
    task, env = tasks.make(name), TaskEnvironment(name)
    env.reset(seed=0)
    step = jax.jit(task.step)
    for action in actions_for(env, 20):
        _, obs, reward, terminated = step(env.states[-1], action, jax.random.key(0))  # no task of ours has noise
        seen, paid, ended, truncated, _ = env.step(action)
        np.testing.assert_allclose(seen, obs, rtol=1e-5, atol=1e-5)
        assert (paid, ended, truncated) == (pytest.approx(float(reward), rel=1e-5), terminated, False)


def test_the_time_limit_truncates_and_does_not_terminate():
    env = gymnasium.make("BeliefRL/TargetReaching-v0")
    _, *steps = play(env, np.zeros((128, 2), np.float32))
    assert [truncated for *_, truncated in steps] == [False] * 127 + [True]
    assert not any(terminated for *_, terminated, _ in steps)


def test_the_same_seed_is_the_same_episodes_and_another_is_not():
    env, twin = TaskEnvironment("pendulum"), TaskEnvironment("pendulum")
    actions = actions_for(env, 5)
    np.testing.assert_equal(play(env, actions, 3), play(twin, actions, 3))
    following = env.reset()[0]
    np.testing.assert_array_equal(following, twin.reset()[0])
    assert not np.allclose(following, env.reset(seed=3)[0])
    assert not np.allclose(env.reset(seed=4)[0], twin.reset(seed=3)[0])


def test_a_task_with_noise_gets_new_noise_at_every_step():
    @dataclasses.dataclass(frozen=True)
    class Noisy(Counting):
        def step(self, state, action, key):
            return state + 1, jax.random.normal(key, (1,)), jnp.array(0.0), jnp.array(False)

    _, *steps = play(TaskEnvironment(Noisy()), np.zeros((9, 1)))
    assert len({float(obs[0]) for obs, *_ in steps}) == 9


def test_equal_tasks_are_compiled_once():
    actions = np.zeros((3, 1))
    play(TaskEnvironment("pendulum", mass=1.7), actions)
    with mock.patch.object(tasks.TASKS["pendulum"], "step", side_effect=AssertionError("compiled again")):
        play(TaskEnvironment("pendulum", mass=1.7), actions, seed=1)


def test_constants_are_the_tasks():
    env = gymnasium.make("BeliefRL/CartPoleP-v0", pole_mass=0.3, gravity=1.6)
    assert env.unwrapped.task == tasks.make("cartpole-p", pole_mass=0.3, gravity=1.6)


def test_actions_beyond_the_bounds_are_clipped():
    @dataclasses.dataclass(frozen=True)
    class Echo(Counting):
        def step(self, state, action, key):
            return state + 1, action, jnp.array(0.0), jnp.array(False)

    _, *steps = play(TaskEnvironment(Echo()), np.array([[3.0], [-1.2], [0.5]]))
    assert [float(obs[0]) for obs, *_ in steps] == [1.0, -1.0, 0.5]


def test_info_tells_success_where_a_task_can_succeed():
    env = TaskEnvironment(Counting())  # succeeds after five steps
    env.reset()
    assert [env.step(np.zeros(1))[4] for _ in range(6)] == [{"is_success": i >= 5} for i in range(1, 7)]
    env = TaskEnvironment("pendulum")
    env.reset()
    assert env.step(np.zeros(1))[4] == {}


@dataclasses.dataclass(frozen=True, eq=False)
class Unhashable(Counting):
    __hash__ = None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gymnasium.make("BeliefRL/Pendulum-v0", weight=1.0), "pendulum has no constant 'weight'"),
        (lambda: gymnasium.make("BeliefRL/Pendulum-v0", max_steps=9), "use the argument max_episode_steps"),
        (lambda: TaskEnvironment("pendulm"), "did you mean pendulum"),
        (lambda: TaskEnvironment("pendulum", "ansi"), "rgb_array, human or None"),
        (lambda: TaskEnvironment("gym:Pendulum-v1"), "gym:Pendulum-v1 is not a JAX task: use gymnasium.make"),
        (lambda: TaskEnvironment(Counting(), ends=3), "make the task itself with ends"),
        (lambda: TaskEnvironment(Unhashable()), "Unhashable is not hashable: make it a frozen dataclass"),
        (lambda: TaskEnvironment("pendulum").step(np.zeros(1)), "call reset first"),
        (lambda: TaskEnvironment("pendulum", "rgb_array").render(), "call reset first"),
        (lambda: play(TaskEnvironment("pendulum"), [np.zeros(2)]), r"shape \(2,\): it must be \(1,\)"),
        (lambda: play(TaskEnvironment(Counting(), "human"), []), r"Counting cannot be rendered: .* draw\(states\)"),
    ],
)
def test_a_users_mistake_is_one_sentence(make, message):
    with pytest.raises(UserError, match=message):
        make()


@pytest.mark.parametrize(
    ("identifier", "shape", "fps"),
    [("PendulumV", (480, 480, 3), 20), ("CartPoleP", (200, 640, 3), 50), ("TargetReaching", (480, 480, 3), 10)],
)
def test_pictures_follow_the_state(identifier, shape, fps):
    env = gymnasium.make(f"BeliefRL/{identifier}-v0", render_mode="rgb_array")
    env.reset(seed=1)
    frames = [env.render(), env.render()]
    for action in actions_for(env, 2):
        env.step(action)
        frames.append(env.render())
    assert {(frame.shape, frame.dtype) for frame in frames} == {(shape, np.dtype(np.uint8))}
    first, again, second, third = frames
    assert np.array_equal(first, again)
    assert not np.array_equal(first, second)
    assert not np.array_equal(second, third)
    assert env.metadata["render_fps"] == fps


def test_a_reached_target_is_ticked():
    env = TaskEnvironment("target-reaching", "rgb_array")
    env.reset(seed=1)
    before = env.render()
    env._states = [env.states[-1]._replace(reached=jnp.array(1))]
    assert not np.array_equal(env.render(), before)


def test_a_window_shows_what_rgb_array_returns():
    pygame = pytest.importorskip("pygame")
    window, picture = (TaskEnvironment("pendulum", mode) for mode in ("human", "rgb_array"))
    for env in (window, picture):
        play(env, np.ones((2, 1)))
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, picture.render())
    assert window.render() is None
    window.close()
    window.close()
    assert pygame.display.get_surface() is None


def test_a_window_without_pygame_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(UserError, match=r"pip install 'beliefrl\[render\]'"):
        TaskEnvironment("pendulum", "human").reset()


@pytest.mark.extra
@pytest.mark.filterwarnings("ignore::UserWarning:stable_baselines3")
def test_stable_baselines_checks_and_trains_on_it():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    contrib = pytest.importorskip("sb3_contrib")
    pytest.importorskip("torch").set_num_threads(1)  # more of them wait for each other where cores are busy
    for identifier in registered_ids():
        checker.check_env(gymnasium.make(identifier))
    agent = contrib.RecurrentPPO("MlpLstmPolicy", "BeliefRL/PendulumV-v0", n_steps=16, batch_size=16)
    assert agent.learn(32).num_timesteps == 32
