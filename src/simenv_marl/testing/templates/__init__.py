"""Templates: models to start from, with an environment, training and tests.

``python -m simenv_marl new plain|simpy|mesa NAME`` copies a module of this package, puts ``NAME``
into it, and writes tests beside it. The modules also run as they are:
``python -m simenv_marl.testing.templates.plain``.
"""

import keyword
import re
import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from ...errors import OptionValueError, short_repr

KINDS: Final = {"plain": "stable-baselines3", "simpy": "simpy", "mesa": '"mesa[network]"'}
"""The packages that each kind of template needs besides ``simenv-marl[experiments]``."""

_TESTS: Final = '''\
"""Tests of MyModel. Keep them when you replace the model: they check its environments."""

from my_model import MySimulation

from simenv_marl.testing import check_simulation


def test_there_is_nothing_to_complain_of() -> None:
    """Under its rule, an environment repeats the plain run; seeds, spaces and rewards are right."""
    report = check_simulation(MySimulation, episodes=2, max_steps=300)
    assert {finding.severity for finding in report.findings} <= {"note"}, str(report)
'''


def write_template(kind: str, name: str, folder: Path | None = None) -> str:
    """Write a template and its tests into a folder.

    The default folder is a new one in the current folder, with the name of the module.
    ``water_tank`` has a ``WaterTankModel`` and a ``WaterTankSimulation``.

    Returns:
        A text that names the files and the next steps.

    Raises:
        OptionValueError: The name is invalid, a file exists already, or the folder cannot be
            written to.
    """
    _check_name(name)
    folder = folder or Path(name)
    module, tests = folder / f"{name}.py", folder / f"test_{name}.py"
    template = Path(__file__).with_name(f"{kind}.py").read_text(encoding="utf-8")
    template = template.replace(f"{__name__}.{kind}", name)
    for path in (module, tests):
        if path.exists():
            raise OptionValueError(
                f"{path} exists already, and is not overwritten; choose another name or folder"
            )
    title = name.title().replace("_", "").removesuffix("Model")
    files = {module: template, tests: _TESTS.replace("my_model", name)}
    if not folder.exists():
        # In a checkout of the library, its own options of pytest would hide the module.
        files[folder / "pytest.ini"] = "[pytest]\n"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in files.items():
            for part in ("Model", "Simulation"):
                text = text.replace(f"My{part}", f"{title}{part}")
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OptionValueError(f"{error.filename} cannot be written: {error.strerror}") from error
    written = "\n".join(f"wrote {path}" for path in files)
    return f"""{written}

Next:
  pip install "simenv-marl[experiments]" pytest {KINDS[kind]}
  cd {shlex.quote(str(folder))}
  python -m {name}    # trains, and compares with the model's own rule
  python -m pytest
  python -m simenv_marl play {name}:{title}Simulation    # decide yourself; with [play]"""


def _check_name(name: str) -> None:
    """Check the name of a new module.

    Raises:
        OptionValueError: It is invalid.
    """
    if not re.fullmatch("[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        problem = "cannot be the name of a module: use lower-case letters, digits and underscores"
    elif (spec := find_spec(name)) is not None and spec.origin is not None:
        problem = f"is the name of another module ({spec.origin}), which the new file would hide"
    else:
        return
    raise OptionValueError(f"{short_repr(name)} {problem}; choose one like water_tank")
