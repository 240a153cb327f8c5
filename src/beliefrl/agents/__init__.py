"""Agents: what learns. A new agent is one file and one line in `AGENTS`."""

import dataclasses
import difflib
import functools
import json
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Key

from beliefrl.agents.sac_lstm import SACLSTMAgent
from beliefrl.agents.sac_mlp import SACMLPAgent
from beliefrl.agents.slac import SLACAgent
from beliefrl.agents.vrm import VRMAgent
from beliefrl.models.nets import Gaussian
from beliefrl.types import Spec, Timestep, UserError, Window, WindowShape

Metrics = dict[str, Float[Array, ""]]


@runtime_checkable
class Agent(Protocol):
    """A frozen dataclass of hyperparameters whose methods are pure functions.

    A training explores for `step_start_rl` steps with the untrained policy, calls `pretrain` `pretrain_updates` times,
    and then goes in cycles of `cycle` steps: when these are done, `begin_cycle` once, then an `update` for each batch
    that it gave.
    """

    @property
    def step_start_rl(self) -> int: ...
    @property
    def pretrain_updates(self) -> int: ...
    @property
    def cycle(self) -> int: ...
    @property
    def window(self) -> WindowShape:
        """The windows that all of the methods below are given."""
        ...

    @property
    def losses(self) -> tuple[str, ...]:
        """The metrics that end a seed where they are not finite; `pretrain` and the updates share these names."""
        ...

    @property
    def pretrain_windows(self) -> int:
        """How many of them `pretrain` is given."""
        ...

    @property
    def cycle_windows(self) -> int:
        """How many of them `begin_cycle` is given."""
        ...

    def init(self, key: Key[Array, ""], spec: Spec) -> Any:
        """The state before training: networks and optimisers."""
        ...

    def networks(self, state: Any) -> Any:
        """The state without what only updates need: its optimisers' fields are replaced by ().

        It is what `act` and `predict` are given outside of training, what is saved as the trained agent, and what is
        counted as parameters. `state` may have leading axes.
        """
        ...

    def reset(self, spec: Spec) -> Any:
        """The empty memory of one actor."""
        ...

    def act(
        self, state: Any, memory: Any, step: Timestep, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> tuple[Float[Array, " action"], Any]:
        """Perceive a moment; returns the action (a sample, or the mode where not `explore`) and the new memory."""
        ...

    def note(self, memory: Any) -> Any:
        """What the replay shall keep of a memory beside the moment that it has just perceived."""
        ...

    def pretrain(self, state: Any, windows: Window, key: Key[Array, ""]) -> tuple[Any, Metrics]:
        """One update of the pre-training."""
        ...

    def begin_cycle(self, state: Any, windows: Window, key: Key[Array, ""]) -> tuple[Any, Any, Metrics]:
        """What is done once a cycle; the second result is a batch for every `update` to come (leading axis)."""
        ...

    def update(self, state: Any, batch: Any, key: Key[Array, ""]) -> tuple[Any, Metrics]:
        """One update of the controller."""
        ...


@runtime_checkable
class Predictive(Protocol):
    """An agent that has a model of what it perceives can be asked for its predictions; it need not."""

    @property
    def predictors(self) -> tuple[str, ...]:
        """The names of its models, the one to be asked by default first."""
        ...

    def predict(
        self, state: Any, model: str, step: Timestep, observed: Bool[Array, " time"], key: Key[Array, ""]
    ) -> Gaussian:
        """What one of its models predicts of x_t = (o_t, r_{t-1}) along an episode, leaves (time, x).

        Open loop where x_t is `observed`: latent variables are inferred from it. Closed loop elsewhere: they are drawn
        from the generative model, and x_t must not be used. Entries that the model does not predict are NaN.
        """
        ...


class Entry(NamedTuple):
    agent: Any  # with the hyperparameters that the name stands for
    about: str


def _own(agent: type) -> Entry:
    """An agent under its own name: as it is, and described by its docstring."""
    return Entry(agent(), (agent.__doc__ or "").split("\n")[0])


AGENTS: dict[str, Entry] = {
    "vrm": _own(VRMAgent),
    "sac-mlp": _own(SACMLPAgent),
    "sac-lstm": _own(SACLSTMAgent),
    "slac": _own(SLACAgent),
    "vrm-single": Entry(VRMAgent(models="single"), "Ablation: one model that is pre-trained and keeps learning."),
    "vrm-first": Entry(VRMAgent(models="first"), "Ablation: only the first-impression model."),
    "vrm-keep": Entry(VRMAgent(models="keep"), "Ablation: only the keep-learning model."),
    "vrm-deterministic": Entry(
        VRMAgent(deterministic=True), "Ablation: models without noise, trained on squared error."
    ),
}


def names() -> dict[str, str]:
    """Every agent's name with a sentence on it."""
    return {name: entry.about for name, entry in AGENTS.items()}


@functools.cache
def defaults() -> dict[str, dict[str, Any]]:
    """Every agent's hyperparameters as its name stands for them, as JSON has them."""
    return {name: json.loads(json.dumps(dataclasses.asdict(entry.agent))) for name, entry in AGENTS.items()}


def find(name: str) -> Any:
    """The agent of that name with the hyperparameters that the name stands for.

    Raises:
        UserError: no agent has that name.
    """
    if name not in AGENTS:
        near = difflib.get_close_matches(name, AGENTS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(AGENTS)}."
        raise UserError(f"There is no agent {name!r}: {hint}")
    return AGENTS[name].agent


def make(name: str, /, **hyperparameters: Any) -> Agent:
    """The agent of that name; `hyperparameters` replace its defaults.

    Raises:
        UserError: no agent has that name, it has no such hyperparameter, or a value is impossible.
    """
    agent = find(name)
    known = [field.name for field in dataclasses.fields(agent)]
    for given in hyperparameters:
        if given not in known:
            near = difflib.get_close_matches(given, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(known)}."
            raise UserError(f"The agent {name} has no hyperparameter {given!r}: {hint}")
    return dataclasses.replace(agent, **hyperparameters)


def name_of(agent: Agent) -> str:
    """The name under which `make` finds an agent; module:Class for one that is not in this library.

    Of names that share a class (the ablations) it is the one whose own settings the agent has.
    """
    found = None
    for name, (known, _) in AGENTS.items():
        if type(agent) is type(known):
            own = [field.name for field in dataclasses.fields(known) if getattr(known, field.name) != field.default]
            if all(getattr(agent, field) == getattr(known, field) for field in own):
                found = name
    return found or f"{type(agent).__module__}:{type(agent).__qualname__}"
