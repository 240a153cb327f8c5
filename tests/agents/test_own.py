"""Agents that are not in this library: found by a class's name or an entry point, and made again from a record."""

import dataclasses
import json
import pathlib
from collections.abc import Callable
from functools import partial

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from beliefrl import agents, catalogue
from beliefrl.agents import hyperparameters, named
from beliefrl.agents.predictive_sac import PredictiveSACAgent
from beliefrl.agents.sac_mlp import SACMLPAgent
from beliefrl.agents.vrm import VRMAgent
from beliefrl.errors import UserError
from beliefrl.policy import Policy
from beliefrl.tasks.environment import TaskEnvironment
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import host_loop, phases
from beliefrl.training.lockstep import Lockstep
from beliefrl.types import tuples
from beliefrl.viewing.episodes import Player
from worlds import Counting, CountingAgent, installed

OWN = "worlds:CountingAgent"


def small(value):
    return value


@dataclasses.dataclass(frozen=True)
class Rates:
    fast: float = 0.1
    slow: float = 0.01


@dataclasses.dataclass(frozen=True)
class Rich(CountingAgent):
    """Hyperparameters that JSON has otherwise, or not at all."""

    layers: tuple[tuple[int, int], ...] = ((3, 2), (4, 1))
    rates: Rates = Rates()
    activation: Callable = small
    doubled: int = dataclasses.field(init=False, default=0)

    def __post_init__(self):
        object.__setattr__(self, "doubled", 2 * self.cycle)


@dataclasses.dataclass(frozen=True)
class Demanding(CountingAgent):
    size: int = dataclasses.field(kw_only=True)

    def __post_init__(self):
        if self.size < 0:
            raise ValueError("size is below 0")


@dataclasses.dataclass
class Thawed:
    pass


def recorded(agent):
    return json.loads(json.dumps(hyperparameters.of(agent), default=str))


def test_an_agent_is_made_by_the_path_of_its_class():
    assert agents.make(OWN, cycle=6) == CountingAgent(cycle=6)
    assert agents.make(OWN) == CountingAgent()
    assert agents.name_of(CountingAgent()) == OWN
    assert agents.name_of(agents.make("beliefrl.agents.sac_mlp:SACMLPAgent")) == "sac-mlp"


@pytest.mark.parametrize(
    ("name", "phrase"),
    [
        ("worlds:Counting", r"worlds:Counting is no agent: it lacks step_start_rl.*init"),
        ("worlds:CountingState", r"worlds:CountingState is no agent: make it a frozen dataclass"),
        ("worlds:Nothing", "no class worlds:Nothing"),
        ("nowhere:Agent", "The module nowhere cannot be imported"),
        ("nowhere", r"no agent 'nowhere': there is vrm.*MODULE:CLASS"),
    ],
)
def test_what_is_no_agent_is_one_sentence(name, phrase):
    with pytest.raises(UserError, match=phrase):
        agents.make(name)


def test_a_dataclass_that_is_not_frozen_is_no_agent():
    with pytest.raises(UserError, match="Thawed is no agent: make it a frozen dataclass"):
        agents.check_class(Thawed)


def test_mistakes_in_hyperparameters_are_sentences():
    with pytest.raises(UserError, match=r"CountingAgent has no hyperparameter 'cycel': did you mean cycle\?"):
        agents.make(OWN, cycel=3)
    with pytest.raises(UserError, match=r"Demanding has no default for size"):
        hyperparameters.build(Demanding, {})
    with pytest.raises(UserError, match=r"cannot be made with its hyperparameters: ValueError: size is below 0\."):
        hyperparameters.build(Demanding, {"size": -1})


@pytest.mark.parametrize("agent", [CountingAgent(cycle=6), Rich(cycle=6), Demanding(size=3), VRMAgent(d_size=4)])
def test_an_agent_is_restored_from_its_record(agent):
    assert hyperparameters.restored(type(agent), recorded(agent)) == agent
    other = dataclasses.replace(agent, step_start_rl=99)
    assert hyperparameters.restored(other, recorded(agent)) == agent
    assert hash(hyperparameters.restored(other, recorded(agent))) == hash(agent)


def test_what_a_record_lacks_has_the_value_from_before_it_existed():
    record = recorded(named("predictive-sac"))
    for newer in ("normalise_critics", "lr_model_min", "pessimism", "critic_likelihood", "observation_memory"):
        del record[newer]
    made = hyperparameters.restored(PredictiveSACAgent, record)
    assert (made.normalise_critics, made.pessimism, made.critic_likelihood) == (False, 1.0, 0.0)
    assert made.observation_memory == ()
    assert made.lr_model_min >= made.lr_model  # the learning rate is constant
    for name, values in agents.before().items():
        assert values.keys() <= hyperparameters.of(named(name)).keys()
        hyperparameters.build(named(name), tuples(values))  # they are possible


def test_dataclasses_in_an_agent_are_restored_and_functions_kept():
    agent = Rich(rates=Rates(fast=0.5))
    made = hyperparameters.restored(Rich(activation=abs), recorded(agent))
    assert made == dataclasses.replace(agent, activation=abs)


def test_whose_class_a_name_is_of():
    assert agents.is_of(CountingAgent, OWN)
    assert agents.is_of(CountingAgent, "__main__:CountingAgent")
    assert agents.is_of(VRMAgent, "vrm-single")
    assert not agents.is_of(Rich, OWN)
    assert not agents.is_of(SACMLPAgent, "vrm")
    assert not agents.is_of(CountingAgent, "unheard-of")


def test_an_entry_point_is_an_agents_name(tmp_path, monkeypatch):
    installed(tmp_path, monkeypatch, "beliefrl.agents", counting=OWN, vrm=OWN, broken="nowhere:Agent")
    assert catalogue.agent_names()["counting"].startswith(OWN)
    assert catalogue.agent_names()["vrm"] != catalogue.agent_names()["counting"]
    assert agents.make("counting", cycle=6) == CountingAgent(cycle=6)
    assert agents.name_of(CountingAgent()) == "counting"
    assert agents.is_of(CountingAgent, "counting")
    assert agents.is_of(CountingAgent, OWN)
    assert isinstance(agents.make("vrm"), VRMAgent)
    with pytest.raises(UserError, match=r"broken, an entry point beliefrl\.agents .* is broken: The module nowhere"):
        agents.make("broken")
    with pytest.raises(UserError, match=r"no agent 'countin': did you mean counting\?"):
        agents.make("countin")


def test_entry_points_are_not_read_for_what_is_ours(monkeypatch):
    def read(*_):
        raise AssertionError("They were read.")

    monkeypatch.setattr("beliefrl.agents.declared", read)
    monkeypatch.setattr("beliefrl.agents.declared_name", read)
    assert agents.name_of(agents.make("vrm-single")) == "vrm-single"


# Whoever runs an episode gives the agent an empty memory at its first timestep, even where that is not zeros.

ENDS = 4


@dataclasses.dataclass(frozen=True)
class Paying(Counting):
    """Pays what is done."""

    def step(self, state, action, key):
        state, obs, _, terminated = super().step(state, action, key)
        return state, obs, action[0], terminated


@dataclasses.dataclass(frozen=True)
class Checking(CountingAgent):
    """Does 1 where its memory is the count of this episode, else -1; looks at is_first nowhere."""

    def act(self, state, memory, step, key, explore):
        right = memory == self.empty + step.obs[0]
        return jnp.where(right, 1.0, -1.0)[None], memory + 1


AGENT, TASK = Checking(), Paying(ends=ENDS)
STATE = AGENT.init(jax.random.key(0), TASK.spec)
HOSTED = GymnasiumTask(TaskEnvironment, "paying", {"task": TASK}, max_steps=TASK.max_steps)
KEYS = jax.random.split(jax.random.key(0), 2)


@pytest.fixture(params=["compiled", "host"])
def program(request):
    if request.param == "compiled":
        yield phases.compile_program(AGENT, TASK, 60, 3)
    else:
        program = host_loop.program(AGENT, HOSTED, 60, 3, range(2), partial(Lockstep, HOSTED))
        yield program
        program.close()


def test_in_training_after_it_was_refreshed_and_in_evaluation(program):
    seeds = program.begin(KEYS)
    seeds, explored = program.explore(seeds, 0, 10)  # ends within an episode
    seeds = program.refresh(seeds)
    seeds, learned = program.learn(seeds, 10, 5)
    for episodes in (explored.episodes, learned.episodes):
        done = np.asarray(episodes.done)
        assert done.sum() >= 4
        np.testing.assert_array_equal(np.asarray(episodes.episode_return)[done], ENDS)
    result = program.evaluate(seeds.state, KEYS)
    np.testing.assert_array_equal(result.episode_return, np.full((2, 2, 3), ENDS))


def counts(policy, arguments):
    """The actions of two episodes of three timesteps each."""
    state, actions = policy.initial_state(1), []
    for time in (0, 1, 2, 0, 1, 2):
        obs, reward = np.full((1, 1), time, np.float32), np.zeros(1, np.float32)
        action, state = arguments(obs, reward, state, np.array([time == 0]))
        actions.append(float(action[0, 0]))
    return actions


def test_in_a_policy_and_in_its_export(tmp_path):
    policy = Policy(AGENT, TASK.spec, STATE)
    assert counts(policy, policy.predict) == [1.0] * 6
    policy.export(tmp_path / "policy.jax")
    exported = jax.export.deserialize(pathlib.Path(tmp_path / "policy.jax").read_bytes())
    assert counts(policy, lambda *inputs: exported.call(*inputs, np.uint32(0), np.bool_(True))) == [1.0] * 6


@pytest.mark.parametrize("task", [TASK, HOSTED], ids=["compiled", "host"])
def test_in_episodes_that_are_shown(task):
    with Player(AGENT, task, STATE) as player:
        assert [player.play(seed).total for seed in range(2)] == [ENDS, ENDS]
