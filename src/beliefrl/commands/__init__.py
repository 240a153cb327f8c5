"""The commands of the command line. Each is a function that parses options, calls the library and prints."""

import importlib
from collections.abc import Callable, Sequence

COMMANDS: dict[str, str] = {  # module:function, imported when it is called
    "check": "training:check",
    "train": "training:train",
    "resume": "training:resume",
    "sweep": "sweep:sweep",
    "tune": "tune:tune",
    "figure": "figure:figure",
    "show": "runs:show",
    "evaluate": "runs:evaluate",
    "export": "runs:export",
    "report": "figure:report",
    "predict": "pictures:predict",
    "video": "pictures:video",
    "film": "pictures:film",
    "demo": "pictures:demo",
    "tasks": "lists:list_tasks",
    "agents": "lists:list_agents",
    "bench": "bench:bench",
}


def find(command: str) -> Callable[[Sequence[str]], None]:
    """The function of a command; imports its module."""
    module, _, function = COMMANDS[command].partition(":")
    return getattr(importlib.import_module(f"beliefrl.commands.{module}"), function)
