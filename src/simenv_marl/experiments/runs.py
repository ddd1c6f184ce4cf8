"""Experiments: every row of a design, every contender, every seed; stored as they are run, and resumed."""

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
from ..core.points import Points
from ..core.processes import pack
from ..errors import OptionValueError, SimEnvError, StoreError, shown, told
from ..many.collect import check_numbers
from ..many.spread import progress_bar, spread
from ..remote.kept import processes_kept
from .evaluation import distinct_seeds, rows_of, typed
from .extras import needed
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
"""The contender that is always there: the model as it is."""

SHARE: Final = 16
"""In so many parts each process gets its work: few enough to cost nothing, enough for all to end together."""

TRIED: Final = 10
"""In so many rows at most it is looked whether all contenders can be, where making their simulations fails."""

LONGEST_TRACE: Final = 4000


class Run(NamedTuple):
    """A run.

    Attributes:
        row: The factors.
        key: The same as JSON.
        contender: Who decides.
        seed: What it is reset with.
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
    """Run every row of a design with every contender on every seed; what was run before is not run again.

    Each run is stored as soon as it is known. A process that is killed loses what it was running, and nothing else:
    called again, with the same or with more rows, contenders and seeds, this does what is missing.

    Args:
        make: Called with the factors of a row by keyword, returns a simulation or a ``Variant``; or a ``Variant``,
            whose parameters they become. It is called for each run, and what it returns is the run's own.
        design: A row for each combination of factors, as ``design`` makes it: a ``DataFrame``, or what becomes one.
        policies: Contenders besides ``"rule"``, the model as it is: from a name to policies of ``simulate``.
        seeds: What the simulations are reset with; all different.
        points: The decision points, as ``generate_env`` takes them.
        metric: As ``evaluate`` takes it.
        team: What the returns of an episode make together, as in ``evaluate``; None: their sum.
        store: The folder of the experiment, which is made where it is missing.
        batched: Whether policies are those of ``simulate_many``. The seeds of a row are then run together.
        batch_size: How many of them at most, if so.
        workers: How many processes share the work: see ``simulate_many``. They all write to the folder.
        progress: Whether to show a bar with the time that is left, by ``tqdm``.
        retry_errors: Whether runs that have failed are run again.
        **options: As ``simulate`` takes them.

    Returns:
        A row for each agent of each run, and one for the team (``agent`` is ``"team"``), in the order of the design,
        the contenders and the seeds. The columns: the factors, ``contender``, ``seed``, ``agent``, ``return``,
        ``length``, the metrics, ``status`` (``"ok"``, or ``"error"``: then the team's row is the only one) and
        ``error``.

    Raises:
        OptionValueError: An argument cannot have its value, or the store is one of another experiment. Nothing has run.
        StoreError: The store cannot be read or written. What was stored before stays.
        MissingExtraError: pandas, joblib or tqdm is missing.
        SimEnvError: Something else cannot work; the leaf says what.
    """
    needed("pandas", "run_experiment")
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
        pack(arguments)  # what cannot be sent to other processes is found out before
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
    """What is stored, once it is known to be of this experiment, with warnings of what has changed since.

    Args:
        folder: Where.
        factors: Their names.
        keys: Of the rows, as they are stored.
        rows: All of them.
        tried: Of which row a simulation was made, and of what.
        trying: Makes one of other rows.
    """
    stored = read(folder, factors, tried[0])
    compare(folder, stored, keys)
    if tried[0] not in stored.rows:  # so that what is there is compared with what it would be now
        with suppress(SimEnvError):  # of a row that has failed
            tried = trying([row for row, key in zip(rows, keys, strict=True) if key in stored.rows])
        stored = read(folder, factors, tried[0])
    warn_of_changes(folder, stored, tried[1])
    return stored


def _run_missing(arguments: Any, missing: list[Run], workers: int, at_once: int, total: int | None) -> None:
    """Run what is missing, with a bar where it is said how many runs there are in all."""
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
            f"the contender {BY_RULE!r} is the model as it is, and always there; rename the other one"
        )
    return {BY_RULE: {}, **found}


def checked_design(design: Any) -> "tuple[DataFrame, list[Row]]":
    """A design as a table, and its rows in values that JSON knows.

    Raises:
        OptionValueError: It is none.
    """
    pandas = needed("pandas", "a design")
    try:
        table = design if isinstance(design, pandas.DataFrame) else pandas.DataFrame(design)
    except (TypeError, ValueError) as error:
        raise OptionValueError(f"design must be a DataFrame, or what becomes one, not {shown(design)}") from error
    names = list(table.columns)
    for name in names:
        if not isinstance(name, str):
            raise OptionValueError(f"the name of a factor must be a string, not {shown(name)}")
        if name in COLUMNS:
            raise OptionValueError(f"the factor {name!r} is called like another column of the table; rename it")
        if names.count(name) > 1:
            raise OptionValueError(f"the factor {name!r} is there twice")
    if not len(table):
        raise OptionValueError("the design has no rows")
    columns = {name: [_plain(name, value) for value in table[name].tolist()] for name in names}
    return table, [{name: columns[name][place] for name in names} for place in range(len(table))]


def _plain(name: str, value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is not None and type(value) not in (bool, int, float, str):
        raise OptionValueError(
            f"the factor {name!r} has the value {shown(value)}, which cannot be stored: factors are numbers, strings,"
            " bools or None. Give it a name, and look that up in make"
        )
    return value


def _folder(store: Any) -> Path:
    try:
        return Path(store).absolute()  # other processes may be in other folders
    except TypeError as error:
        raise OptionValueError(f"store must be the path of a folder, not {shown(store)}") from error


def _try(workshop: Workshop, rows: Sequence[Row], contenders: Iterable[str]) -> tuple[str, dict[str, dict[str, Any]]]:
    """Find out whether all contenders can be.

    Returns:
        A row, as JSON, and what its runs are made of, by contender; nothing where no row can be.

    Raises:
        SimEnvError: One of them cannot be.
    """
    for row in rows[:TRIED]:
        try:
            made = {contender: json.loads(workshop.plan(row, contender)[1](0)) for contender in contenders}
        except SimEnvError:
            raise
        except Exception:  # this row is going to fail, maybe another does not
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
        if key in seen:  # the same row brings the same
            continue
        seen.add(key)
        for contender in contenders:
            for seed in seeds:
                known = stored.runs.get((key, contender, seed))
                if known is None or (retry and known.outcome is None):
                    yield Run(row, key, contender, seed)


def _work(arguments: tuple[Any, ...], runs: list[Run], workers: int, together: int) -> Iterator[int]:
    """Do what is missing; yields how many runs have been done since the last time."""
    if not runs:
        return
    if workers:
        for number, _ in spread(_do_part, arguments, runs, workers, together, SHARE):
            yield number
    else:
        yield from _do(*arguments, runs=runs)


def _do_part(*arguments: Any) -> None:
    """In a worker: do a part of the runs."""
    *others, runs = arguments
    parent = _parents.setdefault(os.getpid(), os.getppid())
    with processes_kept():
        for _ in _do(*others, runs=runs):
            if os.getppid() != parent:  # it was killed, and nothing waits for this any more
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
    """Run, and write down what comes of it; yields how many runs have been done since the last time."""
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
        known, trace = Known(None, told(error)), "".join(traceback.format_exception(error))[-LONGEST_TRACE:]
        workshop.forget()
    writer.write(line_of(run.row, run.contender, run.seed, known, provenance(run.seed), trace))


def _is_failure(error: BaseException) -> bool:
    """Whether an error is one of the run, and not what stops this process."""
    cancelled = getattr(sys.modules.get("asyncio"), "CancelledError", SystemExit)  # of a task of the model's own
    return isinstance(error, (Exception, SystemExit, cancelled))


def _unknown(seed: int) -> str:
    """What there is to say of what could not be made."""
    return written({"seed": seed})


def _do_many(
    workshop: Workshop, row: Row, contender: str, runs: list[Run], metrics: Metrics, size: int, writer: Writer
) -> list[Run]:
    """Do the runs of one row and contender together; returns those that an error has kept from coming to an end."""
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
        workshop.forget()  # whose it is will be seen when they are run one by one
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
    """The table of all runs, in the order of the design, the contenders and the seeds."""
    pandas = needed("pandas", "run_experiment")
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


LOST: Final = Known(None, "it has not come to an end: the process that was to run it has ended")


def _rows(known: Known, contender: str, seed: int, metrics: Sequence[str], team: Any) -> Iterator[tuple[Any, ...]]:
    if known.outcome is None:
        nothing = [None] * len(metrics)
        yield contender, seed, TEAM, float("nan"), 0, *nothing, "error", known.error
        return
    try:
        rows = rows_of(known.outcome, team)
    except Exception as error:  # of team=, which is asked for what is stored, too
        yield from _rows(Known(None, told(error)), contender, seed, metrics, team)
        return
    measured = [known.outcome.metrics.get(name) for name in metrics]
    for agent, value, length in rows:
        yield contender, seed, agent, value, length, *measured, "ok", None
