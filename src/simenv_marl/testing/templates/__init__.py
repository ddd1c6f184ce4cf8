"""Templates: models to start from, one file each, from the model's class to a trained policy, with tests.

``python -m simenv_marl new plain|simpy|mesa NAME`` copies one of the modules of this package and puts ``NAME`` into it.
They also run as they are: ``python -m simenv_marl.testing.templates.plain``.
"""

from __future__ import annotations

import ast
import builtins
import keyword
import shlex
import sys
from dataclasses import dataclass
from importlib.machinery import PathFinder
from importlib.resources import files
from pathlib import Path
from typing import Final

from ...errors import OptionValueError, short_repr

KINDS: Final = {
    "plain": "stable-baselines3",
    "simpy": "simpy cma",
    "mesa": "mesa",
}
"""The kinds of templates, and the packages that each needs besides ``simenv-marl[experiments]``."""

PLACEHOLDER: Final = "MyModel"
"""The name of the model's class in the templates, which is replaced; so is the name of their module."""


@dataclass(frozen=True)
class Written:
    """The files that were written.

    Attributes:
        kind: The kind of the template.
        files: The module, and its tests.
    """

    kind: str
    files: tuple[Path, Path]

    def __str__(self) -> str:
        module, tests = self.files
        return "\n".join(
            [
                f"wrote {module}",
                f"wrote {tests}",
                "",
                "Next:",
                f'  pip install "simenv-marl[experiments]" pytest {KINDS[self.kind]}',
                f"  cd {shlex.quote(str(module.parent))}",
                f"  python -m {module.stem}    # trains, and compares with the model's own rule",
                "  python -m pytest",
            ]
        )


def write_template(kind: str, name: str, folder: Path | None = None) -> Written:
    """Write a template and its tests into a folder.

    Args:
        kind: One of ``KINDS``.
        name: The name of the new module. Its class gets the same name in CamelCase: ``water_tank`` has a ``WaterTank``.
        folder: The folder to write to; it is created if it does not exist. None: a folder of that name in the current
            one.

    Returns:
        The files that were written.

    Raises:
        OptionValueError: The name cannot be used, a file exists already, or the folder cannot be written to.
    """
    template = _text(kind)
    class_name = "".join(part[:1].upper() + part[1:] for part in name.split("_"))
    _check_name(name, class_name, template)
    folder = Path(name) if folder is None else folder
    texts = {folder / f"{name}.py": template, folder / f"test_{name}.py": _text(f"test_{kind}")}
    for path in texts:
        if path.exists():
            raise OptionValueError(f"{path} exists already, and is not overwritten; choose another name or folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in texts.items():
            text = text.replace(PLACEHOLDER, class_name).replace(f"{__name__}.{kind}", name)
            with path.open("x", encoding="utf-8") as file:
                file.write(text)
    except OSError as error:
        raise OptionValueError(f"{error.filename} cannot be written: {error.strerror}") from error
    module, tests = texts
    return Written(kind, (module, tests))


def _text(module: str) -> str:
    return (files(__name__) / f"{module}.py").read_text(encoding="utf-8")


def _check_name(name: str, class_name: str, template: str) -> None:
    """Refuse names that are not valid, that hide another module, or whose class exists in the template."""
    example = "; choose one like water_tank"
    if not name.isidentifier() or keyword.iskeyword(name) or not class_name.isidentifier():
        raise OptionValueError(
            f"{short_repr(name)} cannot be the name of a module and, as {class_name}, of a class{example}"
        )
    tree = ast.parse(template)
    imported = {node.names[0].name.partition(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import)}
    if name in sys.stdlib_module_names or name.lower() in imported or _installed(name):
        raise OptionValueError(
            f"{short_repr(name)} is the name of another module, which the new file would hide{example}"
        )
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    used |= {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)} - {PLACEHOLDER}
    if class_name in used or hasattr(builtins, class_name):
        raise OptionValueError(f"{short_repr(name)} would name the class {class_name}, and that name is taken{example}")


def _installed(name: str) -> bool:
    """Return whether Python finds a module or package of that name anywhere but in the current folder."""
    here = ("", str(Path.cwd()))
    spec = PathFinder.find_spec(name, [entry for entry in sys.path if entry not in here])
    return spec is not None and spec.origin is not None
