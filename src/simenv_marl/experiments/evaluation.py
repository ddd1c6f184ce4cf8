"""Compares contenders on the same seeds, with confidence intervals."""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby, product
from math import inf, isfinite, nan, sqrt
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, Unpack

import numpy as np
from numpy.typing import NDArray

from ..core import EpisodeOptions, Plan, Points, pack, reuse_resources
from ..data.plots import interval, is_proportion
from ..errors import OptionValueError, did_you_mean, short_repr
from ..many.parallel import import_extra, progress_bar, spread
from .plots import plot_contenders
from .runner import (
    FALLBACKS,
    RUN_COLUMNS,
    STATUS_COLUMNS,
    TEAM,
    Outcome,
    Returns,
    Runner,
    distinct_seeds,
    make_table,
    noting,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure
    from pandas import DataFrame, Series

FIRST: Final = 16
"""The number of seeds before the first check of the intervals' width: intervals of fewer seeds are unreliable."""

MOST_SEEDS: Final = 10_000_000
"""A difference that needs more seeds than this counts as none."""

FALLBACK_LIMIT: Final = 0.05
"""A contender with a larger share of decisions by fallbacks is marked."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The results of contenders on the same seeds. Made by ``evaluate``.

    Attributes:
        frame: A ``DataFrame`` with one row for each contender, seed and agent, and one for the
            team, whose ``agent`` is ``"team"``. Columns: ``contender``, ``seed``, ``agent``,
            ``return`` (the undiscounted sum of rewards), ``length`` (the number of decisions; for
            the team, of all agents) and the metrics, which are the same in all rows of an episode.
            Where a contender has a ``FallbackPolicy``, ``fallbacks`` is the number of decisions
            that a fallback answered.
        baseline: The contender that all others are compared with, or None.
        confidence: The confidence level of the intervals.

    In all methods, ``metric`` is ``"return"``, ``"length"`` or the name of a metric; another one is
    an ``OptionValueError``.
    """

    frame: "DataFrame"
    baseline: str | None
    confidence: float

    def __repr__(self) -> str:
        values = self.values()
        return f"<Evaluation: {', '.join(values.columns)} on {len(values)} seeds>"

    def __str__(self) -> str:
        return f"{self!r}\n{self.summary().to_string(float_format='{:.6g}'.format)}"

    def values(self, metric: str = "return") -> "DataFrame":
        """Return the team's values: one row for each seed, one column for each contender."""
        check_metric(metric, self.frame.columns)
        team = self.frame[self.frame["agent"] == TEAM]
        return team.pivot(index="seed", columns="contender", values=metric).loc[
            team["seed"].unique(), team["contender"].unique()
        ]

    def summary(self, metric: str = "return") -> "DataFrame":
        """Return the mean of the team's values for each contender, with its confidence interval.

        Intervals are by Student's t; those of bools, and of numbers that are all 0 or 1, by
        Wilson's score.

        Returns:
            A table indexed by contender, with the columns ``mean``, ``low`` and ``high``. With a
            baseline also ``difference``, ``difference_low`` and ``difference_high``: the mean
            paired difference from the baseline on the same seeds. Bounds of which nothing is known
            are nan; the column ``note``, which is there only then, says why. Where fallbacks are
            counted, ``fallbacks`` is the share of decisions that they answered, and the note of a
            contender with more than 5 % of them says so.
        """
        values = self.values(metric)
        columns, rows, notes = ["mean", "low", "high"], {}, {}
        proportion = is_proportion(values.to_numpy())
        for name, own in numbers(values, metric).items():
            sample = own.to_numpy()
            low, high, notes[name] = interval(sample, self.confidence, proportion=proportion)
            rows[name] = [sample.mean(), low, high]
        if self.baseline is not None:
            columns += ["difference", "difference_low", "difference_high"]
            for name, difference in self._differences(metric).items():
                low, high, note = interval(difference, self.confidence)
                rows[name] += [difference.mean(), low, high]
                notes[name] = notes[name] or (note and f"differences: {note}")
            rows[self.baseline] += [0.0] * 3
        for name, share in self._fallback_shares().items():
            columns += [] if FALLBACKS in columns else [FALLBACKS]
            rows[name].append(share)
            if share > FALLBACK_LIMIT:
                notes[name] = "; ".join(
                    filter(None, [notes[name], f"{share:.0%} of decisions by a fallback"])
                )
        table = _by_contender(rows, columns)
        return table.assign(note=notes) if any(notes.values()) else table

    def improvement(self, metric: str = "return") -> "DataFrame":
        """Estimate the probability that a contender has a higher value than the baseline on a seed. Ties count half.

        Returns:
            A table indexed by contender, with the columns ``probability``, ``low`` and ``high``.

        Raises:
            OptionValueError: There is no baseline.
        """
        rows = {}
        for name, difference in self._differences(metric).items():
            better = (np.sign(difference) + 1) / 2  # nan where a value is missing
            low, high, _ = interval(better, self.confidence, proportion=not (difference == 0).any())
            rows[name] = [better.mean(), *np.clip([low, high], 0.0, 1.0)]
        return _by_contender(rows, ["probability", "low", "high"])

    def seeds_needed(
        self, difference: float, *, power: float = 0.8, metric: str = "return"
    ) -> "Series[float]":
        """Estimate the number of seeds that would detect a difference from the baseline.

        The estimate is that of the paired t-test, at ``confidence``, with the variance on the
        present seeds.

        Args:
            difference: The mean difference to detect.
            power: The probability of detecting it. 0.8 is four times out of five.
            metric: The name of the value.

        Returns:
            The number of seeds by contender; infinity if no number is large enough, nan if the
            variance is unknown.

        Raises:
            OptionValueError: There is no baseline, or an argument has an invalid value.
        """
        _check_number("difference", difference)
        check_probability("power", power, 0.8)
        if difference == 0:
            raise OptionValueError(
                "difference must not be 0: no number of seeds is enough to detect that"
            )
        differences = self._differences(metric)
        rows = {
            name: [seeds_needed(own, difference, self.confidence, power)]
            for name, own in differences.items()
        }
        return _by_contender(rows, ["seeds"])["seeds"]

    def plot(
        self, metric: str = "return", *, figure: "Figure | SubFigure | None" = None
    ) -> "Figure | SubFigure":
        """Draw each seed as a line across the contenders and, with a baseline, the difference on each seed.

        ``figure`` and the result are as in ``plot_timeline``.
        """
        values, summary = numbers(self.values(metric), metric), self.summary(metric)
        shares = summary[FALLBACKS] if FALLBACKS in summary else dict.fromkeys(values.columns, 0.0)
        marks = [
            f"\n{shares[name]:.0%} fallbacks" if shares[name] > FALLBACK_LIMIT else ""
            for name in values.columns
        ]
        return plot_contenders(values, summary, metric, self.baseline, marks, figure)

    def _fallback_shares(self) -> dict[str, float]:
        """Return the share of decisions that a fallback answered, by contender.

        Empty if they are not counted.
        """
        if FALLBACKS not in self.frame:
            return {}
        team = (
            self.frame[self.frame["agent"] == TEAM]
            .groupby("contender")[[FALLBACKS, "length"]]
            .sum()
        )
        return {str(name): number / max(1, length) for name, number, length in team.itertuples()}

    def _differences(self, metric: str) -> dict[str, NDArray[np.float64]]:
        """Return the differences from the baseline, by other contender, in the order of the seeds."""
        if self.baseline is None:
            raise OptionValueError(
                "there is no baseline to compare with; give evaluate a baseline="
            )
        values = numbers(self.values(metric), metric)
        differences = values.sub(values[self.baseline], axis=0).drop(columns=self.baseline)
        return {name: own.to_numpy() for name, own in differences.items()}

    def _widest(self) -> float:
        """Return the width of the widest interval of a difference or, without a baseline, of a mean; nan if unknown."""
        summary, prefix = self.summary(), "" if self.baseline is None else "difference_"
        return float((summary[f"{prefix}high"] - summary[f"{prefix}low"]).max(skipna=False))


def _by_contender(rows: Mapping[str, Iterable[float]], columns: list[str]) -> "DataFrame":
    pandas = import_extra("pandas", "a table")
    table: DataFrame = pandas.DataFrame.from_dict(rows, "index", columns=columns, dtype=float)
    return table.rename_axis("contender")


def evaluate(
    simulation: Any,
    contenders: Mapping[str, Mapping[Any, Any]],
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
    concurrency: int = 64,
    workers: int = 0,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> Evaluation:
    """Evaluate contenders on the same seeds.

    Args:
        simulation: As ``simulate_many`` takes it.
        contenders: A dict from the name of a contender to its policies, as ``simulate`` takes them.
            ``{}`` is the model as it is. Agents without a policy follow their rule, and have
            returns like all others.
        seeds: The seeds of the simulations, all different.
        points: As ``simulate_many`` takes them.
        baseline: The contender that the others are compared with.
        metric: A callable of the simulation after its end, whose column is ``metric``, or a dict
            from column to callable. A metric returns a number, a string or None.
        team: A callable that combines the returns of an episode's agents into the team's value.
            None: their sum. It gets an object that is both the tuple of returns (``max`` works) and
            a mapping by agent (``lambda returns: returns["waterer_0"]``). Agents that never decided
            are missing there (``returns.get("waterer_0", 0.0)``).
        confidence: The confidence level of the intervals.
        width: Stop as soon as the interval of every difference from the baseline (without a
            baseline: of every mean) is at most this wide; ``seeds`` are then the seeds that may be
            used. The width is checked from 16 seeds on, at growing distances.
        batched: Whether the policies are those of ``simulate_many``, which answer many decisions at
            once.
        batch_size: As ``simulate_many`` takes it, if ``batched``.
        concurrency: As ``simulate_many`` takes it.
        workers: As ``simulate_many`` takes them.
        progress: As ``simulate_many`` takes it.
        **options: The options of ``simulate``.

    Returns:
        The evaluation.

    Raises:
        OptionValueError: An argument has an invalid value. No simulation has run.
        AgentError: A contender names an agent that no episode had, and that ``possible_agents``
            does not declare.
        MissingExtraError: pandas, SciPy, joblib or tqdm is missing.
        SimEnvError: Something else cannot work. The subclass tells what.
        BaseException: Any exception of a model, a mapping, a policy, a metric or ``team``, with
            notes that name the contender and the seed.
    """
    import_extra("pandas", "evaluate"), import_extra("scipy.stats", "evaluate")
    runner = Runner(
        contenders,
        points,
        options,
        metric,
        team,
        batched=bool(batched),
        batch_size=batch_size,
        concurrency=concurrency,
        workers=workers,
    )
    if not contenders:
        raise OptionValueError(
            "contenders must be a dict, such as {'rule': {}}, but there are none"
        )
    if baseline is not None and baseline not in list(contenders):
        raise OptionValueError(
            f"the baseline {short_repr(baseline)} is not one of the contenders:"
            f" {', '.join(contenders)}{did_you_mean(baseline, contenders)}"
        )
    check_probability("confidence", confidence, 0.95)
    if width is not None:
        _check_number("width", width)
        if width <= 0:
            raise OptionValueError(f"width must be positive, not {short_repr(width)}")
    all_seeds = distinct_seeds(seeds)
    # Plans are made and pickled here even if workers do the work, so that errors come first.
    plans = {name: runner.plan(simulation, name) for name in runner.contenders}
    arguments = simulation, runner, None if workers else plans
    if workers:
        pack(arguments)
    rows: list[Any] = []
    names, done, number = list(plans), 0, len(all_seeds)
    with progress_bar(len(names) * number, progress, "episode") as bar, reuse_resources():
        while True:
            # The intervals' width is checked at growing distances, since each check takes time,
            # too.
            end = number if width is None else min(number, max(FIRST, done + max(4, done // 8)))
            runs = list(product(names, all_seeds[done:end]))
            for part in spread(_run, arguments, runs, workers, runner.batch_size, bar):
                rows += part
            rows.sort(key=lambda row: names.index(row[0]))
            evaluation = Evaluation(make_table(runner.columns, rows), baseline, float(confidence))
            done = end
            if done == number or (
                width is not None and done >= FIRST and evaluation._widest() <= width
            ):
                break
    for name, plan in plans.items():
        present = {
            agent: None for contender, _, agent, *_ in rows if contender == name and agent != TEAM
        }
        runner.check_agents(name, runner.unproven_agents(plan, name), present)
    return evaluation


def _run(
    simulation: Any,
    runner: Runner,
    plans: Mapping[str, Plan] | None,
    runs: Sequence[tuple[str, int]],
    bar: Any,
) -> list[Any]:
    """Run pairs of contender and seed, and return the rows of the table.

    Without plans, in a worker, it makes them.
    """
    rows: dict[tuple[str, int], list[Any]] = {}

    def report(name: str, seed: int, outcome: Outcome) -> None:
        rows[name, seed] = [(name, seed, *row) for row in runner.rows(outcome)]
        bar.update()

    with reuse_resources():
        for name, own in groupby(runs, itemgetter(0)):
            with noting(f"of the contender {name!r}"):
                plan = runner.plan(simulation, name) if plans is None else plans[name]
                runner.run(plan, name, [seed for _, seed in own], partial(report, name))
    return [row for run in runs for row in rows[run]]


# -- statistics -----------------------------------------------------------------------------------


def check_metric(metric: Any, columns: Iterable[str]) -> None:
    """Check that a metric is one of the columns of a table, and does not say which run it is."""
    names = [name for name in columns if name not in (*RUN_COLUMNS[:3], *STATUS_COLUMNS)]
    if metric not in names:
        raise OptionValueError(
            f"metric={short_repr(metric)} is not a column of numbers; these are:"
            f" {names}{did_you_mean(metric, names)}"
        )


def numbers(values: Any, metric: str) -> Any:
    """Return a ``DataFrame`` or ``Series`` as floats; nan where a value is missing."""
    try:
        return values.astype(np.float64)
    except (TypeError, ValueError, OverflowError):  # the last of integers that no float can hold
        raise OptionValueError(f"metric={short_repr(metric)} is not a column of numbers") from None


def seeds_needed(
    differences: NDArray[np.float64], difference: float, confidence: float, power: float
) -> float:
    """Return the number of seeds that detects a mean difference: see ``Evaluation.seeds_needed``."""
    stats = import_extra("scipy.stats", "the number of seeds")
    *_, note = interval(differences, confidence)
    if note:
        return nan
    size = abs(difference) / float(np.std(differences, ddof=1))

    def is_enough(number: int) -> bool:
        critical = stats.t.ppf(1 - (1 - confidence) / 2, number - 1)
        shift = min(size * sqrt(number), 1e4)  # SciPy has no values for much larger ones
        # on either side
        return bool(stats.nct.sf(critical, number - 1, [shift, -shift]).sum() >= power)

    number = 2 + bisect_left(range(2, MOST_SEEDS + 1), True, key=is_enough)
    return float(number) if number <= MOST_SEEDS else inf


def _check_number(name: str, value: Any) -> None:
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float, np.number))
        or not isfinite(value)
    ):
        raise OptionValueError(f"{name} must be a finite number, not {short_repr(value)}")


def check_probability(name: str, value: Any, example: float) -> None:
    """Check that an argument is a number between 0 and 1."""
    _check_number(name, value)
    if not 0 < value < 1:
        raise OptionValueError(
            f"{name} must lie between 0 and 1, such as {example}, not {short_repr(value)}"
        )
