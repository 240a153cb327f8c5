"""The agents. A new agent is one file and one line in `catalogue.AGENTS`, or a user's class (`find_class`)."""

import dataclasses
import functools
from typing import Any

from beliefrl import catalogue
from beliefrl.agents.hyperparameters import build, values_before
from beliefrl.agents.protocol import Agent as Agent
from beliefrl.agents.protocol import Predictive as Predictive
from beliefrl.catalogue import AGENT_GROUP as GROUP
from beliefrl.errors import UserError, short
from beliefrl.imports import declared, declared_name, is_named, load, load_declared, path
from beliefrl.types import plain

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
