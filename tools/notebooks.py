"""Make notebooks of pages: the same text and the same code, executed.

``docs/conf.py`` calls ``write_notebooks`` when Sphinx builds the pages. A notebook that shows
something else than its page ends the build.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from doctest import ELLIPSIS, NORMALIZE_WHITESPACE, DocTestParser, OutputChecker
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import nbformat
from nbclient import NotebookClient

PAGES = ("tutorial", "many-agents", "branches")
"""The pages that have a notebook."""

FENCE = re.compile(r"^```(\S+)([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[([^]]*)\]\(([\w/-]+\.md)?(?:#[\w-]+)?\)")
DOWNLOAD = re.compile(r"\{download\}`([\w.]+)`")
NOTEBOOK = re.compile(r"\n[^\n]*\{download\}`[^`]*\.ipynb>`[^\n]*\n")


SECONDS: Final = 300
"""How long a cell may take."""

LOG = logging.getLogger(__name__)
LOG.setLevel(logging.WARNING)

FLAGS = ELLIPSIS | NORMALIZE_WHITESPACE


def write_notebooks(docs: Path, pages: tuple[str, ...] = PAGES) -> None:
    """Write the executed notebooks of pages into ``_notebooks``.

    Args:
        docs: The folder of the pages.
        pages: The names of the pages.

    Raises:
        ValueError: A cell shows something else than the page.
    """
    folder = docs / "_notebooks"
    folder.mkdir(exist_ok=True)
    for page in pages:
        book = executed(notebook(docs, page))
        nbformat.write(book, folder / f"{page}.ipynb")  # type: ignore[no-untyped-call]


def executed(made: Any) -> Any:
    """Execute a notebook in an empty folder.

    Args:
        made: The notebook, with the outputs of the page.

    Returns:
        A notebook with the outputs of the cells.

    Raises:
        ValueError: A cell shows something else than the page.
    """
    found = nbformat.from_dict(made)  # type: ignore[no-untyped-call]
    with TemporaryDirectory() as folder:
        NotebookClient(
            found,
            timeout=SECONDS,
            resources={"metadata": {"path": folder}},
            extra_arguments=["--log-level=ERROR"],  # of the kernel, which warns of its own ports
            log=LOG,
        ).execute()
    for cell, run in zip(made["cells"], found["cells"], strict=True):
        if cell["cell_type"] == "code" and not cell["source"].startswith("%%writefile"):
            expected, shown = _shown(cell["outputs"]), _shown(run["outputs"])
            if not OutputChecker().check_output(expected, shown, FLAGS):
                raise ValueError(f"{cell['source']}\nshows\n{shown}\nand its page has\n{expected}")
    return found


def _shown(outputs: list[Any]) -> str:
    """Return what a cell prints, its value or the name of its error."""
    texts = []
    for output in outputs:
        match output["output_type"]:
            case "stream" if output["name"] == "stdout":
                texts.append(output["text"])
            case "execute_result":
                texts.append(output["data"]["text/plain"] + "\n")
            case "error":
                texts.append(output["ename"].rpartition(".")[2] + "\n")
    return "".join(texts)


def notebook(docs: Path, page: str) -> dict[str, Any]:
    """Make the notebook of a page.

    Args:
        docs: The folder of the pages.
        page: The name of the page.

    Returns:
        The notebook, in format 4.5, with the outputs that the page shows.
    """
    cells = []
    for number, cell in enumerate(
        _cells(docs, NOTEBOOK.sub("\n", (docs / f"{page}.md").read_text(encoding="utf-8")))
    ):
        cells.append(cell | {"id": f"{page}-{number}", "metadata": cell.get("metadata", {})})
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def _cells(docs: Path, text: str) -> Iterator[dict[str, Any]]:
    """Yield the cells of a page, in order.

    A cell writes each file that the page needs before its first use.
    """
    position, written = 0, set[str]()
    for found in [*FENCE.finditer(text), None]:
        prose = text[position : found.start() if found else None].strip()
        if prose:
            yield {"cell_type": "markdown", "source": _prose(docs, prose)}
        files = set(DOWNLOAD.findall(prose))
        if found and found[1] == "{literalinclude}":
            files.add(found[2].strip())
        for file in sorted(files - written):
            source = (docs / file).read_text(encoding="utf-8")
            yield _code(f"%%writefile {file}\n{source.rstrip()}")
        written |= files
        if found and found[1] == "python":
            yield from _examples(found[3])
        position = found.end() if found else len(text)


def _prose(docs: Path, text: str) -> str:
    """Replace links to other pages and to downloads, which do not work in a notebook."""

    def title(link: re.Match[str]) -> str:
        if link[1] or not link[2]:
            return link[1]
        heading, _ = (docs / link[2]).read_text(encoding="utf-8").split("\n", 1)
        return f"*{heading.removeprefix('# ')}*"

    return DOWNLOAD.sub(r"`\1`", LINK.sub(title, text))


def _examples(session: str) -> Iterator[dict[str, Any]]:
    """Yield the cells of a session: each ends where the session shows an output."""
    sources: list[str] = []
    for example in DocTestParser().get_examples(session):
        sources.append(example.source)
        if example.exc_msg is not None:
            kind, _, message = example.exc_msg.strip().partition(": ")
            trace = [example.want]
            error = {"output_type": "error", "ename": kind, "evalue": message, "traceback": trace}
            yield _code("".join(sources), error) | {"metadata": {"tags": ["raises-exception"]}}
            sources = []
        elif example.want:
            yield _code(
                "".join(sources), {"output_type": "stream", "name": "stdout", "text": example.want}
            )
            sources = []
    if sources:
        yield _code("".join(sources))


def _code(source: str, *outputs: dict[str, Any]) -> dict[str, Any]:
    return {
        "cell_type": "code",
        "source": source.rstrip("\n"),
        "outputs": list(outputs),
        "execution_count": None,
    }
