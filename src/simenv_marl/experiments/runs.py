"""Experiments: every row of a design with every contender on every seed, stored and resumed.

Variants of a model.
"""

import inspect
import json
import os
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from itertools import groupby, product, starmap
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING, Any, Unpack
from uuid import uuid4

from ..core import (
    EpisodeOptions,
    Plan,
    Points,
    as_json,
    describe,
    portable,
    reuse_resources,
)
from ..errors import (
    OptionValueError,
    SimEnvError,
    SimulationError,
    StoreError,
    describe_error,
    name_of,
    short_repr,
)
from ..many.parallel import NO_BAR, import_extra, progress_bar, spread
from ..runs import check_options
from ..simulation import Model
from .runner import (
    RESERVED,
    STATUS_COLUMNS,
    Contenders,
    Metrics,
    Outcome,
    Result,
    Row,
    Runner,
    Team,
    Value,
    check_agents,
    distinct_seeds,
    make_table,
    plain_value,
)
from .store import (
    Entry,
    Provenance,
    Run,
    Store,
    append,
    make_entry,
    to_json,
)

if TYPE_CHECKING:
    from pandas import DataFrame

BY_RULE = "rule"
"""The contender that is always present: the model as it is."""

DEATH = "WorkerError: the worker died in this run, twice; see retry_errors="
"""The result of a run that has killed its worker."""


def run_experiment(
    make: "Callable[..., Model] | Variant",
    design: "DataFrame | Iterable[Any]",
    *,
    contenders: Contenders | None = None,
    seeds: Iterable[int],
    points: Points = None,
    metric: Metrics = None,
    team: Team | None = None,
    store: str | os.PathLike[str],
    batched: bool = False,
    batch_size: int = 1024,
    concurrency: int = 64,
    workers: int = 0,
    progress: bool = False,
    retry_errors: bool = False,
    **options: Unpack[EpisodeOptions],
) -> "DataFrame":
    """Run every row of a design with every contender on every seed. Stored runs are not repeated.

    Each run is stored as soon as it is finished. A process that is killed loses only the runs it
    was working on. Call this again with the same rows, contenders and seeds, or with more, and it
    does the missing runs.

    Args:
        make: A callable that gets the factors of a row as keyword arguments and returns a
            simulation or a ``Variant``; or a ``Variant``, whose parameters the factors become. It
            is called for each row and contender; a simulation that it returns is copied for each
            run, and a class or factory called.
        design: One row for each combination of factors, as ``design`` makes it: a ``DataFrame``, or
            data for one.
        contenders: As ``evaluate`` takes them. ``"rule"``, the model as it is, is always added.
        seeds: As ``evaluate`` takes them.
        points: As ``evaluate`` takes them.
        metric: As ``evaluate`` takes it.
        team: As ``evaluate`` takes it.
        store: The folder of the experiment. It is created if it is missing.
        batched: As ``evaluate`` takes it. The seeds of a row then run together.
        batch_size: As ``evaluate`` takes it.
        concurrency: As ``evaluate`` takes it.
        workers: As ``evaluate`` takes them. All of them write to the folder.
        progress: As ``evaluate`` takes it. The bar shows the remaining time.
        retry_errors: Whether failed runs are repeated.
        **options: As ``evaluate`` takes them.

    Returns:
        One row for each agent of each run, and one for the team (``agent`` is ``"team"``), in the
        order of the design, the contenders and the seeds. The columns: the factors, ``contender``,
        ``seed``, ``agent``, ``return``, ``length``, the metrics, ``status`` (``"ok"`` or
        ``"error"``; a run that failed, or whose numbers are known to be wrong, has only the team's
        row) and ``error``.

    Raises:
        OptionValueError: An argument has an invalid value, or the store belongs to another
            experiment. Nothing has run.
        StoreError: The store cannot be read or written. Stored runs stay.
        MissingExtraError: pandas, joblib or tqdm is missing.
        SimEnvError: Another argument does not work. The subclass and the message say which.
    """
    import_extra("pandas", "run_experiment")
    table, rows = _read_design(design)
    keys = [to_json(row) for row in rows]
    all_seeds = distinct_seeds(seeds)
    check_options(batch_size, workers, None, concurrency)
    contenders = {BY_RULE: {}, **(contenders or {})}
    if contenders[BY_RULE]:
        raise OptionValueError(
            f"the contender {BY_RULE!r} is always the model as it is; give your policies another"
            " name"
        )
    runner = Runner(
        contenders,
        points,
        options,
        metric,
        team,
        batch_size,
        concurrency,
        batched=batched,
        factors=rows[0],
    )
    if isinstance(make, Variant):
        _source_of_row(make, rows[0])  # a variant checks its parameters
    elif problem := find_call_problem(make, rows[0]):
        raise OptionValueError(
            f"{name_of(make)} cannot be called with the factors {', '.join(rows[0]) or '(none)'}:"
            f" {problem}; make must be a callable of the factors, such as a class, or a Variant"
        )
    folder = Path(store).absolute()  # other processes may have another working directory
    storage = Store(folder, keys, rows[0], runner.metrics)
    storage.read()
    storage.check_rows()
    session = f"{time_ns():016x}{uuid4().hex[:8]}"  # later sessions sort after it
    job = Job(make, runner, folder, session)
    agents = job.try_contenders(storage, keys)
    storage.create()
    # A row that occurs twice has the same results.
    runs = list(starmap(Run, product(dict.fromkeys(keys), contenders, all_seeds)))
    final_results = Outcome if retry_errors else (Outcome, str)
    missing = [run for run in runs if not isinstance(storage.runs.get(run), final_results)]
    with progress_bar(len(runs), progress, "run", len(runs) - len(missing)) as bar:
        trials = []
        for (_, contender), group in groupby(missing, lambda run: run[:2]):
            names = agents.pop(contender, set()) - storage.agents[contender]
            if names:
                trials.append((names, list(group)))
        if trials:
            with suppress(BrokenExecutor):  # a run that kills its worker does so again below
                spread(job.try_agents, (), trials, workers, 1, NO_BAR)
            storage.read(session)
            missing = [run for run in missing if run not in storage.runs]
            bar.update(len(storage.runs))
        job.run_all(missing, storage, workers, len(all_seeds) if batched else 1, bar)
    storage.read()
    return _make_frame(table, keys, all_seeds, storage.runs, runner)


# -- the checks before any run --------------------------------------------------------------------


def _read_design(design: "DataFrame | Iterable[Any]") -> "tuple[DataFrame, list[dict[str, Value]]]":
    """Return a design as a table, and its rows as values for JSON."""
    import pandas

    try:
        table = pandas.DataFrame(design)
    except (TypeError, ValueError) as error:
        raise OptionValueError(
            f"design must be a DataFrame, or data to make one from, not {short_repr(design)}"
        ) from error
    for name in table.columns:
        if not isinstance(name, str):
            raise OptionValueError(f"the name of a factor must be a string, not {short_repr(name)}")
        if name in RESERVED:
            raise OptionValueError(
                f"the factor {name!r} has the name of another column of the table; rename it"
            )
    if not len(table):
        raise OptionValueError("the design has no rows")
    rows = table.to_dict("records") or [{}] * len(table)  # no records without columns
    for row in rows:
        for name, value in row.items():
            row[name] = plain_value(f"the factor {name!r}", value)
    return table, rows


def find_call_problem(source: Model, arguments: Mapping[str, Any]) -> str:
    """Return why a class or factory cannot be called with some arguments; empty if it can."""
    if not callable(source) or (hasattr(source, "run") and not isinstance(source, type)):
        return "it is neither a class nor a factory"
    try:
        inspect.signature(source).bind(**arguments)
    except TypeError as problem:
        return str(problem)
    except ValueError:  # a builtin without a signature
        pass
    return ""


# -- runs -----------------------------------------------------------------------------------------


def _source_of_row(make: "Callable[..., Model] | Variant", row: Mapping[str, Value]) -> Model:
    """Return the variant, class or factory of a row's simulations."""
    if isinstance(make, Variant):
        return replace(make, parameters={**make.parameters, **row})
    return partial(make, **row) if isinstance(make, type) else make(**row)


@dataclass(frozen=True)
class Job:
    """The work of an experiment, as its workers get it.

    Attributes:
        make: Makes the simulations of a row.
        runner: Runs the episodes.
        folder: The store.
        session: The id of this call of ``run_experiment``, for the names of files.
    """

    make: "Callable[..., Model] | Variant"
    runner: Runner
    folder: Path
    session: str

    def prepare(self, row: str, contender: str) -> tuple[Plan, Provenance]:
        """Return the plan of runs of a row with a contender, and their provenance."""
        source = _source_of_row(self.make, json.loads(row))
        plan = self.runner.plan(source, contender)
        provenance = describe(plan, None)
        provenance["policies"] |= as_json(self.runner.contenders[contender])
        return plan, provenance

    def try_contenders(self, storage: Store, rows: Sequence[str]) -> dict[str, set[str]]:
        """Set up all contenders, and warn if they have changed since their runs were stored.

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
        return agents

    def run_all(
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
                if not any(self.folder.glob(f"runs-{self.session}-*")):
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

        An error is a result, too.
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
                if self.runner.episodes_at_once(contender) > 1 and len(remaining) > 1 < number:
                    number = 1  # running them one by one shows which of them failed
                    continue
                trace = "".join(traceback.format_exception(error))[-4000:]
                report(next(iter(remaining)), describe_error(error), trace)


# -- the table ------------------------------------------------------------------------------------


def _make_frame(
    table: "DataFrame",
    keys: Sequence[str],
    seeds: Sequence[int],
    results: Mapping[Run, Result],
    runner: Runner,
) -> "DataFrame":
    """Return the table of all runs, in the order of the design, the contenders and the seeds."""
    places: list[int] = []
    rows: list[Row] = []
    for (place, key), contender, seed in product(enumerate(keys), runner.contenders, seeds):
        result = results.get(Run(key, contender, seed), "its result is no longer stored")
        try:
            rows += runner.rows(contender, seed, result)
        except Exception as error:  # raised by team=, which is called for stored runs, too
            rows += runner.rows(contender, seed, describe_error(error))
        places += [place] * (len(rows) - len(places))
    factors = table.iloc[places].reset_index(drop=True)
    return factors.join(make_table((*runner.columns, *STATUS_COLUMNS), rows))


# -- variants -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Variant:
    """A simulation with all changes of an experiment, under one name. Its attributes cannot be set.

    Use ``dataclasses.replace`` to derive another variant.

    Attributes:
        name: Its name in results.
        simulation: A simulation (which is copied), its class, or a factory.
        parameters: The keyword arguments of the class or factory.
        points: The decision points and their definitions, as ``generate_env`` takes them.
        plugins: Handlers for its simulations alone, as the option ``plugins`` takes them. Handlers
            that are given where the variant is used run after these.
        policies: Policies that decide without being agents, as the option ``policies`` takes them.
        options: All other options of its environments.
    """

    name: str
    simulation: Model
    _: KW_ONLY
    parameters: Mapping[str, Any] = field(default_factory=dict)
    points: Points = None
    plugins: Iterable[Any] = ()
    policies: Mapping[Any, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise OptionValueError(f"a variant needs a name, not {short_repr(self.name)}")
        source = self.simulation
        if isinstance(source, Variant):
            raise SimulationError(
                f"the variant {self.name!r} needs a simulation, not the variant {source.name!r};"
                " derive one variant from another with dataclasses.replace"
            )
        for name in ("parameters", "policies", "options"):
            value = getattr(self, name)
            if not isinstance(value, Mapping):
                raise OptionValueError(
                    f"{name} of the variant {self.name!r} must be a dict, not {short_repr(value)}"
                )
        misplaced_options = {"plugins", "policies"} & self.options.keys()
        if misplaced_options:
            raise OptionValueError(
                f"{' and '.join(sorted(misplaced_options))} must be arguments of the variant"
                f" {self.name!r} itself, not among its options"
            )
        if self.parameters and (problem := find_call_problem(source, self.parameters)):
            raise SimulationError(
                f"{name_of(source)} cannot be called with the parameters of the variant"
                f" {self.name!r}: {problem}; its simulation must be a class or a factory that takes"
                " them"
            )

        # Copied, so that later changes of the arguments do not change the variant. Functions become
        # names, because hooks replace them while environments are in use.
        parts = {
            "parameters": dict(self.parameters),
            "points": _named_points(self.points),
            "plugins": tuple(
                (handler, _name(target), *rest) for handler, target, *rest in self.plugins
            ),
            "policies": {_name(key): policy for key, policy in self.policies.items()},
            "options": dict(self.options),
        }
        for name, part in parts.items():
            object.__setattr__(self, name, part)

    def environment_arguments(
        self, points: Points, options: Mapping[str, Any]
    ) -> tuple[Model, Points, dict[str, Any]]:
        """Return simulation, points and options of an environment of this variant.

        The arguments of the environment precede the variant's.
        """
        source = self.simulation
        if self.parameters:
            source = partial(source, **self.parameters)
        all_options = {
            **self.options,
            **options,
            "policies": {**self.policies, **(options.get("policies") or {})},
            "plugins": (*self.plugins, *options.get("plugins", ())),
        }
        return source, self.points if points is None else points, all_options


def _named_points(points: Points) -> Points:
    """Return points by their names, where they can be imported."""
    if isinstance(points, Mapping):
        return {_name(key): definition for key, definition in points.items()}
    if isinstance(points, Iterable) and not isinstance(points, str):
        return list(map(_name, points))
    name: Points = _name(points)
    return name


def _name(key: Model) -> Model:
    """Return the name of a function that can be imported, and any other key itself."""
    name = portable(key)
    return name if isinstance(name, str) else key
