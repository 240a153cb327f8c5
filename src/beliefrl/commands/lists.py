"""Lists of names: `beliefrl tasks` and `beliefrl agents`."""

import dataclasses
from collections.abc import Sequence

from beliefrl.commands.arguments import parse


@dataclasses.dataclass(frozen=True)
class ListOptions:
    """Print all names with their descriptions."""


def list_tasks(argv: Sequence[str]) -> None:
    """`beliefrl tasks`."""
    parse(ListOptions, argv, "beliefrl tasks")
    from beliefrl import tasks

    _print_names(tasks.names() | tasks.registered.names())


def list_agents(argv: Sequence[str]) -> None:
    """`beliefrl agents`."""
    parse(ListOptions, argv, "beliefrl agents")
    from beliefrl import agents

    _print_names(agents.names())


def _print_names(names: dict[str, str]) -> None:
    width = max(map(len, names)) + 2
    for name, about in names.items():
        print(f"{name:<{width}}{about}")
