"""The folder in which an experiment is stored: what is known of each run, one line of JSON for each.

::

    store/
      experiment.json       what every run has: the names of factors and metrics
      runs-<id>-<id>.jsonl  a file for each process that has run something, to which only that process has appended

A line is written at once and as a whole, as soon as a run is known. So a process that is killed loses what it was
running; a line that it has not finished is the last of its file, and a run that is not known. Nothing is a pickle.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple
from uuid import uuid4

from ..errors import OptionValueError, StoreError, shown, warn_user
from .playing import Outcome

VERSION: Final = 1
HEADER: Final = "experiment.json"

Key = tuple[str, str, int]
"""What tells a run from all others: its row, written as JSON, the contender, the seed."""


def written(value: Any) -> str:
    """A value as JSON, on one line."""
    return json.dumps(value, separators=(",", ":"))


class Known(NamedTuple):
    """What is known of a run.

    Attributes:
        outcome: What has come of it; None where it has failed.
        error: The error in which it has failed; None where it has not.
    """

    outcome: Outcome | None
    error: str | None


class Writer:
    """What one process appends to its file."""

    def __init__(self, store: Path, session: str) -> None:
        """Open the file of this process.

        Args:
            store: The folder.
            session: What all processes have in common that take part.

        Raises:
            StoreError: It cannot be opened.
        """
        if not (store / HEADER).exists():
            raise StoreError(
                f"the store {store} is not seen by the process that is to write to it; give a folder that all machines"
                " share"
            )
        self._path = store / f"runs-{session}-{_process()}.jsonl"
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
        try:
            self._file = os.open(self._path, flags, 0o666)
        except OSError as error:
            raise _unwritable(self._path, error) from error

    def write(self, line: str) -> None:
        """Append a line.

        Raises:
            StoreError: It cannot be written. What was written before is as it was.
        """
        data = line.encode("ascii") + b"\n"
        before = os.fstat(self._file).st_size
        try:
            left = data
            while left:
                left = left[os.write(self._file, left) :]
        except BaseException as error:
            os.ftruncate(self._file, before)
            if isinstance(error, OSError):
                raise _unwritable(self._path, error) from error
            raise

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._file)


_processes: dict[int, str] = {}


def _process() -> str:
    """What tells this process from all others, on all machines."""
    return _processes.setdefault(os.getpid(), uuid4().hex[:12])


def _unwritable(path: Path, error: OSError) -> StoreError:
    reason = error.strerror or str(error)
    return StoreError(f"nothing can be written to {path}: {reason}; what was stored before stays, and can be read")


# -- what every run has ---------------------------------------------------------------------------


def prepare(store: Path, factors: Sequence[str], metrics: Sequence[str]) -> None:
    """Make a folder ready for an experiment, or make sure that it is one of the same.

    Raises:
        OptionValueError: It is a store of something else.
        StoreError: It cannot be read or written.
    """
    header = store / HEADER
    meant = {"simenv_marl": VERSION, "factors": sorted(factors), "metrics": sorted(metrics)}
    try:
        store.mkdir(parents=True, exist_ok=True)
        if not header.exists():
            if any(not path.name.startswith(HEADER) for path in store.iterdir()):
                raise OptionValueError(f"the folder {store} holds something, and is the store of no experiment")
            fresh = store / f"{HEADER}.{uuid4().hex}"  # replaced as a whole, so that it is there or not
            try:
                fresh.write_text(json.dumps(meant) + "\n", encoding="ascii")
                os.replace(fresh, header)
            finally:
                fresh.unlink(missing_ok=True)
        found = json.loads(header.read_text(encoding="ascii"))
    except OSError as error:
        raise _unwritable(store, error) from error
    except ValueError as error:
        if isinstance(error, OptionValueError):
            raise
        raise StoreError(f"{header} cannot be read: {error}") from error
    if not isinstance(found, dict) or found.get("simenv_marl") != VERSION:
        raise OptionValueError(f"{header} was not written by this version of simenv_marl")
    for what in ("factors", "metrics"):
        if found[what] != meant[what]:
            raise OptionValueError(
                f"the store {store} is one of another experiment: its {what} are {found[what]}, and not {meant[what]};"
                " give another folder"
            )


# -- reading --------------------------------------------------------------------------------------


def lines(store: Path) -> Iterator[dict[str, Any]]:
    """All that is stored, in the order of the names of files.

    Raises:
        StoreError: A file cannot be read.
    """
    for path in sorted(store.glob("runs-*.jsonl")):
        try:
            with path.open("rb") as file:
                for number, line in enumerate(file, 1):
                    if not line.endswith(b"\n"):
                        break  # its process was killed, or is writing it
                    try:
                        yield json.loads(line)
                    except ValueError:
                        warn_user(f"line {number} of {path} cannot be read, and is taken for a run that is not known")
        except OSError as error:
            raise StoreError(f"{path} cannot be read: {error.strerror or error}") from error


def line_of(
    row: Mapping[str, Any], contender: str, seed: int, known: Known, provenance: str, trace: str | None = None
) -> str:
    """The line of a run.

    Args:
        row: The factors.
        contender: Who has decided.
        seed: What it was reset with.
        known: What is known of it.
        provenance: What it was made of, as JSON.
        trace: Where it has failed, for those who look.
    """
    entry: dict[str, Any] = {
        "factors": row,
        "contender": contender,
        "seed": seed,
        "status": "ok" if known.outcome is not None else "error",
        "error": known.error,
    }
    if known.outcome is not None:
        entry |= known.outcome._asdict()
    if trace is not None:
        entry["traceback"] = trace
    return f'{written(entry)[:-1]},"provenance":{provenance}}}'


class Stored(NamedTuple):
    """What a store holds.

    Attributes:
        runs: What is known of each run.
        rows: All rows that are known, as JSON.
        versions: The versions of what has run: by package, all that there were.
    """

    runs: dict[Key, Known]
    rows: set[str]
    versions: dict[str, set[Any]]


def read(store: Path, factors: Sequence[str]) -> Stored:
    """All that is stored; of a run that was run twice, what did not fail.

    Raises:
        StoreError: Something cannot be read.
    """
    runs: dict[Key, Known] = {}
    rows: dict[str, str] = {}  # each is kept once, however many runs it has
    versions: dict[str, set[Any]] = {}
    seen: set[str] = set()
    for entry in lines(store):
        try:
            row = written({name: entry["factors"][name] for name in factors})
            key = rows.setdefault(row, row), entry["contender"], entry["seed"]
            outcome = None
            if entry["status"] == "ok":
                outcome = Outcome(entry["returns"], entry["lengths"], entry["metrics"])
            known = Known(outcome, entry["error"])
            provenance = entry["provenance"]
        except (KeyError, TypeError) as error:
            raise StoreError(f"the store {store} has a line that is no run: {shown(entry)} ({error!r})") from error
        if key not in runs or (runs[key].outcome is None and outcome is not None):
            runs[key] = known
        made_with = {name: provenance.get(name) for name in ("python", "packages", "dependencies")}
        text = written(made_with)
        if text not in seen:
            seen.add(text)
            for package, version in versions_in(made_with).items():
                versions.setdefault(package, set()).add(version)
    return Stored(runs, set(rows), versions)


def versions_in(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The versions that provenance tells of, by package."""
    own = {"python": provenance["python"]} if provenance.get("python") else {}
    return {**own, **(provenance.get("packages") or {}), **(provenance.get("dependencies") or {})}
