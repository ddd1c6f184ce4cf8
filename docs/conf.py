"""Configuration of the documentation; ``make docs`` builds it into ``docs/_build``."""

import re
import sys
from pathlib import Path

from docutils import nodes

from simenv_marl import __version__

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
from tools.notebooks import write_notebooks  # noqa: E402

project = "simenv_marl"
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
extensions += ["sphinx_copybutton", "sphinx_design"]
exclude_patterns = ["_build", "figures", "_clients_*"]  # figures and clients are parts of pages
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

add_module_names = False
autosummary_generate = False  # tables of names alone; the pages of rooms have the rest
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
html_extra_path = ["_moved"]  # pages at old addresses, which lead to the new ones
html_css_files = ["pages.css"]
html_js_files = ["sidebar.js"]
html_copy_source = False
html_show_copyright = False
html_theme_options = {"top_of_page_buttons": []}


def _trim(app, doctree):
    """Drop the empty lines that doctest needs at the end of examples."""
    for block in doctree.findall(nodes.literal_block):
        text = block.astext().rstrip()
        block.rawsource = text
        block[:] = [nodes.Text(text)]


def _label(app, doctree):
    """Tell tables of words from tables of numbers, and label the cells of words.

    A narrow screen shows each row of a table of words as a list, without the head. It scrolls a
    table of numbers.
    """
    for table in doctree.findall(nodes.table):
        head = table.next_node(nodes.thead)
        if head is None or "sequence" in table["classes"]:
            continue
        titles = [title.astext() for title in head[0]]
        rows = [row[1:] for row in table.next_node(nodes.tbody)]
        cells = [text for row in rows for cell in row if (text := cell.astext())]
        if 2 * sum(bool(re.match(r"[-+\N{MINUS SIGN}≤≥ ]*\d", text)) for text in cells) >= len(
            cells
        ):
            table["classes"].append("numbers")
            for text in list(table.findall(nodes.Text)):
                text.parent.replace(
                    text, nodes.Text(re.sub("([≤≥]) ", "\\1\N{NO-BREAK SPACE}", text))
                )
            continue
        table["classes"].append("words")
        for row in rows if len(titles) > 2 else ():
            for title, cell in zip(titles[1:], row, strict=True):
                if title and cell.astext():
                    cell[0].insert(0, nodes.inline("", f"{title}: ", classes=["label"]))


def _enlarge(app, doctree):
    """Load figures when they come into view.

    A click shows one in its own size; the pictures of cards link to pages.
    """
    for image in doctree.findall(nodes.image):
        image["loading"] = "lazy"
        if "sd-card-img-top" not in image["classes"]:
            image["width"] = "100%"


def _shorten(app, what, name, obj, options, lines):
    """Link the page on options, where docstrings for editors list all of them."""
    text = re.sub(
        r"(\*\*options: )Any of these:\n\n(?: {8}.*\n)+",
        r"\1See :doc:`/options`.\n",
        "\n".join(lines),
    )
    lines[:] = text.split("\n")


def setup(app):
    """Called by Sphinx."""
    app.connect("builder-inited", lambda app: write_notebooks(DOCS))
    app.connect("doctree-read", _trim)
    app.connect("doctree-read", _label)
    app.connect("doctree-read", _enlarge)
    app.connect("autodoc-process-docstring", _shorten, priority=400)  # before napoleon
