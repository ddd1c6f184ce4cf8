"""Templates: models to start from, one file each, from the model's class to a trained policy, with tests.

``python -m simenv_marl new plain|simpy|mesa NAME`` copies one of the modules of this package, puts
``NAME`` into it, and writes tests beside it. They also run as they are:
``python -m simenv_marl.testing.templates.plain``.
"""

import keyword
import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Final
from unicodedata import normalize

from ...errors import OptionValueError, short_repr

KINDS: Final = {"plain": "stable-baselines3", "simpy": "simpy", "mesa": "mesa"}
"""The kinds of templates, and the packages that each needs besides ``simenv-marl[experiments]``."""

_TESTS: Final = '''\
"""Tests of MyModel. Keep them when you replace the model: they say whether its environments can be trusted."""

from my_model import MySimulation

from simenv_marl.testing import check_simulation


def test_there_is_nothing_to_complain_of() -> None:
    """With the rule throughout, environments repeat the plain run; seeds, resets, spaces and rewards are right."""
    report = check_simulation(MySimulation, episodes=2, max_steps=300)
    assert {finding.severity for finding in report.findings} <= {"note"}, str(report)
'''


def write_template(kind: str, name: str, folder: Path | None = None) -> str:
    """Write a template and its tests into a folder, and return what was written and what to do next.

    Without a folder, the current one gets a new one with the name of the module. ``water_tank`` has
    a ``WaterTankModel`` and a ``WaterTankSimulation``.

    Raises:
        OptionValueError: The name cannot be used, a file exists already, or the folder cannot be
            written to.
    """
    problem = ""
    if (
        not name.isidentifier()
        or keyword.iskeyword(name)
        or name != name.lower()
        or name.startswith("_")
    ):
        problem = "cannot be the name of a module"
    elif normalize("NFKC", name) != name:  # as with a ligature
        problem = f"is {normalize('NFKC', name)!r} in Python, which would not find the file"
    elif (spec := find_spec(name)) is not None and spec.origin is not None:
        problem = f"is the name of another module ({spec.origin}), which the new file would hide"
    if problem:
        raise OptionValueError(f"{short_repr(name)} {problem}; choose one like water_tank")
    folder, title = Path(name) if folder is None else folder, name.title().replace("_", "")
    template = Path(__file__).with_name(f"{kind}.py").read_text(encoding="utf-8")
    texts = {
        folder / f"{name}.py": template,
        folder / f"test_{name}.py": _TESTS.replace("my_model", name),
    }
    for path in texts:
        if path.exists():
            raise OptionValueError(
                f"{path} exists already, and is not overwritten; choose another name or folder"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in texts.items():
            text = text.replace("MyModel", f"{title}Model").replace(
                "MySimulation", f"{title}Simulation"
            )
            path.write_text(text.replace(f"{__name__}.{kind}", name), encoding="utf-8")
    except OSError as error:
        raise OptionValueError(f"{error.filename} cannot be written: {error.strerror}") from error
    module, tests = texts
    return f"""wrote {module}
wrote {tests}

Next:
  pip install "simenv-marl[experiments]" pytest {KINDS[kind]}
  cd {shlex.quote(str(folder))}
  python -m {name}    # trains, and compares with the model's own rule
  python -m pytest"""
