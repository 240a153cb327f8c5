"""Sphinx configuration: `sphinx-build -W --keep-going docs docs/_build`. The pages need no network, built or read.

The functions at the end turn docstrings into pages: Google's sections, indented equations as literal blocks, and the
comments of a NamedTuple's fields as their descriptions.
"""

import ast
import dataclasses
import importlib
import inspect
import pathlib
import re
import shutil
import textwrap
from collections.abc import Iterator
from typing import Any

import jax
from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config, GoogleDocstring

jax.Array.__name__ = "Array"  # jaxlib._jax.Array before JAX 0.11; jaxtyping shows this name in shapes

import beliefrl  # noqa: E402 - after the name is set

COPIES = {  # Sphinx shows only what lies in its own folder, so it gets copies
    "../examples/tutorial.ipynb": "tutorial.ipynb",
    "../benchmarks/README.md": "benchmarks.md",
}
for original, copied in COPIES.items():
    shutil.copy(pathlib.Path(__file__).parent / original, pathlib.Path(__file__).parent / copied)


project = html_title = "BeliefRL"
release = version = beliefrl.__version__
html_show_copyright = False

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "sphinx_copybutton"]
exclude_patterns = ["_build", "jupyter_execute"]  # what a build writes
nb_execution_mode = "off"  # the notebook is shown with the outputs that it has
myst_heading_anchors = 3
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(?!beliefrl\.).*"),  # names of other libraries
    ("py:class", r"beliefrl\.models\.(nets|optimisation)\.Params"),  # type variables
    ("py:class", r"beliefrl\.tasks\.(faults\.Draws|check_warnings\.Entry|interface\.Interface)"),  # parts of others
]

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_show_sourcelink = html_copy_source = False
highlight_language = "none"  # a block without a language is plain text

smartquotes = False
default_role = "code"  # a word in backticks is code in docstrings, as it is in Markdown
add_module_names = False
toc_object_entries_show_parents = "hide"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autoclass_content = "both"
autodoc_default_options = {"members": True}
python_use_unqualified_type_names = True
maximum_signature_line_length = 90

SECTION = re.compile(r"(Args|Returns|Raises|Yields):$")
STAR = re.compile(r"(?<![`\w])\*(?=\w)")  # in a shape such as (*batch, obs), not for emphasis


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect the functions below. Sphinx calls this."""
    app.connect("source-read", link_to_copies)
    app.connect("autodoc-process-docstring", rewrite)
    app.connect("autodoc-process-signature", without_fields)
    app.connect("autodoc-skip-member", skip_methods_of_agents)
    return {"parallel_read_safe": True}


def link_to_copies(app: Sphinx, page: str, content: list[str]) -> None:
    """Let links to the originals lead to the copies, and links in a copy to the pages here."""
    for original, copied in COPIES.items():
        content[0] = content[0].replace(original, copied)
        if page == pathlib.Path(copied).stem:
            content[0] = content[0].replace("](../docs/", "](")


def rewrite(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Turn a docstring into reStructuredText, in place."""
    lines[:] = [line for line in lines if not line.startswith("Create new instance of ")]  # added by NamedTuple
    if lines and lines[0].startswith("Alias for field number "):
        lines[:] = [comments(name).get(name.rpartition(".")[2], "")]
    elif what != "attribute":
        lines[:] = GoogleDocstring(list(literal(lines)), Config(), app, what, name, obj, options).lines()


def literal(lines: list[str]) -> Iterator[str]:
    """The same lines, with a `::` before each indented block that follows an empty line: equations, layouts, code."""
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
            line = f"    : {line.strip()}"  # without it, napoleon takes the text before the first colon for a type
        yield line


def without_fields(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, returns: str
) -> tuple[str, None] | None:
    """Omit the signature of a class whose fields are listed below it, and of a protocol."""
    listed = dataclasses.is_dataclass(obj) or hasattr(obj, "_fields")
    return ("", None) if what == "class" and (listed or getattr(obj, "_is_protocol", False)) else None


def skip_methods_of_agents(app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """List only the hyperparameters of an agent. Its methods are those of the protocol."""
    module = getattr(getattr(obj, "fget", obj), "__module__", "")
    return True if module.startswith("beliefrl.agents.") and module != "beliefrl.agents.protocol" else None


def comments(field: str) -> dict[str, str]:
    """The comment at the end of each field's line in a NamedTuple; `field` is the full name of one of the fields."""
    module, kind, _ = field.rsplit(".", 2)
    source = textwrap.dedent(inspect.getsource(getattr(importlib.import_module(module), kind)))
    lines, (tree,) = source.splitlines(), ast.parse(source).body
    found = {}
    for node in tree.body:
        if isinstance(node, ast.AnnAssign):
            _, _, found[node.target.id] = lines[node.end_lineno - 1].partition("  # ")
    return found
