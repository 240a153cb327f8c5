"""What of an agent's state is saved and counted: its networks, whatever its fields are called."""

from typing import Any, NamedTuple

import jax.numpy as jnp

import beliefrl
from beliefrl.analysis.scalability import parameters
from beliefrl.runs import arrays
from worlds import Counting, CountingAgent


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
