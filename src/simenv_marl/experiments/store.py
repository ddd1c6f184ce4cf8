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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple
from uuid import uuid4

from ..errors import LONGEST, OptionValueError, StoreError, warn_user
from .runner import Outcome

VERSION: Final = 1
HEADER: Final = "experiment.json"

MADE_OF: Final = ("make", "simulation", "variant", "parameters", "points", "plugins", "policies", "options")
"""The parts of the provenance that affect the results of a run."""

ADDRESS: Final = re.compile(" at 0x[0-9a-fA-F]+")
"""Addresses in memory, which differ in the texts of equal objects."""

Run = tuple[str, str, int]
"""The identity of a run: its row as JSON, the contender, the seed."""

Result = Outcome | str
"""The result of a run. A string describes the error of a run that failed."""

Provenance = Mapping[str, Any]


def to_json(value: Any) -> str:
    """Return a value as JSON, on one line."""
    return json.dumps(value, separators=(",", ":"))


class Stored(NamedTuple):
    """The contents of a store.

    Attributes:
        runs: The result of each run. If a run is stored more than once, a success counts, else the latest error.
        versions: Pairs of a package and a version with which runs were done.
        sample: A row of the design, as JSON, of which a run has succeeded; empty if there is none.
        provenances: By contender, the provenance of the first of these runs.
    """

    runs: dict[Run, Result]
    versions: set[tuple[str, Any]]
    sample: str
    provenances: dict[str, Provenance]


@dataclass(frozen=True)
class Store:
    """The folder of an experiment, whose runs all have these factors (in the order of the design) and metrics."""

    folder: Path
    factors: Sequence[str]
    metrics: Sequence[str]

    def exists(self) -> bool:
        """Return whether the folder is the store of this experiment; False if it is empty or missing.

        Raises:
            OptionValueError: The folder belongs to something else.
            StoreError: The folder cannot be read.
        """
        header = self.folder / HEADER
        try:
            found = [path.name for path in self.folder.iterdir()] if self.folder.exists() else []
            if not header.exists():  # checked after the others were listed: another process may be writing both
                if any(not name.startswith((HEADER, ".")) for name in found):
                    raise OptionValueError(f"the folder {self.folder} is not empty, and not the store of an experiment")
                return False
            content = json.loads(header.read_bytes())
        except OSError as error:
            raise self._unusable(error) from error
        except json.JSONDecodeError as error:
            raise StoreError(f"{header} cannot be read: {error}") from error
        if not isinstance(content, dict) or content.get("simenv_marl") != VERSION:
            raise OptionValueError(f"{header} was not written by this version of simenv_marl")
        for what, names in (("factors", self.factors), ("metrics", self.metrics)):
            if content.get(what) != sorted(names):
                raise OptionValueError(
                    f"the store {self.folder} belongs to another experiment: its {what} are {content.get(what)}, not"
                    f" {sorted(names)}; pass another folder"
                )
        return True

    def create(self) -> None:
        """Make the store, unless it exists. Errors are those of ``exists``."""
        if self.exists():
            return
        header = {"simenv_marl": VERSION, "factors": sorted(self.factors), "metrics": sorted(self.metrics)}
        fresh = self.folder / f"{HEADER}.{uuid4().hex}"  # renamed as a whole: readers never see half of it
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            try:
                fresh.write_text(json.dumps(header) + "\n", encoding="ascii")
                os.replace(fresh, self.folder / HEADER)
            finally:
                fresh.unlink(missing_ok=True)
        except OSError as error:
            raise self._unusable(error) from error

    def _unusable(self, error: OSError) -> StoreError:
        reason = error.strerror or error
        return StoreError(f"{self.folder} cannot be made or read as the folder of an experiment: {reason}")

    def read(self, keys: Sequence[str]) -> Stored:
        """Read all runs, after a check with ``exists``. ``keys`` are the rows of the design, as JSON."""
        self.exists()
        runs: dict[Run, Result] = {}
        versions: set[tuple[str, Any]] = set()
        provenances: dict[str, Provenance] = {}
        sample, texts = "", {key: key for key in keys}  # each text is in memory once, for all runs of its row
        for (row, contender, seed), result, provenance in self._lines():
            if not sample and row in texts and not isinstance(result, str):
                sample = row
            if row == sample and not isinstance(result, str):
                provenances.setdefault(contender, provenance)
            run = texts.setdefault(row, row), contender, seed
            if isinstance(runs.get(run, ""), str):
                runs[run] = result
            versions.update(_versions_in(provenance).items())
        return Stored(runs, versions, sample, provenances)

    def _lines(self) -> Iterator[tuple[Run, Result, Provenance]]:
        """Yield all runs, in the order in which their files were begun."""
        for path in sorted(self.folder.glob("runs-*.jsonl")):
            try:
                with path.open("rb") as file:
                    for number, line in enumerate(file, 1):
                        if not line.endswith(b"\n"):
                            break  # its process was killed, or is still writing
                        try:
                            yield self._parsed(json.loads(line))
                        except (ValueError, TypeError, LookupError, AttributeError):  # not JSON, or not a run
                            warn_user(f"line {number} of {path} cannot be read, so its run counts as missing")
            except OSError as error:
                raise StoreError(f"{path} cannot be read: {error.strerror or error}") from error

    def _parsed(self, entry: Any) -> tuple[Run, Result, Provenance]:
        """Return the contents of a line. If that is not a run, it raises TypeError, LookupError or AttributeError."""
        run = to_json({name: entry["factors"][name] for name in self.factors}), entry["contender"], entry["seed"]
        result: Result = str(entry["error"])
        if entry["status"] == "ok":
            result = Outcome(*(dict(entry[part].items()) for part in Outcome._fields))
        return run, result, dict(entry["provenance"].items())


# -- writing --------------------------------------------------------------------------------------


def new_session() -> str:
    """Return an id for all processes that participate from now on. Later ids sort after earlier ones."""
    return f"{time.time_ns():016x}{uuid4().hex[:8]}"


_processes: dict[tuple[int, int], str] = {}
"""Ids of this process among all machines, one for each of its threads, since threads may be workers."""


class Writer:
    """Appends lines to the file of one process."""

    def __init__(self, folder: Path, session: str) -> None:
        """Open the file of this process in a session, whose id all participating processes share."""
        if not (folder / HEADER).exists():
            raise StoreError(
                f"the process that must write to the store {folder} cannot see it; pass a folder that all machines"
                " share"
            )
        process = _processes.setdefault((os.getpid(), threading.get_ident()), uuid4().hex[:12])
        self._path = folder / f"runs-{session}-{process}.jsonl"
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
        try:
            self._file = os.open(self._path, flags, 0o666)
        except OSError as error:
            raise self._unwritable(error) from error

    def write(self, run: Run, result: Result, provenance: Provenance, trace: str | None = None) -> None:
        """Append the line of a run. ``trace`` is the traceback of an error, for people who read the file."""
        row, contender, seed = run
        entry = {"factors": json.loads(row), "contender": contender, "seed": seed}
        if isinstance(result, str):
            entry |= {"status": "error", "error": result, "traceback": trace}
        else:
            entry |= {"status": "ok", "error": None, **result._asdict()}
        left = to_json(entry | {"provenance": provenance}).encode("ascii") + b"\n"
        before = os.fstat(self._file).st_size
        try:
            while left:
                left = left[os.write(self._file, left) :]
        except BaseException as error:
            os.ftruncate(self._file, before)
            if isinstance(error, OSError):
                raise self._unwritable(error) from error
            raise

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _unwritable(self, error: OSError) -> StoreError:
        reason = error.strerror or error
        return StoreError(f"cannot write to {self._path}: {reason}; what was stored before is still there")


# -- what has changed since the runs were stored --------------------------------------------------


def _versions_in(provenance: Provenance) -> dict[str, Any]:
    """Return the versions of packages in a provenance."""
    python = {"python": provenance["python"]} if provenance.get("python") else {}
    return {**python, **(provenance.get("packages") or {}), **(provenance.get("dependencies") or {})}


def check_rows(store: Store, stored: Stored, keys: Sequence[str]) -> None:
    """Warn of stored rows that are not in the design. If none is, the store belongs to another experiment."""
    rows = {row for row, *_ in stored.runs}
    strange = rows - set(keys)
    if strange and strange == rows:
        raise OptionValueError(
            f"the store {store.folder} holds runs of {len(strange)} rows, such as {min(strange)}, but this design has"
            f" none of them: its first is {keys[0]}; pass another folder, or a design that includes them"
        )
    if strange:
        warn_user(
            f"the store {store.folder} holds runs of {len(strange)} rows that this design does not have, such as"
            f" {min(strange)}; they stay in the store, but are not in the table"
        )


def warn_of_changes(store: Store, stored: Stored, row: str, provenances: Mapping[str, Provenance]) -> None:
    """Warn if runs are now made of something else than the stored ones. ``provenances`` tell of what, for a row."""
    now = _versions_in(next(iter(provenances.values()), {}))
    changes = [
        f"{name} {version} then, {now[name]} now"
        for name, version in sorted(stored.versions, key=str)
        if version != now.get(name, version)
    ]
    if changes:
        warn_user(f"the store {store.folder} holds runs that were made with other versions: {'; '.join(changes)}")
    if row != stored.sample:
        return
    for contender, provenance in provenances.items():
        parts, then = _parts_of(provenance), _parts_of(stored.provenances.get(contender, {}))
        changes = [
            f"{part} {then[part][:LONGEST]} then, {text[:LONGEST]} now"
            for part, text in parts.items()
            if text != then.get(part, text)
        ]
        if changes:
            warn_user(
                f"the store {store.folder} holds runs of {contender!r} that were made differently:"
                f" {'; '.join(changes)}; they are kept, so pass another folder if all must be made alike"
            )
            return


def _parts_of(provenance: Provenance) -> dict[str, str]:
    """Return the parts of a provenance that affect results, as text without addresses in memory."""
    options = {name: value for name, value in (provenance.get("options") or {}).items() if name != "driver"}
    parts = {**provenance, "options": options}
    return {part: ADDRESS.sub("", json.dumps(parts[part], sort_keys=True)) for part in MADE_OF if part in parts}
