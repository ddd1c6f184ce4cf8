"""Templates: models to start from, one file each, from the model's class to a trained policy, with tests.

``python -m simenv_marl new plain|simpy|mesa NAME`` copies one of the modules of this package and its tests, and puts
``NAME`` into both. They also run as they are: ``python -m simenv_marl.testing.templates.plain``.
"""

import keyword
import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from ...errors import OptionValueError, short_repr

KINDS: Final = {"plain": "stable-baselines3", "simpy": "simpy", "mesa": "mesa"}
"""The kinds of templates, and the packages that each needs besides ``simenv-marl[experiments]``."""


def write_template(kind: str, name: str, folder: Path | None = None) -> str:
    """Write a template and its tests into a folder.

    Args:
        kind: One of ``KINDS``.
        name: The name of the new module. ``water_tank`` has a ``WaterTankModel`` and a ``WaterTankSimulation``.
        folder: The folder to write to, which may be new. None: a folder of that name in the current one.

    Returns:
        What was written, and what to do next.

    Raises:
        OptionValueError: The name cannot be used, a file exists already, or the folder cannot be written to.
    """
    if not name.isidentifier() or keyword.iskeyword(name) or name != name.lower() or name.startswith("_"):
        raise OptionValueError(f"{short_repr(name)} cannot be the name of a module; choose one like water_tank")
    folder = Path(name) if folder is None else folder
    module, tests = folder / f"{name}.py", folder / f"test_{name}.py"
    for path in (module, tests):
        if path.exists():
            raise OptionValueError(f"{path} exists already, and is not overwritten; choose another name or folder")
    spec = find_spec(name)
    if spec is not None and spec.origin is not None:
        raise OptionValueError(
            f"{short_repr(name)} is the name of another module ({spec.origin}), which the new file would hide; choose"
            " one like water_tank"
        )
    title = name.title().replace("_", "")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, source in ((module, kind), (tests, "test_model")):
            text = Path(__file__).with_name(f"{source}.py").read_text(encoding="utf-8")
            text = text.replace("MyModel", f"{title}Model").replace("MySimulation", f"{title}Simulation")
            for template in KINDS:
                text = text.replace(f"{__name__}.{template}", name)
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OptionValueError(f"{error.filename} cannot be written: {error.strerror}") from error
    return f"""wrote {module}
wrote {tests}

Next:
  pip install "simenv-marl[experiments]" pytest {KINDS[kind]}
  cd {shlex.quote(str(folder))}
  python -m {name}    # trains, and compares with the model's own rule
  python -m pytest"""
