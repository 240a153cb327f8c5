"""Lists of names: `beliefrl tasks` and `beliefrl agents`. They import neither JAX nor, without options, tyro."""

import dataclasses
from collections.abc import Sequence

from beliefrl import catalogue


@dataclasses.dataclass(frozen=True)
class ListOptions:
    """Print all names with their descriptions."""


def list_tasks(argv: Sequence[str]) -> None:
    """`beliefrl tasks`."""
    _check(argv, "beliefrl tasks")
    _print_names(catalogue.task_names() | catalogue.environment_names())


def list_agents(argv: Sequence[str]) -> None:
    """`beliefrl agents`."""
    _check(argv, "beliefrl agents")
    _print_names(catalogue.agent_names())


def _check(argv: Sequence[str], prog: str) -> None:
    if argv:
        from beliefrl.commands.arguments import parse

        parse(ListOptions, argv, prog)


def _print_names(names: dict[str, str]) -> None:
    width = max(map(len, names)) + 2
    for name, about in names.items():
        print(f"{name:<{width}}{about}")
