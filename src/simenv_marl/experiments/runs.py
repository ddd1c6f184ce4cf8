"""Experiments: every row of a design with every contender on every seed; stored as they run, and resumed."""

import json
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Unpack

import numpy as np

from ..core.options import EpisodeOptions
from ..core.packing import pack
from ..core.points import Points
from ..core.reuse import processes_kept
from ..errors import OptionValueError, SimEnvError, StoreError, describe_error, short_repr
from ..many.parallel import import_extra, progress_bar, spread
from ..many.simulate import check_numbers
from .evaluation import distinct_seeds, rows_of, typed
from .playing import (
    COLUMNS,
    TEAM,
    Metrics,
    Outcome,
    Policies,
    Returns,
    checked_contenders,
    checked_metrics,
    checked_options,
    checked_team,
    play,
    play_many,
    points_of,
)
from .store import Known, Stored, Writer, compare, line_of, new_session, prepare, read, warn_of_changes, written
from .workshop import Row, Workshop, checked_make

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["run_experiment"]

BY_RULE: Final = "rule"
"""The contender that is always present: the model as it is."""

SHARE: Final = 16
"""The number of parts of the work per process: few enough to cost nothing, enough for all to end together."""

TRIED: Final = 10
"""The largest number of rows on which contenders are checked, if making the simulations of rows fails."""

LONGEST_TRACE: Final = 4000


class Run(NamedTuple):
    """A run.

    Attributes:
        row: The factors.
        key: The factors as JSON.
        contender: The name of the contender.
        seed: The seed of the simulation.
    """

    row: Row
    key: str
    contender: str
    seed: int


def run_experiment(
    make: Any,
    design: Any,
    *,
    policies: Mapping[str, Policies] | None = None,
    seeds: Iterable[int],
    points: Points = None,
    metric: Any = None,
    team: Callable[[Returns], Any] | None = None,
    store: str | os.PathLike[str],
    batched: bool = False,
    batch_size: int = 1024,
    workers: int = 0,
    progress: bool = False,
    retry_errors: bool = False,
    **options: Unpack[EpisodeOptions],
) -> "DataFrame":
    """Run every row of a design with every contender on every seed. Stored runs are not repeated.

    Each run is stored as soon as it is finished. A process that is killed loses only the runs it was working on. Call
    this again with the same rows, contenders and seeds, or with more, and it does the missing runs.

    Args:
        make: A callable that gets the factors of a row as keyword arguments and returns a simulation or a ``Variant``;
            or a ``Variant``, whose parameters the factors become. It is called anew for each run.
        design: One row for each combination of factors, as ``design`` makes it: a ``DataFrame``, or data for one.
        policies: Contenders besides ``"rule"``, the model as it is: a dict from a name to policies for ``simulate``.
        seeds: The seeds of the simulations, all different.
        points: The decision points, as ``generate_env`` takes them.
        metric: As ``evaluate`` takes it.
        team: As ``evaluate`` takes it. None: the sum of the returns.
        store: The folder of the experiment. It is created if it is missing.
        batched: Whether the policies are those of ``simulate_many``. The seeds of a row then run together.
        batch_size: The largest number of seeds that run together, if ``batched``.
        workers: The number of worker processes: see ``simulate_many``. All of them write to the folder.
        progress: Whether to show a progress bar with the remaining time, by ``tqdm``.
        retry_errors: Whether failed runs are repeated.
        **options: The options of ``simulate``.

    Returns:
        One row for each agent of each run, and one for the team (``agent`` is ``"team"``), in the order of the design,
        the contenders and the seeds. The columns: the factors, ``contender``, ``seed``, ``agent``, ``return``,
        ``length``, the metrics, ``status`` (``"ok"`` or ``"error"``; a failed run has only the team's row) and
        ``error``.

    Raises:
        OptionValueError: An argument has an invalid value, or the store belongs to another experiment. Nothing has run.
        StoreError: The store cannot be read or written. What was stored before stays.
        MissingExtraError: pandas, joblib or tqdm is missing.
        SimEnvError: Something else cannot work. The subclass tells what.
    """
    import_extra("pandas", "run_experiment")
    contenders = _contenders(policies, batched=bool(batched))
    table, rows = checked_design(design)
    metrics, size = checked_metrics(metric, list(table.columns)), int(batch_size) if batched else 0
    places = distinct_seeds(seeds)
    _check(make, rows, batch_size, workers, team)
    chosen = checked_options(options)
    points = list(points) if isinstance(points, Iterator) else points
    workshop = (make, contenders, points, chosen, points_of(contenders))
    folder, keys, factors = _folder(store), [written(row) for row in rows], list(table.columns)
    trying = Workshop(*workshop)
    tried = _try(trying, rows, contenders)
    arguments = (*workshop, metrics, size, folder, new_session())
    if workers:
        pack(arguments)  # errors of pickling come before any run
    prepare(folder, factors, list(metrics))
    stored = _compared(folder, factors, keys, rows, tried, partial(_try, trying, contenders=contenders))
    missing = list(_missing(rows, keys, contenders, places, stored, retry=retry_errors))
    total = len(set(keys)) * len(contenders) * len(places) if progress else None
    _run_missing(arguments, missing, int(workers), len(places) if batched else 1, total)
    return _frame(table, keys, list(contenders), places, read(folder, factors), list(metrics), team)


def _compared(
    folder: Path,
    factors: list[str],
    keys: list[str],
    rows: Sequence[Row],
    tried: Any,
    trying: Callable[[list[Row]], Any],
) -> Stored:
    """Return the stored runs, after checks that they belong to this experiment; warn of changes since then.

    Args:
        folder: The folder of the store.
        factors: The names of the factors.
        keys: The keys of the rows, as they are stored.
        rows: All rows.
        tried: The row of which a simulation was made, and its provenance.
        trying: A callable that does the same for other rows.
    """
    stored = read(folder, factors, tried[0])
    compare(folder, stored, keys)
    if tried[0] not in stored.rows:  # so that stored runs are compared with what they would be made of now
        with suppress(SimEnvError):  # making this row's simulation failed
            tried = trying([row for row, key in zip(rows, keys, strict=True) if key in stored.rows])
        stored = read(folder, factors, tried[0])
    warn_of_changes(folder, stored, tried[1])
    return stored


def _run_missing(arguments: Any, missing: list[Run], workers: int, at_once: int, total: int | None) -> None:
    """Do the missing runs, with a progress bar if ``total`` is given."""
    with nullcontext() if total is None else progress_bar(total, "run", total - len(missing)) as bar, processes_kept():
        for number in _work(arguments, missing, workers, at_once):
            if bar is not None:
                bar.update(number)


# -- what is checked before anything runs ---------------------------------------------------------


def _check(make: Any, rows: Any, batch_size: Any, workers: Any, team: Any) -> None:
    check_numbers(batch_size, workers)
    checked_team(team)
    for row in rows[:1]:
        checked_make(make, row)


def _contenders(policies: Any, *, batched: bool) -> dict[str, Policies]:
    found = checked_contenders(policies or {}, "policies", batched=batched)
    if found.pop(BY_RULE, {}):
        raise OptionValueError(
            f"the contender {BY_RULE!r} is always the model as it is; give your policies another name"
        )
    return {BY_RULE: {}, **found}


def checked_design(design: Any) -> "tuple[DataFrame, list[Row]]":
    """Return a design as a table, and its rows as JSON values.

    Raises:
        OptionValueError: It is not a design.
    """
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
        if name in COLUMNS:
            raise OptionValueError(f"the factor {name!r} has the name of another column of the table; rename it")
        if names.count(name) > 1:
            raise OptionValueError(f"the factor {name!r} occurs twice")
    if not len(table):
        raise OptionValueError("the design has no rows")
    columns = {name: [_plain(name, value) for value in table[name].tolist()] for name in names}
    return table, [{name: columns[name][place] for name in names} for place in range(len(table))]


def _plain(name: str, value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is not None and type(value) not in (bool, int, float, str):
        raise OptionValueError(
            f"the factor {name!r} has the value {short_repr(value)}, which cannot be stored: factors"
            " are numbers, strings,"
            " bools or None. Use a name as the value, and look it up in make"
        )
    return value


def _folder(store: Any) -> Path:
    try:
        return Path(store).absolute()  # other processes may have another working directory
    except TypeError as error:
        raise OptionValueError(f"store must be the path of a folder, not {short_repr(store)}") from error


def _try(workshop: Workshop, rows: Sequence[Row], contenders: Iterable[str]) -> tuple[str, dict[str, dict[str, Any]]]:
    """Check that all contenders can be set up.

    Returns:
        A row, as JSON, and the provenance of its runs by contender; empty if no row's simulation can be made.

    Raises:
        SimEnvError: A contender cannot be set up.
    """
    for row in rows[:TRIED]:
        try:
            made = {contender: json.loads(workshop.plan(row, contender)[1](0)) for contender in contenders}
        except SimEnvError:
            raise
        except Exception:  # this row fails; another may not
            continue
        return written(row), made
    return "", {}


# -- runs -----------------------------------------------------------------------------------------


def _missing(
    rows: Sequence[Row],
    keys: Sequence[str],
    contenders: Iterable[str],
    seeds: Sequence[int],
    stored: Stored,
    *,
    retry: bool,
) -> Iterator[Run]:
    seen: set[str] = set()
    for row, key in zip(rows, keys, strict=True):
        if key in seen:  # the same row has the same result
            continue
        seen.add(key)
        for contender in contenders:
            for seed in seeds:
                known = stored.runs.get((key, contender, seed))
                if known is None or (retry and known.outcome is None):
                    yield Run(row, key, contender, seed)


def _work(arguments: tuple[Any, ...], runs: list[Run], workers: int, together: int) -> Iterator[int]:
    """Do the missing runs; yield the number of runs done since the last yield."""
    if not runs:
        return
    if workers:
        for number, _ in spread(_do_part, arguments, runs, workers, together, SHARE):
            yield number
    else:
        yield from _do(*arguments, runs=runs)


def _do_part(*arguments: Any) -> None:
    """Do a part of the runs, in a worker."""
    *others, runs = arguments
    parent = _parents.setdefault(os.getpid(), os.getppid())
    with processes_kept():
        for _ in _do(*others, runs=runs):
            if os.getppid() != parent:  # the parent was killed, so that nothing waits for the results
                return


_parents: dict[int, int] = {}


def _do(
    make: Any,
    contenders: Mapping[str, Policies],
    points: Any,
    options: Mapping[str, Any],
    named: Sequence[Any],
    metrics: Metrics,
    size: int,
    folder: Path,
    session: str,
    *,
    runs: Sequence[Run],
) -> Iterator[int]:
    """Do runs and store their results; yield the number of runs done since the last yield."""
    workshop = Workshop(make, contenders, points, options, named)
    writer = Writer(folder, session)
    try:
        for (_, contender), group in groupby(runs, lambda run: run[1:3]):
            together = list(group)
            row = together[0].row
            if size and len(together) > 1:
                left = _do_many(workshop, row, contender, together, metrics, size, writer)
                yield len(together) - len(left)
                together = left
            for run in together:
                _do_one(workshop, run, metrics, size, writer)
                yield 1
    finally:
        writer.close()


def _do_one(workshop: Workshop, run: Run, metrics: Metrics, size: int, writer: Writer) -> None:
    provenance: Callable[[int], str] = _unknown
    known = Known(None, None)

    def keep(_: int, outcome: Outcome) -> None:
        nonlocal known
        known = Known(outcome, None)

    trace = None
    try:
        plan, provenance = workshop.plan(run.row, run.contender)
        if size:
            play_many(plan, [run.seed], 1, metrics, keep)
        else:
            keep(0, play(plan, run.seed, metrics))
    except BaseException as error:
        if not _is_failure(error):
            raise
        known, trace = Known(None, describe_error(error)), "".join(traceback.format_exception(error))[-LONGEST_TRACE:]
        workshop.forget()
    writer.write(line_of(run.row, run.contender, run.seed, known, provenance(run.seed), trace))


def _is_failure(error: BaseException) -> bool:
    """Return whether an error is a failure of the run, and not a request to stop this process."""
    cancelled = getattr(sys.modules.get("asyncio"), "CancelledError", SystemExit)  # a task of the model was cancelled
    return isinstance(error, (Exception, SystemExit, cancelled))


def _unknown(seed: int) -> str:
    """Return the provenance of a run whose simulation could not be made."""
    return written({"seed": seed})


def _do_many(
    workshop: Workshop, row: Row, contender: str, runs: list[Run], metrics: Metrics, size: int, writer: Writer
) -> list[Run]:
    """Do the runs of one row and contender together; return those that did not end because of an error."""
    left = dict(enumerate(runs))
    try:
        plan, provenance = workshop.plan(row, contender)

        def keep(place: int, outcome: Outcome) -> None:
            seed = left[place].seed
            writer.write(line_of(row, contender, seed, Known(outcome, None), provenance(seed)))
            del left[place]

        play_many(plan, [run.seed for run in runs], size, metrics, keep)
    except StoreError:
        raise
    except BaseException as error:
        if not _is_failure(error):
            raise
        workshop.forget()  # running them one by one will show which run it was
    return list(left.values())


# -- the table ------------------------------------------------------------------------------------


def _frame(
    table: "DataFrame",
    keys: Sequence[str],
    contenders: Sequence[str],
    seeds: Sequence[int],
    stored: Stored,
    metrics: Sequence[str],
    team: Any,
) -> "DataFrame":
    """Return the table of all runs, in the order of the design, the contenders and the seeds."""
    pandas = import_extra("pandas", "run_experiment")
    places: list[int] = []
    columns: dict[str, list[Any]] = {name: [] for name in (*COLUMNS[:5], *metrics, *COLUMNS[5:])}
    for place, key in enumerate(keys):
        for contender in contenders:
            for seed in seeds:
                known = stored.runs.get((key, contender, seed), LOST)
                for values in _rows(known, contender, seed, metrics, team):
                    places.append(place)
                    for column, value in zip(columns.values(), values, strict=True):
                        column.append(value)
    factors = table.iloc[places].reset_index(drop=True)
    return pandas.concat([factors, typed(columns)], axis=1)


LOST: Final = Known(None, "it did not come to its end: the worker process that ran it has ended")


def _rows(known: Known, contender: str, seed: int, metrics: Sequence[str], team: Any) -> Iterator[tuple[Any, ...]]:
    if known.outcome is None:
        nothing = [None] * len(metrics)
        yield contender, seed, TEAM, float("nan"), 0, *nothing, "error", known.error
        return
    try:
        rows = rows_of(known.outcome, team)
    except Exception as error:  # raised by team=, which is called for stored runs, too
        yield from _rows(Known(None, describe_error(error)), contender, seed, metrics, team)
        return
    measured = [known.outcome.metrics.get(name) for name in metrics]
    for agent, value, length in rows:
        yield contender, seed, agent, value, length, *measured, "ok", None
