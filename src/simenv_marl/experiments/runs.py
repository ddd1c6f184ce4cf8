"""Experiments: every row of a design with every contender on every seed, stored and resumed.

Variants of a model.
"""

import inspect
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from itertools import product, starmap
from typing import TYPE_CHECKING, Any, Unpack

from ..core import EpisodeOptions, Points, portable
from ..errors import OptionValueError, SimulationError, describe_error, name_of, short_repr
from ..many.parallel import import_extra, progress_bar
from ..runs import check_options
from ..simulation import Model
from .jobs import open_store
from .runner import (
    RESERVED,
    STATUS_COLUMNS,
    Contenders,
    Metrics,
    Result,
    Row,
    Runner,
    Team,
    Value,
    distinct_seeds,
    make_table,
    plain_value,
)
from .store import Run, to_json

if TYPE_CHECKING:
    from pandas import DataFrame

BY_RULE = "rule"
"""The contender that is always present: the model as it is."""


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
    job, storage = open_store(partial(_source_of_row, make), runner, store, keys, rows[0])
    storage.check_rows()
    agents = job.try_contenders(storage, keys)
    # A row that occurs twice has the same results.
    runs = list(starmap(Run, product(dict.fromkeys(keys), contenders, all_seeds)))
    missing = storage.missing(runs, retry_errors=retry_errors)
    least = len(all_seeds) if batched else 1
    with progress_bar(len(runs), progress, "run", len(runs) - len(missing)) as bar:
        job.run_missing(missing, agents, storage, workers, least, bar)
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
