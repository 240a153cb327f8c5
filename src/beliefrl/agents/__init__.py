"""The agents. A new agent is one file and one line in `catalogue.AGENTS`, or a user's class (`find_class`)."""

import dataclasses
import functools
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Key

from beliefrl import catalogue
from beliefrl.agents.hyperparameters import build, values_before
from beliefrl.catalogue import AGENT_GROUP as GROUP
from beliefrl.imports import declared, declared_name, is_named, load, load_declared, path
from beliefrl.models.nets import Gaussian
from beliefrl.types import Spec, Timestep, UserError, Window, WindowShape, plain, short

Metrics = dict[str, Float[Array, ""]]


@runtime_checkable
class Agent(Protocol):
    """A frozen dataclass of hyperparameters whose methods are pure functions.

    A training explores for `step_start_rl` steps with the untrained policy, and calls `pretrain` `pretrain_updates`
    times. Then it makes cycles of `cycle` steps. At the end of a cycle it calls `begin_cycle` once, and `update` for
    each batch that `begin_cycle` returned.
    """

    @property
    def step_start_rl(self) -> int: ...
    @property
    def pretrain_updates(self) -> int: ...
    @property
    def cycle(self) -> int: ...
    @property
    def window(self) -> WindowShape:
        """The shape of the windows that the methods below receive."""
        ...

    @property
    def losses(self) -> tuple[str, ...]:
        """The metrics that stop a seed if they are not finite; `pretrain` and the updates share these names."""
        ...

    @property
    def pretrain_windows(self) -> int:
        """Number of windows that `pretrain` receives."""
        ...

    @property
    def cycle_windows(self) -> int:
        """Number of windows that `begin_cycle` receives."""
        ...

    def init(self, key: Key[Array, ""], spec: Spec) -> Any:
        """The state before training: networks and optimisers."""
        ...

    def networks(self, state: Any) -> Any:
        """The trained agent: the state without what only updates need. Its optimisers' fields are replaced by ().

        In evaluations and outside of training, `act` and `predict` receive this state. So it may have averages of the
        weights in place of the newest. It is saved as the trained agent, and its numbers are counted as parameters.
        `state` may have leading axes.
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
        """Perceive a timestep; returns the action (a sample, or the mode if not `explore`) and the new memory.

        At the first timestep of an episode the caller passes the memory of `reset`, so this method need not check
        `step.is_first` for it.
        """
        ...

    def note(self, memory: Any) -> Any:
        """The data that the replay stores with a timestep, given the memory after it."""
        ...

    def pretrain(self, state: Any, windows: Window, key: Key[Array, ""]) -> tuple[Any, Metrics]:
        """One update of the pre-training."""
        ...

    def begin_cycle(self, state: Any, windows: Window, key: Key[Array, ""]) -> tuple[Any, Any, Metrics]:
        """Called once per cycle; the second result has a batch for each `update` of the cycle (leading axis)."""
        ...

    def update(self, state: Any, batch: Any, key: Key[Array, ""]) -> tuple[Any, Metrics]:
        """One update of the controller."""
        ...


@runtime_checkable
class Predictive(Protocol):
    """An agent with a model that can predict its inputs. This protocol is optional."""

    @property
    def predictors(self) -> tuple[str, ...]:
        """The names of its models, the default first."""
        ...

    def predict(
        self, state: Any, model: str, step: Timestep, observed: Bool[Array, " time"], key: Key[Array, ""]
    ) -> Gaussian:
        """One model's predictions of x_t = (o_t, r_{t-1}) along an episode, leaves (time, x).

        Where x_t is `observed` (open loop), latent variables are inferred from it. Elsewhere (closed loop) they are
        drawn from the generative model, and x_t must not be used. Entries that the model does not predict are NaN.
        """
        ...


# Every built-in name, and the agent with the hyperparameters that belong to this name.
AGENTS: dict[str, Any] = {name: load(known.path)(**known.hyperparameters) for name, known in catalogue.AGENTS.items()}


@functools.cache
def defaults() -> dict[str, dict[str, Any]]:
    """The hyperparameters of each built-in name, in the form of JSON."""
    return {name: plain(dataclasses.asdict(agent)) for name, agent in AGENTS.items()}


@functools.cache
def before() -> dict[str, dict[str, Any]]:
    """For each built-in name the hyperparameters of runs that do not record them (`hyperparameters.values_before`)."""
    return {name: values_before(agent) for name, agent in AGENTS.items()}


def find_class(name: str) -> type:
    """The class of the agent of that name, which may be `module:Class`.

    Pass only names that the user gave, because this function may import a module.

    Raises:
        UserError: no agent has that name, or the class is not an agent.
    """
    if name in AGENTS:
        return type(AGENTS[name])
    if is_own(name):
        return check_class(load(name))
    catalogue.check_agent(name)
    return check_class(load_declared(GROUP, name, declared(GROUP, AGENTS)[name]))


def check_class(kind: type) -> type:
    """Check that a class has everything that an agent needs, and return it.

    Raises:
        UserError: it is not a frozen dataclass, or lacks a member of an agent.
    """
    parameters = getattr(kind, "__dataclass_params__", None)
    if not (dataclasses.is_dataclass(kind) and parameters is not None and parameters.frozen):
        raise UserError(f"{path(kind)} is no agent: make it a frozen dataclass, @dataclasses.dataclass(frozen=True).")
    has = {field.name for field in dataclasses.fields(kind)} | set(dir(kind))
    lacks = [name for name in vars(Agent) if not name.startswith("_") and name not in has]
    if lacks:
        raise UserError(f"{path(kind)} is no agent: it lacks {', '.join(lacks)} (see beliefrl.Agent).")
    return kind


def make(name: str, /, **hyperparameters: Any) -> Agent:
    """The agent of that name; `hyperparameters` replace its defaults.

    Args:
        name: a built-in name, a name of an installed package, or `module:Class` for an agent of your own, which is
            imported.

    Raises:
        UserError: no agent has that name, it has no such hyperparameter, or a value is impossible.
    """
    if not isinstance(name, str):
        raise UserError(f"{short(name)} is not the name of an agent: make_agent takes a name, such as vrm.")
    return build(named(name), hyperparameters, name)


def given(agent: Any) -> Agent:
    """The agent itself, or the one of this name.

    Raises:
        UserError: no agent has that name, it is a class, or no agent at all.
    """
    if isinstance(agent, str):
        return make(agent)
    if isinstance(agent, type):
        raise UserError(f"{path(agent)} is a class: give an agent, {agent.__name__}().")
    check_class(type(agent))
    return agent


def named(name: str) -> Any:
    """For a built-in name the agent with its hyperparameters; for another name the class.

    Raises:
        UserError: as `find_class`.
    """
    return AGENTS[name] if name in AGENTS else find_class(name)


def name_of(agent: Agent) -> str:
    """The name under which `make` finds an agent; module:Class if it is neither built in nor declared by a package.

    If several names share the class (the ablations), it is the name whose settings the agent has.
    """
    found = None
    for name, known in AGENTS.items():
        if type(agent) is type(known):
            own = [field.name for field in dataclasses.fields(known) if getattr(known, field.name) != field.default]
            if all(getattr(agent, field) == getattr(known, field) for field in own):
                found = name
    return found or declared_name(GROUP, type(agent), AGENTS) or path(type(agent))


def is_own(name: str) -> bool:
    """Whether the name is `module:Class`: a user's own agent, which only a user may name."""
    return ":" in name


def is_of(kind: type, name: str) -> bool:
    """Whether agents of that name are of this class; imports nothing."""
    if name in AGENTS:
        return type(AGENTS[name]) is kind
    return is_named(kind, name) or declared_name(GROUP, kind, AGENTS) == name
