"""Agents: what learns. A new agent is one file and one line in `catalogue.AGENTS`, or a user's class (`find_class`)."""

import dataclasses
import functools
import json
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Key

from beliefrl import catalogue
from beliefrl.agents.hyperparameters import build
from beliefrl.catalogue import AGENT_GROUP as GROUP
from beliefrl.catalogue import agent_names as names  # noqa: F401 - agents.names
from beliefrl.imports import declared, declared_name, is_named, load, load_declared, path
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
        """Number of windows that `pretrain` is given."""
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
        """The empty memory of one actor: arrays, not necessarily zeros.

        The caller passes it to `act` at the first timestep.
        """
        ...

    def act(
        self, state: Any, memory: Any, step: Timestep, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> tuple[Float[Array, " action"], Any]:
        """Perceive a timestep; returns the action (a sample, or the mode where not `explore`) and the new memory.

        Where `step.is_first`, `memory` is already that of `reset`: this method need not look at `is_first` for it.
        """
        ...

    def note(self, memory: Any) -> Any:
        """What the replay stores with a timestep, given the memory after it."""
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


# Every name of ours, and the agent with the hyperparameters that the name stands for.
AGENTS: dict[str, Any] = {name: load(known.path)(**known.hyperparameters) for name, known in catalogue.AGENTS.items()}


@functools.cache
def defaults() -> dict[str, dict[str, Any]]:
    """The hyperparameters of each of our agents as its name stands for them, as JSON has them."""
    return {name: json.loads(json.dumps(dataclasses.asdict(agent))) for name, agent in AGENTS.items()}


def find_class(name: str) -> type:
    """The class of the agent of that name, which may be `module:Class`.

    Pass only names that the user gave: it may import a module.

    Raises:
        UserError: no agent has that name, or the class is no agent.
    """
    if name in AGENTS:
        return type(AGENTS[name])
    if is_own(name):
        return check_class(load(name))
    catalogue.check_agent(name)
    return check_class(load_declared(GROUP, name, declared(GROUP, AGENTS)[name]))


def check_class(kind: type) -> type:
    """Check that a class is an agent's, and return it.

    Raises:
        UserError: it is no frozen dataclass, or lacks something that an agent has.
    """
    parameters = getattr(kind, "__dataclass_params__", None)
    if not (dataclasses.is_dataclass(kind) and parameters is not None and parameters.frozen):
        raise UserError(f"{path(kind)} is no agent: make it a frozen dataclass, @dataclasses.dataclass(frozen=True).")
    has = {field.name for field in dataclasses.fields(kind)} | set(dir(kind))
    lacks = [name for name in vars(Agent) if not name.startswith("_") and name not in has]
    if lacks:
        raise UserError(f"{path(kind)} is no agent: it lacks {', '.join(lacks)} (see beliefrl.Agent).")
    return kind


def find(name: str) -> Any:
    """The agent of that name with the hyperparameters that the name stands for; see `find_class`.

    Raises:
        UserError: no agent has that name, or the class is no agent or has a hyperparameter without a default.
    """
    agent = named(name)
    return build(agent, {}, name) if isinstance(agent, type) else agent


def make(name: str, /, **hyperparameters: Any) -> Agent:
    """The agent of that name; `hyperparameters` replace its defaults.

    Args:
        name: of one of ours or of an installed package, or `module:Class` for an agent of your own, which is imported.

    Raises:
        UserError: no agent has that name, it has no such hyperparameter, or a value is impossible.
    """
    return build(named(name), hyperparameters, name)


def named(name: str) -> Any:
    """What a name stands for: of ours an agent with the hyperparameters of that name, of others the class.

    Raises:
        UserError: as `find_class`.
    """
    return AGENTS[name] if name in AGENTS else find_class(name)


def name_of(agent: Agent) -> str:
    """The name under which `make` finds an agent; module:Class for one that is neither ours nor of an entry point.

    Of names that share a class (the ablations) it is the one whose own settings the agent has.
    """
    found = None
    for name, known in AGENTS.items():
        if type(agent) is type(known):
            own = [field.name for field in dataclasses.fields(known) if getattr(known, field.name) != field.default]
            if all(getattr(agent, field) == getattr(known, field) for field in own):
                found = name
    return found or declared_name(GROUP, type(agent), AGENTS) or path(type(agent))


def is_own(name: str) -> bool:
    """Whether it is `module:Class`: a user's own agent, which only a user may name."""
    return ":" in name


def is_of(kind: type, name: str) -> bool:
    """Whether agents of that name are of this class; imports nothing."""
    if name in AGENTS:
        return type(AGENTS[name]) is kind
    return is_named(kind, name) or declared_name(GROUP, kind, AGENTS) == name
