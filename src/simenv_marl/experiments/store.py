"""The folder of an experiment or evaluation: the result of each run is one line of JSON.

::

    store/
      experiment.json       the names of factors (null: an evaluation) and metrics
      runs-<id>-<id>.jsonl  the runs of one process, which alone appends to this file

The first ids sort in the order of the sessions: calls of the function. A process writes a
line at once and as a whole when a run is finished. If it is killed, it loses the runs it was
working on; an unfinished line is the last one of its file and is ignored. There are no pickles.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import get_ident
from typing import Any, NamedTuple
from uuid import getnode, uuid4

from ..errors import LONGEST, OptionValueError, StoreError, short_repr, warn_user
from .runner import Outcome, Result

VERSION = 1
HEADER = "experiment.json"

NO_FACTORS = "{}"
"""The row of an evaluation, which has no factors."""

IRRELEVANT = ("seed", "packages", "dependencies")
"""The parts of the provenance that are not compared as they are. Each package is a part."""

VARYING = re.compile(r" at 0x[0-9a-fA-F]+|\w+\.<locals>\.")
"""The differences between texts of equal objects.

These are addresses in memory, and functions around classes, whose names workers lose.
"""

Provenance = Mapping[str, Any]

Entry = dict[str, Any]
"""A finished run, as data for JSON: see ``make_entry``."""


class Run(NamedTuple):
    """The identity of a run. ``row`` is its row of the design as JSON."""

    row: str
    contender: str
    seed: int


def to_json(value: object) -> str:
    """Return a value as JSON, on one line."""
    try:
        return json.dumps(value, separators=(",", ":"))
    except ValueError as error:  # for example of an integer of 5,000 digits
        raise OptionValueError(
            f"{short_repr(value)} cannot be stored as JSON ({error}); use other values"
        ) from error


@contextmanager
def _explain_errors(problem: str) -> Iterator[None]:
    """Turn errors of the file system into errors that explain the problem."""
    try:
        yield
    except OSError as error:
        raise StoreError(f"{problem}: {error.strerror or error}") from error


class Store:
    """The folder of an experiment or evaluation, and its contents as of the latest ``read``.

    Attributes:
        runs: The result of each run. If a run is stored more than once, a success counts, else the
            latest error.
        samples: For each contender, a row of the design that has a successful run, as JSON. Its
            provenance is compared.
        agents: The agents that have decided, by contender.
    """

    def __init__(
        self,
        folder: Path,
        rows: Iterable[str],
        factors: Collection[str] | None,
        metrics: Iterable[str],
    ) -> None:
        """Describe an experiment, or without ``factors`` an evaluation.

        ``rows`` are the rows of the design, as JSON.
        """
        self.folder = folder
        self._rows = dict.fromkeys(rows)
        self._factors = factors or ()
        self._path = folder / HEADER
        self._header = {
            "simenv_marl": VERSION,
            "factors": None if factors is None else sorted(factors),
            "metrics": sorted(metrics),
        }
        self._unusable = f"{folder} cannot be made or read as the folder of an experiment"

    def create(self) -> None:
        """Make the store, unless it exists."""
        with _explain_errors(self._unusable):
            if not self._path.exists():
                # Renamed as a whole, so that readers never see half of it.
                fresh = self.folder / f"{HEADER}.{uuid4().hex}"
                self.folder.mkdir(parents=True, exist_ok=True)
                fresh.write_text(json.dumps(self._header) + "\n", encoding="ascii")
                os.replace(fresh, self._path)

    def read(self, session: str = "") -> None:
        """Read all runs, or the runs of a session. The folder may be empty or missing.

        Raises:
            OptionValueError: The folder is not the store of this experiment.
            StoreError: The folder cannot be read.
        """
        self.runs: dict[Run, Result] = {}
        self.samples: dict[str, str] = {}
        self.agents = defaultdict[str, set[str]](set)
        self._parts: dict[str, dict[str, str]] = {}  # of the samples, by contender
        self._check_header()
        for path in sorted(self.folder.glob(f"runs-{session}*.jsonl")):
            with _explain_errors(f"{path} cannot be read"), path.open("rb") as file:
                for number, line in enumerate(file, 1):
                    if not line.endswith(b"\n"):
                        break  # its process was killed, or is still writing
                    try:
                        self._add(json.loads(line))
                    except Exception:  # a damaged line can raise nearly any error
                        warn_user(
                            f"line {number} of {path} cannot be read, so its run counts as missing"
                        )

    def _check_header(self) -> None:
        """Check that the folder is the store of this experiment, or can become it."""
        with _explain_errors(self._unusable):
            names = [path.name for path in self.folder.iterdir()] if self.folder.exists() else []
            # This comes after the list, because another process may be writing both.
            if not self._path.exists():
                if any(not name.startswith((HEADER, ".")) for name in names):
                    raise OptionValueError(
                        f"the folder {self.folder} is not empty, and not the store of an experiment"
                        " or evaluation"
                    )
                return
            text = self._path.read_bytes()
        try:
            content = dict(json.loads(text))
        except (TypeError, ValueError, RecursionError) as error:
            raise StoreError(
                f"{self._path} cannot be read: {error}; restore the file, or pass another folder"
            ) from error
        for part, expected in self._header.items():
            if content.get(part) != expected:
                raise OptionValueError(
                    f"the store {self.folder} belongs to another experiment or evaluation: its"
                    f" {part} are {content.get(part)}, not {expected}; pass another folder"
                )

    def _add(self, entry: Entry) -> None:
        """Add a run. If the line is damaged, it raises an error and adds nothing."""
        row = sys.intern(to_json({name: entry["factors"][name] for name in self._factors}))
        run = Run(row, entry["contender"], entry["seed"])
        result: Result = entry["error"]
        if entry["status"] == "ok":
            numbers = entry["agents"], entry["metrics"], entry.get("team")
            result = Outcome(*numbers, entry.get("counts", {}))
            if row in self._rows and run.contender not in self.samples:
                self._parts[run.contender] = _comparable_parts(entry["provenance"])
                self.samples[run.contender] = row
            self.agents[run.contender].update(result.agents)
        if not isinstance(self.runs.get(run), Outcome):
            self.runs[run] = result

    def missing(self, runs: Iterable[Run], *, retry_errors: bool) -> list[Run]:
        """Return the runs that are not stored, and those with errors if they are to be retried."""
        final = Outcome if retry_errors else (Outcome, str)
        return [run for run in runs if not isinstance(self.runs.get(run), final)]

    # -- changes since the runs were stored -------------------------------------------------------

    def check_rows(self) -> None:
        """Warn of stored rows that are not in the design.

        If no row is in the design, the store belongs to another experiment.
        """
        stored_rows = {run.row for run in self.runs}
        extra_rows = stored_rows - self._rows.keys()
        if extra_rows and extra_rows == stored_rows:
            raise OptionValueError(
                f"the store {self.folder} holds runs of {len(extra_rows)} rows, such as"
                f" {min(extra_rows)}, but this design has none of them: its first is"
                f" {next(iter(self._rows))}; pass another folder, or a design that includes them"
            )
        if extra_rows:
            warn_user(
                f"the store {self.folder} holds runs of {len(extra_rows)} rows that this design"
                f" does not have, such as {min(extra_rows)}; they stay in the store, but are not in"
                " the table"
            )

    def warn_of_changes(self, contender: str, row: str, provenance: Provenance) -> None:
        """Warn if the provenance of a contender in a row has changed since its runs were stored."""
        if row != self.samples.get(contender):
            return
        now = _comparable_parts(provenance)
        changes = "; ".join(
            f"{part} {then[:LONGEST]} then, {now[part][:LONGEST]} now"
            for part, then in self._parts[contender].items()
            if now.get(part, then) != then
        )
        if changes:
            warn_user(
                f"the store {self.folder} holds runs of {contender!r} that were made differently:"
                f" {changes}; they are kept, so pass another folder if all must be made alike"
            )


def _comparable_parts(provenance: Provenance) -> dict[str, str]:
    """Return the parts of a provenance that affect results, and versions, as texts."""
    parts = {**provenance, **provenance["packages"], **provenance["dependencies"]}
    options = provenance["options"].items()
    parts["options"] = {name: value for name, value in options if name != "driver"}
    return {
        name: VARYING.sub("", json.dumps(part, sort_keys=True)).strip('"')
        for name, part in parts.items()
        if name not in IRRELEVANT
    }


# -- writing --------------------------------------------------------------------------------------


def make_entry(
    run: Run,
    result: Result,
    provenance: Provenance,
    trace: str | None = None,
) -> Entry:
    """Return the entry of a run.

    ``trace`` is the traceback of an error, for people who read the file.
    """
    factors = json.loads(run.row)
    entry = {"factors": factors, "contender": run.contender, "seed": run.seed}
    if isinstance(result, Outcome):
        entry |= {"status": "ok", "error": None, **vars(result)}
    else:
        entry |= {"status": "error", "error": result, "traceback": trace}
    return entry | {"provenance": provenance}


def append(folder: Path, session: str, *entries: Entry) -> None:
    """Append the lines of runs to the file of this thread in a session, which is made at least."""
    # Threads may be workers, and machines may share the folder.
    path = folder / f"runs-{session}-{getnode():x}{os.getpid():x}{get_ident():x}.jsonl"
    lines = "".join(f"{to_json(entry)}\n" for entry in entries)
    problem = f"cannot write to {path}, whose folder all machines must share; stored runs stay"
    with _explain_errors(problem), path.open("a", encoding="ascii") as file:
        file.write(lines)
