"""Configuration of the documentation; ``make docs`` builds it into ``docs/_build``."""

import sys
from pathlib import Path

from docutils import nodes

from simenv_marl import __version__

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
from tools.notebooks import write_notebooks  # noqa: E402

project = "simenv_marl"
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton", "sphinx_design"]
exclude_patterns = ["_build", "figures", "_clients_*"]  # figures and clients are parts of pages
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
napoleon_attr_annotations = False
napoleon_numpy_docstring = False
python_use_unqualified_type_names = True

copybutton_prompt_text = r">>> |\.\.\. |\$ "  # copied is what is typed, without prompts and output
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_title = f"simenv_marl {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_copy_source = False
html_show_copyright = False
html_theme_options = {"top_of_page_buttons": []}


def _trim(app, doctree):
    """Drop the empty lines that doctest needs at the end of examples."""
    for block in doctree.findall(nodes.literal_block):
        text = block.astext().rstrip()
        block.rawsource = text
        block[:] = [nodes.Text(text)]


def setup(app):
    """Called by Sphinx."""
    app.connect("builder-inited", lambda app: write_notebooks(DOCS))
    app.connect("doctree-read", _trim)
