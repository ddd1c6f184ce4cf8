"""Configuration of the documentation; ``make docs`` builds it into ``docs/_build``."""

import re
import sys
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.nodes import make_refnode

from simenv_marl import ROOMS, __version__

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
from tools.notebooks import write_notebooks  # noqa: E402

project = "simenv_marl"
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
extensions += ["sphinx.ext.viewcode", "sphinx_copybutton", "sphinx_design"]
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
pygments_dark_style = "a11y-dark"  # the partner of furo's light style; it underlines no names
html_title = f"simenv_marl {release}"
html_static_path = ["_static"]
html_extra_path = ["_moved"]  # pages at old addresses, which lead to the new ones
html_css_files = ["pages.css"]
html_js_files = ["sidebar.js"]
html_copy_source = False
html_show_copyright = False
html_theme_options = {"top_of_page_buttons": []}

MOST_SECTIONS_UNLISTED = 3
COLUMNS = {"difference", "first"}  # of tables of experiments, and also names of functions


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


def _load_lazily(app, doctree):
    """Load figures when they come into view.

    A click shows one in its own size, because Sphinx links pictures that have a width. pages.css
    shows none larger than that. The pictures of cards link to pages.
    """
    for image in doctree.findall(nodes.image):
        image["loading"] = "lazy"
        if "sd-card-img-top" not in image["classes"]:
            image["width"] = "100%"


class LinkNames(SphinxPostTransform):
    """Link code in prose that is the name of a public object, or of a member of one."""

    default_priority = 900  # after references, whose text may be code

    def run(self, **kwargs):
        """Replace each such text by a link to the entry of the object."""
        entries = _entries_by_name(self.env.domains.python_domain.objects)
        for code in list(self.document.findall(nodes.literal)):
            entry = entries.get(code.astext().removesuffix("()"))
            is_column = code.astext() in COLUMNS and self.env.docname == "reference/experiments"
            if entry and not is_column and not _is_linked(code, entry.node_id):
                place = (self.env.docname, entry.docname, entry.node_id)
                code.replace_self(make_refnode(self.app.builder, *place, code.deepcopy()))


def _entries_by_name(objects):
    """Return the entries of objects, by the names that prose has for them."""
    found = {}
    for name, entry in objects.items():
        if entry.aliased or not name.startswith("simenv_marl."):
            continue
        short = name.removeprefix("simenv_marl.")
        room, _, rest = short.partition(".")
        found |= dict.fromkeys({name, short, rest if room in ROOMS else short}, entry)
    return found


def _is_linked(node, node_id):
    """Whether a node is in a link, in a heading, or in the entry itself."""
    while node := node.parent:
        if isinstance(node, (nodes.reference, nodes.title, addnodes.desc_signature)):
            return True
        if isinstance(node, addnodes.desc) and node_id in node[0]["ids"]:
            return True
    return False


def _shorten(app, what, name, obj, options, lines):
    """Link the page on options, where docstrings for editors list all of them."""
    text = re.sub(
        r"(\*\*options: )Any of these:\n\n(?: {8}.*\n)+",
        r"\1See :doc:`/options`.\n",
        "\n".join(lines),
    )
    lines[:] = text.split("\n")


def _keep_colons(app, what, name, obj, options, lines):
    """Keep the first words of an attribute's text, which napoleon takes for its type at a colon."""
    if what == "attribute" and lines:
        lines[0] = f": {lines[0]}"


def _list_sections(app, pagename, templatename, context, doctree):
    """List the sections of a long page at its top, for screens without room beside the text."""
    toc = context.get("toc", "")
    sections = toc.count("<li>") - toc.count("><code")  # without the names in the reference
    shown = doctree is not None and "hide-toc" not in context["meta"]
    if shown and sections > MOST_SECTIONS_UNLISTED:
        listed = f'<details class="sections" open><summary>On this page</summary>{toc}</details>'
        context["body"] = context["body"].replace("</h1>", f"</h1>\n{listed}", 1)


def setup(app):
    """Called by Sphinx."""
    app.add_post_transform(LinkNames)
    app.connect("builder-inited", lambda app: write_notebooks(DOCS))
    app.connect("doctree-read", _trim)
    app.connect("doctree-read", _label)
    app.connect("doctree-read", _load_lazily)
    app.connect("html-page-context", _list_sections)
    app.connect("autodoc-process-docstring", _shorten, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", _keep_colons, priority=400)  # the same
