"""Gymnasium environments as tasks: observations and actions, supported spaces, and one clear message per fault."""

import dataclasses
import os
import pathlib
from typing import ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import beliefrl
from beliefrl import catalogue, tasks
from beliefrl.errors import Fault, UserError
from beliefrl.tasks import seen_environment
from beliefrl.tasks.faults import Faults
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.interface import Interface, measure_of
from beliefrl.tasks.registered import _Registered
from beliefrl.training.lockstep import Lockstep
from wrong import BOX, FAULTS, UNSUPPORTED, Dictionary, Fine, observing, spaced, with_end


def a_sentence(error):
    text = str(error.value)
    assert text.endswith(".")
    assert "\n" not in text
    assert "Traceback" not in text
    return text


@pytest.mark.parametrize("make", UNSUPPORTED, ids=lambda make: UNSUPPORTED[make])
def test_what_is_not_supported_is_refused_before_anything_begins(make):
    with pytest.raises(UserError) as error:
        _ = GymnasiumTask(make, "robot").spec
    text = a_sentence(error)
    assert text.startswith("robot ")
    assert UNSUPPORTED[make] in text


@pytest.mark.parametrize("make", FAULTS, ids=lambda make: FAULTS[make][0])
def test_a_fault_names_the_environment_the_seed_and_the_step(make, monkeypatch):
    monkeypatch.setattr(seen_environment, "ENDLESS", 25)
    phrase, step = FAULTS[make]
    lanes = Lockstep(GymnasiumTask(make, "robot"), ["seed 4"])
    with pytest.raises(Fault) as error:  # noqa: PT012 - it may come at any of them
        lanes.reset(np.array([0]))
        for _ in range(30):
            lanes.step(np.zeros((1, 1), np.float32))
    text = a_sentence(error)
    assert text.startswith(f"robot (seed 4, step {step}): ")
    assert phrase in text
    lanes.close()


def test_another_interface_is_an_error_that_names_what_differs():
    trained = Interface(("angle", "entry 1"), [-1.0], [1.0])._asdict()
    Interface(("angle", "speed"), [-1.0], [1.0]).check(trained, "runs/one")  # an entry without a name fits any
    Interface(("angle",), [-9.0], [9.0]).check(None, "runs/one")  # of an older run nothing is known
    for other, phrase in (
        (Interface(("angle",), [-1.0], [1.0]), "number of observed entries before: 2, now: 1"),
        (Interface(("speed", "entry 1"), [-1.0], [1.0]), r"observed entries before: \['angle'\], now: \['speed'\]"),
        (
            Interface(("angle", "entry 1"), [-2.0], [1.0]),
            r"lower bounds of the actions before: \[-1.0\], now: \[-2",
        ),
        (Interface(("angle", "entry 1"), [-1.0], [2.0]), "upper bounds of the actions"),
    ):
        with pytest.raises(UserError, match=f"^runs/one was trained in another environment: {phrase}"):
            other.check(trained, "runs/one")


def test_the_interface_has_the_entries_that_the_agent_sees_and_the_bounds_of_its_actions():
    class Named(Fine):
        entry_names = ("angle", "speed")

    assert GymnasiumTask(Named, indices=(1,)).interface == (("speed",), [-2.0], [6.0])
    assert GymnasiumTask(Fine).interface.entries == ("entry 0", "entry 1")


def test_discrete_values_of_any_type_of_number_are_observed():
    for space, given, expected in (
        (spaces.Discrete(2), np.bool_(True), [0, 1]),
        (spaces.Discrete(3, start=1), np.array([3]), [0, 0, 1]),
        (spaces.MultiDiscrete([2, 3]), jnp.array([1, 2]), [0, 1, 0, 0, 1]),
        (spaces.MultiBinary(2), (True, False), [1, 0]),
    ):
        environment = GymnasiumTask(observing(space, given, given)).environment()
        np.testing.assert_array_equal(environment.reset(seed=0)[0], expected)


def test_an_environment_that_switches_jax_to_64_bits_needs_a_process_of_its_own():
    class Wide(Fine):
        def step(self, action):
            jax.config.update("jax_enable_x64", True)
            return super().step(action)

    lanes = Lockstep(GymnasiumTask(Wide, "robot"), ["seed 0"])
    lanes.reset(np.array([0]))
    with pytest.raises(Fault, match="robot has switched JAX to 64 bits"):
        lanes.step(np.zeros((1, 1), np.float32))
    assert not jax.config.read("jax_enable_x64")
    lanes.close()


def test_making_an_environment_changes_neither_the_working_directory_nor_jax(tmp_path, monkeypatch):
    class Moving(Fine):
        def __init__(self):
            os.chdir("/")
            jax.config.update("jax_enable_x64", True)

    class Failing(Moving):
        def __init__(self):
            super().__init__()
            raise OSError("no port")

    monkeypatch.chdir(tmp_path)
    assert GymnasiumTask(Moving).spec.obs_dim == 2
    assert pathlib.Path.cwd() == tmp_path
    assert not beliefrl.check(Moving, steps=3).refusals
    assert pathlib.Path.cwd() == tmp_path
    for look in (lambda: GymnasiumTask(Failing).spec, lambda: beliefrl.check(Failing)):
        with pytest.raises(UserError, match="cannot be made: OSError: no port"):
            look()
        assert pathlib.Path.cwd() == tmp_path
    with pytest.raises(UserError, match="cannot be made: OSError: no port"):
        Lockstep(GymnasiumTask(Failing), ["seed 0"], "never")
    assert pathlib.Path.cwd() == tmp_path
    assert not jax.config.read("jax_enable_x64")


@pytest.mark.parametrize(
    ("actions", "task"),
    [
        (Fine.action_space, {"indices": (7,)}),
        (Fine.action_space, {"faults": Faults(noise=(0.1, 0.2, 0.3))}),
        (spaces.Discrete(2), {}),
    ],
)
def test_an_environment_that_is_refused_is_closed(actions, task):
    closed = []

    class Robot(Fine):
        action_space = actions

        def close(self):
            closed.append(True)

    with pytest.raises(UserError):
        GymnasiumTask(Robot, **task).environment()
    assert closed


def test_a_text_in_place_of_a_tuple_of_measures_is_an_error(unchecked):
    with pytest.raises(UserError, match=r"measures='success' is a text: give a tuple, \('success',\)"):
        GymnasiumTask(Fine, measures="success")


def test_options_are_given_to_a_reset_only_if_there_are_any():
    """Some environments have no such argument."""

    class Without(Fine):
        def reset(self, *, seed=None):
            return super().reset(seed=seed)

    lanes = Lockstep(GymnasiumTask(Without), ["seed 0"])
    lanes.reset(np.array([0]))
    lanes.restart(np.array([True]))


def test_one_environment_for_two_is_refused_until_it_is_closed():
    only = Fine()
    task = GymnasiumTask(lambda: only, "robot")
    assert task.spec.obs_dim == 2
    first = task.environment()
    with pytest.raises(UserError, match="robot is one environment, which is already in use: make a new one in each"):
        task.environment()
    with pytest.raises(UserError, match="already in use"):
        Lockstep(task, ["seed 0", "seed 1"])
    first.close()
    task.environment().close()


@pytest.mark.parametrize("flag", [np.array(True), jnp.array(True), 1, np.int64(1), np.bool_(True)])
def test_the_end_of_an_episode_may_be_any_kind_of_flag(flag):
    environment = GymnasiumTask(with_end(flag, False)).environment()
    environment.reset(seed=0)
    ends = [environment.step(np.zeros(1, np.float32))[2] for _ in range(3)]
    assert ends == [False, False, True]


def test_an_attribute_spec_of_its_own_is_no_time_limit():
    class Own(Fine):
        spec: ClassVar = {"arm": "left"}

    assert GymnasiumTask(Own).environment().limit is None


def test_spaces_of_the_old_package_are_named():
    Old = type("Box", (), {"__module__": "gym.spaces.box"})
    for changes in ({"action_space": Old()}, {"observation_space": Old()}):
        with pytest.raises(UserError, match="has spaces of the old package gym: write `import gymnasium as gym`"):
            GymnasiumTask(Fine, "robot", changes).environment()


def test_options_of_a_reset_are_none_also_at_a_restart():
    """Gymnasium's vector environments remove their own entry and leave an empty dict."""
    given = []

    class Asking(Fine):
        def reset(self, *, seed=None, options=None):
            given.append(options)
            return super().reset(seed=seed)

    lanes = Lockstep(GymnasiumTask(Asking), ["seed 0"])
    lanes.reset(np.array([0]))
    lanes.restart(np.array([True]))
    assert given[-2:] == [None, None]


def test_actions_are_scaled_to_the_range_of_the_environment():
    environment = GymnasiumTask(Fine).environment()
    environment.reset(seed=0)
    for action, expected in ((-1.0, -2.0), (0.0, 2.0), (1.0, 6.0), (5.0, 6.0), (0.5, 4.0)):
        environment.step(np.array([action]))
        np.testing.assert_allclose(environment.inner.action, [expected])
        assert environment.inner.action.dtype == np.float32


def test_an_action_of_any_shape_is_a_row_of_numbers():
    class Matrix(Fine):
        action_space = spaces.Box(
            np.array([[0.0, 0.0], [0.0, -4.0]]), np.array([[1.0, 2.0], [3.0, 4.0]]), dtype=np.float64
        )

    task = GymnasiumTask(Matrix)
    assert task.spec.action_dim == 4
    environment = task.environment()
    environment.reset(seed=0)
    environment.step(np.array([-1.0, 1.0, 1.0, 0.0]))
    np.testing.assert_allclose(environment.inner.action, [[0.0, 2.0], [3.0, 0.0]])


def test_composite_observations_are_flat():
    task = GymnasiumTask(Dictionary)
    assert task.spec.obs_dim == 5
    np.testing.assert_array_equal(task.environment().reset(seed=0)[0][-3:], [0.0, 1.0, 0.0])


def test_only_the_entries_observed_are_seen_in_their_order():
    whole = tasks.make("gym:Pendulum-v1").environment().reset(seed=3)[0]
    part = tasks.make("gym:Pendulum-v1", observe=[2, 0]).environment().reset(seed=3)[0]
    np.testing.assert_array_equal(part, whole[[2, 0]])
    again = tasks.observe(tasks.make("gym:Pendulum-v1", observe=[2, 0]), (1,))
    np.testing.assert_array_equal(again.environment().reset(seed=3)[0], whole[[0]])


@pytest.mark.parametrize(
    ("indices", "phrase"),
    [((2,), "2 is not an index of the observation, which has 2 entries"), ((1, 1), "twice"), ((), "has no index")],
)
def test_indices_of_a_task_of_your_own_are_checked(indices, phrase):
    with pytest.raises(UserError, match=phrase):
        _ = GymnasiumTask(Fine, indices=indices).spec


def test_an_entry_that_is_not_seen_may_be_anything():
    class Broken(Fine):
        def observe(self):
            return np.array([np.nan, 0.5])

    np.testing.assert_allclose(GymnasiumTask(Broken, indices=(1,)).environment().reset(seed=0)[0], [0.5])


@pytest.mark.parametrize(
    ("space", "obs"),
    [
        (BOX, [-201.0, 201.0]),  # as far as a hundred widths
        (spaces.Box(0.0, 1e-3, (2,), np.float32), [-100.0, 100.0]),  # a range of less than one counts as one
        (spaces.Box(-np.inf, np.inf, (2,), np.float32), [-9e14, 9e14]),
        (spaces.Box(0.0, np.inf, (2,), np.float32), [-9e14, 9e14]),
        (spaces.Box(-3e38, 3e38, (2,), np.float32), [-9e14, 9e14]),
    ],
)
def test_what_leaves_its_range_a_little_is_seen_as_it_is(space, obs):
    make = spaced(observation_space=space, observe=lambda self: np.array(obs))
    np.testing.assert_allclose(GymnasiumTask(make).environment().reset()[0], obs, rtol=1e-6)


def test_the_range_of_an_entry_is_its_own_in_a_composite_observation():
    space = spaces.Dict({"far": spaces.Box(-1e4, 1e4, (1,), np.float32), "near": BOX})

    def observing(near):
        return spaced(
            observation_space=space, observe=lambda self: {"far": np.array([9e3]), "near": np.array([0.0, near])}
        )

    np.testing.assert_allclose(GymnasiumTask(observing(1.0)).environment().reset()[0], [9e3, 0.0, 1.0])
    with pytest.raises(Fault, match=r"entry 2 of the observation \(near 1\) is 9000\.0, far outside"):
        GymnasiumTask(observing(9e3)).environment().reset()
    GymnasiumTask(observing(9e3), indices=(0, 1)).environment().reset()  # what is not seen may be anything


@pytest.mark.parametrize("limit", [0, -1, 1.5, "long", True])
def test_an_impossible_time_limit_is_refused(limit, unchecked):
    with pytest.raises(UserError, match=f"max_steps={limit} is impossible: it must be a whole number"):
        GymnasiumTask(Fine, max_steps=limit)


def test_a_time_limit_truncates_and_does_not_terminate():
    environment = GymnasiumTask(Fine, max_steps=4).environment()
    environment.reset(seed=0)
    ends = [environment.step(np.zeros(1))[2:4] for _ in range(4)]
    assert ends == [(False, False)] * 3 + [(False, True)]
    assert GymnasiumTask(Fine, max_steps=4).spec.max_steps == 4
    assert tasks.make("gym:Pendulum-v1", max_episode_steps=7).spec.max_steps == 7


def test_masks_by_name_are_those_of_the_task():
    assert tasks.make("gym:MountainCarContinuous-v0", observe="velocities").indices == (1,)
    assert tasks.make("gym:Pendulum-v1", observe=["positions"]).indices == (0, 1)
    assert tasks.describe(tasks.make("pendulum", observe="velocities"))["task"] == "pendulum-v"
    hopper = catalogue.ROBOTS["hopper"]
    assert hopper.velocities == (3, 4, 5, 9, 11, 13)  # the authors' index sets
    assert hopper.positions == (0, 1, 2, 6, 7, 8, 10, 12, 14)
    ant = catalogue.ROBOTS["ant"]
    assert ant.velocities == (3, 4, 5, 9, 11, 13, 15, 17, 19, 21, 23)
    assert ant.positions == (0, 1, 2, 6, 7, 8, 10, 12, 14, 16, 18, 20, 22, 24, 25, 26, 27)


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("gym:MountainCarContinuous-v0", {"observe": [0]}),
        ("gym:Pendulum-v1", {"g": 9.81, "max_episode_steps": 50}),
        pytest.param("hopper-v", {}, marks=pytest.mark.extra),
        pytest.param("walker2d", {"observe": "positions"}, marks=pytest.mark.extra),
        ("pendulum-p", {"observe": [1]}),
        ("cartpole", {"observe": (0, 3)}),
        ("pendulum-v", {"mass": 2.0}),
    ],
)
def test_a_task_is_made_again_from_its_description(name, given):
    if name[:6] in ("hopper", "walker"):
        pytest.importorskip("pybullet_envs_gymnasium")
    task = tasks.make(name, **given)
    said = tasks.describe(task)
    again = tasks.make(said["task"], said["observe"], **said["constants"])
    assert tasks.describe(again) == said
    assert again.spec == task.spec
    assert getattr(again, "indices", None) == getattr(task, "indices", None)


@pytest.mark.parametrize(
    ("name", "given", "phrase"),
    [
        ("gym:Pendulum-v0", {}, "did you mean gym:Pendulum-v1?"),
        ("gym:MountainCarContinous-v0", {}, "did you mean gym:MountainCarContinuous-v0?"),
        ("MountainCarContinous-v0", {}, "did you mean gym:MountainCarContinuous-v0?"),
        ("gym:Pendulum-v1", {"observe": [0, 2, 0]}, "observe=0 2 0 has the index 0 twice"),
        ("gym:Pendulum-v1", {"observe": 99}, "99 is not an index of the observation, which has 3 entries"),
        ("gym:Pendulum-v1", {"max_episode_steps": True}, "max_episode_steps=True is impossible"),
        ("gym:Nothing-v0", {}, "Gymnasium has no environment 'Nothing-v0'"),
        ("gym:", {}, "Gymnasium has no environment ''"),
        ("gym:no_such_module:Robot-v0", {}, "no_such_module"),
        ("gym:Pendulum-v1", {"observe": [3]}, "give indices from 0 to 2"),
        ("gym:Pendulum-v1", {"observe": ["x"]}, "observe=x cannot be understood"),
        ("gym:CartPole-v1", {"observe": "velocities"}, "does not define which"),
        ("pendulum-v", {"observe": "velocities"}, "does not define which"),
        ("gym:Pendulum-v1", {"max_episode_steps": 0}, "max_episode_steps=0 is impossible"),
        ("hoper-v", {}, "did you mean hopper-v?"),
    ],
)
def test_a_task_that_cannot_be_made_is_a_sentence(name, given, phrase):
    with pytest.raises(UserError) as error:
        tasks.make(name, **given)
    assert phrase in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("name", "extra"), [("hopper", "robots"), ("gym:Hopper-v5", "mujoco")])
def test_without_the_extra_there_is_the_command_to_install_it(name, extra, monkeypatch):
    for module in ("pybullet_envs_gymnasium", "mujoco", "gymnasium.envs.mujoco", "gymnasium.envs.mujoco.hopper_v5"):
        monkeypatch.setitem(__import__("sys").modules, module, None)
    with pytest.raises(UserError, match=rf"pip install 'beliefrl\[{extra}\]'"):
        _ = tasks.make(name).spec


def test_an_environment_of_ones_own_is_never_recorded_as_one_of_our_tasks():
    def pendulum():
        return Fine()

    pendulum.__qualname__ = "pendulum"
    assert not tasks.knows(tasks.describe(GymnasiumTask(pendulum))["task"])


def test_a_selection_of_a_selection_is_recorded_as_entries_of_the_full_observation():
    robot = GymnasiumTask(_Registered("any"), "hopper-v", indices=catalogue.ROBOTS["hopper"].velocities)
    one = dataclasses.replace(robot, indices=(robot.indices[1],))  # as observe=[1] does
    assert tasks.describe(one)["task"] == "hopper"
    assert tasks.describe(one)["observe"] == [4]
    assert tasks.describe(robot)["task"] == "hopper-v"
    twice = tasks.observe(tasks.make("pendulum", observe=[2, 0]), (0,))
    assert tasks.entries(twice) == (2,)
    recorded = tasks.describe(twice)
    assert tasks.entries(tasks.make(recorded["task"], observe=recorded["observe"])) == (2,)


@pytest.mark.extra
@pytest.mark.parametrize("known", catalogue.ROBOTS, ids=str)
def test_robots_have_the_observations_of_their_masks(known):
    robot = catalogue.ROBOTS[known]
    pytest.importorskip({"robots": "pybullet_envs_gymnasium", "mujoco": "mujoco"}[robot.extra])
    assert sorted(robot.velocities + robot.positions) == list(range(len(robot.velocities + robot.positions)))
    size = len(robot.velocities) + len(robot.positions)
    assert tasks.make(known).spec.obs_dim == size
    assert tasks.make(f"{known}-v").spec.obs_dim == len(robot.velocities)
    assert tasks.make(f"{known}-p").environment().reset(seed=0)[0].shape == (len(robot.positions),)


MUJOCO = {f"gym:{known.id}": known for known in catalogue.GYMNASIUMS if known.extra}
MUJOCO |= {name: robot for name, robot in catalogue.ROBOTS.items() if robot.extra == "mujoco"}


@pytest.mark.extra
@pytest.mark.parametrize("name", MUJOCO)
def test_velocities_of_mujoco_are_the_simulators(name):
    pytest.importorskip("mujoco")
    pytest.importorskip("imageio")
    known, environment = MUJOCO[name], tasks.make(name).environment()
    environment.reset(seed=0)
    obs = environment.step(np.full(environment.action_space.shape, 0.3, np.float32))[0]
    assert len(obs) == len(known.velocities) + len(known.positions)
    velocities = environment.inner.unwrapped.data.qvel
    limit = np.abs(obs).max() if known.id == "Ant-v5" else 10.0  # others are clipped
    np.testing.assert_allclose(obs[list(known.velocities)], np.clip(velocities, -limit, limit), rtol=1e-5)


def test_an_environment_is_one_that_others_can_use():
    environment = GymnasiumTask(Fine).environment()
    assert isinstance(environment, gymnasium.Env)
    assert environment.observation_space.shape == BOX.shape
    assert environment.action_space == spaces.Box(-1.0, 1.0, (1,), np.float32)


def test_a_measure_keeps_the_value_that_was_reported_last():
    class Reports(Fine):
        def step(self, action):
            *result, _ = super().step(action)
            return *result, {"is_success": True, "distance": 0.5} if self.time == 3 else {}

    environment = GymnasiumTask(Reports, measures=("success", "distance")).environment()
    environment.reset(seed=0)
    seen = [environment.step(np.zeros(1))[-1] for _ in range(5)]
    assert [each["success"] for each in seen] == [0, 0, 1, 1, 1]
    assert [each["distance"] for each in seen] == [0, 0, 0.5, 0.5, 0.5]
    environment.reset(seed=0)
    assert environment.step(np.zeros(1))[-1] == {"success": 0, "distance": 0}


def test_a_measure_may_be_in_the_info_of_the_reset():
    class Drawing(Fine):
        mass = 0.5

        def reset(self, *, seed=None, options=None):
            obs, _ = super().reset(seed=seed)
            self.mass += 1.0
            return obs, {"mass": self.mass}

    environment = GymnasiumTask(Drawing, measures=("mass",)).environment()
    for mass in (1.5, 2.5):
        environment.reset(seed=0)
        seen = [environment.step(np.zeros(1))[-1] for _ in range(10)]  # a whole episode
        assert seen == [{"mass": mass}] * 10


@pytest.mark.parametrize(
    ("info", "expected"),
    [
        ({"is_success": None, "success": True}, 1.0),
        ({"is_success": False, "success": True}, 0.0),
        ({"is_success": np.nan, "success": None}, None),
        (None, None),
    ],
)
def test_the_success_is_the_first_number_of_its_two_names(info, expected):
    assert measure_of(info, "success") == expected


@pytest.mark.parametrize("name", ["step", "kind", "return", "length", "mean", "sem", "seeds", "seeds_height"])
def test_a_measure_cannot_replace_a_number_of_the_library(name):
    with pytest.raises(UserError, match=f"a measure '{name}', which every run has: choose another name"):
        GymnasiumTask(Fine, measures=(name,))


def test_an_environment_may_change_the_array_of_its_action():
    seen = []

    class Halving(Fine):
        def step(self, action):
            seen.append(float(action[0]))
            action *= 0.5
            return super().step(action)

    environment = GymnasiumTask(Halving, steps_per_action=3).environment()
    environment.reset(seed=0)
    environment.step(np.array([0.5], np.float32))
    assert seen == [4.0, 4.0, 4.0]


def test_an_explicit_name_of_ours_is_not_recorded_as_our_task():
    assert GymnasiumTask(Fine, "pendulum").name == "wrong:pendulum"
    assert tasks.make("gym:Pendulum-v1").name == "gym:Pendulum-v1"


def test_the_exit_of_an_environment_that_is_made_is_one_sentence():
    def leave():
        raise SystemExit("no robot found")

    with pytest.raises(UserError, match="cannot be made: SystemExit: no robot found"):
        _ = GymnasiumTask(leave).spec


@pytest.mark.parametrize(
    ("space", "obs"),
    [
        (spaces.Box(0, 255, (2,), np.uint8), [300.0, -1.0]),
        (spaces.Box(0, 255, (2,), np.uint8), [0.5, 1.0]),
        (spaces.Box(0, 255, (2,), np.uint8), [np.nan, 1.0]),
        (spaces.Box(-1.0, 1.0, (2,), np.float32), [0.1, 0.2, 0.3]),
        (spaces.Box(-1.0, 1.0, (2,), np.float32), ["0.1", "0.2"]),
    ],
)
def test_a_part_of_an_observation_is_not_cast_to_its_space(space, obs):
    class Parts(Fine):
        observation_space = spaces.Dict({"a": space, "b": BOX})

        def observe(self):
            return {"a": obs, "b": np.ones(2 if len(obs) == 2 else 1, np.float32)}

    with pytest.raises(UserError, match="the observation does not fit its space"):
        GymnasiumTask(Parts).environment().reset(seed=0)


def test_integers_in_a_part_may_have_another_type():
    class Parts(Fine):
        observation_space = spaces.Dict({"a": spaces.Box(0, 255, (2,), np.uint8)})

        def observe(self):
            return {"a": [3, 200]}

    np.testing.assert_array_equal(GymnasiumTask(Parts).environment().reset(seed=0)[0], [3, 200])


def test_bounds_whose_distance_is_not_finite_are_no_bounds():
    largest = np.finfo(np.float64).max
    space = spaces.Box(-largest, largest, (1,), np.float64)
    with pytest.raises(UserError, match="unbounded actions"):
        _ = GymnasiumTask(spaced(action_space=space)).spec


def test_what_an_environment_says_when_it_is_made_is_seen(tmp_path, monkeypatch, capfd):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "talking.py").write_text(
        "import gymnasium\n"
        "from wrong import Fine\n"
        "class Talking(Fine):\n"
        "    def __init__(self):\n"
        "        print('turn the robot on', flush=True)\n"
        "        super().__init__()\n"
        "gymnasium.register('Talking-v0', Talking)\n"
        "print('imported', flush=True)\n"
    )
    _ = tasks.make("gym:talking:Talking-v0").spec
    assert capfd.readouterr().out.split("\n")[:2] == ["imported", "turn the robot on"]
