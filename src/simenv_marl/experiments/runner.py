"""Runs the episodes of contenders: who decides, what is measured, and the rows of a table that this gives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from ..core import Agent, Episode, Plan, declared_agents, has_fallback, waits
from ..data.collect import learners_plan
from ..decision import decision_points
from ..errors import (
    AgentError,
    OptionValueError,
    UnknownPointError,
    annotate,
    did_you_mean,
    short_repr,
    warn_user,
)  # fmt: skip
from ..many.batch import BatchRun, Group, takes_identities
from ..many.parallel import import_extra
from ..runs import check_options, checked_seeds
from ..simulation import RULE

if TYPE_CHECKING:
    from pandas import DataFrame

TEAM: Final = "team"
"""The value of the column ``agent`` in the row of the team."""

RUN_COLUMNS: Final = ("contender", "seed", "agent", "return", "length")
"""The first columns of tables, after the factors."""

FALLBACKS: Final = "fallbacks"
"""The column, after these, with the number of decisions that a fallback answered, if a contender has one."""

STATUS_COLUMNS: Final = ("status", "error")
"""The last columns of the table of an experiment, after the metrics."""


class Outcome(NamedTuple):
    """The results of one episode: each agent's undiscounted return and number of decisions, and the metrics.

    ``fallbacks`` has the agents for which a fallback has answered, and how often.
    """

    returns: dict[str, float]
    lengths: dict[str, int]
    metrics: dict[str, Any]
    fallbacks: dict[str, int]


class Returns(tuple[float, ...]):
    """The returns of an episode's agents: a tuple of numbers, for ``sum`` and ``max``, and a mapping by agent."""

    _by_agent: dict[str, float]

    def __new__(cls, returns: Mapping[str, float]) -> Returns:
        """Make the returns from a dict."""
        instance = super().__new__(cls, returns.values())
        instance._by_agent = dict(returns)  # the user of the tuple may change it
        return instance

    def __getitem__(self, key: Any) -> Any:
        if not isinstance(key, str):
            return super().__getitem__(key)
        if key not in self._by_agent:
            raise KeyError(
                f"{key!r} did not decide in this episode; these agents did:"
                f" {', '.join(self._by_agent) or 'none'}"
            )
        return self._by_agent[key]

    def __contains__(self, key: object) -> bool:
        return key in self._by_agent if isinstance(key, str) else super().__contains__(key)

    def __getattr__(self, name: str) -> Any:
        """Return ``get``, ``keys``, ``values`` or ``items`` of the dict."""
        return getattr(self._by_agent, name)


@contextmanager
def noting(note: str) -> Iterator[None]:
    """Add a note to errors."""
    try:
        yield
    except BaseException as error:
        annotate(error, f"simenv_marl: {note}")
        raise


class Runner:
    """Runs episodes of contenders, with the arguments that ``evaluate`` and ``run_experiment`` share.

    Workers get a copy. With a ``batch_size`` of 0, policies answer one decision at a time.
    """

    def __init__(
        self, contenders: Any, points: Any, options: Mapping[str, Any], metric: Any, team: Any, *, batched: bool,
        batch_size: int, concurrency: int, workers: int, factors: Collection[str] = (),
    ) -> None:  # fmt: skip
        """Check the arguments.

        ``factors`` are the columns of the design, whose names metrics must not have.
        """
        check_options(batch_size, workers, None, concurrency)
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
            for key, policy in policies.items():
                if (
                    callable(policy)
                    and policy is not RULE
                    and not batched
                    and takes_identities(policy)
                ):
                    raise OptionValueError(
                        f"the policy of {short_repr(key)} in {name!r}, {short_repr(policy)},"
                        " answers many decisions at once, as mixtures do; pass batched=True, and"
                        " only policies as simulate_many takes them"
                    )
        if team is not None and not callable(team):
            raise OptionValueError(
                f"team must be a callable of the returns, or None, not {short_repr(team)}"
            )
        if "policies" in options:
            raise OptionValueError(
                "there is no option policies here; pass the policies of each contender in"
                " contenders="
            )
        self.contenders: Mapping[str, Mapping[Any, Any]] = contenders
        self.metrics: Mapping[str, Callable[[Any], Any]] = {"metric": metric}
        if metric is None or isinstance(metric, Mapping):
            self.metrics = metric or {}
        for name, function in self.metrics.items():
            if not isinstance(name, str) or not callable(function):
                raise OptionValueError(
                    "metric must be a callable of the simulation, or a dict of them, not"
                    f" {short_repr(metric)}"
                )
            if name in (*RUN_COLUMNS, FALLBACKS, *STATUS_COLUMNS, *factors):
                raise OptionValueError(
                    f"the metric {name!r} has the name of another column; rename it"
                )
        self.batch_size, self._concurrency = int(batch_size) if batched else 0, int(concurrency)
        policies = [policy for own in contenders.values() for policy in own.values()]
        self._fallbacks = (FALLBACKS,) if any(map(has_fallback, policies)) else ()
        self._team = team
        # They may be iterators, and every plan reads them.
        self._points = list(points) if isinstance(points, Iterator) else points
        self._options = {
            n: list(value) if isinstance(value, Iterator) else value for n, value in options.items()
        }

    def plan(self, simulation: Any, contender: str) -> Plan:
        """Return the plan of a contender's episodes.

        All agents whose rewards count decide in it.
        """
        policies, points, options = self.contenders[contender], self._points, self._options
        alone = not self.batch_size
        with noting(f"of the contender {contender!r}"):
            try:
                return learners_plan(
                    simulation, policies, points, options, all_points=True, alone=alone
                )
            except (AgentError, UnknownPointError) as error:
                if points is not None:
                    raise
                # The points are not known: those that the contenders name are used, if there are
                # any.
                keys = dict.fromkeys(key for own in self.contenders.values() for key in own)
                points = [key for key in keys if not isinstance(key, str) or "." in key] or None
                with suppress(AgentError, UnknownPointError):
                    plan = learners_plan(
                        simulation,
                        policies,
                        points,
                        options,
                        all_points=points is not None,
                        alone=alone,
                    )
                    if points is None and decision_points():
                        warn_user(
                            "returns are not counted, because the decision points are not known:"
                            f" {error}"
                        )
                    return plan
                raise

    def unproven_agents(self, plan: Plan, contender: str) -> set[str]:
        """Return the names in a contender of which only episodes tell whether they are agents'."""
        known = {point.agent for point in plan.points}.union(
            declared_agents(plan.options.possible_agents)
        )
        return {
            name
            for name in self.contenders[contender]
            if name in plan.policies and name not in known
        }

    def check_agents(self, contender: str, names: set[str], present: Collection[str]) -> None:
        """Check that agents of these names have decided."""
        for name in sorted(names.difference(present)):
            raise AgentError(
                f"the contender {contender!r} has a policy for {name!r}, but no agent of that name"
                " has decided; declare it in possible_agents= if it may appear later; these have"
                f" decided: {', '.join(present) or 'none'}{did_you_mean(name, present)}"
            )

    def together(self, contender: str) -> int:
        """Return how many episodes of a contender run together."""
        waiting = any(map(waits, self.contenders[contender].values()))
        return self.batch_size or (self._concurrency if waiting else 1)

    def run(
        self,
        plan: Plan,
        contender: str,
        seeds: Sequence[int],
        report: Callable[[int, Outcome], None],
    ) -> None:
        """Run one episode for each seed.

        ``report`` gets the seed and its results when the simulation is closed.
        """
        tally = Tally()

        def finish(place: int, simulation: Any) -> Callable[[], None]:
            return partial(report, seeds[place], tally.outcome(place, simulation, self.metrics))

        size = self.together(contender)
        BatchRun(plan, seeds, size, finish, tally, self._concurrency).run()

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of ``rows``, with those of contender and seed before them."""
        return (*RUN_COLUMNS, *self._fallbacks, *self.metrics)

    def rows(self, outcome: Outcome) -> list[tuple[Any, ...]]:
        """Return agent, return, length, fallbacks and metrics for each agent and for the team."""
        metrics = [outcome.metrics.get(name) for name in self.metrics]
        rows = []
        for agent, of_agent in outcome.returns.items():
            own = [outcome.fallbacks.get(agent, 0) for _ in self._fallbacks]
            rows.append((agent, of_agent, outcome.lengths[agent], *own, *metrics))
        value: Any = (
            sum(outcome.returns.values())
            if self._team is None
            else self._team(Returns(outcome.returns))
        )
        fallbacks = [sum(outcome.fallbacks.values()) for _ in self._fallbacks]
        try:
            return [
                *rows,
                (TEAM, float(value), sum(outcome.lengths.values()), *fallbacks, *metrics),
            ]
        except (TypeError, ValueError):
            raise OptionValueError(f"team must return a number, not {short_repr(value)}") from None


class Tally:
    """Counts the returns of agents while episodes run: a ``Watcher`` for ``BatchRun``, and for one episode alone."""

    def __init__(self) -> None:
        # by place and agent: return, length, fallbacks
        self._accounts: dict[int, dict[str, list[Any]]] = {}
        self._of_agents: dict[Agent, list[Any]] = {}  # the same, of agents that have not ended

    def count(self, place: int, agent: Agent) -> None:
        """Count a decision of an agent."""
        account = self._of_agents.get(agent)
        if account is None:
            accounts = self._accounts.setdefault(place, {})
            account = self._of_agents[agent] = accounts.setdefault(agent.name, [0.0, 0, 0])
        account[1] += 1

    def record(self, group: Group, places: list[int], waiting: list[Any], *_: Any) -> None:
        """Count decisions: see ``Watcher``."""
        for place, episode in zip(places, waiting, strict=True):
            self.count(place, episode.pending)

    def pay(self, episode: Episode) -> None:
        """Add the rewards: see ``Watcher``."""
        ended = [*episode.take_ended(), *(episode.agents.values() if episode.over else ())]
        for agent in ended:
            self._pay(agent, self._of_agents.pop(agent, None))
        pending = episode.pending
        if pending is not None:
            self._pay(pending, self._of_agents.get(pending))

    def _pay(self, agent: Agent, account: list[Any] | None) -> None:
        if account is not None:
            account[0] += agent.reward
            account[2] = agent.fallbacks

    def outcome(
        self, place: int, simulation: Any, metrics: Mapping[str, Callable[[Any], Any]]
    ) -> Outcome:
        """Return the results of an episode that is over."""
        accounts = self._accounts.pop(place, {})
        if TEAM in accounts:
            raise AgentError(
                f"an agent is called {TEAM!r}, as is the row of all agents together; rename the"
                " agent"
            )
        returns = {name: float(account[0]) for name, account in accounts.items()}
        lengths = {name: account[1] for name, account in accounts.items()}
        values = {
            name: plain_value(f"the metric {name!r}", metric(simulation))
            for name, metric in metrics.items()
        }
        fallbacks = {name: account[2] for name, account in accounts.items() if account[2]}
        return Outcome(returns, lengths, values, fallbacks)


# -- seeds, values and tables ---------------------------------------------------------------------


def distinct_seeds(seeds: Iterable[int]) -> list[int]:
    """Return the seeds as a list: at least one, and all different."""
    checked = checked_seeds(seeds)
    if not checked:
        raise OptionValueError("seeds must be integers, such as range(32), but there are none")
    seed, number = Counter(checked).most_common(1)[0]
    if number > 1:
        raise OptionValueError(f"the seed {seed} occurs twice: its result would be counted twice")
    return checked


def plain_value(what: str, value: Any, advice: str = "") -> Any:
    """Return a number, a string, a bool or None as an object of Python; refuse any other value."""
    if isinstance(value, (np.generic, np.ndarray)) and value.ndim == 0:
        value = value.item()
    # 4,214 digits
    plain = type(value) in (bool, float, str) or (
        type(value) is int and value.bit_length() < 14_000
    )
    if value is not None and not plain:
        what += " must be a number of no more than 4,200 digits, a string or None"
        raise OptionValueError(f"{what}, not {short_repr(value)}{advice}")
    return value


def make_table(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> DataFrame:
    """Return a table whose columns keep the types of their values.

    A numeric column with missing values is float.
    """
    pandas = import_extra("pandas", "a table")
    columns = dict(zip(names, zip(*rows, strict=True), strict=True))
    table: DataFrame = pandas.DataFrame(
        {
            name: pandas.Series(values, dtype=dtype_of(values, missing=True))
            for name, values in columns.items()
        }
    )
    return table


def dtype_of(values: Collection[Any], *, missing: bool) -> Any:
    """Return the dtype of a column that keeps the types of its values.

    With ``missing``, None is a missing number, and numbers of both types become floats where that
    is exact.
    """
    kinds = set(map(type, values))
    if kinds == {int} and all(-(2**63) <= value < 2**63 for value in values):
        return np.int64
    if missing and kinds & {int, float} and kinds <= {int, float, type(None)}:
        exact = all(type(value) is not int or abs(value) <= 2**53 for value in values)
        return np.float64 if exact else object
    return (
        {str: "str", float: np.float64, bool: np.bool_}.get(kinds.pop(), object)
        if len(kinds) == 1
        else object
    )
