"""The hyperparameters of an agent, built in or a user's: set, recorded as JSON, and restored from the record.

A `Range` defines the values that `beliefrl.tune` tries.
"""

import dataclasses
import difflib
import functools
import json
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from beliefrl.errors import UserError, said
from beliefrl.imports import path
from beliefrl.types import plain, tuples

Scale = Literal["linear", "log", "horizon"]


@dataclasses.dataclass(frozen=True)
class Range:
    """The numbers from `low` to `high`, which `beliefrl.tune` tries for a hyperparameter.

    The class attribute `ranges` of an agent has a Range, or a tuple of values, for each hyperparameter that is tuned.
    """

    low: int | float
    """The lowest number."""
    high: int | float
    """The highest number."""
    scale: Scale | None = None
    """The quantity that is drawn uniformly: the number (linear), its logarithm (log), or log(1 - number) (horizon),
    as for a discount factor γ with the horizon 1 / (1 - γ). None: the scale of the agent's own range, or linear."""


Ranges = Mapping[str, Range | Sequence[Any]]


def build(agent: Any, hyperparameters: Mapping[str, Any], name: str | None = None) -> Any:
    """An agent like this one, or of this class, in which these hyperparameters replace its own.

    `name` is the agent's name in messages; None is the path of its class.

    Raises:
        UserError: it has no such hyperparameter, lacks one that has no default, or a value is impossible.
    """
    kind = agent if isinstance(agent, type) else type(agent)
    name = name or path(kind)
    known = [field.name for field in dataclasses.fields(kind) if field.init]
    for given in hyperparameters:
        if given not in known:
            near = difflib.get_close_matches(given, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(known) or 'none'}."
            raise UserError(f"The agent {name} has no hyperparameter {given!r}: {hint}")
    if agent is kind:
        for missing in _required(kind) - set(hyperparameters):
            raise UserError(f"The agent {name} has no default for {missing}: give that field one.")
    make: Any = agent if isinstance(agent, type) else functools.partial(dataclasses.replace, agent)
    try:
        return make(**hyperparameters)
    except UserError:
        raise
    except Exception as error:  # an agent of a user may raise anything
        if kind.__module__.startswith("beliefrl."):
            raise
        raise UserError(f"The agent {name} cannot be made with its hyperparameters: {said(error)}.") from None


def of(agent: Any) -> dict[str, Any]:
    """The hyperparameters of an agent; nested dataclasses become dictionaries."""
    values = dataclasses.asdict(agent)
    return {field.name: values[field.name] for field in dataclasses.fields(agent) if field.init}


def values_before(agent: Any) -> dict[str, Any]:
    """Values, as JSON, of the hyperparameters that older runs do not record: they describe how these runs were trained.

    They are in the class attribute `values_before` of an agent. A hyperparameter that is not there had its default.
    """
    return plain(dict(getattr(agent, "values_before", {})))


def named_by(agent: Any, attribute: Literal["network_settings", "note_settings"]) -> dict[str, Any]:
    """The hyperparameters, as JSON, that a class attribute of an agent names; none if it has no such attribute.

    network_settings: they change what the networks' arrays mean, but perhaps not their shapes. A training starts from
    another run (init_from) only if they agree: tuples must be equal, and others must both be on, or both be off.
    note_settings: with others, the notes in the replay differ. With init_replay they must be equal.
    """
    return plain({name: getattr(agent, name) for name in getattr(agent, attribute, ())})


def restored(agent: Any, recorded: Mapping[str, Any]) -> Any:
    """An agent like this one, or of this class, with hyperparameters that were recorded as JSON.

    JSON cannot represent some values, such as functions. For these the agent keeps its own values. A hyperparameter
    that the record lacks has its value in `values_before`, or else that of the given agent (of a class: its default).

    Raises:
        UserError: as `build`.
    """
    like: Any = build(agent, {}) if isinstance(agent, type) and not _required(agent) else agent
    values = {}
    for name, value in tuples(values_before(like) | dict(recorded)).items():
        own = getattr(like, name, None)
        if dataclasses.is_dataclass(own) and isinstance(value, dict):
            values[name] = restored(own, value)
        elif _is_json(own):
            values[name] = value
    return build(like, values)


def _required(kind: type) -> set[str]:
    """The fields without a default."""
    unset = dataclasses.MISSING
    fields = [field for field in dataclasses.fields(kind) if field.init]
    return {field.name for field in fields if field.default is unset and field.default_factory is unset}


def _is_json(value: Any) -> bool:
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        return False
    return True
