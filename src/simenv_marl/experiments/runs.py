"""Experiments: every row of a design with every contender on every seed; stored as they run, and resumed."""

import json
import os
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial, wraps
from itertools import groupby, product
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Unpack

from ..core.context import reuse_resources
from ..core.options import EpisodeOptions
from ..core.packing import pack
from ..core.plan import Plan
from ..core.points import Points
from ..core.provenance import as_json, describe, source_name
from ..errors import OptionValueError, SimEnvError, StoreError, describe_error, short_repr
from ..many.parallel import import_extra, progress_bar, spread
from .runner import (
    RUN_COLUMNS,
    STATUS_COLUMNS,
    TEAM,
    Policies,
    Returns,
    Runner,
    checked_contenders,
    distinct_seeds,
    make_runner,
    make_table,
    plain_value,
)
from .store import Provenance, Result, Run, Store, Writer, check_rows, new_session, to_json, warn_of_changes
from .variants import Variant, check_call

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

LOST: Final = "it did not come to its end: the worker process that ran it has ended"


def run_experiment(
    make: Any,
    design: Any,
    *,
    contenders: Mapping[str, Policies] | None = None,
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
        contenders: As ``evaluate`` takes them. ``"rule"``, the model as it is, is always added.
        seeds: As ``evaluate`` takes them.
        points: As ``evaluate`` takes them.
        metric: As ``evaluate`` takes it.
        team: As ``evaluate`` takes it.
        store: The folder of the experiment. It is created if it is missing.
        batched: As ``evaluate`` takes it. The seeds of a row then run together.
        batch_size: As ``evaluate`` takes it.
        workers: As ``evaluate`` takes them. All of them write to the folder.
        progress: As ``evaluate`` takes it. The bar shows the remaining time.
        retry_errors: Whether failed runs are repeated.
        **options: As ``evaluate`` takes them.

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
    by_name = checked_contenders(contenders or {}, batched=bool(batched))
    if by_name.pop(BY_RULE, {}):
        raise OptionValueError(
            f"the contender {BY_RULE!r} is always the model as it is; give your policies another name"
        )
    by_name = {BY_RULE: {}, **by_name}
    table, rows = _checked_design(design)
    keys, all_seeds = [to_json(row) for row in rows], distinct_seeds(seeds)
    runner = make_runner(
        by_name, points, options, metric, team, batched=bool(batched), batch_size=batch_size, workers=workers,
        factors=list(table.columns),
    )  # fmt: skip
    _check_make(make, rows[0])
    storage = Store(_checked_folder(store), list(table.columns), list(runner.metrics))
    stored = storage.read(keys)
    check_rows(storage, stored, keys)
    work = make, runner, storage.folder, new_session()
    if workers:
        pack(work)  # errors of pickling come before any run, and so do those of contenders
    row, provenances = _try_contenders(make, runner, sorted(keys, key=lambda key: key != stored.sample))
    storage.create()
    warn_of_changes(storage, stored, row, provenances)
    finished = {run for run, result in stored.runs.items() if not (retry_errors and isinstance(result, str))}
    runs = list(product(dict.fromkeys(keys), by_name, all_seeds))  # a row that occurs twice has the same results
    missing = [run for run in runs if run not in finished]
    with progress_bar(len(runs), "run", len(runs) - len(missing)) if progress else nullcontext() as bar:
        if workers and missing:
            for number, _ in spread(_run_part, work, missing, int(workers), len(all_seeds) if batched else 1, SHARE):
                if bar is not None:
                    bar.update(number)
        elif missing:
            _run_part(*work, missing, bar)
    return _make_frame(table, keys, all_seeds, storage.read(keys).runs, runner)


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
        if name in (*RUN_COLUMNS, *STATUS_COLUMNS):
            raise OptionValueError(f"the factor {name!r} has the name of another column of the table; rename it")
        if names.count(name) > 1:
            raise OptionValueError(f"the factor {name!r} occurs twice")
    if not len(table):
        raise OptionValueError("the design has no rows")
    advice = "; other values cannot be stored: use a name as the value, and look it up in make"
    levels = {name: [plain_value(f"the factor {name!r}", value, advice) for value in table[name]] for name in names}
    return table, [{name: levels[name][place] for name in names} for place in range(len(table))]


def _checked_folder(store: Any) -> Path:
    try:
        return Path(store).absolute()  # other processes may have another working directory
    except TypeError as error:
        raise OptionValueError(f"store must be the path of a folder, not {short_repr(store)}") from error


def _check_make(make: Any, row: Mapping[str, Any]) -> None:
    """Check that ``make`` takes the factors."""
    if isinstance(make, Variant):
        _source(make, row)  # a variant checks its parameters
    else:
        what = "make must be a callable of the factors, such as a class, or a Variant"
        check_call(make, row, OptionValueError, what, f"the factors {', '.join(row) or '(none)'}")


def _try_contenders(make: Any, runner: Runner, keys: Sequence[str]) -> tuple[str, dict[str, Provenance]]:
    """Check that all contenders can be set up; return a row, as JSON, and the provenance of its runs by contender.

    Both are empty if no row's simulation can be made.
    """
    for key in keys[:TRIED]:
        try:
            return key, {contender: _prepare(make, runner, key, contender)[1] for contender in runner.contenders}
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
        return ready.pop() if ready else make(**row)

    return factory


def _prepare(make: Any, runner: Runner, key: str, contender: str) -> tuple[Plan, dict[str, Any]]:
    """Return the plan of runs of a row with a contender, and their provenance."""
    source = _source(make, json.loads(key))
    plan = runner.plan(source, contender)
    name = make.name if isinstance(make, Variant) else source_name(make)
    policies = {**(source.policies if isinstance(source, Variant) else {}), **runner.contenders[contender]}
    return plan, describe(plan, None) | {"make": name, "policies": as_json(policies)}


def _run_part(make: Any, runner: Runner, folder: Path, session: str, runs: Sequence[Run], bar: Any = None) -> None:
    """Do runs and store their results."""
    with closing(Writer(folder, session)) as writer, reuse_resources():
        for (key, contender), group in groupby(runs, lambda run: run[:2]):
            _run_seeds(make, runner, writer, key, contender, [seed for *_, seed in group], bar)


def _run_seeds(
    make: Any, runner: Runner, writer: Writer, key: str, contender: str, seeds: Sequence[int], bar: Any
) -> None:
    """Run seeds of a row with a contender, and store the result of each. An error is a result, too."""
    remaining = dict.fromkeys(seeds)

    def report(seed: int, result: Result, trace: str | None = None) -> None:
        writer.write((key, contender, seed), result, {**provenance, "seed": seed}, trace)
        del remaining[seed]
        if bar is not None:
            bar.update()

    while remaining:
        provenance: dict[str, Any] = {}  # unknown if the simulation cannot be made
        try:
            plan, provenance = _prepare(make, runner, key, contender)
            runner.run(plan, list(remaining), report)
        except (KeyboardInterrupt, StoreError):
            raise
        except BaseException as error:
            if runner.batch_size > 1 and len(remaining) > 1:  # running them one by one shows which of them failed
                for seed in list(remaining):
                    _run_seeds(make, runner, writer, key, contender, [seed], bar)
                return
            trace = "".join(traceback.format_exception(error))[-LONGEST_TRACE:]
            report(next(iter(remaining)), describe_error(error), trace)


# -- the table ------------------------------------------------------------------------------------


def _make_frame(
    table: "DataFrame", keys: Sequence[str], seeds: Sequence[int], results: Mapping[Run, Result], runner: Runner
) -> "DataFrame":
    """Return the table of all runs, in the order of the design, the contenders and the seeds."""
    places: list[int] = []
    rows: list[tuple[Any, ...]] = []
    for place, key in enumerate(keys):
        for contender, seed in product(runner.contenders, seeds):
            for row in _rows(runner, results.get((key, contender, seed), LOST)):
                places.append(place)
                rows.append((contender, seed, *row))
    factors = table.iloc[places].reset_index(drop=True)
    return factors.join(make_table((*RUN_COLUMNS, *runner.metrics, *STATUS_COLUMNS), rows))


def _rows(runner: Runner, result: Result) -> list[tuple[Any, ...]]:
    """Return agent, return, length, metrics, status and error for each agent and for the team."""
    if not isinstance(result, str):
        try:
            return [(*row, "ok", None) for row in runner.rows(result)]
        except Exception as error:  # raised by team=, which is called for stored runs, too
            result = describe_error(error)
    return [(TEAM, nan, 0, *[None] * len(runner.metrics), "error", result)]
