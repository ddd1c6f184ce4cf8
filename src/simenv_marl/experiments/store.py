"""The folder of an experiment: the result of each run is one line of JSON.

::

    store/
      experiment.json       what all runs share: the names of factors and metrics
      runs-<id>-<id>.jsonl  one file per process that has done runs; only that process appends to
      it;
                            the first ids sort in the order in which the files were begun

A process writes a line at once and as a whole when a run is finished. If it is killed, it loses the
runs it was working on; an unfinished line is the last one of its file and is ignored. There are no
pickles.
"""

from __future__ import annotations

import json
import os
import re
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

from ..errors import LONGEST, OptionValueError, StoreError, short_repr, warn_user
from .runner import Outcome, plain_value

VERSION: Final = 1
HEADER: Final = "experiment.json"

MADE_OF: Final = (
    "make",
    "simulation",
    "variant",
    "parameters",
    "points",
    "plugins",
    "policies",
    "options",
)
"""The parts of the provenance that affect the results of a run."""

VARYING: Final = re.compile(r" at 0x[0-9a-fA-F]+|\w+\.<locals>\.")
"""What differs in the texts of equal objects: addresses in memory, and functions around classes, which workers lose."""

Run = tuple[str, str, int]
"""The identity of a run: its row as JSON, the contender, the seed."""

Result = Outcome | str
"""The result of a run. A string describes the error of a run that failed."""

Provenance = Mapping[str, Any]


def to_json(value: Any) -> str:
    """Return a value as JSON, on one line."""
    try:
        return json.dumps(value, separators=(",", ":"))
    except (ValueError, RecursionError) as error:  # for example of an integer of 5,000 digits
        raise OptionValueError(
            f"{short_repr(value)} cannot be stored as JSON ({error}); use other values"
        ) from error


@contextmanager
def _explain(what: str) -> Iterator[None]:
    """Turn errors of the file system into errors that say what cannot be done."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{what}: {error.strerror or error}") from error


class Store:
    """The folder of an experiment, and its contents when they were read last.

    Attributes:
        runs: The result of each run. If a run is stored more than once, a success counts, else the
            latest error.
        sample: A row of the design, as JSON, of which a run has succeeded; empty if there is none.
    """

    def __init__(self, folder: Path, factors: Collection[str], metrics: Iterable[str]) -> None:
        """All runs have these factors, in the order of the design, and these metrics."""
        self.folder, self._factors = folder, factors
        self._header = {
            "simenv_marl": VERSION,
            "factors": sorted(factors),
            "metrics": sorted(metrics),
        }
        self._unusable = f"{folder} cannot be made or read as the folder of an experiment"

    def exists(self) -> bool:
        """Return whether the folder is the store of this experiment.

        False if it is empty or missing.
        """
        header = self.folder / HEADER
        with _explain(self._unusable):
            found = [path.name for path in self.folder.iterdir()] if self.folder.exists() else []
            # checked after the others were listed: another process may be writing both
            if not header.exists():
                if any(not name.startswith((HEADER, ".")) for name in found):
                    raise OptionValueError(
                        f"the folder {self.folder} is not empty, and not the store of an experiment"
                    )
                return False
            text = header.read_bytes()
        try:
            content = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise StoreError(
                f"{header} cannot be read: {error}; restore the file, or pass another folder"
            ) from error
        if not isinstance(content, dict) or content.get("simenv_marl") != VERSION:
            raise OptionValueError(f"{header} was not written by this version of simenv_marl")
        for what in ("factors", "metrics"):
            if content.get(what) != self._header[what]:
                raise OptionValueError(
                    f"the store {self.folder} belongs to another experiment: its {what} are"
                    f" {content.get(what)}, not {self._header[what]}; pass another folder"
                )
        return True

    def create(self) -> None:
        """Make the store, unless it exists. Errors are those of ``exists``."""
        if not self.exists():
            # renamed as a whole: readers never see half of it
            fresh = self.folder / f"{HEADER}.{uuid4().hex}"
            with _explain(self._unusable):
                self.folder.mkdir(parents=True, exist_ok=True)
                fresh.write_text(json.dumps(self._header) + "\n", encoding="ascii")
                os.replace(fresh, self.folder / HEADER)

    def read(self, keys: Iterable[str], session: str = "") -> None:
        """Read all runs, or those of a session, after ``exists``.

        ``keys`` are the rows of the design, as JSON.
        """
        self.exists()
        self.runs: dict[Run, Result] = {}
        self.sample = ""
        self.seen: set[tuple[str, str]] = set()  # contenders with agents that have decided
        self._versions: set[tuple[str, Any]] = set()
        # by contender, of the first success of the sample
        self._parts: dict[str, dict[str, str]] = {}
        texts = {key: key for key in keys}
        # in the order in which they were begun
        for path in sorted(self.folder.glob(f"runs-{session}*.jsonl")):
            with _explain(f"{path} cannot be read"), path.open("rb") as file:
                for number, line in enumerate(file, 1):
                    if not line.endswith(b"\n"):
                        break  # its process was killed, or is still writing
                    try:
                        self._add(json.loads(line), texts)
                    except (
                        ValueError,
                        TypeError,
                        LookupError,
                        AttributeError,
                        ArithmeticError,
                        RecursionError,
                    ):
                        warn_user(
                            f"line {number} of {path} cannot be read, so its run counts as missing"
                        )

    def _add(self, entry: Any, texts: dict[str, str]) -> None:
        """Add the run of a line. If that is not a run, it raises an error and adds nothing."""
        row = to_json({name: entry["factors"][name] for name in self._factors})
        # so that a text is in memory once
        run = texts.get(row, row), str(entry["contender"]), int(entry["seed"])
        provenance, parts = entry["provenance"], {}
        versions = _versions_in(provenance).items()
        result: Result = str(entry["error"])
        if entry["status"] == "ok":
            returns = {name: float(value) for name, value in entry["returns"].items()}
            lengths = {name: int(entry["lengths"][name]) for name in returns}
            metrics = {name: plain_value(name, value) for name, value in entry["metrics"].items()}
            fallbacks = {name: int(number) for name, number in entry.get("fallbacks", {}).items()}
            result = Outcome(returns, lengths, metrics, fallbacks)
            if row in texts and self.sample in ("", row) and run[1] not in self._parts:
                parts = {run[1]: _parts_of(provenance)}
        self._versions.update(versions)
        if isinstance(self.runs.get(run, ""), str):
            self.runs[run] = result
        if not isinstance(result, str):
            self.seen.update((run[1], name) for name in result.returns)
        if parts:
            self.sample = row
            self._parts |= parts

    # -- what has changed since the runs were stored ----------------------------------------------

    def check_rows(self, keys: Sequence[str]) -> None:
        """Warn of stored rows that are not in the design.

        If none is, the store belongs to another experiment.
        """
        rows = {row for row, *_ in self.runs}
        strange = rows - set(keys)
        if strange and strange == rows:
            raise OptionValueError(
                f"the store {self.folder} holds runs of {len(strange)} rows, such as"
                f" {min(strange)}, but this design has none of them: its first is {keys[0]}; pass"
                " another folder, or a design that includes them"
            )
        if strange:
            warn_user(
                f"the store {self.folder} holds runs of {len(strange)} rows that this design does"
                f" not have, such as {min(strange)}; they stay in the store, but are not in the"
                " table"
            )

    def warn_of_changes(self, row: str, provenances: Mapping[str, Provenance]) -> None:
        """Warn if runs are now made of something else than the stored ones.

        ``provenances`` tell of what, for a row.
        """
        now = _versions_in(next(iter(provenances.values()), {}))
        changes = _changes(sorted(self._versions, key=str), now)
        if changes:
            warn_user(
                f"the store {self.folder} holds runs that were made with other versions: {changes}"
            )
        for contender, provenance in provenances.items() if row == self.sample else ():
            changes = _changes(self._parts.get(contender, {}).items(), _parts_of(provenance))
            if changes:
                warn_user(
                    f"the store {self.folder} holds runs of {contender!r} that were made"
                    f" differently: {changes}; they are kept, so pass another folder if all must"
                    " be made alike"
                )
                return


def _versions_in(provenance: Provenance) -> dict[str, Any]:
    """Return the versions of packages in a provenance."""
    python = {"python": provenance["python"]} if provenance.get("python") else {}
    return {
        **python,
        **(provenance.get("packages") or {}),
        **(provenance.get("dependencies") or {}),
    }


def _parts_of(provenance: Provenance) -> dict[str, str]:
    """Return the parts of a provenance that affect results, as text without what varies."""
    options = {
        name: value for name, value in (provenance.get("options") or {}).items() if name != "driver"
    }
    parts = {**provenance, "options": options}
    return {
        part: VARYING.sub("", json.dumps(parts[part], sort_keys=True))
        for part in MADE_OF
        if part in parts
    }


def _changes(then: Iterable[tuple[str, Any]], now: Mapping[str, Any]) -> str:
    """Describe the changes of versions or parts since then."""
    changes = [(name, str(old), str(now[name])) for name, old in then if old != now.get(name, old)]
    return "; ".join(
        f"{name} {old[:LONGEST]} then, {new[:LONGEST]} now" for name, old, new in changes
    )


# -- writing --------------------------------------------------------------------------------------


_processes: dict[tuple[int, int], str] = {}
"""Ids of this process among all machines, one for each of its threads, since threads may be workers."""


class Writer:
    """Appends lines to the file of one process."""

    def __init__(self, folder: Path, session: str) -> None:
        """Open the file of this process in a session, whose id all participating processes share."""
        if not (folder / HEADER).exists():
            raise StoreError(
                f"the process that must write to the store {folder} cannot see it; pass a folder"
                " that all machines share"
            )
        process = _processes.setdefault((os.getpid(), threading.get_ident()), uuid4().hex[:12])
        path = folder / f"runs-{session}-{process}.jsonl"
        self._unwritable = f"cannot write to {path}, but what was stored before is still there"
        with _explain(self._unwritable):
            self._file = path.open("ab", buffering=0)
        self.close = self._file.close

    def write(
        self, run: Run, result: Result, provenance: Provenance, trace: str | None = None
    ) -> None:
        """Append the line of a run.

        ``trace`` is the traceback of an error, for people who read the file.
        """
        row, contender, seed = run
        entry = {"factors": json.loads(row), "contender": contender, "seed": seed}
        if isinstance(result, str):
            entry |= {"status": "error", "error": result, "traceback": trace}
        else:
            entry |= {"status": "ok", "error": None, **result._asdict()}
        left = to_json(entry | {"provenance": provenance}).encode("ascii") + b"\n"
        with _explain(self._unwritable):
            while left:
                left = left[os.write(self._file.fileno(), left) :]
