"""Compares contenders on the same seeds, with confidence intervals."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Unpack

import numpy as np
from numpy.typing import NDArray

from ..core.options import EpisodeOptions
from ..core.packing import pack
from ..core.plan import Plan
from ..core.points import Points
from ..core.reuse import processes_kept
from ..errors import OptionValueError, did_you_mean, short_repr
from ..many.parallel import import_extra, progress_bar, spread
from ..many.simulate import check_numbers, checked_seeds
from .playing import (
    TEAM,
    Metrics,
    Outcome,
    Policies,
    Returns,
    checked_contenders,
    checked_metrics,
    checked_options,
    checked_team,
    contender_plan,
    play,
    play_many,
    points_of,
    team_value,
    telling,
)
from .statistics import check_confidence, check_number, improvement, interval, numbers, seeds_needed

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure
    from pandas import DataFrame, Series

__all__ = ["Evaluation", "evaluate"]

FIRST: Final = 16
"""The number of seeds before the first check of the intervals' width: intervals of fewer seeds are unreliable."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The results of contenders on the same seeds. Made by ``evaluate``.

    Attributes:
        frame: A ``DataFrame`` with one row for each contender, seed and agent, and one for the team, whose ``agent`` is
            ``"team"``. Columns: ``contender``, ``seed``, ``agent``, ``return`` (the undiscounted sum of rewards),
            ``length`` (the number of decisions; for the team, of all agents) and the metrics, which are the same in all
            rows of an episode.
        baseline: The contender that all others are compared with, or None.
        confidence: The confidence level of the intervals.
    """

    frame: "DataFrame"
    baseline: str | None
    confidence: float

    def __repr__(self) -> str:
        values = self.values()
        return f"<Evaluation: {', '.join(values.columns)} on {len(values)} seeds>"

    def values(self, of: str = "return") -> "DataFrame":
        """Return the team's values: one row for each seed, one column for each contender.

        Args:
            of: ``"return"``, ``"length"`` or the name of a metric.

        Raises:
            OptionValueError: There is no such column.
        """
        if of not in self.frame.columns or of in ("contender", "seed", "agent"):
            known = list(self.frame.columns[3:])
            raise OptionValueError(
                f"of={short_repr(of)} is not a column of numbers; these are: {known}{did_you_mean(of, known)}"
            )
        team = self.frame[self.frame["agent"] == TEAM]
        names = list(dict.fromkeys(team["contender"]))
        seeds = list(dict.fromkeys(team["seed"]))
        return team.pivot(index="seed", columns="contender", values=of).loc[seeds, names]

    def summary(self, of: str = "return") -> "DataFrame":
        """Return the mean of the team's values for each contender, with its confidence interval.

        Args:
            of: ``"return"``, ``"length"`` or the name of a metric.

        Returns:
            A table indexed by contender, with the columns ``mean``, ``low`` and ``high``. With a baseline also
            ``difference``, ``difference_low`` and ``difference_high``: the mean paired difference from the baseline on
            the same seeds.

        Raises:
            OptionValueError: There is no such column.
        """
        pandas, values, rows = import_extra("pandas", "summary"), numbers(self.values(of), of), {}
        for name in values.columns:
            own = values[name].to_numpy()
            rows[name] = [own.mean(), *interval(own, self.confidence)]
            if self.baseline is not None:
                apart = own - values[self.baseline].to_numpy()
                rows[name] += [apart.mean(), *interval(apart, self.confidence)]
        columns = ["mean", "low", "high"]
        if self.baseline is not None:
            columns += ["difference", "difference_low", "difference_high"]
        table: DataFrame = pandas.DataFrame.from_dict(rows, "index", columns=columns)
        return table.rename_axis("contender")

    def improvement(self, of: str = "return") -> "DataFrame":
        """Estimate the probability that a contender has a higher value than the baseline on a seed. Ties count half.

        Args:
            of: ``"return"``, ``"length"`` or the name of a metric.

        Returns:
            A table indexed by contender, with the columns ``probability``, ``low`` and ``high``.

        Raises:
            OptionValueError: There is no baseline, or no such column.
        """
        pandas, rows = import_extra("pandas", "improvement"), {}
        for name, apart in self._differences(of).items():
            rows[name] = improvement(apart, self.confidence)
        table: DataFrame = pandas.DataFrame.from_dict(rows, "index", columns=["probability", "low", "high"])
        return table.rename_axis("contender")

    def seeds_needed(self, difference: float, *, power: float = 0.8, of: str = "return") -> "Series[float]":
        """Estimate the number of seeds that would detect a difference from the baseline.

        The estimate uses the variance on the present seeds.

        Args:
            difference: The mean difference to detect.
            power: The probability of detecting it. 0.8 is four times out of five.
            of: ``"return"``, ``"length"`` or the name of a metric.

        Returns:
            The number of seeds by contender (by the paired t-test, at ``confidence``); infinity if no number of seeds
            is large enough.

        Raises:
            OptionValueError: There is no baseline or no such column, or an argument has an invalid value.
        """
        check_number("difference", difference)
        check_number("power", power)
        if difference == 0:
            raise OptionValueError("difference must not be 0: no number of seeds is enough to detect that")
        if not 0 < power < 1:
            raise OptionValueError(f"power must lie between 0 and 1, such as 0.8, not {short_repr(power)}")
        apart = self._differences(of)
        found = {name: seeds_needed(own, difference, self.confidence, power) for name, own in apart.items()}
        counts: Series[float] = import_extra("pandas", "seeds_needed").Series(found, name="seeds", dtype=float)
        return counts.rename_axis("contender")

    def _differences(self, of: str) -> dict[str, NDArray[np.float64]]:
        if self.baseline is None:
            raise OptionValueError("there is no baseline to compare with; give evaluate a baseline=")
        values = numbers(self.values(of), of)
        base = values[self.baseline].to_numpy()
        return {name: values[name].to_numpy() - base for name in values.columns if name != self.baseline}

    def plot(self, of: str = "return", *, figure: "Figure | SubFigure | None" = None) -> "Figure | SubFigure":
        """Draw each seed as a line across the contenders and, with a baseline, the difference on each seed.

        Args:
            of: ``"return"``, ``"length"`` or the name of a metric.
            figure: The figure to draw in. None: a new figure.

        Returns:
            The figure. A notebook shows a new figure that is the last value of a cell; ``savefig`` saves it.

        Raises:
            OptionValueError: There is no such column.
            MissingExtraError: Matplotlib is missing.
        """
        from .pictures import draw_pairs

        drawn: Figure | SubFigure = draw_pairs(
            numbers(self.values(of), of), self.summary(of), self.baseline, of, figure
        )
        return drawn


def evaluate(
    simulation: Any,
    contenders: Mapping[str, Policies],
    *,
    seeds: Iterable[int],
    points: Points = None,
    baseline: str | None = None,
    metric: Any = None,
    team: Callable[[Returns], Any] | None = None,
    confidence: float = 0.95,
    width: float | None = None,
    batched: bool = False,
    batch_size: int = 1024,
    workers: int = 0,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> Evaluation:
    """Evaluate contenders on the same seeds.

    Args:
        simulation: A simulation (which is copied for each seed), its class, a zero-argument factory, or a ``Variant``.
        contenders: A dict from the name of a contender to its policies, as ``simulate`` takes them. ``{}`` is the model
            as it is.
        seeds: The seeds of the simulations, all different.
        points: The decision points, as ``generate_env`` takes them. Agents without a policy of the contender follow
            their rule, and have returns like all others.
        baseline: The contender that the others are compared with.
        metric: A callable of the simulation after its end, whose column is ``metric``, or a dict from column to
            callable. A metric returns a number, a string or None.
        team: A callable that combines the returns of an episode's agents into the team's value. None: their sum. It
            gets an object that is both the tuple of returns (``max`` works) and a mapping by agent (``lambda returns:
            returns["waterer_0"]``). Agents that never decided are missing there (``returns.get("waterer_0", 0.0)``).
        confidence: The confidence level of the intervals.
        width: Stop as soon as the interval of every difference from the baseline (without a baseline: of every mean) is
            at most this wide; ``seeds`` are then the seeds that may be used. The width is checked from 16 seeds on, at
            growing distances.
        batched: Whether the policies are those of ``simulate_many``, which answer many decisions at once.
        batch_size: The largest number of simulations that are suspended together, if ``batched``.
        workers: The number of worker processes: see ``simulate_many``.
        progress: Whether to show a progress bar, by ``tqdm``.
        **options: The options of ``simulate``.

    Returns:
        The evaluation.

    Raises:
        OptionValueError: An argument has an invalid value. No simulation has run.
        MissingExtraError: pandas, SciPy, joblib or tqdm is missing.
        SimEnvError: Something else cannot work. The subclass tells what.
        BaseException: Any exception of a model, a mapping, a policy, a metric or ``team``, with notes that name the
            contender and the seed.
    """
    import_extra("pandas", "evaluate"), import_extra("scipy.stats", "evaluate")
    found = checked_contenders(contenders, batched=bool(batched))
    _check(found, baseline, confidence, width, team)
    places = distinct_seeds(seeds)
    check_numbers(batch_size, workers)
    chosen = checked_options(options)
    metrics, size = checked_metrics(metric), int(batch_size) if batched else 0
    points = list(points) if isinstance(points, Iterator) else points
    common = (simulation, points, chosen, points_of(found), metrics, size, team)
    plans = _plans(found, *common[:4])  # made here even if workers do the work, so that errors come first
    if workers:
        pack((found, common))  # so do errors of pickling

    def play(name: str, lot: list[int]) -> list[Outcome]:
        if workers:
            return _spread(({name: found[name]}, *common), lot, int(workers), size)
        return _play(plans[name], lot, metrics, size, team)

    def is_narrow(outcomes: Mapping[str, Sequence[Outcome]]) -> bool:
        return width is not None and _widest(outcomes, team, baseline, confidence) <= width

    with progress_bar(len(found) * len(places), "episode") if progress else nullcontext() as bar, processes_kept():
        outcomes = _play_all(list(found), places, width, play, is_narrow, bar)
    done = len(next(iter(outcomes.values())))
    return Evaluation(_frame(places[:done], outcomes, tuple(metrics), team), baseline, float(confidence))


def _play_all(
    names: list[str],
    places: list[int],
    width: float | None,
    play: Callable[[str, list[int]], list[Outcome]],
    is_narrow: Callable[[Mapping[str, Sequence[Outcome]]], bool],
    bar: Any,
) -> dict[str, list[Outcome]]:
    """Have these contenders play, one lot of seeds after the other, until the intervals are narrow enough."""
    outcomes: dict[str, list[Outcome]] = {name: [] for name in names}
    done = 0
    while done < len(places):
        lot = places[done : _next(done, len(places), width)]
        for name, known in outcomes.items():
            with telling(name):
                known += play(name, lot)
            if bar is not None:
                bar.update(len(lot))
        done += len(lot)
        if done >= FIRST and is_narrow(outcomes):
            break
    return outcomes


def _next(done: int, number: int, width: float | None) -> int:
    """Return the number of seeds before the next check of the intervals; each check takes time, too."""
    return number if width is None else min(number, max(FIRST, done + max(4, done // 8)))


def _widest(outcomes: Mapping[str, Sequence[Outcome]], team: Any, baseline: str | None, confidence: float) -> float:
    values = {
        name: np.array([team_value(team, outcome.returns) for outcome in known]) for name, known in outcomes.items()
    }
    if baseline is not None:
        base = values.pop(baseline)
        values = {name: own - base for name, own in values.items()}
    bounds = [interval(own, confidence) for own in values.values()]
    return float(np.max([high - low for low, high in bounds], initial=0.0))  # nan if one of them is nan


def _plans(
    contenders: Mapping[str, Policies], simulation: Any, points: Any, options: Mapping[str, Any], named: Sequence[Any]
) -> dict[str, Plan]:
    plans = {}
    for name, policies in contenders.items():
        with telling(name):
            plans[name] = contender_plan(simulation, policies, points, options, named)
    return plans


def _spread(arguments: tuple[Any, ...], seeds: list[int], workers: int, size: int) -> list[Outcome]:
    """Play the episodes of a contender in workers."""
    return [outcome for _, part in spread(_play_part, arguments, seeds, workers, size) for outcome in part]


def _play_part(
    contender: Mapping[str, Policies],
    simulation: Any,
    points: Any,
    options: Mapping[str, Any],
    named: Sequence[Any],
    metrics: Metrics,
    size: int,
    team: Any,
    seeds: list[int],
) -> list[Outcome]:
    """Play a part of a contender's episodes, in a worker."""
    (plan,) = _plans(contender, simulation, points, options, named).values()
    with processes_kept():
        return _play(plan, seeds, metrics, size, team)


def _play(plan: Plan, seeds: Sequence[int], metrics: Metrics, size: int, team: Any) -> list[Outcome]:
    """Play episodes of a contender: ``size`` of them at once, or one by one if ``size`` is 0."""
    if not size:
        return [play(plan, seed, metrics, team) for seed in seeds]
    outcomes: dict[int, Outcome] = {}
    play_many(plan, seeds, size, metrics, outcomes.__setitem__, team)
    return [outcomes[place] for place in range(len(seeds))]


def _frame(seeds: Sequence[int], outcomes: Mapping[str, Sequence[Outcome]], metrics: Sequence[str], team: Any) -> Any:
    columns: dict[str, list[Any]] = {name: [] for name in ("contender", "seed", "agent", "return", "length", *metrics)}
    for contender, known in outcomes.items():
        for seed, outcome in zip(seeds, known, strict=True):
            for row in rows_of(outcome, team):
                values = (contender, seed, *row, *outcome.metrics.values())
                for column, value in zip(columns.values(), values, strict=True):
                    column.append(value)
    return typed(columns)


def typed(columns: Mapping[str, Sequence[Any]]) -> "DataFrame":
    """Return a table whose columns keep the types of their values. A numeric column with missing values is float."""
    pandas = import_extra("pandas", "a table")
    table: DataFrame = pandas.DataFrame(
        {name: pandas.Series(values, dtype=_dtype(values)) for name, values in columns.items()}
    )
    return table


def _dtype(values: Sequence[Any]) -> Any:
    kinds = {type(value) for value in values}
    if kinds <= {int} and all(-(2**63) <= value < 2**63 for value in values):
        return np.int64
    if kinds == {bool}:
        return np.bool_
    if kinds <= {int, float, type(None)} and kinds & {int, float}:
        exact = all(type(value) is not int or abs(value) <= 2**53 for value in values)
        return np.float64 if exact else object
    return object if kinds != {str} else "str"


def rows_of(outcome: Outcome, team: Any) -> list[tuple[str, float, int]]:
    """Return agent, return and length for each agent and for the team."""
    rows = [(agent, value, outcome.lengths[agent]) for agent, value in outcome.returns.items()]
    return [*rows, (TEAM, team_value(team, outcome.returns), sum(outcome.lengths.values()))]


# -- what is checked before anything runs ---------------------------------------------------------


def distinct_seeds(given: Iterable[int]) -> list[int]:
    """Return the seeds as a list; there is at least one, and all are different.

    Raises:
        OptionValueError: There are none, or one of them is repeated.
    """
    seeds = checked_seeds(given)
    if not seeds:
        raise OptionValueError("seeds must be integers, such as range(32), but there are none")
    twice = next((seed for seed in seeds if seeds.count(seed) > 1), None) if len(set(seeds)) < len(seeds) else None
    if twice is not None:
        raise OptionValueError(f"the seed {twice} occurs twice: its result would be counted twice")
    return seeds


def _check(contenders: Any, baseline: Any, confidence: Any, width: Any, team: Any) -> None:
    if not contenders:
        raise OptionValueError("contenders must be a dict, such as {'rule': {}}, but there are none")
    if baseline is not None and baseline not in list(contenders):
        raise OptionValueError(
            f"the baseline {short_repr(baseline)} is not one of the contenders:"
            f" {', '.join(contenders)}{did_you_mean(baseline, contenders)}"
        )
    check_confidence(confidence)
    if width is not None:
        check_number("width", width)
        if width <= 0:
            raise OptionValueError(f"width must be positive, not {short_repr(width)}")
    checked_team(team)
