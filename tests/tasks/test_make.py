"""Tasks by name: their sizes, their masks, the errors of a user, and what every task keeps to."""

import dataclasses
import math
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import tasks
from beliefrl.errors import UserError
from beliefrl.tasks import TASKS, describe, entry_names, given, make, names, observe, with_action_repeat, with_faults
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.pendulum import Pendulum
from beliefrl.tasks.target_reaching import TargetReaching
from beliefrl.types import tuples
from worlds import Counter, Counting, installed
from wrong import Fine

SIZES = {  # obs_dim, action_dim, max_steps, measures
    "pendulum": (3, 1, 200, ()),
    "pendulum-v": (1, 1, 200, ()),
    "pendulum-p": (2, 1, 200, ()),
    "cartpole": (4, 1, 1000, ()),
    "cartpole-v": (2, 1, 1000, ()),
    "cartpole-p": (2, 1, 1000, ()),
    "target-reaching": (12, 2, 128, ("success",)),
}
SEEN = {"pendulum-v": [2], "pendulum-p": [0, 1], "cartpole-v": [1, 3], "cartpole-p": [0, 2]}
KEYS = jax.random.split(jax.random.key(0), 5)


def test_the_listed_names_are_the_tasks_there_are():
    runners = ("hopper", "walker2d", "ant", "halfcheetah")
    robots = [kind + name + mask for kind in ("", "mujoco-") for name in runners for mask in ("", "-v", "-p")]
    assert list(names()) == [*SIZES, *robots]
    assert all(names().values())


@pytest.mark.parametrize("name", SIZES)
def test_sizes_and_limits(name):
    assert tuple(make(name).spec) == SIZES[name]


@pytest.mark.parametrize("name", SEEN)
def test_a_mask_hides_all_other_entries_and_changes_nothing_else(name):
    full, masked = make(name[:-2]), make(name)
    (state, obs), (masked_state, masked_obs) = full.reset(KEYS[0]), masked.reset(KEYS[0])
    np.testing.assert_array_equal(masked_obs, obs[jnp.array(SEEN[name])])
    action = jnp.array([0.3])
    _, obs, reward, terminated = full.step(state, action, KEYS[1])
    _, masked_obs, masked_reward, masked_terminated = masked.step(masked_state, action, KEYS[1])
    np.testing.assert_array_equal(masked_obs, obs[jnp.array(SEEN[name])])
    assert (masked_reward, masked_terminated) == (reward, terminated)


def test_observe_keeps_the_order_that_was_asked_for():
    task = make("target-reaching")
    some = observe(task, (11, 0, 4))
    obs, seen = jax.jit(lambda key: (task.reset(key)[1], some.reset(key)[1]))(KEYS[0])
    np.testing.assert_array_equal(seen, obs[jnp.array([11, 0, 4])])
    assert some.spec == task.spec._replace(obs_dim=3)


def test_every_entry_that_is_seen_has_the_tasks_name_for_it():
    for name, (size, *_) in SIZES.items():
        assert len(set(entry_names(make(name)))) == size
    assert entry_names(make("cartpole-v")) == ("ẋ (m/s)", "θ̇ (rad/s)")
    assert entry_names(observe(make("pendulum", (2, 0)), (1,))) == ("cos θ",)
    order = ("nearness of red", "nearness of wall ahead", "sin of bearing to red", "cos of bearing to blue")
    assert entry_names(make("target-reaching", (0, 3, 5, 10))) == order


def test_entries_without_a_name_have_their_index_in_the_full_observation():
    assert entry_names(observe(GymnasiumTask(Counter), (1,))) == ("entry 1",)
    assert entry_names(Counting()) == ("entry 0",)


class Misnamed(Counting):
    entry_names = ("count", "another")


def test_names_that_do_not_fit_the_observation_are_one_sentence():
    with pytest.raises(UserError, match="Misnamed has 2 entry_names for an observation of 1: give one name for each"):
        entry_names(Misnamed())


@pytest.mark.parametrize("indices", [(), (3,), (0, -1), (1.5,), (True,), ("1",), (10**30,)])
def test_observe_refuses_entries_that_are_not_there(indices, unchecked):
    with pytest.raises(UserError, match="indices from 0 to 2"):
        observe(make("pendulum"), indices)


def test_observe_refuses_the_same_entry_twice():
    with pytest.raises(UserError, match="observe=2 0 2 has the index 2 twice"):
        observe(make("pendulum"), (2, 0, 2))


def test_observe_does_not_round(unchecked):
    with pytest.raises(UserError, match=r"observe=1\.5 cannot be understood"):
        make("pendulum", observe=[1.5])


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("pendulm", "did you mean pendulum"),
        ("target_reaching", "did you mean target-reaching"),
        ("zzz", "beliefrl tasks"),
    ],
)
def test_an_unknown_name_gets_a_hint(name, hint):
    with pytest.raises(UserError, match=f"no task '{name}'.*{hint}"):
        make(name)


def test_a_task_without_velocities_has_no_masks():
    with pytest.raises(UserError, match="no task 'target-reaching-v'"):
        make("target-reaching-v")


@pytest.mark.parametrize("name", ["cartpole", "cartpole-v"])
def test_an_unknown_constant_is_refused_with_those_there_are(name):
    with pytest.raises(UserError, match=r"cartpole has no constant 'mass'.*cart_mass, pole_mass"):
        make(name, mass=1.0)


@pytest.mark.parametrize("name", ["pendulum", "pendulum-v"])
def test_constants_are_replaced(name):
    assert make(name, max_steps=50).spec.max_steps == 50


CONSTANTS = [(name, field) for name, task in TASKS.items() for field in dataclasses.fields(task)]


@pytest.mark.parametrize(("name", "field"), CONSTANTS, ids=lambda each: getattr(each, "name", each))
def test_a_constant_is_a_finite_number(name, field, unchecked):
    sentence = f"^{field.name}=.* is impossible: it must be .*number.* (from|of at least) "
    for value in ("abc", "nan", math.nan, math.inf, -math.inf, True, None, [], {}, 10**12, -(10**12)):
        with pytest.raises(UserError, match=sentence):
            make(name, **{field.name: value})


@pytest.mark.parametrize(
    ("name", "constants"),
    [
        ("pendulum", {"dt": 0}),
        ("pendulum-v", {"mass": -1}),
        ("pendulum", {"max_steps": 1.5}),
        ("pendulum", {"max_steps": 0}),
        ("cartpole", {"max_theta": 0.04}),  # it could begin beyond it
        ("target-reaching", {"rewards": [1, 2]}),
        ("target-reaching", {"rewards": [1, 2, "many"]}),
        ("target-reaching", {"rewards": 5}),
        ("target-reaching", {"target_square": 16}),  # larger than the field
        ("target-reaching", {"min_squared_gap": 8.1}),  # no three points in the square are so far apart
    ],
)
def test_a_constant_out_of_its_range_is_refused(name, constants, unchecked):
    (constant,) = constants
    with pytest.raises(UserError, match=f"^{constant}=.* is impossible"):
        make(name, **constants)


def test_constants_are_checked_where_the_class_is_used(unchecked):
    with pytest.raises(UserError, match=r"^mass=abc is impossible"):
        Pendulum(mass="abc")  # pyright: ignore[reportArgumentType]
    with pytest.raises(UserError, match=r"^mass=0 is impossible"):
        dataclasses.replace(Pendulum(), mass=0)


def test_a_list_of_rewards_is_a_tuple_of_the_task(unchecked):
    task = make("target-reaching", rewards=[1, 2, 3])
    assert task.rewards == (1, 2, 3)
    assert hash(task) == hash(TargetReaching(rewards=(1, 2, 3)))


@pytest.mark.parametrize("name", SIZES)
def test_tasks_can_be_compiled_and_batched(name):
    task = make(name)
    actions = jax.random.uniform(KEYS[0], (5, task.spec.action_dim), minval=-1, maxval=1)
    states, first = jax.jit(jax.vmap(task.reset))(KEYS)
    _, obs, reward, terminated = jax.jit(jax.vmap(task.step))(states, actions, KEYS)
    assert first.shape == obs.shape == (5, task.spec.obs_dim)
    assert (obs.dtype, reward.dtype, terminated.dtype) == (jnp.float32, jnp.float32, jnp.bool_)
    alone = jax.jit(task.step)(jax.jit(task.reset)(KEYS[3])[0], actions[3], KEYS[3])
    np.testing.assert_allclose(obs[3], alone[1], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(reward[3], alone[2], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "target-reaching"])
def test_a_step_keeps_the_types_of_a_state(name):
    """Else a loop over a compiled step would compile it twice."""
    task = make(name)
    before, _ = jax.eval_shape(task.reset, KEYS[0])
    after, *_ = jax.eval_shape(task.step, before, jnp.zeros(task.spec.action_dim), KEYS[0])
    assert after == before


# Tasks that installed packages declare as entry points.


@dataclasses.dataclass(frozen=True)
class Masked(Pendulum):
    VELOCITIES = [2]
    POSITIONS = [0, 1]


@pytest.fixture
def package(tmp_path, monkeypatch):
    names = {"counts": "worlds:Counting", "masked": f"{__name__}:Masked", "pendulum": "worlds:Counting"}
    names |= {"broken": "nowhere:Task", "wrong": "worlds:CountingAgent", "lost": "worlds:Nothing"}
    installed(tmp_path, monkeypatch, "beliefrl.tasks", **names)


def test_a_task_is_made_by_name_and_has_it(package):
    task = tasks.make("counts", ends=3)
    assert task == Counting(ends=3)
    assert tasks.describe(task) == {"task": "counts", "constants": {"ends": 3, "max_steps": 7}, "observe": None}
    assert tasks.knows("counts")
    assert tasks.names()["counts"].startswith("worlds:Counting")


def test_a_task_that_says_so_has_versions_with_a_part_of_the_observation(package):
    for name, indices in (("masked-v", (2,)), ("masked-p", (0, 1))):
        task = tasks.make(name)
        assert task == tasks.observe(Masked(), indices)
        assert tasks.describe(task)["task"] == name
        assert tasks.knows(name)
    assert tasks.make("masked", observe="velocities") == tasks.make("masked-v")
    with pytest.raises(UserError, match="counts does not define which entries are velocities"):
        tasks.make("counts-v")


def test_ours_are_not_hidden(package):
    assert isinstance(tasks.make("pendulum"), Pendulum)
    assert "worlds" not in tasks.names()["pendulum"]


@pytest.mark.parametrize(
    ("name", "phrase"),
    [
        ("broken", r"broken, an entry point beliefrl\.tasks of an installed package, is broken: The module nowhere"),
        ("lost", "is broken: There is no class worlds:Nothing"),
        ("wrong", "wrong, the entry point worlds:CountingAgent, is no task: it lacks spec"),
        ("countz", r"no task 'countz': did you mean counts\?"),
    ],
)
def test_a_broken_entry_point_is_one_sentence_when_it_is_used(package, name, phrase):
    with pytest.raises(UserError, match=phrase):
        tasks.make(name)


def test_an_unknown_constant_is_refused(package):
    with pytest.raises(UserError, match="The task counts has no constant 'mass': it has ends, max_steps"):
        tasks.make("counts", mass=1)


def test_entry_points_are_not_read_for_what_is_ours(monkeypatch):
    def read(*_):
        raise AssertionError("They were read.")

    monkeypatch.setattr("beliefrl.tasks.declared", read)
    monkeypatch.setattr("beliefrl.tasks.declared_name", read)
    for name in ("pendulum-v", "target-reaching"):
        assert tasks.knows(name)
        assert tasks.describe(tasks.make(name))["task"] == name


def test_a_class_of_environments_is_a_task():
    task = given(Fine)
    assert (task.make, task.name) == (Fine, "Fine")
    assert given("pendulum-v") == tasks.make("pendulum-v")
    assert given(task) is task


@pytest.mark.parametrize(
    ("wrong", "phrase"),
    [
        (Fine(), "Fine is given as one environment, but several are needed: give its class"),
        (
            gymnasium.make("Pendulum-v1"),
            r"PendulumEnv is given as one .* its name, 'gym:Pendulum-v1', or a function",
        ),
        (gymnasium.make_vec("Pendulum-v1"), r"A vector environment is not needed: give .* one environment, and envs=N"),
        (Pendulum, r"Pendulum is a class: give a task, Pendulum\(\)"),
        (None, r"None is no task: give a task \(make_task makes one from its name\), a GymnasiumTask, or a class"),
        (SimpleNamespace(spec=None), "is no task"),
    ],
)
def test_what_is_no_task_is_refused(wrong, phrase):
    with pytest.raises(UserError, match=phrase):
        given(wrong)


def test_a_class_of_environments_can_be_changed_as_it_is():
    task = GymnasiumTask(Fine)
    for change, argument in ((observe, (1,)), (with_faults, {"noise": 0.1}), (with_action_repeat, 2)):
        assert describe(change(Fine, argument)) == describe(change(task, argument))
        with pytest.raises(UserError, match="Fine is given as one environment, but several are needed: give its class"):
            change(Fine(), argument)


@pytest.mark.parametrize("make", [Fine(), "gym:Pendulum-v1"])
def test_a_gymnasium_task_needs_something_that_makes_environments(make):
    with pytest.raises(UserError, match="GymnasiumTask needs a class or function that makes environments, not"):
        GymnasiumTask.__post_init__(SimpleNamespace(make=make))  # the constructor's types are checked in tests


@pytest.mark.parametrize("measures", ["success", ["success"], ("success",)])
def test_measures_of_a_registered_environment_are_recorded_with_its_task(measures):
    task = make("gym:Pendulum-v1", measures=measures)
    assert task.measures == ("success",)
    described = describe(task)
    assert described == {"task": "gym:Pendulum-v1", "constants": {"measures": ["success"]}, "observe": None}
    assert make(described["task"], **tuples(described["constants"])).measures == ("success",)
    assert not task.arguments
