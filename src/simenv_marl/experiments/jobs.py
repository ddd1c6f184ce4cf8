"""Runs whose results are stored, for ``evaluate`` and ``run_experiment``: each in a worker or here.

The process that has finished a run writes its line.
"""

import json
import os
import traceback
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from time import time_ns
from typing import Any
from uuid import uuid4

from ..core import Plan, as_json, describe, reuse_resources
from ..errors import SimEnvError, StoreError, describe_error
from ..many.parallel import spread
from ..simulation import Model
from .runner import Result, Row, Runner, check_agents, error_note
from .store import NO_FACTORS, Entry, Provenance, Run, Store, append, make_entry

DEATH = "WorkerError: the worker died in this run, twice; see retry_errors="
"""The result of a run that has killed its worker."""


def open_store(
    source: Callable[[Row], Model],
    runner: Runner,
    folder: str | os.PathLike[str],
    rows: Iterable[str] = (NO_FACTORS,),
    factors: Collection[str] | None = None,
) -> "tuple[Job, Store]":
    """Read the store of an experiment, or without ``factors`` of an evaluation.

    Args:
        source: Returns the variant, class, factory or simulation of a row.
        runner: Runs the episodes.
        folder: The folder, which may be missing.
        rows: The rows of the design, as JSON.
        factors: The names of the factors.
    """
    path = Path(folder).absolute()  # other processes may have another working directory
    storage = Store(path, rows, factors, runner.metrics)
    storage.read()
    session = f"{time_ns():016x}{uuid4().hex[:8]}"  # later sessions sort after it
    return Job(source, runner, path, session, factors is None), storage


@dataclass(frozen=True)
class Job:
    """The work of an experiment or evaluation, as its workers get it.

    Attributes:
        source: Returns the variant, class, factory or simulation of a row.
        runner: Runs the episodes.
        folder: The store.
        session: The id of this call, for the names of files.
        raises: Whether errors of runs are raised. Otherwise they are results.
    """

    source: Callable[[Row], Model]
    runner: Runner
    folder: Path
    session: str
    raises: bool

    def prepare(self, row: str, contender: str) -> tuple[Plan, Provenance]:
        """Return the plan of runs of a row with a contender, and their provenance."""
        plan = self.runner.plan(self.source(json.loads(row)), contender)
        provenance = describe(plan, None)
        provenance["policies"] |= as_json(self.runner.contenders[contender])
        return plan, provenance

    def try_contenders(self, storage: Store, rows: Sequence[str]) -> dict[str, set[str]]:
        """Set up all contenders, and warn if they have changed since their runs were stored.

        Make the store, unless it exists.

        Returns:
            The undeclared agents of each contender. It lacks a contender whose simulations cannot
            be made in the first ten rows, because its runs tell why.
        """
        agents = {}
        for contender in self.runner.contenders:
            for row in [storage.samples.get(contender, rows[0]), *rows[:10]]:
                try:
                    plan, provenance = self.prepare(row, contender)
                except SimEnvError:
                    raise
                except Exception:  # this row fails; another may not
                    continue
                storage.warn_of_changes(contender, row, provenance)
                agents[contender] = self.runner.undeclared_agents(plan, contender)
                break
        storage.create()
        return agents

    def run_missing(
        self,
        missing: Sequence[Run],
        agents: dict[str, set[str]],
        storage: Store,
        workers: int,
        least: int,
        bar: Any,
    ) -> None:
        """Do runs in workers, in parts of at least ``least`` runs, and read the store.

        ``agents`` are those of ``try_contenders``. Contenders that were tried out are removed.

        Raises:
            AgentError: An agent that a contender names has not decided.
            StoreError: The store cannot be read or written.
            BaseException: An interrupt, or with ``raises`` an error of a run. A note tells how to
                go on.
        """
        with error_note(f"finished runs are kept in {self.folder}; the same call does the others"):
            trials = []
            for (_, contender), group in groupby(missing, lambda run: run[:2]):
                names = agents.pop(contender, set()) - storage.agents[contender]
                if names:
                    trials.append((names, list(group)))
            if trials:
                with suppress(BrokenExecutor):  # a run that kills its worker does so again below
                    spread(self.try_agents, (), trials, workers, 1, bar)
                storage.read(self.session)
                missing = [run for run in missing if run not in storage.runs]
            self._run_all(missing, storage, workers, least, bar)
        storage.read()

    def _run_all(
        self,
        runs: Sequence[Run],
        storage: Store,
        workers: int,
        least: int,
        bar: Any,
    ) -> None:
        """Do runs in workers, in parts of at least ``least`` runs.

        If a worker dies, joblib ends all others. Each half of the missing runs is then tried
        separately. A single run that kills its worker twice becomes an error.

        Raises:
            BrokenExecutor: The workers have died before one of them began.
        """
        parts = [runs]
        while parts:
            part = parts.pop()
            try:
                # Small parts cost nothing.
                spread(self.run_part, (), part, workers, least, bar, share=16)
            except BrokenExecutor:
                if self.raises or not any(self.folder.glob(f"runs-{self.session}-*")):
                    raise
                if len(part) == 1 and part is not runs:
                    append(self.folder, self.session, make_entry(part[0], DEATH, {}))
                    continue
                storage.read(self.session)
                missing = [run for run in part if run not in storage.runs]
                middle = len(missing) // 2
                parts += [missing[middle:], missing[:middle]]

    def run_part(self, runs: Sequence[Run], bar: Any) -> None:
        """Do runs and store their results."""
        append(self.folder, self.session)  # because this worker has begun
        with reuse_resources():
            for _, group in groupby(runs, lambda run: run[:2]):
                self._run_group(list(group), partial(append, self.folder, self.session), bar)

    def try_agents(
        self,
        trials: Sequence[tuple[set[str], list[Run]]],
        bar: Any,
    ) -> None:
        """Run the first row of contenders until all agents that they name have decided.

        Store the results only then.

        Args:
            trials: For each contender: the names of the agents, and the runs of its first row.
            bar: The progress bar.

        Raises:
            AgentError: An agent has not decided.
        """
        for names, runs in trials:
            entries: list[Entry] = []
            present: dict[str, object] = {}
            for run in runs:
                self._run_group([run], entries.append, bar)
                present |= entries[-1].get("agents", {})
                if present.keys() >= names:
                    break
            if any(entry["status"] == "ok" for entry in entries):
                check_agents(runs[0].contender, names, present)
            append(self.folder, self.session, *entries)

    def _run_group(
        self,
        runs: Sequence[Run],
        write: Callable[[Entry], None],
        bar: Any,
    ) -> None:
        """Do runs of one row and one contender, and ``write`` the result of each.

        An error is a result, too, unless it is raised.
        """
        row, contender, _ = runs[0]
        remaining = {run.seed: run for run in runs}
        number = len(runs)

        def report(
            seed: int,
            result: Result,
            trace: str | None = None,
        ) -> None:
            write(make_entry(remaining[seed], result, {**provenance, "seed": seed}, trace))
            del remaining[seed]
            bar.update()

        while remaining:
            seeds = list(remaining)[:number]
            provenance: Provenance = {}  # unknown if the simulation cannot be made
            try:
                plan, provenance = self.prepare(row, contender)
                self.runner.run(plan, contender, seeds, report)
            except (KeyboardInterrupt, StoreError):
                raise
            except BaseException as error:
                if self.raises:
                    raise
                if self.runner.episodes_at_once(contender) > 1 and len(remaining) > 1 < number:
                    number = 1  # running them one by one shows which of them failed
                    continue
                trace = "".join(traceback.format_exception(error))[-4000:]
                report(next(iter(remaining)), describe_error(error), trace)
