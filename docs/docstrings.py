"""How docstrings become pages: Google's sections, indented equations as they stand, fields with their comments."""

import ast
import dataclasses
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import Any

from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config, GoogleDocstring

SECTION = re.compile(r"(Args|Returns|Raises|Yields):$")
STAR = re.compile(r"(?<![`\w])\*(?=\w)")  # of a shape such as (*batch, obs), not of emphasis


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", rewrite)
    app.connect("autodoc-process-signature", without_fields)
    app.connect("autodoc-skip-member", skip_methods_of_agents)
    return {"parallel_read_safe": True}


def rewrite(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Turn a docstring into reStructuredText, in place."""
    lines[:] = [line for line in lines if not line.startswith("Create new instance of ")]  # NamedTuple's own
    if lines and lines[0].startswith("Alias for field number "):
        lines[:] = [comments(name).get(name.rpartition(".")[2], "")]
    elif what != "attribute":
        lines[:] = GoogleDocstring(list(literal(lines)), Config(), app, what, name, obj, options).lines()


def literal(lines: list[str]) -> Iterator[str]:
    """The same lines, with a `::` before what is indented below an empty line: equations, layouts, code."""
    section = inside = False
    for before, line in zip(["", *lines], lines, strict=False):
        indented = line.startswith("    ")
        if line and not indented:
            section, inside = bool(SECTION.match(line)), False
            line = STAR.sub(r"\\*", line)
        elif indented and not (before or section or inside):
            inside = True
            yield from ("::", "")
        if before == "Returns:":
            line = f"    : {line.strip()}"  # else what stands before its first colon is taken for a type
        yield line


def without_fields(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, returns: str
) -> tuple[str, None] | None:
    """No signature for a class whose fields follow, or that nobody makes."""
    listed = dataclasses.is_dataclass(obj) or hasattr(obj, "_fields")
    return ("", None) if what == "class" and (listed or getattr(obj, "_is_protocol", False)) else None


def skip_methods_of_agents(app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """Of an agent the hyperparameters are listed; its methods are those of the protocol, in `beliefrl.agents`."""
    function = getattr(obj, "fget", obj)
    return True if getattr(function, "__module__", "").startswith("beliefrl.agents.") else None


def comments(field: str) -> dict[str, str]:
    """What is said of each field of a NamedTuple, at the end of its line; `field` is the full name of one of them."""
    module, kind, _ = field.rsplit(".", 2)
    source = textwrap.dedent(inspect.getsource(getattr(importlib.import_module(module), kind)))
    lines, (tree,) = source.splitlines(), ast.parse(source).body
    found = {}
    for node in tree.body:
        if isinstance(node, ast.AnnAssign):
            _, _, found[node.target.id] = lines[node.end_lineno - 1].partition("  # ")
    return found
