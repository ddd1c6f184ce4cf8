"""Build and unpack the room's co-simulation units: one from C, two from Python."""

from __future__ import annotations

import fcntl
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import fmpy

HERE: Final = Path(__file__).parent
UNITS: Final = {"c": "room", "fmi2": "RoomFmi2", "fmi3": "RoomFmi3"}
BUILDERS: Final = {"fmi2": "pythonfmu", "fmi3": "pythonfmu3"}


def unit(kind: str) -> Path:
    """Return the folder of an unpacked unit, one of ``UNITS``.

    Build it, unless it is up to date.
    """
    out = HERE / "out"
    sources = [HERE / "room.c", HERE / "room.xml"] if kind == "c" else [HERE / f"room_{kind}.py"]
    target = out / f"{kind}-{max(source.stat().st_mtime_ns for source in sources)}"
    out.mkdir(exist_ok=True)
    with sources[0].open() as locked, TemporaryDirectory(dir=out) as folder:
        fcntl.flock(locked, fcntl.LOCK_EX)  # parallel builds wait here
        if not target.exists():
            _build(kind, sources, Path(folder))
            Path(fmpy.extract(f"{folder}/{UNITS[kind]}.fmu", f"{folder}/unpacked")).replace(target)
    return target


def _build(kind: str, sources: list[Path], folder: Path) -> None:
    library = folder / f"room{sysconfig.get_config_var('SHLIB_SUFFIX')}"
    headers = Path(fmpy.__file__).parent / "c-code"
    command = [
        "gcc",
        "-O2",
        "-shared",
        "-fPIC",
        f"-I{headers}",
        str(sources[0]),
        "-o",
        str(library),
        "-lm",
    ]
    if kind != "c":
        command = [
            sys.executable,
            "-m",
            BUILDERS[kind],
            "build",
            "-f",
            str(sources[0]),
            "-d",
            str(folder),
        ]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} has failed:\n{done.stderr[-4000:]}")
    if kind == "c":
        with zipfile.ZipFile(folder / "room.fmu", "w") as packed:
            packed.write(sources[1], "modelDescription.xml")
            packed.write(library, f"binaries/{fmpy.platform}/{library.name}")
