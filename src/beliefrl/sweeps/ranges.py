"""The search space of `tune`: the ranges of an agent's hyperparameters, and how a trial draws settings from them."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, get_args, runtime_checkable

from beliefrl.agents import hyperparameters
from beliefrl.agents.hyperparameters import Range, Ranges, Scale
from beliefrl.errors import UserError
from beliefrl.types import tuples

DIGITS = 4  # significant digits of a drawn number, so that settings can be read and copied
ENDS = re.compile(r"(?P<low>[^:]+)\.\.(?P<high>[^:]+?)(:(?P<scale>.*))?")


@runtime_checkable
class Drawing(Protocol):
    """The methods of an Optuna trial that are used here."""

    def suggest_categorical(self, name: str, choices: Sequence[str], /) -> Any: ...
    def suggest_int(self, name: str, low: int, high: int, /, *, log: bool) -> int: ...
    def suggest_float(self, name: str, low: float, high: float, /, *, log: bool) -> float: ...


def from_text(name: str, text: str) -> Range | None:
    """The Range of a text LOW..HIGH or LOW..HIGH:SCALE; None if the text has no "..".

    Raises:
        UserError: an end is not a number, or there is no such scale.
    """
    if ".." not in text:
        return None
    found = ENDS.fullmatch(text)
    low, high = (None, None) if found is None else map(_number, found.group("low", "high"))
    if found is None or low is None or high is None:
        raise UserError(f"{name}={text} cannot be understood: write {name}=LOW..HIGH, such as {name}=0.1..0.5.")
    scale: Any = found["scale"]  # `chosen` checks it
    return Range(low, high, scale)


def _number(text: str) -> Any:
    try:
        value = json.loads(text)
    except ValueError:
        return None
    return value if _is_number(value) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def chosen(agent: Any, name: str, given: Ranges, only: Sequence[str] = (), fixed: Sequence[str] = ()) -> Ranges:
    """The ranges of the hyperparameters that are tuned.

    Args:
        agent: the agent with its fixed settings.
        name: the agent's name, for messages.
        given: ranges that replace or extend those of the agent.
        only: the hyperparameters to tune. Empty: all that have a range.
        fixed: hyperparameters with a fixed value. They are tuned only if they are in `given`.

    Raises:
        UserError: the agent has no such hyperparameter, one has no range, or a range is impossible.
    """
    own = getattr(agent, "ranges", {})
    if not isinstance(own, Mapping):
        raise UserError(f"The attribute `ranges` of {name} must be a dictionary from names to ranges.")
    known = {each: values for each, values in own.items() if each not in fixed} | dict(given)
    for each in only:
        _ = hyperparameters.build(agent, {each: getattr(agent, each, None)}, name)  # raises if there is none
        if each not in known:
            raise UserError(f"{each} has no range in {name}: give --range {each}=LOW..HIGH, in Python ranges=.")
    tuned = {each: values for each, values in known.items() if not only or each in only}
    if not tuned:
        raise UserError(f"{name} has no hyperparameter to tune: give --range NAME=LOW..HIGH, in Python ranges=.")
    return {each: _checked(agent, name, each, values, own.get(each)) for each, values in tuned.items()}


def _checked(agent: Any, agent_name: str, name: str, values: Any, own: Any) -> Range | Sequence[Any]:
    """A range with its scale, after a check of its ends; or the values to choose from."""
    if not isinstance(values, Range):
        choices = tuples({name: list(values)})[name] if isinstance(values, list | tuple) else ()
        if not choices:
            raise UserError(f"The range of {name} is impossible: give a beliefrl.Range, or a list of values.")
        for value in choices:
            _ = hyperparameters.build(agent, {name: value}, agent_name)
        return choices
    _ = hyperparameters.build(agent, {name: getattr(agent, name, values.low)}, agent_name)  # there is such a field
    low, high, scale = values.low, values.high, values.scale or getattr(own, "scale", None) or "linear"
    shown, default = f"The range {name}={low}..{high}", getattr(agent, name)
    if scale not in get_args(Scale):
        raise UserError(f"{shown}:{scale} is impossible: the scale must be {', '.join(get_args(Scale))}.")
    if not (default is None or _is_number(default)):
        raise UserError(f"{shown} is impossible, because {name} is not a number: give values, {name}=A,B,C.")
    if not (_is_number(low) and _is_number(high) and low < high):
        raise UserError(f"{shown} is impossible: the first number must be less than the second.")
    is_whole = isinstance(low, int) and isinstance(high, int) and not isinstance(default, float)
    if isinstance(default, int) and not is_whole:
        raise UserError(f"{shown} is impossible: {name} is a whole number.")
    if scale == "log" and low <= 0:
        raise UserError(f"{shown} is impossible: a logarithmic range must begin above 0.")
    if scale == "horizon" and (high >= 1 or is_whole):
        raise UserError(f"{shown} is impossible: a range with the scale horizon must end below 1.")
    low, high = (low, high) if is_whole else (float(low), float(high))
    for end in (low, high):
        _ = hyperparameters.build(agent, {name: end}, agent_name)
    return Range(low, high, scale)


def as_json(ranges: Ranges) -> dict[str, Any]:
    """The ranges as JSON, to be recorded."""
    return {
        name: [values.low, values.high, values.scale] if isinstance(values, Range) else {"values": list(values)}
        for name, values in ranges.items()
    }


def draw(trial: Drawing, ranges: Ranges) -> dict[str, Any]:
    """The settings that a trial tries. Numbers have few digits and lie in their range."""
    return {name: _drawn(trial, name, values) for name, values in ranges.items()}


def _drawn(trial: Drawing, name: str, values: Range | Sequence[Any]) -> Any:
    if not isinstance(values, Range):
        texts = {json.dumps(value): value for value in values}
        return texts[trial.suggest_categorical(name, list(texts))]
    low, high, is_log = values.low, values.high, values.scale == "log"
    if isinstance(low, int) and isinstance(high, int):
        return trial.suggest_int(name, low, high, log=is_log)
    if values.scale == "horizon":
        number = round(1 - _rounded(trial.suggest_float(_parameter(name, values), 1 - high, 1 - low, log=True)), 12)
    else:
        number = _rounded(trial.suggest_float(name, low, high, log=is_log))
    return min(max(number, low), high)


def _rounded(number: float) -> float:
    return float(f"{number:.{DIGITS}g}")


def _parameter(name: str, values: Range | Sequence[Any]) -> str:
    """The name of Optuna's parameter for a hyperparameter. With the scale horizon it stands for 1 - value."""
    return f"1-{name}" if isinstance(values, Range) and values.scale == "horizon" else name


def parameters(ranges: Ranges, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Optuna's parameters for these settings; those outside of their range are left out."""
    found = {}
    for name, values in ranges.items():
        value = settings[name]
        if not isinstance(values, Range):
            if value in values:
                found[name] = json.dumps(value)
        elif _is_number(value) and values.low <= value <= values.high:
            found[_parameter(name, values)] = 1 - value if values.scale == "horizon" else value
    return found
