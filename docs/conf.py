"""How the pages are built: `sphinx-build -W --keep-going docs docs/_build`. Nothing is fetched, then or when read."""

import pathlib
import shutil
import sys

import jax

sys.path.insert(0, str(pathlib.Path(__file__).parent))
jax.Array.__name__ = "Array"  # jaxlib._jax.Array before JAX 0.11; jaxtyping names its shapes after it

import beliefrl  # noqa: E402 - with that name

NOTEBOOK = "../examples/tutorial.ipynb"  # Sphinx shows only what lies in its own folder, so it gets a copy
shutil.copy(pathlib.Path(__file__).parent / NOTEBOOK, pathlib.Path(__file__).parent)


def setup(app):
    """Let links to the notebook lead to the copy."""

    def link(app, name, content):
        content[0] = content[0].replace(f"]({NOTEBOOK})", "](tutorial.ipynb)")

    app.connect("source-read", link)


project = html_title = "BeliefRL"
release = version = beliefrl.__version__
html_show_copyright = False

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "sphinx_copybutton", "docstrings"]
exclude_patterns = ["_build"]
nb_execution_mode = "off"  # the notebook is shown with the outputs that it has
myst_heading_anchors = 3
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(?!beliefrl\.).*"),  # of other libraries
    ("py:class", r"beliefrl\.models\.(soft_actor_critic\.Network|nets\.Params)"),  # type variables
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
