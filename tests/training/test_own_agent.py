"""A run of a user's own agent is read as one of ours is, where the user says which class it is of."""

import dataclasses
import json
import sys
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import beliefrl
from beliefrl import cli
from beliefrl.agents.vrm import VRMAgent
from beliefrl.analysis.figures import curve_figure
from beliefrl.analysis.tables import parameters
from beliefrl.errors import UserError
from beliefrl.models.nets import Gaussian
from beliefrl.runs import arrays
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import phases
from beliefrl.training.restore import agent_of
from beliefrl.types import perception, plain
from worlds import Counter, Counting, CountingAgent

OPTIONS = {"steps": 20, "eval_every": 20, "eval_episodes": 1, "checkpoint_steps": 10}


@dataclasses.dataclass(frozen=True)
class Foreteller(CountingAgent):
    """Predicts what it perceives, exactly."""

    predictors = ("memory",)

    def predict(self, state, model, step, seen, key):
        x = perception(step)
        return Gaussian(x, jnp.zeros_like(x))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own") / "run"
    return beliefrl.train(Foreteller(cycle=2, cycle_windows=8), "pendulum-p", folder, **OPTIONS)


def test_it_is_recorded_by_the_path_of_its_class(run):
    assert run.config["agent"] == f"{__name__}:Foreteller"
    assert run.config["hyperparameters"]["cycle"] == 2


@pytest.mark.parametrize("agent", [Foreteller, Foreteller(cycle=4)], ids=["class", "instance"])
def test_it_gets_the_hyperparameters_of_the_run(run, agent):
    assert agent_of(run, agent) == Foreteller(cycle=2)


def test_a_run_that_was_given_a_number_of_numpy_is_read_and_resumed(tmp_path):
    agent = CountingAgent(cycle=np.int64(2))
    run = beliefrl.train(agent, "pendulum-p", tmp_path / "run", **OPTIONS)
    assert run.config["hyperparameters"]["cycle"] == 2
    assert beliefrl.evaluate(run, 1, agent=CountingAgent)["episodes"] == 1
    assert beliefrl.resume(run, 30, agent=CountingAgent).results()["step"] == 30


def test_what_is_no_number_is_recorded_as_text():
    given = {"kind": np.float32, "few": np.arange(2), "wide": np.longdouble(0.5), "one": np.bool_(True), "path": ("a",)}
    recorded = {"kind": "<class 'numpy.float32'>", "few": [0, 1], "wide": 0.5, "one": True, "path": ["a"]}
    assert plain(given) == recorded


def test_whatever_reads_a_run_takes_it(run, tmp_path):
    assert beliefrl.evaluate(run, 2, agent=Foreteller)["episodes"] == 2
    policy = beliefrl.load(run, agent=Foreteller())
    np.testing.assert_array_equal(policy.predict(np.zeros(2))[0], [0.5])
    trajectory = beliefrl.play(run, steps=3, agent=Foreteller)
    np.testing.assert_array_equal(trajectory.steps.prev_action[1:], 0.5)
    assert len(beliefrl.video(run, tmp_path / "film.gif", steps=3, agent=Foreteller)) == 1
    assert beliefrl.film([run], tmp_path / "strip.png", steps=3, agent=Foreteller).exists()
    predicted = beliefrl.predictions(run, start=2, horizon=3, samples=2, agent=Foreteller)
    np.testing.assert_array_equal(predicted.errors()[1], 0.0)


@pytest.mark.slow
def test_it_is_resumed(run, tmp_path):
    folder = tmp_path / "run"
    before = beliefrl.train(Foreteller(), "pendulum-p", folder, **OPTIONS)
    assert beliefrl.resume(before, 30, agent=Foreteller).results()["step"] == 30


@dataclasses.dataclass(frozen=True)
class Shaped(Foreteller):
    shape: Any = None
    scale: float = 1.0


@pytest.mark.slow
def test_one_with_a_function_is_resumed_and_its_numbers_are_compared(tmp_path):
    folder = tmp_path / "run"
    beliefrl.train(Shaped(shape=lambda reward: reward), "pendulum-p", folder, **OPTIONS)
    again = Shaped(shape=lambda reward: 2 * reward)
    resumed = beliefrl.train(again, "pendulum-p", folder, resume=True, **OPTIONS | {"steps": 30})
    assert resumed.results()["step"] == 30
    with pytest.raises(UserError, match=r"was trained with scale=1\.0, not 2\.0"):
        beliefrl.train(dataclasses.replace(again, scale=2.0), "pendulum-p", folder, resume=True, **OPTIONS)


def test_an_oserror_of_a_callback_is_not_one_of_the_run(tmp_path):
    def fails(event):
        raise FileNotFoundError("mine.txt")

    with pytest.raises(FileNotFoundError, match=r"^mine\.txt$"):
        beliefrl.train(Foreteller(), "pendulum-p", tmp_path / "run", callback=fails, **OPTIONS)


def test_a_diverged_seed_is_null_in_json(run, monkeypatch, capsys):
    monkeypatch.setattr("beliefrl.training.evaluation.evaluate", lambda *_, **__: {"mode": {"mean": float("nan")}})
    cli.main(["evaluate", str(run.folder), "--json"])
    assert json.loads(capsys.readouterr().out, parse_constant=pytest.fail) == {"mode": {"mean": None}}


def readers(run, tmp_path):
    return [
        lambda **given: beliefrl.resume(run, **given),
        lambda **given: beliefrl.evaluate(run, **given),
        lambda **given: beliefrl.load(run, **given),
        lambda **given: beliefrl.play(run, **given),
        lambda **given: beliefrl.predictions(run, **given),
        lambda **given: beliefrl.video(run, tmp_path / "film.gif", **given),
        lambda **given: beliefrl.film([run], tmp_path / "strip.png", **given),
    ]


def test_without_it_one_sentence_says_what_to_give(run, tmp_path):
    for read in readers(run, tmp_path):
        with pytest.raises(
            UserError, match=r"was trained by \S+:Foreteller: give --agent \S+:Foreteller, or in Python"
        ):
            read()


@pytest.mark.parametrize("agent", [CountingAgent, VRMAgent()], ids=["another", "ours"])
def test_an_agent_of_another_class_is_one_sentence(run, tmp_path, agent):
    for read in readers(run, tmp_path):
        with pytest.raises(UserError, match=r"was trained by \S+:Foreteller, not by \S+: give that agent"):
            read(agent=agent)


def test_ours_may_be_given_too(tmp_path):
    config = {"agent": "vrm-single", "hyperparameters": {"d_size": 8}, "task": "pendulum", "constants": {}}
    (tmp_path / "config.json").write_text(json.dumps(config | {"options": {"seed": 0, "seeds": 1}}))
    assert agent_of(beliefrl.Run(tmp_path), VRMAgent) == VRMAgent(models="single", d_size=8)


@pytest.fixture
def altered(run, tmp_path):
    """Writes a folder with the run's config in which something is changed."""

    def write(**changes):
        (tmp_path / "config.json").write_text(json.dumps(run.config | changes))
        return beliefrl.Run(tmp_path)

    return write


def test_a_class_without_a_recorded_field_is_one_sentence(altered):
    with pytest.raises(
        UserError, match=r"config\.json.* cannot be used: .* has no hyperparameter 'colour': it has step"
    ):
        agent_of(altered(hyperparameters={"colour": 1}), Foreteller)


def test_what_is_no_agent_is_one_sentence(run, unchecked):
    with pytest.raises(UserError, match="str is no agent: make it a frozen dataclass"):
        agent_of(run, "Foreteller")  # pyright: ignore[reportArgumentType]


def test_what_only_a_run_names_is_never_imported(altered, tmp_path, monkeypatch):
    (tmp_path / "trap.py").write_text("raise AssertionError('It was imported.')")
    monkeypatch.syspath_prepend(str(tmp_path))
    run = altered(agent="trap:Agent")
    for read in readers(run, tmp_path):
        with pytest.raises(UserError, match="was trained by trap:Agent: give --agent trap:Agent"):
            read()
        with pytest.raises(UserError, match="was trained by trap:Agent, not by"):
            read(agent=Foreteller)
    assert "trap" not in sys.modules


def test_a_message_quotes_a_name_without_its_control_characters(altered):
    with pytest.raises(UserError) as raised:
        agent_of(altered(agent="trap\x1b[31m:Agent"))
    assert str(raised.value).isprintable()


# What of an agent's state is saved and counted: its networks, whatever its fields are called.


class OwnState(NamedTuple):
    optimiser_network: Any  # a network, although its name says otherwise
    opt_state: Any


class OwnAgent(CountingAgent):
    def init(self, key, spec):
        return OwnState(jnp.ones(7), jnp.ones(1000))

    def networks(self, state):
        return state._replace(opt_state=())


def test_only_the_networks_of_an_agent_are_saved_and_counted(tmp_path):
    options = {"steps": 4, "seeds": 2, "eval_every": 4, "eval_episodes": 1}
    run = beliefrl.train(OwnAgent(), Counting(), tmp_path / "run", **options)
    assert set(arrays.load(run.folder / "agent.safetensors")) == {".optimiser_network"}
    assert parameters(run) == 7


# Which metrics end a seed, and that no two share a name.


class Undefined(CountingAgent):
    """Returns a metric that is NaN."""

    def update(self, state, batch, key):
        return state, {"ratio": jnp.array(jnp.nan), "count": jnp.ones(())}


class Diverging(Undefined):
    losses: ClassVar = ("ratio",)


SHORT = {"steps": 14, "seeds": 1, "eval_every": 14, "eval_episodes": 1}


@pytest.mark.nightly
def test_a_metric_that_is_no_loss_may_be_undefined_and_a_loss_may_not(tmp_path):
    run = beliefrl.train(Undefined(), Counting(), tmp_path / "undefined", **SHORT)
    (row,) = run.rows(0, "update")
    assert row["count"] == 1
    assert "ratio" not in row
    with pytest.raises(UserError, match=r"All seeds have diverged; .*ratio is not finite"):
        beliefrl.train(Diverging(), Counting(), tmp_path / "diverging", **SHORT)


class Twice(CountingAgent):
    def begin_cycle(self, state, windows, key):
        state, batches, _ = super().begin_cycle(state, windows, key)
        return state, batches, {"valid": jnp.zeros(())}


def test_two_metrics_of_one_name_are_refused():
    agent = Twice()
    seed = phases.begin(agent, Counting(), 100, jax.random.key(0))
    with pytest.raises(UserError, match="both return a metric 'valid'"):
        jax.eval_shape(lambda seed: phases.learn_round(agent, seed, jnp.array(10)), seed)


# What a task measures of an episode goes everywhere by itself.


class Walk(Counting):
    """Counts its steps as metres."""

    @property
    def spec(self):
        return super().spec._replace(measures=("success", "metres"))

    def measures(self, state):
        return super().measures(state) | {"metres": state}


class WalkingEnvironment(Counter):
    """The same in Gymnasium; its info has the metres at every other step."""

    def step(self, action):
        *step, info = super().step(action)
        return *step, info | ({"metres": self.steps} if self.steps % 2 else {})


WALKING = GymnasiumTask(WalkingEnvironment, max_steps=7, measures=("metres",))


@pytest.mark.parametrize("task", [Walk(), pytest.param(WALKING, marks=pytest.mark.nightly)])
def test_a_measure_is_logged_evaluated_shown_and_drawn(task, tmp_path, capsys):
    options = {"steps": 14, "seeds": 2, "eval_every": 7, "eval_episodes": 2}
    run = beliefrl.train(CountingAgent(), task, tmp_path / "run", **options)
    assert [row["metres"] for row in run.rows(0, "episode")] == [7.0, 7.0]
    assert [row["sampled_metres"] for row in run.rows(1, "evaluation")] == [[7.0, 7.0]] * 2
    assert run.results()["mode"]["metres"] == 7.0
    assert run.results()["mode"]["seeds_metres"] == [7.0, 7.0]
    printed = capsys.readouterr().out
    assert "metres 7 sampled, 7 mode" in printed
    assert "metres" in [axis.get_ylabel() for axis in curve_figure(run).axes]


def test_a_task_that_does_not_return_its_measures_is_refused(tmp_path):
    class Less(Walk):
        def measures(self, state):
            return {"metres": state}

    class Length(Walk):
        @property
        def spec(self):
            return super().spec._replace(measures=("length",))

        def measures(self, state):
            return {"length": state}

    for task, error in ((Less(), "so return these"), (Length(), "choose another name")):
        with pytest.raises(UserError, match=error):
            beliefrl.train(CountingAgent(), task, tmp_path / "run", steps=7, progress=False)
    task = GymnasiumTask(Counter, max_steps=7, measures=("metres",))
    with pytest.raises(UserError, match="has a number 'metres', which the task measures"):
        beliefrl.train(CountingAgent(), task, tmp_path / "other", steps=7, progress=False)
