"""The folder in which an experiment is stored: what is known of each run, one line of JSON for each.

::

    store/
      experiment.json       what every run has: the names of factors and metrics
      runs-<id>-<id>.jsonl  a file for each process that has run something, to which only that process has appended;
                            the first id is later the later it was begun

A line is written at once and as a whole, as soon as a run is known. So a process that is killed loses what it was
running; a line that it has not finished is the last of its file, and a run that is not known. Nothing is a pickle.
"""

from __future__ import annotations

import json
import os
import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple
from uuid import uuid4

from ..errors import LONGEST, OptionValueError, StoreError, warn_user
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


_processes: dict[tuple[int, int], str] = {}


def _process() -> str:
    """What tells this process from all others, on all machines; and this thread, where threads are workers."""
    return _processes.setdefault((os.getpid(), threading.get_ident()), uuid4().hex[:12])


def new_session() -> str:
    """What all processes have in common that take part from now on; in the order of letters, the later the later."""
    return f"{time.time_ns():016x}{uuid4().hex[:8]}"


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
            strange = any(not path.name.startswith((HEADER, ".")) for path in store.iterdir())
            if strange and not header.exists():  # which another process may have made meanwhile
                raise OptionValueError(f"the folder {store} holds something, and is the store of no experiment")
            fresh = store / f"{HEADER}.{uuid4().hex}"  # replaced as a whole, so that it is there or not
            try:
                fresh.write_text(json.dumps(meant) + "\n", encoding="ascii")
                os.replace(fresh, header)
            finally:
                fresh.unlink(missing_ok=True)
        found = json.loads(header.read_text(encoding="ascii"))
    except OSError as error:
        reason = error.strerror or str(error)
        raise StoreError(f"{store} cannot be made or read as the folder of an experiment: {reason}") from error
    except ValueError as error:
        if isinstance(error, OptionValueError):
            raise
        raise StoreError(f"{header} cannot be read: {error}") from error
    if not isinstance(found, dict) or found.get("simenv_marl") != VERSION:
        raise OptionValueError(f"{header} was not written by this version of simenv_marl")
    for what in ("factors", "metrics"):
        if found.get(what) != meant[what]:
            raise OptionValueError(
                f"the store {store} is one of another experiment: its {what} are {found.get(what)}, and not"
                f" {meant[what]}; give another folder"
            )


# -- reading --------------------------------------------------------------------------------------


def lines(store: Path, factors: Sequence[str]) -> Iterator[tuple[Key, Known, dict[str, Any]]]:
    """All that is stored, in the order in which it was begun: which run, what is known of it, its provenance.

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
                        yield _parsed(json.loads(line), factors)
                    except (ValueError, TypeError, LookupError, AttributeError):  # it is no JSON, or no run
                        warn_user(f"line {number} of {path} cannot be read, and is taken for a run that is not known")
        except OSError as error:
            raise StoreError(f"{path} cannot be read: {error.strerror or error}") from error


def _parsed(entry: Any, factors: Sequence[str]) -> tuple[Key, Known, dict[str, Any]]:
    """What a line tells.

    Raises:
        TypeError, LookupError, AttributeError: It is no run.
    """
    key = written({name: entry["factors"][name] for name in factors}), entry["contender"], entry["seed"]
    outcome = None
    if entry["status"] == "ok":
        outcome = Outcome(*(dict(entry[part].items()) for part in Outcome._fields))
    return key, Known(outcome, entry["error"]), dict(entry["provenance"].items())


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
        made: What runs of one row were made of, by contender.
    """

    runs: dict[Key, Known]
    rows: set[str]
    versions: dict[str, set[Any]]
    made: dict[str, list[dict[str, Any]]]


def read(store: Path, factors: Sequence[str], looked_at: str = "") -> Stored:
    """All that is stored; of a run that was run twice, what did not fail, or the latest error.

    Args:
        store: The folder.
        factors: Their names, in the order of the design.
        looked_at: The row, as JSON, of which it is to be told what its runs were made of.

    Raises:
        StoreError: Something cannot be read.
    """
    runs: dict[Key, Known] = {}
    rows: dict[str, str] = {}  # each is kept once, however many runs it has
    versions: dict[str, set[Any]] = {}
    seen: set[str] = set()
    made: dict[str, list[dict[str, Any]]] = {}
    for (row, contender, seed), known, provenance in lines(store, factors):
        key = rows.setdefault(row, row), contender, seed
        if key not in runs or runs[key].outcome is None:
            runs[key] = known
        if row == looked_at:
            made.setdefault(contender, []).append(provenance)
        made_with = {name: provenance.get(name) for name in ("python", "packages", "dependencies")}
        text = written(made_with)
        if text not in seen:
            seen.add(text)
            for package, version in versions_in(made_with).items():
                versions.setdefault(package, set()).add(version)
    return Stored(runs, set(rows), versions, made)


def versions_in(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The versions that provenance tells of, by package."""
    own = {"python": provenance["python"]} if provenance.get("python") else {}
    return {**own, **(provenance.get("packages") or {}), **(provenance.get("dependencies") or {})}


# -- what has changed since ------------------------------------------------------------------------

MADE_OF: Final = ("make", "simulation", "variant", "parameters", "points", "plugins", "policies", "options")
"""What changes what comes of a run, of its provenance."""

ADDRESS: Final = re.compile(" at 0x[0-9a-fA-F]+")
"""What stands for one object in its text, and for another in that of its like."""


def compare(folder: Path, stored: Stored, keys: Sequence[str]) -> None:
    """Compare the rows with those that are stored.

    Raises:
        OptionValueError: It is another experiment.
    """
    strange = stored.rows - set(keys)
    if strange and len(strange) == len(stored.rows):
        raise OptionValueError(
            f"the store {folder} holds runs of {len(strange)} rows, such as {min(strange)}, of which this design has"
            f" none: its first is {keys[0]}; give another folder, or a design that has them too"
        )
    if strange:
        warn_user(
            f"the store {folder} holds runs of {len(strange)} rows that this design does not have, such as"
            f" {min(strange)}; they stay there, and are not in the table"
        )


def warn_of_changes(folder: Path, stored: Stored, made_of: Mapping[str, dict[str, Any]]) -> None:
    """Tell what runs are made of now and were not when the experiment was last run."""
    versions = versions_in(next(iter(made_of.values()), {}))
    changed = {
        name: sorted(map(str, found - {versions[name]}))
        for name, found in stored.versions.items()
        if name in versions and found - {versions[name]}
    }
    if changed:
        listed = "; ".join(f"{name} {', '.join(old)} then, {versions[name]} now" for name, old in changed.items())
        warn_user(f"the store {folder} holds runs that were made with other versions: {listed}")
    for contender, now in made_of.items():
        parts = _parts_of(now)
        for then in map(_parts_of, stored.made.get(contender, ())):
            other = [
                f"{part} {then[part][:LONGEST]} then, {text[:LONGEST]} now"
                for part, text in parts.items()
                if then.get(part, text) != text  # it is not known of what could not be made
            ]
            if other:
                warn_user(
                    f"the store {folder} holds runs of {contender!r} that were made otherwise: {'; '.join(other)}; they"
                    " stay what they are, so give another folder if all are to be alike"
                )
                return


def _parts_of(made: Mapping[str, Any]) -> dict[str, str]:
    """What a run is made of that changes what comes of it, as text; without addresses in memory."""
    options = {name: value for name, value in (made.get("options") or {}).items() if name != "driver"}
    known = {**made, "options": options}
    return {part: ADDRESS.sub("", json.dumps(known[part], sort_keys=True)) for part in MADE_OF if part in known}
