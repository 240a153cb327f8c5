"""Classes that are not in this library, by name: `module:Class`, and the entry points of installed packages."""

import difflib
import functools
import importlib
import re
import sys
from collections.abc import Container
from importlib import metadata
from pathlib import Path
from typing import Any

from beliefrl.errors import UserError, one_line, said

NAME = re.compile(r"\w[\w.-]*")  # of an entry point; a module:Class is none


def load(name: str) -> type:
    """The class that `module:Class` names; imports the module.

    Only a user may name it, never a file: importing a module runs its code.

    Raises:
        UserError: the name is of another form, the module cannot be imported, or it has no such class.
    """
    shown = one_line(name)
    module, _, qualname = name.partition(":")
    if not (module and qualname):
        raise UserError(f"{shown!r} names no class: write MODULE:CLASS, such as my_module:MyClass.")
    try:
        imported = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # whatever a module of a user's may raise
        raise UserError(f"The module {one_line(module)} cannot be imported: {said(error)}.") from None
    found = _attribute(imported, qualname)
    if not isinstance(found, type):
        classes = [each for each, value in vars(imported).items() if isinstance(value, type)]
        near = difflib.get_close_matches(qualname, classes, n=1)
        hint = f"did you mean {one_line(module)}:{near[0]}?" if near else "write MODULE:CLASS."
        raise UserError(f"There is no class {shown}: {hint}")
    return found


def path(kind: type) -> str:
    """The name of a class for `load`; a class of the program itself is in the module that its file would be."""
    module = kind.__module__
    if module == "__main__":
        main = sys.modules["__main__"]
        spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
        module = spec.name if spec else Path(file).stem if file else module
    return f"{module}:{kind.__qualname__}"


def is_named(kind: type, name: str) -> bool:
    """Whether `name` is the path of a class, or what a notebook records of it."""
    return name in (path(kind), f"__main__:{kind.__qualname__}")


def declared(group: str, but: Container[str] = ()) -> dict[str, str]:
    """The entry points of a group that installed packages declare: {name: module:Class}. Imports none of them.

    Left out are names in `but`, and names that are not letters, digits, _, . and -. Of packages that declare the same
    name the first on sys.path counts.
    """
    found: dict[str, str] = {}
    # The command line adds "" to sys.path for what the user names. What lies in that folder is not installed.
    for distribution in metadata.distributions(path=[folder for folder in sys.path if folder]):
        try:
            points = distribution.entry_points.select(group=group)
        except (TypeError, ValueError):  # an entry_points.txt that cannot be read
            continue
        for point in points:
            if NAME.fullmatch(point.name) and point.name not in but:
                found.setdefault(point.name, point.value.partition("[")[0].strip())
    return found


def load_declared(group: str, name: str, value: str) -> type:
    """The class of an entry point, NAME = VALUE; imports its module.

    Raises:
        UserError: it is broken.
    """
    try:
        return load(value)
    except UserError as error:
        raise UserError(f"{name}, an entry point {group} of an installed package, is broken: {error}") from None


def declared_name(group: str, kind: type, but: Container[str] = ()) -> str | None:
    """The name of the entry point that is this class, if one is; imports nothing."""
    for name, value in declared(group, but).items():
        module, _, qualname = value.partition(":")
        if _attribute(sys.modules.get(module), qualname) is kind:
            return name
    return None


def _attribute(module: Any, qualname: str) -> Any:
    """What a module has under a name with dots; None where it has nothing."""
    return functools.reduce(lambda found, part: getattr(found, part, None), qualname.split("."), module)
