"""Runs the episodes of contenders, and measures them: the returns of agents, and metrics."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from math import nan
from types import NoneType
from typing import TYPE_CHECKING, Any, SupportsFloat

from ..core import Episode, Plan, Points, has_fallback, waits
from ..data.collect import learners_plan
from ..decision import decision_points
from ..errors import (
    AgentError,
    OptionValueError,
    UnknownPointError,
    annotate,
    did_you_mean,
    short_repr,
)
from ..many.batch import BatchRun, Group, takes_identities
from ..runs import checked_seeds
from ..simulation import RULE, Model

if TYPE_CHECKING:
    from pandas import DataFrame, Series

TEAM = "team"
"""The value of the column ``agent`` in the row of the team."""

RUN_COLUMNS = ("contender", "seed", "agent", "return", "length")
"""The first columns of tables, after the factors."""

FALLBACKS = "fallbacks"
"""The next column, if a contender has a fallback: the number of decisions that it answered."""

STATUS_COLUMNS = ("status", "error")
"""The last columns of the table of an experiment, after the metrics."""

RESERVED = (*RUN_COLUMNS, FALLBACKS, *STATUS_COLUMNS)
"""The columns whose names factors and metrics must not have."""

Contenders = Mapping[str, Mapping[Any, Any]]
"""The policies of each contender, as ``simulate`` takes them."""

Metric = Callable[[Model], object]
"""A callable of a simulation after its end. ``plain_value`` checks its result."""

Metrics = Metric | Mapping[str, Metric] | None
"""The argument ``metric`` of ``evaluate`` and ``run_experiment``."""

Value = str | float | None
"""A factor or the result of a metric: a string, a number, a bool or None."""

Row = dict[str, Value]
"""A row of a table, by column."""


@dataclass(frozen=True)
class Outcome:
    """The results of one episode.

    Attributes:
        agents: For each agent that has decided, its ``return`` (undiscounted), ``length`` (the
            number of its decisions) and ``fallbacks`` (the number that its fallback answered).
        metrics: The result of each metric.
        team: What the team has earned, by ``team_reward=``. None without it.
        counts: For each of these agents, all numbers that its policies have counted.
    """

    agents: dict[str, dict[str, float]]
    metrics: dict[str, Value]
    team: float | None = None
    counts: dict[str, dict[str, float]] = field(default_factory=dict)


Result = Outcome | str
"""The result of a run. A string tells the error of a failed run, or why its numbers are wrong."""

Team = Callable[["Series[float]"], SupportsFloat]
"""A callable that combines the returns of agents into the team's value."""


@contextmanager
def error_note(note: str) -> Iterator[None]:
    """Add a note to errors."""
    try:
        yield
    except BaseException as error:
        annotate(error, f"simenv_marl: {note}")
        raise


class Runner:
    """Runs episodes of contenders for ``evaluate`` and ``run_experiment``.

    Workers get a copy.

    Attributes:
        contenders: The policies of each contender.
        metrics: The metrics, by column.
        batch_size: The largest number of episodes in a batch; 0: policies answer one decision at a
            time.
    """

    def __init__(
        self,
        contenders: Contenders,
        points: Points,
        options: Mapping[str, Any],
        metric: Metrics,
        team: Team | None,
        batch_size: int,
        concurrency: int,
        *,
        batched: bool,
        factors: Collection[str] = (),
    ) -> None:
        """Check the arguments.

        ``factors`` are the columns of the design, whose names metrics must not have.
        """
        if team is not None and not callable(team):
            raise OptionValueError(
                f"team must be a callable of the returns, or None, not {short_repr(team)}"
            )
        if "policies" in options:
            raise OptionValueError(
                "there is no option policies here; pass the policies of each contender in"
                " contenders="
            )
        check_contenders(contenders, batched=batched)
        self.contenders = contenders
        self.metrics: Mapping[str, Metric] = {}
        if isinstance(metric, Mapping):
            self.metrics = metric
        elif metric is not None:
            self.metrics = {"metric": metric}
        for name, function in self.metrics.items():
            if not isinstance(name, str) or not callable(function):
                raise OptionValueError(
                    "metric must be a callable of the simulation, or a dict of them, not"
                    f" {short_repr(metric)}"
                )
            if name in (*RESERVED, *factors):
                raise OptionValueError(
                    f"the metric {name!r} has the name of another column; rename it"
                )
        self.batch_size = batch_size if batched else 0
        self._concurrency = concurrency
        self._counts_fallbacks = any(
            has_fallback(policy) for policies in contenders.values() for policy in policies.values()
        )
        self._team = team
        # Iterators are copied, because each plan reads them again.
        self._points = list(points) if isinstance(points, Iterator) else points
        self._options = {
            name: list(value) if isinstance(value, Iterator) else value
            for name, value in options.items()
        }

    def plan(self, simulation: Model, contender: str) -> Plan:
        """Return the plan of a contender's episodes.

        All entities that decide are agents with rewards, also without a policy. If the decision
        points are not known, the points that contenders name are used, if there are any.
        """
        make_plan = partial(
            learners_plan,
            simulation,
            self.contenders[contender],
            options=self._options,
            alone=not self.batch_size,
        )
        with error_note(f"of the contender {contender!r}"):
            try:
                return make_plan(points=self._points, all_points=True)
            except (AgentError, UnknownPointError):
                keys = dict.fromkeys(chain.from_iterable(self.contenders.values()))
                points = [key for key in keys if not isinstance(key, str) or "." in key]
                if self._points is not None or (decision_points() and not points):
                    raise
                return make_plan(points=points or None, all_points=bool(points))

    def undeclared_agents(self, plan: Plan, contender: str) -> set[str]:
        """Return the agents that a contender names, but neither points nor ``possible_agents``."""
        declared_names = {*plan.options.declared_agents, *(point.agent for point in plan.points)}
        return (self.contenders[contender].keys() & plan.policies.keys()) - declared_names

    def episodes_at_once(self, contender: str) -> int:
        """Return how many episodes of a contender run at once."""
        is_awaited = any(map(waits, self.contenders[contender].values()))
        return self.batch_size or (self._concurrency if is_awaited else 1)

    def run(
        self,
        plan: Plan,
        contender: str,
        seeds: Sequence[int],
        report: Callable[[int, Result], None],
    ) -> None:
        """Run one episode for each seed.

        ``report`` gets the seed and the result after the simulation is closed.
        """
        tally = Tally()

        def finish(place: int, episode: Episode) -> Callable[[], None]:
            seed = seeds[place]
            outcome = replace(tally.outcomes.pop(seed), team=episode.total)
            if episode.fault:
                return partial(report, seed, f"the numbers are wrong: {episode.fault}")
            if TEAM in outcome.agents:
                raise AgentError(
                    f"an agent is called {TEAM!r}, as is the row of all agents together; rename the"
                    " agent"
                )
            for name, metric in self.metrics.items():
                value = metric(episode.simulation)
                outcome.metrics[name] = plain_value(f"the metric {name!r}", value)
            return partial(report, seed, outcome)

        with error_note(f"of the contender {contender!r}"):
            BatchRun(
                plan,
                seeds,
                self.episodes_at_once(contender),
                finish,
                tally,
                self._concurrency,
            ).run()

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of ``rows``."""
        return (*RUN_COLUMNS, *([FALLBACKS] if self._counts_fallbacks else []), *self.metrics)

    def rows(
        self,
        contender: str,
        seed: int,
        result: Result,
    ) -> list[Row]:
        """Return a row of the table for each agent, and one for the team.

        A run with an error has only the team's row.
        """
        from pandas import Series

        run: Row = {"contender": contender, "seed": seed, "status": "ok"}
        if isinstance(result, str):
            failed: Row = {"agent": TEAM, "return": nan, "length": 0}
            return [{**run, **failed, "status": "error", "error": result}]
        agents = result.agents
        total: dict[str, Any] = {
            name: sum(own[name] for own in agents.values())
            for name in ("return", "length", FALLBACKS)
        }
        if result.team is not None:
            total["return"] = result.team
        if self._team is not None:
            returns = Series({name: own["return"] for name, own in agents.items()}, dtype=float)
            try:
                total["return"] = self._team(returns)
            except KeyError as error:
                names = ", ".join(agents) or "none"
                raise KeyError(
                    f"{error} did not decide in this episode; these did: {names}"
                ) from error
        try:
            total["return"] = float(total["return"])
        except (TypeError, ValueError):
            raise OptionValueError(
                f"team must return a number, not {short_repr(total['return'])}"
            ) from None
        run |= result.metrics
        return [{**run, "agent": name, **own} for name, own in {**agents, TEAM: total}.items()]


class Tally:
    """Counts the decisions and rewards of agents during episodes: a ``Watcher`` for ``BatchRun``.

    Attributes:
        outcomes: The results of the episodes, by seed.
    """

    def __init__(self) -> None:
        self.outcomes = defaultdict[int, Outcome](lambda: Outcome(defaultdict(_no_decision), {}))

    def record(
        self,
        group: Group,
        places: list[int],
        waiting: list[Any],
        *_: object,
    ) -> None:
        """Count decisions: see ``Watcher``."""
        for episode in waiting:
            self.outcomes[episode.seed].agents[episode.pending.name]["length"] += 1

    def pay(self, episode: Episode) -> None:
        """Add the rewards: see ``Watcher``.

        Agents that end before the simulation get their last reward when it is over.
        """
        outcome = self.outcomes[episode.seed]
        results = outcome.agents
        agents = [*episode.ended.values(), *episode.agents.values()]
        for agent in agents if episode.pending is None else [episode.pending]:
            if agent.name in results:
                own = results[agent.name]
                own["return"] += agent.reward
                own[FALLBACKS] = agent.counts.get(FALLBACKS, 0)
                outcome.counts[agent.name] = agent.counts


def _no_decision() -> dict[str, float]:
    return {"return": 0.0, "length": 0, FALLBACKS: 0}


# -- checks ---------------------------------------------------------------------------------------


def check_contenders(contenders: Contenders, *, batched: bool) -> None:
    """Check that contenders are a dict from names to policies."""
    if not isinstance(contenders, Mapping):
        raise OptionValueError(
            f"contenders must be a dict from a name to policies, not {short_repr(contenders)}"
        )
    for name, policies in contenders.items():
        if not isinstance(name, str) or not name:
            raise OptionValueError(
                f"the name of a contender must be a string, not {short_repr(name)}"
            )
        if not isinstance(policies, Mapping):
            raise OptionValueError(
                f"the contender {name!r} must be a dict from agents or points to policies,"
                f" {{}} for the model as it is, not {short_repr(policies)}"
            )
        for key, policy in {} if batched else policies.items():
            if policy is not RULE and callable(policy) and takes_identities(policy):
                raise OptionValueError(
                    f"the policy of {short_repr(key)} in {name!r}, {short_repr(policy)},"
                    " answers many decisions at once, as mixtures do; pass batched=True, and"
                    " only policies as simulate_many takes them"
                )


def check_agents(
    contender: str,
    names: set[str],
    present: Collection[str],
) -> None:
    """Check that agents of these names have decided."""
    for name in sorted(names.difference(present)):
        raise AgentError(
            f"the contender {contender!r} has a policy for {name!r}, but no agent of that name"
            " has decided; declare it in possible_agents= if it may appear later; these have"
            f" decided: {', '.join(present) or 'none'}{did_you_mean(name, present)}"
        )


def distinct_seeds(seeds: Iterable[int]) -> list[int]:
    """Return the seeds as a list: at least one, and all different."""
    all_seeds = checked_seeds(seeds)
    if not all_seeds:
        raise OptionValueError("seeds must be integers, such as range(32), but there are none")
    seed, number = Counter(all_seeds).most_common(1)[0]
    if number > 1:
        raise OptionValueError(f"the seed {seed} occurs twice: its result would be counted twice")
    return all_seeds


def plain_value(name: str, value: Any) -> Any:
    """Return the named value without NumPy's types, or raise an error."""
    if getattr(value, "ndim", None) == 0:
        value = value.item()
    if type(value) not in (bool, int, float, str, NoneType):
        raise OptionValueError(
            f"{name} must be a number, a string or None, not {short_repr(value)}"
        )
    return value


def make_table(columns: Sequence[str], rows: Iterable[Row]) -> DataFrame:
    """Return a table. A numeric column with missing values is float."""
    import pandas

    return pandas.DataFrame(list(rows), columns=list(columns))
