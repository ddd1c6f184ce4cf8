"""What turns the sources in Java into classes, or says what is missing for it."""

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
"""The client, which every model in Java is compiled with."""

SOURCES: Final = (CLIENT, *sorted(HERE.glob("*.java")))
"""Those of this example."""

OUT: Final = HERE / "out"
"""Where its classes are."""

VERSION: Final = 17
"""The oldest Java that serves."""


def java() -> tuple[str, str]:
    """Find the commands that run and compile Java.

    Returns:
        Both.

    Raises:
        RuntimeError: One is missing, or too old.
    """
    remedy = f"install a JDK of version {VERSION} or newer (Debian: apt-get install openjdk-17-jdk-headless)"
    found = []
    for name in ("java", "javac"):
        command = shutil.which(name)
        if command is None:
            raise RuntimeError(f"{name} is not found on the PATH; {remedy}")
        found.append(command)
    said = subprocess.run([found[1], "-version"], capture_output=True, text=True, timeout=60)
    version = (said.stdout + said.stderr).removeprefix("javac ").strip()  # older ones say it on stderr
    if not version.split(".")[0].isdecimal() or int(version.split(".")[0]) < VERSION:
        raise RuntimeError(f"{found[1]} is of version {version}; {remedy}")
    return found[0], found[1]


def build(out: Path = OUT, sources: Iterable[Path] = SOURCES) -> Path:
    """Compile sources, unless they are compiled already.

    Args:
        out: The folder of the classes.
        sources: All files.

    Returns:
        The folder.

    Raises:
        RuntimeError: There is no JDK, or the sources do not compile; with the words of the compiler.
    """
    sources = list(sources)
    with sources[0].open() as locked:  # for those that want to build it at the same time
        fcntl.flock(locked, fcntl.LOCK_EX)
        done = out / "done"
        if not done.exists() or done.stat().st_mtime < max(source.stat().st_mtime for source in sources):
            _compile(sources, out)
    return out


def _compile(sources: list[Path], out: Path) -> None:
    """Compile, and take the classes into use when they are whole."""
    _, javac = java()
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".java-") as folder:
        classes = Path(folder) / "classes"
        command = [javac, "-Xlint:all", "-Werror", "-encoding", "UTF-8", "-d", str(classes), *map(str, sources)]
        said = subprocess.run(command, capture_output=True, text=True, timeout=300)
        if said.returncode:
            raise RuntimeError(f"{' '.join(command)} has failed:\n{said.stdout}{said.stderr}")
        (classes / "done").touch()
        if out.exists():
            out.rename(Path(folder) / "old")
        classes.rename(out)
