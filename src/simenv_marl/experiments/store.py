"""The folder of an experiment: the result of each run is one line of JSON.

::

    store/
      experiment.json       the names of factors and metrics
      runs-<id>-<id>.jsonl  the runs of one process, which alone appends to this file

The first ids sort in the order of the sessions: calls of ``run_experiment``. A process writes a
line at once and as a whole when a run is finished. If it is killed, it loses the runs it was
working on; an unfinished line is the last one of its file and is ignored. There are no pickles.
"""

from __future__ import annotations

import json
import os
import re
import threading
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

from ..errors import LONGEST, OptionValueError, StoreError, short_repr, warn_user
from .runner import Outcome, plain_value

VERSION = 1
HEADER = "experiment.json"

MADE_OF = (
    "make",
    "simulation",
    "variant",
    "parameters",
    "points",
    "plugins",
    "policies",
    "options",
    "python",
)
"""The parts of the provenance that affect the results of a run, besides versions of packages."""

VARYING = re.compile(r" at 0x[0-9a-fA-F]+|\w+\.<locals>\.")
"""The differences between texts of equal objects.

These are addresses in memory, and functions around classes, whose names workers lose.
"""

Result = Outcome | str
"""The result of a run. A string describes the error of a run that failed."""

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
    """The folder of an experiment, and its contents as of the latest ``read``.

    Attributes:
        runs: The result of each run. If a run is stored more than once, a success counts, else the
            latest error.
        sample: The row of the design, as JSON, whose provenance is compared. It has a successful
            run; the text is empty if no row has one.
        agents: The agents that have decided, by contender.
    """

    def __init__(
        self,
        folder: Path,
        rows: Iterable[str],
        factors: Collection[str],
        metrics: Iterable[str],
    ) -> None:
        """Describe an experiment. ``rows`` are the rows of the design, as JSON."""
        self.folder = folder
        self._rows = {row: row for row in rows}
        self._factors = factors
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
        with _explain_errors(self._unusable):
            names = [path.name for path in self.folder.iterdir()] if self.folder.exists() else []
            # This comes after the list, because another process may be writing both.
            if not header.exists():
                if any(not name.startswith((HEADER, ".")) for name in names):
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
        for part in ("factors", "metrics"):
            if content.get(part) != self._header[part]:
                raise OptionValueError(
                    f"the store {self.folder} belongs to another experiment: its {part} are"
                    f" {content.get(part)}, not {self._header[part]}; pass another folder"
                )
        return True

    def create(self) -> None:
        """Make the store, unless it exists. Errors are as for ``exists``."""
        if not self.exists():
            # Renamed as a whole, so that readers never see half of it.
            fresh = self.folder / f"{HEADER}.{uuid4().hex}"
            with _explain_errors(self._unusable):
                self.folder.mkdir(parents=True, exist_ok=True)
                fresh.write_text(json.dumps(self._header) + "\n", encoding="ascii")
                os.replace(fresh, self.folder / HEADER)

    def read(self, session: str = "") -> None:
        """Read all runs, or the runs of a session. Errors are as for ``exists``."""
        self.exists()
        self.runs: dict[Run, Result] = {}
        self.sample = ""
        self.agents = defaultdict[str, set[str]](set)
        self._parts: dict[str, dict[str, str]] = {}  # of the sample, by contender
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

    def _add(self, entry: Entry) -> None:
        """Add a run. If the line is damaged, it raises an error and adds nothing."""
        row = to_json({name: entry["factors"][name] for name in self._factors})
        row = self._rows.get(row, row)  # so that a text is in memory once
        run = Run(row, entry["contender"], int(entry["seed"]))
        provenance = entry["provenance"]
        result: Result = str(entry["error"])
        parts: dict[str, str] = {}
        if entry["status"] == "ok":
            returns = {name: float(value) for name, value in entry["returns"].items()}
            result = Outcome(
                returns,
                {name: int(entry["lengths"][name]) for name in returns},
                {name: plain_value(name, value) for name, value in entry["metrics"].items()},
                entry.get("fallbacks", {}),
            )
            is_sample = row in self._rows and self.sample in ("", row)
            if is_sample and run.contender not in self._parts:
                parts = _comparable_parts(provenance)
        # No line below raises an error.
        if not isinstance(self.runs.get(run), Outcome):
            self.runs[run] = result
        if isinstance(result, Outcome):
            self.agents[run.contender].update(result.returns)
        if parts:
            self.sample = row
            self._parts[run.contender] = parts

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

    def warn_of_changes(self, row: str, provenances: Mapping[str, Provenance]) -> None:
        """Warn if the provenance has changed since the runs were stored.

        ``provenances`` are the present ones of a row, by contender.
        """
        for contender, provenance in provenances.items() if row == self.sample else ():
            now = _comparable_parts(provenance)
            changes = "; ".join(
                f"{part} {then[:LONGEST]} then, {now[part][:LONGEST]} now"
                for part, then in self._parts.get(contender, {}).items()
                if now.get(part, then) != then
            )
            if changes:
                warn_user(
                    f"the store {self.folder} holds runs of {contender!r} that were made"
                    f" differently: {changes}; they are kept, so pass another folder if all must"
                    " be made alike"
                )
                return


def _comparable_parts(provenance: Provenance) -> dict[str, str]:
    """Return the parts of a provenance that affect results, and versions, as texts."""
    options = dict(provenance["options"])
    options.pop("driver", None)
    parts = {part: provenance[part] for part in MADE_OF if part in provenance}
    parts |= {**provenance["packages"], **provenance["dependencies"], "options": options}
    return {
        name: VARYING.sub("", json.dumps(part, sort_keys=True)).strip('"')
        for name, part in parts.items()
    }


# -- writing --------------------------------------------------------------------------------------


_processes: dict[tuple[int, int], str] = {}
"""A unique id for each thread of this process, because threads may be workers."""


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


class Writer:
    """Appends lines to the file of one process."""

    def __init__(self, folder: Path, session: str) -> None:
        """Open the file of this process in a session, whose id all its processes share."""
        process = _processes.setdefault((os.getpid(), threading.get_ident()), uuid4().hex[:12])
        path = folder / f"runs-{session}-{process}.jsonl"
        self._unwritable = (
            f"cannot write to {path}, whose folder all machines must share; stored runs stay"
        )
        with _explain_errors(self._unwritable):
            self._file = path.open("ab", buffering=0)
        self.close = self._file.close

    def write(self, entry: Entry) -> None:
        """Append the line of a run."""
        rest = to_json(entry).encode("ascii") + b"\n"
        with _explain_errors(self._unwritable):
            while rest:
                rest = rest[os.write(self._file.fileno(), rest) :]
