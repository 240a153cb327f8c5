"""Agents that are not in this library: found by a class's name or an entry point, and made again from a record."""

import dataclasses
import json
from collections.abc import Callable

import pytest

from beliefrl import agents
from beliefrl.agents import hyperparameters
from beliefrl.agents.sac_mlp import SACMLPAgent
from beliefrl.agents.vrm import VRMAgent
from beliefrl.types import UserError
from worlds import CountingAgent, installed

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
    assert agents.find(OWN) == CountingAgent()
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
    assert agents.names()["counting"].startswith(OWN)
    assert agents.names()["vrm"] != agents.names()["counting"]
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
