"""Parse the arguments of a command with tyro, with value types of our own, and report mistakes as clear sentences."""

import contextlib
import dataclasses
import difflib
import io
import json
import pathlib
import re
from collections.abc import Collection, Sequence
from decimal import Decimal, InvalidOperation
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from beliefrl.errors import UserError

VALUES = ConstructorRegistry()


def whole_number(text: str) -> int:
    """Parse a whole number, also as 20_000 or 1e4.

    Raises:
        ValueError: it is not a whole number, such as 1.5.
    """
    try:
        number = Decimal(text)
        if number.adjusted() < 400 and number == number.to_integral_value():
            return int(number)
    except (InvalidOperation, OverflowError, ValueError):
        pass
    raise ValueError(f"must be a whole number, not {text!r}")


@VALUES.primitive_rule
def _whole_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    if info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda given: whole_number(given[0]),
        is_instance=lambda value: isinstance(value, int) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


@VALUES.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Show T | None as T, and accept None as well.

    If a positional argument is missing and there is an unknown option, tyro passes an empty list instead of a text.
    """
    inner = [kind for kind in get_args(info.type) if kind is not NoneType]
    if info.type_origin not in (Union, UnionType) or len(inner) != 1:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(inner[0], info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec) or spec.nargs != 1:
        return None
    return dataclasses.replace(
        spec,
        instance_from_str=lambda given: None if given in (["None"], [[]]) else spec.instance_from_str(given),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
        choices=None if spec.choices is None else (*spec.choices, "None"),
    )


@VALUES.primitive_rule
def _one_or_several(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Parse one number as float, and several as tuple[float, ...]."""
    if info.type != float | tuple[float, ...]:
        return None

    def parsed(given: list[str]) -> float | tuple[float, ...]:
        values = tuple(map(float, given))
        return values[0] if len(values) == 1 else values

    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="FLOAT [FLOAT ...]",
        instance_from_str=parsed,
        is_instance=lambda value: isinstance(value, float | tuple),
        str_from_instance=lambda value: list(map(str, value if isinstance(value, tuple) else [value])),
    )


@VALUES.primitive_rule
def _several(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Show the empty default of tuple[T, ...] as "none"."""
    if info.type_origin is not tuple or get_args(info.type)[1:] != (...,):
        return None
    as_list: Any = list[get_args(info.type)[0]]
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(as_list, info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return None
    return dataclasses.replace(
        spec,
        instance_from_str=lambda given: tuple(spec.instance_from_str(given)),
        is_instance=lambda value: isinstance(value, tuple) and spec.is_instance(list(value)),
        str_from_instance=lambda value: spec.str_from_instance(list(value)) or ["none"],
    )


OwnAgent = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="MODULE:CLASS",
        help="The class of the agent, where an agent of your own was trained. Its module is imported.",
    ),
]
RunFolder = Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN", help="The run's folder.")]
RunFolders = Annotated[
    tyro.conf.Positional[tuple[pathlib.Path, ...]],
    tyro.conf.arg(
        metavar="RUNS",
        help="Folders of runs, folders that contain runs (such as a sweep's), or files of results, NAME.json.gz.",
        help_behavior_hint="(required)",
    ),
]
Seed = Annotated[int | None, tyro.conf.arg(help="One of the run's seeds. None: its first.")]
Sampled = Annotated[bool, tyro.conf.arg(help="Sample the actions, instead of taking the policy's mode.")]
Out = Annotated[pathlib.Path | None, tyro.conf.arg(aliases=["-o"])]
Best = Annotated[
    bool,
    tyro.conf.arg(
        help="Use the agent with the highest return of all evaluations during the training (with sampled actions), "
        "instead of the last one."
    ),
]


def own_agent(name: str | None) -> type | None:
    """The class that --agent names, if it was given."""
    from beliefrl import agents

    return None if name is None else agents.find_class(name)


def agent_options(agent: Any, own: dict[str, Any]) -> type:
    """A dataclass of a command's options: its own {name: (type, default)}, and the hyperparameters of `agent`."""
    fields = [(name, kind, dataclasses.field(default=default)) for name, (kind, default) in own.items()]
    if agent is None:
        return dataclasses.make_dataclass("Options", fields, frozen=True)
    hyperparameters = Annotated[
        type(agent), tyro.conf.OmitArgPrefixes, tyro.conf.arg(help="Hyperparameters of the agent.")
    ]
    taken = set(_option_names(dataclasses.make_dataclass("Options", fields)))
    for field in dataclasses.fields(agent):
        if field.name in taken:
            raise UserError(f"{type(agent).__name__} has a field {field.name}, an option of this command: rename it.")
    fields.append(("agent", hyperparameters, dataclasses.field(default=agent)))
    return dataclasses.make_dataclass("Options", fields, frozen=True)


def agent_name(argv: Sequence[str], command: str, more: str = "") -> tuple[str, Sequence[str]]:
    """The name of the agent, and the remaining arguments."""
    usage = f"beliefrl {command} AGENT {more}".rstrip()
    if argv and argv[0] in ("-h", "--help"):
        print(f"usage: {usage} ...\n")
        print(f"`beliefrl agents` lists the agents. To see the options of one: beliefrl {command} vrm --help")
        print("MODULE:CLASS is an agent of your own, in the current folder or on the Python path.")
        raise SystemExit(0)
    if not argv or argv[0].startswith("-"):
        raise UserError(f"No agent is given: write {usage}; `beliefrl agents` lists the agents.")
    return argv[0], argv[1:]


def parse(options: Any, argv: Sequence[str], prog: str, advice: str = "") -> Any:
    """Parse the options. A mistake raises a UserError with one sentence, instead of tyro's box.

    `advice` is the end of the message for an option that does not exist and resembles no other.
    """
    if any(arg in ("-h", "--help") for arg in argv):
        return tyro.cli(options, prog=prog, args=argv, registry=VALUES)
    _refuse_repeated(_lists(options), argv)
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box), contextlib.redirect_stdout(box):
            parsed, unknown = tyro.cli(options, prog=prog, args=argv, return_unknown_args=True, registry=VALUES)
    except SystemExit:
        raise UserError(f"{_sentence(box.getvalue())}; `{prog} --help` shows the options.") from None
    if unknown:
        raise UserError(_unknown(options, unknown[0], prog, advice))
    return parsed


def _refuse_repeated(lists: Collection[str], argv: Sequence[str]) -> None:
    """Raise a UserError if an option with several values is given twice: the second would replace the first."""
    given = [option for option in (arg.split("=")[0].replace("_", "-") for arg in argv) if option in lists]
    for option in given:
        if given.count(option) > 1:
            raise UserError(f"{option} is given twice: give all its values after one {option}.")


def refuse_empty(argv: Sequence[str], *options: str) -> None:
    """Raise a UserError if one of these options is given without a value, for example an empty variable of a shell."""
    for option, after in zip(argv, [*argv[1:], "--"], strict=False):
        if option in options and after.startswith("--"):
            raise UserError(f"{option} needs a value: give one, or leave the option out.")


def named_values(given: Sequence[str], option: str) -> dict[str, Any]:
    """{"name": value} of NAME=VALUE arguments. A value is parsed as JSON; if that fails, it is a string."""
    values = {}
    for each in given:
        name, separator, value = each.partition("=")
        if not (separator and name.isidentifier()):
            raise UserError(f"{option} {each} cannot be understood: write NAME=VALUE, such as max_episode_steps=500.")
        if name in values:
            raise UserError(f"{option} has {name} twice: give it once.")
        if name in ("name", "observe", "faults"):  # arguments of `tasks.make` that are not constants
            raise UserError(
                f"{option} {each} is impossible: name, observe and faults are not constants of a task: use TASK, "
                "--observe, and options such as --noise."
            )
        try:
            values[name] = json.loads({"True": "true", "False": "false", "None": "null"}.get(value, value))
        except ValueError:
            values[name] = value
    return values


def value_lists(given: Sequence[str], option: str) -> dict[str, list[Any]]:
    """{"name": [value, ...]} of NAME=VALUE,VALUE arguments. A list in brackets is one value: [64,64],[128,128]."""
    lists = {}
    for each in given:
        name, separator, text = each.partition("=")
        name = name.replace("-", "_")
        named_values([name + separator + text], option)  # raises an error unless it is NAME=VALUE
        parts = re.split(r",(?![^\[]*\])", text)
        if name in lists:
            raise UserError(f"{option} has {name} twice: give all its values at once, {name}=A,B.")
        lists[name] = [named_values([f"value={part}"], option)["value"] for part in parts]
    return lists


WORDING = (  # message of tyro or Python: our message
    (r"Missing from .*: (\w+) .*", r"\1 is missing"),
    (r"Error parsing (\S+): (must be .*)", r"\1 \2"),
    (r"Error parsing (\S+): could not convert string to float: (.*)", r"\1 must be a number, not \2"),
    (r"Error parsing (\S+): .* \[(.*)\]", r"\1 cannot be \2"),
    (r"invalid choice (.*) for argument '(\S+)'. Expected one of \((.*)\)", r"\2 must be one of \3, not \1"),
    (r"Missing value for argument '([^-\s]\S*)'.*", r"\1 is missing"),  # a positional argument
    (r"Missing value for argument '(\S+)'.*", r"\1 needs a value"),
)


def _sentence(box: str) -> str:
    """The first paragraph of an error box of tyro, on one line and in our wording."""
    lines = [line.strip(" │|╭╮╰╯─-") for line in box.splitlines()[1:]]  # frame lines become empty
    paragraphs = " ".join(line or "\n" for line in lines).split("\n")
    message = next(filter(str.strip, paragraphs), "That command line cannot be understood").strip().rstrip(". ")
    for pattern, wording in WORDING:
        message = re.sub(f"^{pattern}$", wording, message)
    return message


def _unknown(options: Any, given: str, prog: str, advice: str) -> str:
    """The error message for an argument that does not belong to any option."""
    if not given.startswith("-"):
        return f"There is one argument too many, {given!r}: `{prog} --help` shows the usage."
    names = [f"--{name.replace('_', '-')}" for name in _option_names(options)]
    near = difflib.get_close_matches(given.split("=")[0], names, n=1, cutoff=0.7)
    hint = f"did you mean {near[0]}?" if near else advice or f"`{prog} --help` lists the options."
    return f"There is no option {given}: {hint}"


def _option_names(options: Any) -> list[str]:
    """The names of all fields of a dataclass and of the dataclasses in it."""
    return [name for name, _ in _fields(options)]


def _lists(options: Any) -> set[str]:
    """The options that have several values."""
    several = re.compile(r"\b(tuple|list)\[", re.IGNORECASE)
    return {f"--{name.replace('_', '-')}" for name, kind in _fields(options) if several.search(str(kind))}


def _fields(options: Any) -> list[tuple[str, Any]]:
    """The name and type of all fields of a dataclass and of the dataclasses in it."""
    found = []
    for field in dataclasses.fields(options):
        kind: Any = field.type
        kind = kind.__origin__ if hasattr(kind, "__metadata__") else kind  # of Annotated
        found += _fields(kind) if dataclasses.is_dataclass(kind) else [(field.name, kind)]
    return found
