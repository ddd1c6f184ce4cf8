"""Compile the Java sources, or report what is missing."""

from __future__ import annotations

import fcntl
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).parent

CLIENT: Final = HERE.parents[1] / "clients" / "java" / "SimEnv.java"
"""The client, which every Java model is compiled with."""

SOURCES: Final = (CLIENT, *sorted(HERE.glob("*.java")))
"""The sources of this example."""

OUT: Final = HERE / "out"
"""The folder of its classes."""

VERSION: Final = 17
"""The oldest supported version of Java."""


def java() -> tuple[str, str]:
    """Find the commands ``java`` and ``javac``.

    Returns:
        The paths of both.

    Raises:
        RuntimeError: A command is missing or too old.
    """
    remedy = (
        f"install a JDK of version {VERSION} or newer "
        "(Debian: apt-get install openjdk-17-jdk-headless)"
    )
    found = []
    for name in ("java", "javac"):
        command = shutil.which(name)
        if command is None:
            raise RuntimeError(f"{name} is not found on the PATH; {remedy}")
        found.append(command)
    said = subprocess.run([found[1], "-version"], capture_output=True, text=True, timeout=60)
    # older versions print it to stderr
    version = (said.stdout + said.stderr).removeprefix("javac ").strip()
    if not version.split(".")[0].isdecimal() or int(version.split(".")[0]) < VERSION:
        raise RuntimeError(f"{found[1]} is of version {version}; {remedy}")
    return found[0], found[1]


def build(out: Path = OUT, sources: Iterable[Path] = SOURCES) -> Path:
    """Compile sources, unless the classes are up to date.

    Args:
        out: The folder of the classes.
        sources: The source files.

    Returns:
        The folder of the classes.

    Raises:
        RuntimeError: There is no JDK, or the sources do not compile; the message contains the
            compiler's output.
    """
    sources = list(sources)
    with sources[0].open() as locked:  # parallel builds wait here
        fcntl.flock(locked, fcntl.LOCK_EX)
        done = out / "done"
        if not done.exists() or done.stat().st_mtime < max(
            source.stat().st_mtime for source in sources
        ):
            _compile(sources, out)
    return out


def _compile(sources: list[Path], out: Path) -> None:
    """Compile, and move the classes into place once they are complete."""
    _, javac = java()
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".java-") as folder:
        classes = Path(folder) / "classes"
        command = [
            javac,
            "-Xlint:all",
            "-Werror",
            "-encoding",
            "UTF-8",
            "-d",
            str(classes),
            *map(str, sources),
        ]
        said = subprocess.run(command, capture_output=True, text=True, timeout=300)
        if said.returncode:
            raise RuntimeError(f"{' '.join(command)} has failed:\n{said.stdout}{said.stderr}")
        (classes / "done").touch()
        if out.exists():
            out.rename(Path(folder) / "old")
        classes.rename(out)
