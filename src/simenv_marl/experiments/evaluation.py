"""Compares contenders on the same seeds, with confidence intervals."""

from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, groupby, product
from math import inf, nan, sqrt
from os import PathLike
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Unpack

import numpy as np
from numpy.typing import NDArray

from ..core import EpisodeOptions, Points, reuse_resources
from ..data.plots import interval, is_proportion, style
from ..errors import OptionValueError, did_you_mean, short_repr
from ..many.parallel import import_extra, progress_bar, spread
from ..runs import check_options
from ..simulation import Model, is_number
from .jobs import Job, open_store
from .plots import LOOKS, draw_dots, label_below
from .runner import (
    FALLBACKS,
    RUN_COLUMNS,
    STATUS_COLUMNS,
    TEAM,
    Contenders,
    Metrics,
    Outcome,
    Result,
    Row,
    Runner,
    Team,
    check_agents,
    distinct_seeds,
    error_note,
    make_table,
)
from .store import NO_FACTORS, Run, Store

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure
    from pandas import DataFrame, Series

FIRST_CHECK = 16
"""The number of seeds at the first check of the width. Intervals of fewer are unreliable."""

MOST_SEEDS = 10_000_000
"""A difference that needs more seeds than this counts as none."""

LINES = 200
"""The largest number of seeds that are drawn as lines."""

FALLBACK_LIMIT = 0.05
"""A contender with a larger share of decisions by fallbacks is marked."""


NO_COUNTS: Final = dict.fromkeys(("decisions", "asked", FALLBACKS, "seconds", "tokens"), 0)
"""The columns of ``Evaluation.seats`` that are always there."""


class Finished(NamedTuple):
    """An episode of a contender, and its rows of the table."""

    contender: str
    seed: int
    result: Result
    rows: list[Row]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The results of contenders on the same seeds. Made by ``evaluate``.

    Attributes:
        frame: A ``DataFrame`` with one row for each contender, seed and agent, and one for the
            team, whose ``agent`` is ``"team"``. Columns: ``contender``, ``seed``, ``agent``,
            ``return`` (the undiscounted sum of rewards), ``length`` (the number of decisions; for
            the team, of all agents) and the metrics, which are the same in all rows of an episode.
            Where a contender has a ``FallbackPolicy``, ``fallbacks`` is the number of decisions
            that a fallback answered. Where the numbers of a run are known to be wrong, there are
            the columns ``status`` and ``error``, as ``run_experiment`` has them.
        baseline: The contender that all others are compared with, or None.
        confidence: The confidence level of the intervals.
        seats: A ``DataFrame`` with one row for each contender and agent. Columns: ``decisions``;
            ``asked``, those that were put to a ``FallbackPolicy``; ``fallbacks``, those that its
            fallback answered; ``seconds``, the time that policies with ``_decision``,
            ``_environment``, ``_simulation`` or ``_state`` took for all answers; ``tokens`` of
            language models; and all other numbers that policies have counted by ``Decision.count``.

    In all methods, ``metric`` is ``"return"``, ``"length"`` or the name of a metric; another one is
    an ``OptionValueError``.
    """

    frame: "DataFrame"
    baseline: str | None
    confidence: float
    seats: "DataFrame | None" = None

    def __repr__(self) -> str:
        values = self.values()
        return f"<Evaluation: {', '.join(values.columns)} on {len(values)} seeds>"

    def __str__(self) -> str:
        """Return a table of the returns: means, differences from the baseline, and intervals."""
        summary = self.summary()
        estimates = {"mean": ("mean", "low", "high")}
        if self.baseline is not None:
            gains = "difference", "difference_low", "difference_high"
            estimates[f"more than {self.baseline}"] = gains
        shown = summary.drop(columns=[name for names in estimates.values() for name in names])
        for title, (middle, low, high) in reversed(estimates.items()):
            bounds = [
                f"({least:.4g} to {most:.4g})"
                for least, most in zip(summary[low], summary[high], strict=True)
            ]
            shown.insert(0, f"{self.confidence:.0%} interval", bounds, allow_duplicates=True)
            shown.insert(0, title, summary[middle].map("{:.4g}".format))
        if self.baseline is not None:
            shown.iloc[shown.index.get_loc(self.baseline), 2:4] = ""
        text: str = shown.rename_axis(None).to_string(float_format="{:.1%}".format)
        return text

    def values(self, metric: str = "return") -> "DataFrame":
        """Return the team's values: one row for each seed, one column for each contender."""
        check_metric(metric, self.frame.columns)
        team = self.frame[self.frame["agent"] == TEAM]
        if "status" in team:
            team = team.assign(**{metric: team[metric].where(team["status"] == "ok")})
        table = team.pivot(index="seed", columns="contender", values=metric)
        return table.loc[team["seed"].unique(), team["contender"].unique()]

    def summary(self, metric: str = "return") -> "DataFrame":
        """Return the mean of the team's values for each contender, with its confidence interval.

        Intervals are by Student's t. For bools, and for numbers that are all 0 or 1, they are by
        Wilson's score.

        Returns:
            A table indexed by contender, with the columns ``mean``, ``low`` and ``high``. With a
            baseline also ``difference``, ``difference_low`` and ``difference_high``: the mean
            paired difference from the baseline on the same seeds. Unknown bounds are nan; then
            there is a column ``note``, which says why. If fallbacks are counted, ``fallbacks`` is
            their share of the decisions that were put to a ``FallbackPolicy``, and the note of a
            contender with more than 5 % says so.
        """
        values = self.values(metric)
        proportions = values.columns if is_proportion(values.to_numpy()) else ()
        table = estimate_means(numbers(values, metric), self.confidence, proportions)
        notes = dict(table.pop("note"))
        if self.baseline is not None:
            estimates = estimate_means(self._differences(metric), self.confidence)
            for name, reason in estimates.pop("note").items():
                notes[name] = notes[name] or (reason and f"differences: {reason}")
            columns = ["difference", "difference_low", "difference_high"]
            table = table.join(estimates.astype(float).set_axis(columns, axis=1))
            table.loc[self.baseline, columns] = 0.0
        if FALLBACKS in self.frame and self.seats is not None:
            sums = self.seats.groupby("contender")[[FALLBACKS, "asked"]].sum()
            table[FALLBACKS] = sums[FALLBACKS] / sums["asked"].clip(lower=1)
            for name, share in table[FALLBACKS].items():
                if share > FALLBACK_LIMIT:
                    separator = "; " if notes[name] else ""
                    notes[name] += f"{separator}{share:.0%} of decisions by a fallback"
        return table.assign(note=notes) if any(notes.values()) else table

    def improvement(self, metric: str = "return") -> "DataFrame":
        """Estimate the probability that a contender has a higher value than the baseline on a seed.

        Ties count half.

        Returns:
            A table indexed by contender, with the columns ``probability``, ``low`` and ``high``.

        Raises:
            OptionValueError: There is no baseline.
        """
        signs = np.sign(self._differences(metric))
        proportions = [name for name in signs if not (signs[name] == 0).any()]
        table = estimate_means((signs + 1) / 2, self.confidence, proportions)
        return table.drop(columns="note").clip(0.0, 1.0).rename(columns={"mean": "probability"})

    def seeds_needed(
        self,
        difference: float,
        *,
        power: float = 0.8,
        metric: str = "return",
    ) -> "Series[float]":
        """Estimate the number of seeds that would detect a difference from the baseline.

        It is the number for a paired t-test, at ``confidence``, with the variance on the present
        seeds.

        Args:
            difference: The size of the mean difference to detect.
            power: The probability of detecting it. 0.8 is four times out of five.
            metric: The name of the value.

        Returns:
            The number of seeds by contender; infinity if no number is large enough, nan if the
            variance is unknown.

        Raises:
            OptionValueError: There is no baseline, or an argument has an invalid value.
        """
        check_number("difference", difference)
        check_number("power", power, 1)
        import pandas
        from scipy import stats

        def seeds_of(sample: NDArray[np.float64]) -> float:
            *_, note = interval(sample, self.confidence)
            if note:
                return nan
            size = difference / float(np.std(sample, ddof=1))

            def is_enough(number: int) -> bool:
                critical = stats.t.ppf((1 + self.confidence) / 2, number - 1)
                shift = min(size * sqrt(number), 1e4)  # SciPy has no values for much larger ones
                # The probabilities that a positive or a negative difference is significant.
                probabilities = stats.nct.sf(critical, number - 1, [shift, -shift])
                return bool(probabilities.sum() >= power)

            number = 2 + bisect_left(range(2, MOST_SEEDS + 1), True, key=is_enough)
            return number if number <= MOST_SEEDS else inf

        samples = self._differences(metric).items()
        seeds = {name: seeds_of(sample.to_numpy()) for name, sample in samples}
        return pandas.Series(seeds, name="seeds", dtype=float).rename_axis("contender")

    def plot(
        self, metric: str = "return", *, figure: "Figure | SubFigure | None" = None
    ) -> "Figure | SubFigure":
        """Draw each seed as a line across the contenders.

        With a baseline, also draw the difference on each seed. ``figure`` and the result are as in
        ``plot_timeline``.
        """
        values = numbers(self.values(metric), metric)
        summary = self.summary(metric)
        names = list(values)
        number = len(values)
        others = [] if self.baseline is None else list(self._differences(metric))
        sizes = [len(names), len(others)] if others else [len(names)]
        title = f"{number} seeds, lines for {LINES} of them"
        if number == 1:
            title = "1 seed"
        elif len(names) == 1:
            title = f"{number} seeds, each a dot"
        elif number <= LINES:
            title = f"{number} seeds, each a line"
        with style(figure) as make_figure:
            figure = make_figure(min(sum(1.1 * size + 1.2 for size in sizes) + 1.0, 14.0), 4.2)
            left, *right = figure.subplots(1, len(sizes), squeeze=False, width_ratios=sizes)[0]
            lines = values.to_numpy()[:LINES].T
            left.plot(lines, **LOOKS["seed"])
            draw_dots(left, values, names, summary[["mean", "low", "high"]], 0.0)
            labels = list(names)
            for place, share in enumerate(summary.get(FALLBACKS, ())):
                if share > FALLBACK_LIMIT:
                    labels[place] += f"\n{share:.0%} fallbacks"
            label_below(left, labels)
            left.set_ylabel(f"{metric} of the team" if metric in ("return", "length") else metric)
            left.set_title(title)
            for axes in right:
                axes.axhline(0.0, **LOOKS["zero"])
                bounds = summary.loc[others, ["difference", "difference_low", "difference_high"]]
                draw_dots(axes, self._differences(metric), names, bounds, 0.24)
                label_below(axes, others)
                axes.set_ylabel(f"difference from {self.baseline}, same seed")
                axes.set_title("differences")
        return figure

    def _differences(self, metric: str) -> "DataFrame":
        """Return the differences from the baseline: a column for each other contender."""
        if self.baseline is None:
            raise OptionValueError(
                "there is no baseline to compare with; give evaluate a baseline="
            )
        values = numbers(self.values(metric), metric)
        return values.sub(values[self.baseline], axis=0).drop(columns=self.baseline)

    def _widest(self) -> float:
        """Return the width of the widest interval that ``width=`` limits; nan if one is unknown."""
        summary = self.summary()
        prefix = "" if self.baseline is None else "difference_"
        widths = summary[f"{prefix}high"] - summary[f"{prefix}low"]
        return float(widths.max(skipna=False))


def evaluate(
    simulation: Model,
    contenders: Contenders,
    *,
    seeds: Iterable[int],
    points: Points = None,
    baseline: str | None = None,
    metric: Metrics = None,
    team: Team | None = None,
    confidence: float = 0.95,
    width: float | None = None,
    batched: bool = False,
    batch_size: int = 1024,
    concurrency: int = 64,
    workers: int = 0,
    progress: bool = False,
    store: str | PathLike[str] | None = None,
    **options: Unpack[EpisodeOptions],
) -> Evaluation:
    """Evaluate contenders on the same seeds.

    With a ``store``, each episode is stored as soon as it is finished. An interrupt, an error or a
    kill loses only the running episodes. The same call then runs the missing ones, also with other
    seeds or more contenders.

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
            None: their sum, or the total of ``team_reward=``. It gets a pandas ``Series`` by agent
            (``max``, or ``lambda returns: returns["waterer_0"]``). Agents that never decided are
            missing there (``returns.get("waterer_0", 0.0)``).
        confidence: The confidence level of the intervals.
        width: Stop as soon as the interval of every difference from the baseline (without a
            baseline: of every mean) is at most this wide; ``seeds`` are then the seeds that may be
            used. The width is checked from 16 seeds on, at growing distances.
        batched: Whether the policies answer many decisions at once, as ``simulate_many`` takes
            them.
        batch_size: As ``simulate_many`` takes it, if ``batched``.
        concurrency: As ``simulate_many`` takes it.
        workers: As ``simulate_many`` takes them.
        progress: As ``simulate_many`` takes it. The bar shows the remaining time.
        store: A folder that keeps finished episodes. It is created if it is missing. All workers
            write to it. None: nothing is kept.
        **options: The options of ``simulate``.

    Returns:
        The evaluation.

    Raises:
        OptionValueError: An argument has an invalid value, or the store has other metrics or
            belongs to an experiment. No simulation has run.
        StoreError: The store cannot be read or written.
        AgentError: A contender names an agent that no episode had, and that ``possible_agents``
            does not declare.
        MissingExtraError: pandas, SciPy, joblib or tqdm is missing.
        SimEnvError: Another argument does not work. The subclass and the message say which.
        BaseException: Any exception of a model, a mapping, a policy, a metric or ``team``, with
            notes that name the contender and the seed, and the store.
    """
    import_extra("pandas", "evaluate")
    import_extra("scipy.stats", "evaluate")
    check_options(batch_size, workers, None, concurrency)
    runner = Runner(
        contenders, points, options, metric, team, batch_size, concurrency, batched=batched
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
    check_number("confidence", confidence, 1)
    if width is not None:
        check_number("width", width)
    all_seeds = distinct_seeds(seeds)
    # Errors of plans come first, even if workers do the work.
    plans = {name: runner.plan(simulation, name) for name in contenders}
    order: dict[Any, int] = {run: place for place, run in enumerate(product(plans, all_seeds))}
    done = 0
    run_all = partial(_run_all, simulation, runner, workers)
    if store is not None:
        job, storage = open_store(lambda _: simulation, runner, store)
        agents = job.try_contenders(storage, [NO_FACTORS])
        done = len(order) - len(storage.missing(_stored_runs(order), retry_errors=True))
        run_all = partial(_run_missing, job, storage, agents, workers)
    finished: list[Finished] = []
    start = 0
    with progress_bar(len(order), progress, "episode", done) as bar:
        for end in _checkpoints(len(all_seeds), width):
            runs = list(product(plans, all_seeds[start:end]))
            start = end
            finished += run_all(runs, bar)
            finished.sort(key=lambda run: order[run.contender, run.seed])
            rows = [row for run in finished for row in run.rows]
            columns = runner.columns
            if any(row["status"] == "error" for row in rows):
                columns += STATUS_COLUMNS
            evaluation = Evaluation(
                make_table(columns, rows), baseline, float(confidence), _seats_of(finished)
            )
            if width is not None and evaluation._widest() <= width:
                break
    for name, plan in plans.items():
        frame = evaluation.frame
        present = set(frame["agent"][frame["contender"] == name]) - {TEAM}
        if present or "status" not in frame:
            check_agents(name, runner.undeclared_agents(plan, name), sorted(present))
    return evaluation


def _checkpoints(number: int, width: float | None) -> Iterator[int]:
    """Yield the numbers of seeds after which the width is checked, up to ``number``.

    Their distances grow, because each check takes time, too.
    """
    seeds = FIRST_CHECK
    while width is not None and seeds < number:
        yield seeds
        seeds += max(4, seeds // 8)
    yield number


def _run_all(
    simulation: Model,
    runner: Runner,
    workers: int,
    runs: Sequence[tuple[str, int]],
    bar: Any,
) -> Iterable[Finished]:
    """Run pairs of contender and seed in workers."""
    return chain(*spread(_run, (simulation, runner), runs, workers, runner.batch_size, bar))


def _run_missing(
    job: Job,
    storage: Store,
    agents: dict[str, set[str]],
    workers: int,
    runs: Sequence[tuple[str, int]],
    bar: Any,
) -> Iterable[Finished]:
    """Run pairs of contender and seed in workers, unless they are stored."""
    missing = storage.missing(_stored_runs(runs), retry_errors=True)
    job.run_missing(missing, agents, storage, workers, job.runner.batch_size, bar)
    for run in _stored_runs(runs):
        result = storage.runs.get(run, "its result is no longer stored")
        with error_note(f"of the contender {run.contender!r}; seed {run.seed}"):
            rows = job.runner.rows(run.contender, run.seed, result)
        yield Finished(run.contender, run.seed, result, rows)


def _stored_runs(runs: Iterable[tuple[str, int]]) -> list[Run]:
    return [Run(NO_FACTORS, *run) for run in runs]


def _run(
    simulation: Model,
    runner: Runner,
    runs: Sequence[tuple[str, int]],
    bar: Any,
) -> list[Finished]:
    """Run pairs of contender and seed."""
    finished: list[Finished] = []

    def report(name: str, seed: int, result: Result) -> None:
        finished.append(Finished(name, seed, result, runner.rows(name, seed, result)))
        bar.update()

    with reuse_resources():
        for name, group in groupby(runs, lambda run: run[0]):
            seeds = [seed for _, seed in group]
            runner.run(runner.plan(simulation, name), name, seeds, partial(report, name))
    return finished


def _seats_of(runs: Iterable[Finished]) -> "DataFrame":
    """Add up the decisions of each contender's agents, and all that their policies have counted."""
    from pandas import DataFrame

    seats = ["contender", "agent"]
    rows = [
        dict(zip(seats, (run.contender, agent), strict=True))
        | NO_COUNTS
        | run.result.counts.get(agent, {})
        | {"decisions": own["length"]}
        for run in runs
        if isinstance(run.result, Outcome)
        for agent, own in run.result.agents.items()
    ]
    table = DataFrame(rows, columns=None if rows else [*seats, *NO_COUNTS])
    return table.groupby(seats, sort=False).sum().reset_index()


# -- statistics -----------------------------------------------------------------------------------


def check_metric(metric: str, columns: Iterable[str]) -> None:
    """Check that a metric is one of the columns with results."""
    names = [name for name in columns if name not in (*RUN_COLUMNS[:3], *STATUS_COLUMNS)]
    if metric not in names:
        raise OptionValueError(
            f"metric={short_repr(metric)} is not a column of numbers; these are:"
            f" {names}{did_you_mean(metric, names)}"
        )


def estimate_means(
    samples: "DataFrame",
    confidence: float,
    proportions: Collection[str] = (),
) -> "DataFrame":
    """Estimate the means of samples, one column for each contender.

    Args:
        samples: The values on each seed.
        confidence: The confidence level of the intervals.
        proportions: The columns of zeros and ones.

    Returns:
        A table indexed by contender, with the columns ``mean``, ``low``, ``high`` and ``note``: the
        reason why the bounds are nan, empty if they are known.
    """
    import pandas

    rows = {}
    for name, values in samples.items():
        sample = values.to_numpy()
        bounds = interval(sample, confidence, proportion=name in proportions)
        rows[name] = (sample.mean(), *bounds)
    columns = ["mean", "low", "high", "note"]
    table = pandas.DataFrame.from_dict(rows, "index", columns=columns)
    return table.rename_axis("contender")


def numbers(values: "DataFrame", metric: str) -> "DataFrame":
    """Return a ``DataFrame`` or ``Series`` as floats, with nan for a missing value."""
    try:
        return values.astype(np.float64)
    except (TypeError, ValueError, OverflowError):  # OverflowError: integers too large for a float
        raise OptionValueError(f"metric={short_repr(metric)} is not a column of numbers") from None


def check_number(name: str, value: float, most: float = inf) -> None:
    """Check that an argument is a number between 0 and ``most``."""
    if not is_number(value) or not 0 < value < most:
        raise OptionValueError(
            f"{name} must lie between 0 and {most}, such as 0.95, not {short_repr(value)}"
        )
