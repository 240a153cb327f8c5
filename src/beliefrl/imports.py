"""Find classes outside of this library by name: `module:Class`, and entry points of installed packages."""

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

NAME = re.compile(r"\w[\w.-]*")  # of an entry point; module:Class does not match


def load(name: str) -> type:
    """Import the module of `module:Class`, and return the class.

    The name must come from the user, never from a file, because importing a module runs its code.

    Raises:
        UserError: the name has another form, the module cannot be imported, or it has no such class.
    """
    shown = one_line(name)
    module, _, qualname = name.partition(":")
    if not (module and qualname):
        raise UserError(f"{shown!r} names no class: write MODULE:CLASS, such as my_module:MyClass.")
    try:
        imported = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise UserError(f"The module {one_line(module)} cannot be imported: {said(error)}.") from None
    found = _attribute(imported, qualname)
    if not isinstance(found, type):
        classes = [each for each, value in vars(imported).items() if isinstance(value, type)]
        near = difflib.get_close_matches(qualname, classes, n=1)
        hint = f"did you mean {one_line(module)}:{near[0]}?" if near else "write MODULE:CLASS."
        raise UserError(f"There is no class {shown}: {hint}")
    return found


def path(kind: type) -> str:
    """The name of a class for `load`. For a class of the main program, the module is named after its file."""
    module = kind.__module__
    if module == "__main__":
        main = sys.modules["__main__"]
        spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
        module = spec.name if spec else Path(file).stem if file else module
    return f"{module}:{kind.__qualname__}"


def is_named(kind: type, name: str) -> bool:
    """Whether `name` is the name of a class as `path` gives it, or as a run records it in a notebook."""
    return name in (path(kind), f"__main__:{kind.__qualname__}")


def declared(group: str, but: Container[str] = ()) -> dict[str, str]:
    """The entry points of a group in all installed packages: {name: module:Class}. Imports none of them.

    Names in `but`, and names with other characters than letters, digits, _, . and -, are left out. If several packages
    declare the same name, the first on sys.path counts.
    """
    found: dict[str, str] = {}
    # The command line adds "" to sys.path, for modules that the user names. Packages in that folder are not installed.
    for distribution in metadata.distributions(path=[folder for folder in sys.path if folder]):
        try:
            points = distribution.entry_points.select(group=group)
        except (TypeError, ValueError):  # its entry_points.txt cannot be read
            continue
        for point in points:
            if NAME.fullmatch(point.name) and point.name not in but:
                found.setdefault(point.name, point.value.partition("[")[0].strip())
    return found


def load_declared(group: str, name: str, value: str) -> type:
    """Import the module of an entry point, NAME = VALUE, and return its class.

    Raises:
        UserError: the entry point is broken.
    """
    try:
        return load(value)
    except UserError as error:
        raise UserError(f"{name}, an entry point {group} of an installed package, is broken: {error}") from None


def declared_name(group: str, kind: type, but: Container[str] = ()) -> str | None:
    """The name of this class's entry point, or None. Imports nothing."""
    for name, value in declared(group, but).items():
        module, _, qualname = value.partition(":")
        if _attribute(sys.modules.get(module), qualname) is kind:
            return name
    return None


def _attribute(module: Any, qualname: str) -> Any:
    """The attribute with a dotted name; None if it does not exist."""
    return functools.reduce(lambda found, part: getattr(found, part, None), qualname.split("."), module)
