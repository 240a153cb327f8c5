"""What `check` says of a task: names, ranges, what is refused, and what is suspicious."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeAwareObservation, TimeLimit

import beliefrl
from beliefrl import cli, tasks
from beliefrl.errors import UserError
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.types import Spec
from worlds import Counting
from wrong import BOX, UNSUPPORTED, Dictionary, Endless, Fine, spaced, with_observation

WIDE = spaces.Box(-1e6, 1e6, (2,), np.float32)


def warned(make, **task):
    """The warnings about an environment, which is not refused."""
    found = beliefrl.check(GymnasiumTask(make, "robot", **task))
    assert found.refusals == ()
    return " ".join(found.warnings)


def test_a_good_environment_has_no_warning():
    class Good(Fine):
        entry_names = ("speed (m/s)", "force (N)")

    found = beliefrl.check(GymnasiumTask(Good, "robot", indices=(1,), max_steps=10), steps=25)
    assert (found.refusals, found.warnings, found.max_steps) == ((), (), 10)
    assert (found.steps, found.episodes, found.rewards) == (25, 2, (1.0, 1.0))
    speed, force = found.entries
    assert (speed.name, speed.position, force.name, force.position) == ("speed (m/s)", None, "force (N)", 0)
    assert (speed.low, speed.high) == (-1.0, 1.0)
    assert -1.0 <= speed.seen_low < -0.5 < 0.5 < speed.seen_high <= 1.0
    assert [(action.low, action.high) for action in found.actions] == [(-2.0, 6.0)]
    assert found.steps_per_second > 0


def test_a_compiled_task_shows_what_a_mask_hides():
    found = beliefrl.check("cartpole-v")
    assert [entry.position for entry in found.entries] == [None, 0, None, 1]
    assert [entry.name for entry in found.entries] == list(tasks.entry_names(tasks.make("cartpole")))
    assert (found.task, found.max_steps, found.rewards) == ("cartpole-v", 1000, (1.0, 1.0))
    assert found.episodes > 0
    assert not found.refusals + found.warnings
    shorter = beliefrl.check("pendulum", observe="positions", max_steps=10)
    assert [entry.position for entry in shorter.entries] == [0, 1, None]
    assert shorter.episodes == 20


def test_a_faulty_task_shows_what_is_observed_of_the_whole():
    found = beliefrl.check(tasks.make("pendulum", observe=[2, 0], faults={"noise": 0.1}))
    assert [entry.position for entry in found.entries] == [1, None, 0]


def test_an_environment_that_fills_the_same_array_again_changes():
    class Same(Fine):
        obs = np.zeros(2, np.float32)

        def step(self, action):
            _, *rest = super().step(action)
            self.obs[:] = self.np_random.uniform(-1, 1, 2)
            return self.obs, *rest

        def close(self):
            raise RuntimeError("the socket is closed already")

    assert "never changed" not in warned(Same)


def test_constants_may_have_the_names_of_the_command(capsys):
    for constant in ("seed=1", "steps=2"):
        with pytest.raises(SystemExit) as ended:
            cli.main(["check", "gym:Pendulum-v1", "--constants", constant])
        assert ended.value.code == 2
        err = capsys.readouterr().err
        assert err.startswith("beliefrl: gym:Pendulum-v1")
        assert err.count("\n") == 1


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("name", "number"), [("steps", 1.5), ("steps", "3"), ("steps", 0), ("seed", -1)])
def test_another_number_than_a_whole_one_in_the_range_is_one_sentence(name, number):
    with pytest.raises(UserError, match=f"^{name}={number!r} is impossible: it must be a whole number"):
        beliefrl.check("pendulum", **{name: number})


def test_the_time_limit_of_a_compiled_task_ends_episodes():
    assert beliefrl.check(dataclasses.replace(tasks.make("pendulum"), max_steps=7), steps=21).episodes == 3
    assert beliefrl.check(Counting()).task.endswith("Counting")


@pytest.mark.parametrize("make", UNSUPPORTED, ids=lambda make: UNSUPPORTED[make])
def test_what_the_training_refuses_is_refused(make):
    try:
        found = beliefrl.check(GymnasiumTask(make, "robot"))
    except UserError as error:
        said = str(error)
    else:
        said = " ".join(found.refusals)
        assert not found.entries
        assert all(sentence in " ".join(str(found).split()) for sentence in found.refusals)
    assert UNSUPPORTED[make] in said


def test_all_refusals_are_named_at_once():
    make = spaced(action_space=spaces.Discrete(3), observation_space=spaces.Text(20))
    actions, observation = beliefrl.check(GymnasiumTask(make, "robot")).refusals
    assert "not discrete" in actions
    assert "Text" in observation


def test_a_fault_is_a_refusal_beside_what_was_seen_until_then():
    found = beliefrl.check(GymnasiumTask(with_observation(np.array([0.0, np.nan])), "robot"))
    assert found.refusals == (
        "robot (step 3): entry 1 of the observation is nan, but must be a number from -1e+15 to 1e+15.",
    )
    assert found.steps == 2
    assert found.entries[0].seen_low < found.entries[0].seen_high


def test_entries_that_do_not_exist_are_refused_beside_those_that_do():
    found = beliefrl.check("gym:Pendulum-v1", observe=[1, 1])
    assert found.refusals == ("observe=1 1 has the index 1 twice: give each index once.",)
    assert [entry.name for entry in found.entries] == ["cos θ", "sin θ", "θ̇ (rad/s)"]
    assert all(entry.position is None for entry in found.entries)


@pytest.mark.parametrize(
    ("changes", "phrase"),
    [
        ({"observe": lambda self: np.array([0.5, 3.0 + self.time])}, "Entry 1 left the declared range"),
        ({"observe": lambda self: np.array([self.time / 9.0, 0.25])}, "Entry 1 never changed"),
        ({"observe": lambda self: np.array([self.time / 9.0, self.time / 9e3])}, "Entry 1 up to 0.00111"),
        ({"observe": lambda self: np.array([self.time / 9.0, self.time / 9e3])}, "Entry 1 changed by less than 0.001"),
        (
            {"observe": lambda self: np.array([self.time, 1e5 + self.time % 2]), "observation_space": WIDE},
            "Entry 1 changed little around a large mean",
        ),
        ({"reward": lambda self: 0.0}, "The reward was always 0"),
    ],
)
def test_what_is_suspicious_is_a_warning(changes, phrase):
    assert phrase in warned(spaced(**changes), max_steps=10)
    assert phrase not in warned(Fine, max_steps=10)


def test_an_entry_that_the_agent_does_not_see_may_be_anything_but_is_mentioned():
    make = with_observation(np.array([np.nan, 0.5]))
    assert "Entry 0 had values that are not finite" in warned(make, indices=(1,), max_steps=10)


def test_an_environment_without_a_time_limit_is_suspicious_unless_it_truncates():
    assert "There is no time limit" in warned(Endless)
    assert "There is no time limit" in warned(spaced(end=lambda self: (self.time >= 10, False)))
    assert warned(Fine, max_steps=5) == warned(spaced(end=lambda self: (False, self.time >= 10))) == ""


def test_composite_observations_are_named_by_their_keys():
    class Composite(Fine):
        observation_space = spaces.Dict(
            {
                "arm": spaces.Tuple([BOX, spaces.Box(0.0, 1.0, (1,), np.float32)]),
                "grip": spaces.Discrete(2, start=5),
                "keys": spaces.MultiDiscrete([2, 1]),
                "on": spaces.MultiBinary(2),
            }
        )

    names = "arm.0 0,arm.0 1,arm.1,grip = 5,grip = 6,keys 0 = 0,keys 0 = 1,keys 1 = 0,on 0,on 1"
    assert GymnasiumTask(Composite).entry_names == tuple(names.split(","))
    assert tasks.entry_names(GymnasiumTask(Dictionary, indices=(4, 0))) == ("b = 2", "a 0")


@pytest.mark.parametrize("names", [5, None, "angle", ()])
def test_what_is_no_list_of_names_is_ignored(names):
    assert GymnasiumTask(spaced(entry_names=names)).entry_names == ("entry 0", "entry 1")


@pytest.mark.parametrize("names", [("one", 2), np.array(["one", "2"]), {"one": 0.5, "2": 0.5}.keys()])
def test_names_may_be_of_any_kind(names):
    assert GymnasiumTask(spaced(entry_names=names)).entry_names == ("one", "2")


def test_a_wrong_number_of_names_is_refused_and_the_entries_are_shown():
    found = beliefrl.check(GymnasiumTask(spaced(entry_names=("angle",)), "robot"))
    assert found.refusals == ("robot has 1 entry_names for an observation of 2: give one name for each entry.",)
    assert [entry.name for entry in found.entries] == ["entry 0", "entry 1"]


def test_a_wrapper_may_change_the_observation_and_name_its_entries():
    class Named(TimeAwareObservation):
        entry_names = ("angle", "speed", "time")

    inner = spaced(entry_names=("angle", "speed"))
    for wrapper, names in ((TimeAwareObservation, ("entry 0", "entry 1", "entry 2")), (Named, Named.entry_names)):
        task = GymnasiumTask(lambda wrapper=wrapper: wrapper(TimeLimit(inner(), 9)))
        assert task.entry_names == names
        assert task.spec.max_steps == 9
        assert "no time limit" not in " ".join(beliefrl.check(task, steps=3).warnings)


def test_names_that_cannot_be_read_are_ignored():
    class Broken(Fine):
        @property
        def entry_names(self):
            raise RuntimeError("not before reset")

    assert GymnasiumTask(Broken).entry_names == ("entry 0", "entry 1")


@pytest.mark.extra
def test_the_robots_entries_have_the_names_of_their_joints():
    pytest.importorskip("pybullet_envs_gymnasium")
    names = tasks.entry_names(tasks.make("hopper-v"))
    assert names[0] == "0.3 v_x (m/s)"
    assert names[3:] == tuple(f"0.1 {joint}_joint velocity (rad/s)" for joint in ("thigh", "leg", "foot"))


@pytest.mark.extra
def test_mujocos_entries_have_the_names_of_their_joints():
    pytest.importorskip("mujoco")
    names = tasks.entry_names(tasks.make("gym:Hopper-v5"))
    assert names[:3] == ("rootz (m)", "rooty (rad)", "thigh_joint (rad)")
    assert names[5:8] == ("rootx velocity (m/s)", "rootz velocity (m/s)", "rooty velocity (rad/s)")
    assert len(set(tasks.entry_names(tasks.make("gym:Ant-v5")))) == 105
    assert beliefrl.check("gym:Hopper-v5", steps=1).actions[0].name == "thigh_joint"


def test_the_command_prints_what_python_prints(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    cli.main(["check", "gym:Pendulum-v1", "--observe", "2", "0", "--steps", "3", "--constants", "max_episode_steps=9"])
    printed = capsys.readouterr().out
    found = beliefrl.check("gym:Pendulum-v1", observe=(2, 0), steps=3, max_episode_steps=9)
    assert "speed" in printed
    both = ([line.rstrip() for line in text.splitlines() if "speed" not in line] for text in (printed, str(found)))
    assert next(both) == next(both)
    assert "θ̇ (rad/s)" in printed
    assert "at most 9 steps" in printed


def test_the_command_shows_the_entries_and_refuses_with_one_sentence(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["check", "gym:Pendulum-v1", "--observe", "7", "--steps", "3"])
    out, err = capsys.readouterr()
    assert end.value.code == 2
    assert "sin θ" in out
    assert err == "beliefrl: 7 is not an index of the observation, which has 3 entries: give indices from 0 to 2.\n"


@dataclasses.dataclass(frozen=True)
class Broken:
    """A task in JAX; `part` says what is wrong with it."""

    part: str = ""

    @property
    def spec(self):
        measures = ("success",) if self.part == "measures" else ()
        return Spec(3, 1, None if self.part == "max_steps" else 10, measures)

    def reset(self, key):
        if self.part == "error":
            raise ValueError("no motor")
        return jnp.zeros(2), jnp.zeros(4 if self.part == "observation" else 3)

    def step(self, state, action, key):
        state = state[:1] if self.part == "state" else state
        reward = {"reward": action, "whole": jnp.int32(1)}.get(self.part, action[0])
        terminated = jnp.float32(0) if self.part == "terminated" else jnp.bool_(False)
        obs = {"scalar": jnp.zeros(()), "list": [0.0] * 3, "type": jnp.zeros(3, int)}.get(self.part, jnp.zeros(3))
        made = state, obs, reward, terminated
        return made[:3] if self.part == "three" else made


@pytest.mark.parametrize(
    ("part", "phrase"),
    [
        ("error", r"reset of .*Broken cannot be traced: ValueError: no motor"),
        (
            "observation",
            r"reset of .*Broken returns an observation that is float32 of shape \(4,\): its spec says shape \(3,\)",
        ),
        (
            "scalar",
            r"step of .*Broken returns an observation that is float32 of shape \(\): its spec says shape \(3,\)",
        ),
        ("list", r"step of .*Broken returns an observation that is no array"),
        ("type", r"step of .*Broken returns an observation that is int32 of .* must agree in type"),
        ("reward", r"step of .*Broken returns a reward that is float32 of shape \(1,\): return one float32"),
        ("whole", r"step of .*Broken returns a reward that is int32 of shape \(\): return one float32"),
        ("terminated", r"step of .*Broken returns no bool for terminated"),
        ("state", r"step of .*Broken returns a state with other shapes or types than reset"),
        ("three", r"step of .*Broken does not return \(state, observation, reward, terminated\)"),
    ],
)
def test_a_task_in_jax_that_does_not_fit_its_spec_is_refused_before_a_folder_is_made(part, phrase, tmp_path):
    assert re.search(phrase, beliefrl.check(Broken(part)).refusals[0])
    with pytest.raises(UserError, match=phrase):
        beliefrl.train("sac-mlp", Broken(part), tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()
    assert beliefrl.check(Broken()).refusals == ()


def test_a_spec_that_is_none_is_refused(tmp_path):
    class Bare(Broken):
        spec = (3, 1, 10)

    with pytest.raises(UserError, match=r"Bare\.spec is \(3, 1, 10\): give a beliefrl\.Spec"):
        beliefrl.train("sac-mlp", Bare(), tmp_path / "run", progress=False)
    for call in (beliefrl.check, lambda task: beliefrl.with_action_repeat(task, 2)):
        with pytest.raises(UserError, match=r"max_steps of Broken\.spec=None is impossible: .* of at least 1"):
            call(Broken("max_steps"))
        with pytest.raises(UserError, match=r"Broken has measures in its spec, but no method measures\(state\)"):
            call(Broken("measures"))
