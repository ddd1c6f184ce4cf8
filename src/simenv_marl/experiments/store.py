"""The folder of an experiment: the result of each run is one line of JSON.

::

    store/
      experiment.json       what all runs share: the names of factors and metrics
      runs-<id>-<id>.jsonl  one file per process that has done runs; only that process appends to it;
                            the first ids sort in the order in which the files were begun

A process writes a line at once and as a whole when a run is finished. If it is killed, it loses the runs it was working
on; an unfinished line is the last one of its file and is ignored. There are no pickles.
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
"""The identity of a run: its row as JSON, the contender, the seed."""


def written(value: Any) -> str:
    """Return a value as JSON, on one line."""
    return json.dumps(value, separators=(",", ":"))


class Known(NamedTuple):
    """The result of a run.

    Attributes:
        outcome: The results of the episode; None if the run failed.
        error: The error; None if the run did not fail.
    """

    outcome: Outcome | None
    error: str | None


class Writer:
    """Appends lines to the file of one process."""

    def __init__(self, store: Path, session: str) -> None:
        """Open the file of this process.

        Args:
            store: The folder.
            session: The id that all participating processes share.

        Raises:
            StoreError: The file cannot be opened.
        """
        if not (store / HEADER).exists():
            raise StoreError(
                f"the process that must write to the store {store} cannot see it; pass a folder that all machines share"
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
            StoreError: The line cannot be written. Earlier lines are unchanged.
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
        """Close the file."""
        os.close(self._file)


_processes: dict[tuple[int, int], str] = {}


def _process() -> str:
    """Return an id of this process among all machines; and of this thread, if threads are workers."""
    return _processes.setdefault((os.getpid(), threading.get_ident()), uuid4().hex[:12])


def new_session() -> str:
    """Return an id for all processes that participate from now on. Later ids sort after earlier ones."""
    return f"{time.time_ns():016x}{uuid4().hex[:8]}"


def _unwritable(path: Path, error: OSError) -> StoreError:
    reason = error.strerror or str(error)
    return StoreError(f"cannot write to {path}: {reason}; what was stored before is still there")


# -- what every run has ---------------------------------------------------------------------------


def prepare(store: Path, factors: Sequence[str], metrics: Sequence[str]) -> None:
    """Create the folder of an experiment, or check that it belongs to the same experiment.

    Raises:
        OptionValueError: The folder belongs to something else.
        StoreError: The folder cannot be read or written.
    """
    header = store / HEADER
    meant = {"simenv_marl": VERSION, "factors": sorted(factors), "metrics": sorted(metrics)}
    try:
        store.mkdir(parents=True, exist_ok=True)
        if not header.exists():
            strange = any(not path.name.startswith((HEADER, ".")) for path in store.iterdir())
            if strange and not header.exists():  # another process may have written it meanwhile
                raise OptionValueError(f"the folder {store} is not empty, and not the store of an experiment")
            fresh = store / f"{HEADER}.{uuid4().hex}"  # renamed as a whole: readers never see half of it
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
                f"the store {store} belongs to another experiment: its {what} are {found.get(what)}, not"
                f" {meant[what]}; pass another folder"
            )


# -- reading --------------------------------------------------------------------------------------


def lines(store: Path, factors: Sequence[str]) -> Iterator[tuple[Key, Known, dict[str, Any]]]:
    """Yield all stored runs, in the order in which their files were begun: identity, result, provenance.

    Raises:
        StoreError: A file cannot be read.
    """
    for path in sorted(store.glob("runs-*.jsonl")):
        try:
            with path.open("rb") as file:
                for number, line in enumerate(file, 1):
                    if not line.endswith(b"\n"):
                        break  # its process was killed, or is still writing
                    try:
                        yield _parsed(json.loads(line), factors)
                    except (ValueError, TypeError, LookupError, AttributeError):  # not JSON, or not a run
                        warn_user(f"line {number} of {path} cannot be read, so its run counts as missing")
        except OSError as error:
            raise StoreError(f"{path} cannot be read: {error.strerror or error}") from error


def _parsed(entry: Any, factors: Sequence[str]) -> tuple[Key, Known, dict[str, Any]]:
    """Return the contents of a line.

    Raises:
        TypeError, LookupError, AttributeError: The line is not a run.
    """
    key = written({name: entry["factors"][name] for name in factors}), entry["contender"], entry["seed"]
    outcome = None
    if entry["status"] == "ok":
        outcome = Outcome(*(dict(entry[part].items()) for part in Outcome._fields))
    return key, Known(outcome, entry["error"]), dict(entry["provenance"].items())


def line_of(
    row: Mapping[str, Any], contender: str, seed: int, known: Known, provenance: str, trace: str | None = None
) -> str:
    """Return the line of a run.

    Args:
        row: The factors.
        contender: The name of the contender.
        seed: The seed of the simulation.
        known: The result.
        provenance: The provenance, as JSON.
        trace: The traceback of the error, for people who read the file.
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
    """The contents of a store.

    Attributes:
        runs: The result of each run.
        rows: All rows with stored runs, as JSON.
        versions: By package, all versions with which runs were done.
        made: The provenance of the runs of one row, by contender.
    """

    runs: dict[Key, Known]
    rows: set[str]
    versions: dict[str, set[Any]]
    made: dict[str, list[dict[str, Any]]]


def read(store: Path, factors: Sequence[str], looked_at: str = "") -> Stored:
    """Read a store. If a run is stored more than once, a success counts, else the latest error.

    Args:
        store: The folder.
        factors: The names of the factors, in the order of the design.
        looked_at: The row, as JSON, whose provenance is wanted.

    Raises:
        StoreError: A file cannot be read.
    """
    runs: dict[Key, Known] = {}
    rows: dict[str, str] = {}  # each row's text is kept once, for all of its runs
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
    """Return the versions of packages in a provenance."""
    own = {"python": provenance["python"]} if provenance.get("python") else {}
    return {**own, **(provenance.get("packages") or {}), **(provenance.get("dependencies") or {})}


# -- what has changed since ------------------------------------------------------------------------

MADE_OF: Final = ("make", "simulation", "variant", "parameters", "points", "plugins", "policies", "options")
"""The parts of the provenance that affect the results of a run."""

ADDRESS: Final = re.compile(" at 0x[0-9a-fA-F]+")
"""Addresses in memory, which differ in the texts of equal objects."""


def compare(folder: Path, stored: Stored, keys: Sequence[str]) -> None:
    """Compare the rows of a design with the stored ones.

    Raises:
        OptionValueError: The store belongs to another experiment.
    """
    strange = stored.rows - set(keys)
    if strange and len(strange) == len(stored.rows):
        raise OptionValueError(
            f"the store {folder} holds runs of {len(strange)} rows, such as {min(strange)}, but this design has none"
            f" of them: its first is {keys[0]}; pass another folder, or a design that includes them"
        )
    if strange:
        warn_user(
            f"the store {folder} holds runs of {len(strange)} rows that this design does not have, such as"
            f" {min(strange)}; they stay in the store, but are not in the table"
        )


def warn_of_changes(folder: Path, stored: Stored, made_of: Mapping[str, dict[str, Any]]) -> None:
    """Warn if runs are now made of something else than when the experiment last ran."""
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
                if then.get(part, text) != text  # unknown for runs whose simulation could not be made
            ]
            if other:
                warn_user(
                    f"the store {folder} holds runs of {contender!r} that were made differently: {'; '.join(other)};"
                    " they are kept, so pass another folder if all must be made alike"
                )
                return


def _parts_of(made: Mapping[str, Any]) -> dict[str, str]:
    """Return the parts of a provenance that affect results, as text without addresses in memory."""
    options = {name: value for name, value in (made.get("options") or {}).items() if name != "driver"}
    known = {**made, "options": options}
    return {part: ADDRESS.sub("", json.dumps(known[part], sort_keys=True)) for part in MADE_OF if part in known}
