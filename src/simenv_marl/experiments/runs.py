"""Experiments: every row of a design with every contender on every seed, stored and resumed.

Variants of a model.
"""

import inspect
import json
import os
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import closing, suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial, wraps
from itertools import groupby, product
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory
from time import time_ns
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Unpack
from uuid import uuid4

from ..core import (
    EpisodeOptions,
    Plan,
    Points,
    as_json,
    describe,
    pack,
    portable,
    reuse_resources,
    source_name,
)
from ..errors import (
    OptionValueError,
    SimEnvError,
    SimulationError,
    StoreError,
    describe_error,
    short_repr,
)
from ..many.parallel import NO_BAR, import_extra, progress_bar, spread
from ..simulation import make_simulation
from .runner import (
    FALLBACKS,
    RUN_COLUMNS,
    STATUS_COLUMNS,
    TEAM,
    Returns,
    Runner,
    distinct_seeds,
    make_table,
    plain_value,
)
from .store import Provenance, Result, Run, Store, Writer, to_json

if TYPE_CHECKING:
    from pandas import DataFrame

BY_RULE: Final = "rule"
"""The contender that is always present: the model as it is."""


def run_experiment(
    make: Any,
    design: Any,
    *,
    contenders: Mapping[str, Mapping[Any, Any]] | None = None,
    seeds: Iterable[int],
    points: Points = None,
    metric: Any = None,
    team: Callable[[Returns], Any] | None = None,
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
            is called anew for each run.
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
        ``"error"``; a failed run has only the team's row) and ``error``.

    Raises:
        OptionValueError: An argument has an invalid value, or the store belongs to another
            experiment. Nothing has run.
        StoreError: The store cannot be read or written. What was stored before stays.
        MissingExtraError: pandas, joblib or tqdm is missing.
        SimEnvError: Something else cannot work. The subclass tells what.
    """
    import_extra("pandas", "run_experiment")
    table, rows = _checked_design(design)
    keys, all_seeds = [to_json(row) for row in rows], distinct_seeds(seeds)
    runner = Runner(
        contenders or {}, points, options, metric, team, batched=bool(batched), batch_size=batch_size,
        concurrency=concurrency, workers=workers,
        factors=rows[0],
    )  # fmt: skip
    if runner.contenders.get(BY_RULE):
        raise OptionValueError(
            f"the contender {BY_RULE!r} is always the model as it is; give your policies another"
            " name"
        )
    runner.contenders = {BY_RULE: {}, **runner.contenders}
    if isinstance(make, Variant):
        _source(make, rows[0])  # a variant checks its parameters
    else:
        what = "make must be a callable of the factors, such as a class, or a Variant"
        check_call(
            make, rows[0], OptionValueError, what, f"the factors {', '.join(rows[0]) or '(none)'}"
        )
    try:
        folder = Path(store).absolute()  # other processes may have another working directory
    except TypeError as error:
        raise OptionValueError(
            f"store must be the path of a folder, not {short_repr(store)}"
        ) from error
    storage = Store(folder, rows[0], runner.metrics)
    storage.read(keys)
    storage.check_rows(keys)
    # of all processes that do runs now; later ones sort after it
    session = f"{time_ns():016x}{uuid4().hex[:8]}"
    if workers:
        # errors of pickling come before any run, and so do those of contenders
        pack((make, runner))
    row, prepared = _try_contenders(
        make, runner, sorted(keys, key=lambda key: key != storage.sample)
    )
    storage.create()
    storage.warn_of_changes(
        row, {contender: provenance for contender, (_, provenance) in prepared.items()}
    )
    finished = {
        run
        for run, result in storage.runs.items()
        if not (retry_errors and isinstance(result, str))
    }
    # A row that occurs twice has the same results.
    runs = list(product(dict.fromkeys(keys), runner.contenders, all_seeds))
    missing = [run for run in runs if run not in finished]
    with (
        progress_bar(len(runs), progress, "run", len(runs) - len(missing)) as bar,
        TemporaryDirectory() as notes,
    ):
        work = make, runner, folder, session, notes if workers else ""
        # for each contender whose agents are not known: these, and the runs of its first row
        firsts = []
        for contender, (names, _) in prepared.items():
            own = [run for run in missing if run[1] == contender]
            unseen = {name for name in names if (contender, name) not in storage.seen}
            if own and unseen:
                firsts.append((unseen, [run for run in own if run[0] == own[0][0]]))
        if firsts:
            with suppress(BrokenExecutor):  # a run that has killed its worker does so again below
                spread(_run_first, work, firsts, workers, 1, NO_BAR)
            storage.read(keys, session)
            missing = [run for run in missing if run not in storage.runs]
            bar.update(len(storage.runs))
        _run_all(work, missing, workers, len(all_seeds) if batched else 1, bar, storage, keys)
    storage.read(keys)
    return _make_frame(table, keys, all_seeds, storage.runs, runner)


# -- checks before anything runs ------------------------------------------------------------------


def _checked_design(design: Any) -> "tuple[DataFrame, list[dict[str, Any]]]":
    """Return a design as a table, and its rows as values for JSON."""
    pandas = import_extra("pandas", "a design")
    try:
        table = design if isinstance(design, pandas.DataFrame) else pandas.DataFrame(design)
    except (TypeError, ValueError) as error:
        raise OptionValueError(
            f"design must be a DataFrame, or data to make one from, not {short_repr(design)}"
        ) from error
    names = list(table.columns)
    for name in names:
        if not isinstance(name, str):
            raise OptionValueError(f"the name of a factor must be a string, not {short_repr(name)}")
        if name in (*RUN_COLUMNS, FALLBACKS, *STATUS_COLUMNS):
            raise OptionValueError(
                f"the factor {name!r} has the name of another column of the table; rename it"
            )
        if names.count(name) > 1:
            raise OptionValueError(f"the factor {name!r} occurs twice")
    if not len(table):
        raise OptionValueError("the design has no rows")
    advice = "; other values cannot be stored: use a name as the value, and look it up in make"
    levels = {
        name: [plain_value(f"the factor {name!r}", value, advice) for value in table[name]]
        for name in names
    }
    return table, [{name: levels[name][place] for name in names} for place in range(len(table))]


def _try_contenders(
    make: Any, runner: Runner, keys: Sequence[str]
) -> tuple[str, dict[str, tuple[set[str], Provenance]]]:
    """Check that all contenders can be set up.

    Return a row, as JSON, and their unproven agents and provenance.

    Both are empty if the simulations of the first ten rows cannot be made: the runs of all rows
    tell why.
    """
    for key in keys[:10]:
        try:
            prepared = {
                contender: _prepare(make, runner, key, contender) for contender in runner.contenders
            }
            return key, {
                name: (runner.unproven_agents(plan, name), made)
                for name, (plan, made) in prepared.items()
            }
        except SimEnvError:
            raise
        except Exception:  # this row fails; another may not
            continue
    return "", {}


# -- runs -----------------------------------------------------------------------------------------


def _source(make: Any, row: Mapping[str, Any]) -> Any:
    """Return the variant, class or factory of a row's simulations."""
    if isinstance(make, Variant):
        return replace(make, parameters={**make.parameters, **row})
    if isinstance(make, type):
        return partial(make, **row)
    first = make(**row)
    if isinstance(first, (Variant, type)) or not hasattr(first, "run"):
        return first
    ready = [first]

    @wraps(type(first), updated=())  # provenance names it after the class that it makes
    def factory() -> Any:
        if ready:
            return ready.pop()
        made = make(**row)
        # each run has a simulation of its own
        return make_simulation(first) if made is first else made

    return factory


def _prepare(make: Any, runner: Runner, key: str, contender: str) -> tuple[Plan, dict[str, Any]]:
    """Return the plan of runs of a row with a contender, and their provenance."""
    source = _source(make, json.loads(key))
    plan = runner.plan(source, contender)
    name = make.name if isinstance(make, Variant) else source_name(make)
    policies = {
        **(source.policies if isinstance(source, Variant) else {}),
        **runner.contenders[contender],
    }
    return plan, describe(plan, None) | {"make": name, "policies": as_json(policies)}


def _run_all(
    work: tuple[Any, ...],
    missing: list[Run],
    workers: int,
    least: int,
    bar: Any,
    storage: Store,
    keys: Sequence[str],
) -> None:
    """Do all runs.

    A run that has killed its worker, and does so again while nothing else runs, becomes an error.
    """
    _, runner, folder, session, notes = work
    while missing:
        try:
            # few parts cost nothing
            spread(_run_part, work, missing, workers, least, bar, share=16)
            return
        except BrokenExecutor:  # a worker has died, and joblib has ended all others
            suspects: list[Run] = []
            storage.read(keys, session)
            for path in sorted(Path(notes).iterdir()):
                with suppress(ValueError):  # its process was killed while it wrote
                    left = [
                        run
                        for run in map(tuple, json.loads(path.read_bytes()))
                        if run not in storage.runs
                    ]
                    suspects += left[: max(runner.batch_size, 1)]
                path.unlink()
            if not suspects:
                raise
        for run in suspects:
            try:
                spread(_run_part, work, [run], max(workers, 2), 1, bar)
            except BrokenExecutor:
                with closing(Writer(folder, session)) as writer:
                    writer.write(
                        run,
                        "WorkerError: the worker died in this run, twice; see retry_errors=",
                        {},
                    )
        storage.read(keys, session)
        missing = [run for run in missing if run not in storage.runs]


def _note(notes: str, runs: Sequence[Run]) -> None:
    """Note the runs that a worker does next, for the case that it dies."""
    if notes:
        with suppress(OSError):  # another machine does not see the folder
            Path(notes, uuid4().hex).write_text(to_json(runs), encoding="ascii")


def _run_first(
    make: Any, runner: Runner, folder: Path, session: str, notes: str, firsts: list[Any], bar: Any
) -> None:
    """Run the first row of contenders, until the agents that they name have appeared.

    Only then store the results.

    Each item consists of these names and of the runs of the row. An agent that has not appeared is
    an ``AgentError``.
    """
    for names, runs in firsts:
        _note(notes, runs)
        held: list[Any] = []
        present: dict[str, float] = {}
        for key, contender, seed in runs:
            _run_seeds(
                make,
                runner,
                lambda *entry, held=held: held.append(entry),
                key,
                contender,
                [seed],
                bar,
            )
            result = held[-1][1]
            present |= {} if isinstance(result, str) else result.returns
            if present.keys() >= names:
                break
        if not all(isinstance(result, str) for _, result, *_ in held):
            runner.check_agents(runs[0][1], names, present)
        with closing(Writer(folder, session)) as writer:
            for entry in held:
                writer.write(*entry)


def _run_part(
    make: Any, runner: Runner, folder: Path, session: str, notes: str, runs: Sequence[Run], bar: Any
) -> None:
    """Do runs and store their results."""
    _note(notes, runs)
    with closing(Writer(folder, session)) as writer, reuse_resources():
        for (key, contender), group in groupby(runs, lambda run: run[:2]):
            _run_seeds(
                make, runner, writer.write, key, contender, [seed for *_, seed in group], bar
            )


def _run_seeds(
    make: Any, runner: Runner, write: Any, key: str, contender: str, seeds: Sequence[int], bar: Any
) -> None:
    """Run seeds of a row with a contender, and ``write`` the result of each.

    An error is a result, too.
    """
    remaining = dict.fromkeys(seeds)

    def report(seed: int, result: Result, trace: str | None = None) -> None:
        write((key, contender, seed), result, {**provenance, "seed": seed}, trace)
        del remaining[seed]
        bar.update()

    while remaining:
        provenance: dict[str, Any] = {}  # unknown if the simulation cannot be made
        try:
            plan, provenance = _prepare(make, runner, key, contender)
            runner.run(plan, contender, list(remaining), report)
        except (KeyboardInterrupt, StoreError):
            raise
        except BaseException as error:
            if (
                runner.together(contender) > 1 and len(remaining) > 1
            ):  # running them one by one shows which of them failed
                for seed in remaining:
                    _run_seeds(make, runner, write, key, contender, [seed], bar)
                return
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
    rows: list[tuple[Any, ...]] = []
    for (place, key), contender, seed in product(enumerate(keys), runner.contenders, seeds):
        result = results.get((key, contender, seed), "its result is no longer stored")
        own: list[tuple[Any, ...]] = []
        if not isinstance(result, str):
            try:
                own = [(*row, "ok", None) for row in runner.rows(result)]
            except Exception as error:  # raised by team=, which is called for stored runs, too
                result = describe_error(error)
        for row in own or [
            (TEAM, nan, 0, *[None] * (len(runner.columns) - len(RUN_COLUMNS)), "error", result)
        ]:
            places.append(place)
            rows.append((contender, seed, *row))
    factors = table.iloc[places].reset_index(drop=True)
    return factors.join(make_table((*runner.columns, *STATUS_COLUMNS), rows))


# -- variants -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Variant:
    """A simulation with all changes of an experiment, under one name. Immutable.

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
    simulation: Any
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
            # Copied, so that later changes of the arguments do not change the variant.
            object.__setattr__(self, name, MappingProxyType(dict(value)))
        object.__setattr__(self, "plugins", tuple(self.plugins))
        twice = [name for name in ("plugins", "policies") if name in self.options]
        if twice:
            raise OptionValueError(
                f"{' and '.join(twice)} must be arguments of the variant {self.name!r} itself, not"
                " among its options"
            )
        if self.parameters:
            what = f"the variant {self.name!r} has parameters, so its simulation must be a class or a factory"
            check_call(
                source,
                self.parameters,
                SimulationError,
                what,
                f"the parameters of the variant {self.name!r}",
            )

    def __reduce__(self) -> Any:
        # Functions are pickled by name: while environments are in use, hooks may stand in their
        # places.
        points = self.points
        if isinstance(points, Mapping):
            points = {portable(key): definition for key, definition in points.items()}
        elif points is not None and not isinstance(points, str):
            points = [
                portable(key) for key in (points if isinstance(points, Iterable) else [points])
            ]
        return partial(
            Variant,
            self.name,
            self.simulation,
            parameters=dict(self.parameters),
            points=points,
            plugins=[(handler, portable(target), *rest) for handler, target, *rest in self.plugins],
            policies={portable(key): policy for key, policy in self.policies.items()},
            options=dict(self.options),
        ), ()

    def environment_arguments(
        self, points: Any, options: Mapping[str, Any]
    ) -> tuple[Any, Any, dict[str, Any]]:
        """Return simulation, points and options of an environment of this variant, with those that are given to it."""
        source = partial(self.simulation, **self.parameters) if self.parameters else self.simulation
        merged = {**self.options, **options}
        policies = {**self.policies, **(options.get("policies") or {})}
        plugins = (*self.plugins, *options.get("plugins", ()))
        if policies:
            merged["policies"] = policies
        if plugins:
            merged["plugins"] = plugins
        return source, self.points if points is None else points, merged


def check_call(
    source: Any,
    arguments: Mapping[str, Any],
    error: type[SimEnvError],
    requirement: str,
    described: str,
) -> None:
    """Check that something is a class or a factory, as ``requirement`` says, and takes the described arguments."""
    if not callable(source) or (hasattr(source, "run") and not isinstance(source, type)):
        raise error(f"{requirement}, not {short_repr(source)}")
    try:
        inspect.signature(source).bind(**arguments)
    except TypeError as problem:
        name = getattr(source, "__qualname__", None) or short_repr(source)
        raise error(f"{name} cannot be called with {described}: {problem}") from problem
    except ValueError:  # a builtin without a signature
        pass
