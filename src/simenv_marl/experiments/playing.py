"""Plays episodes and returns their results: the return of each agent, and the metrics of the model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from ..core.agent import Agent
from ..core.asking import AskingPolicy
from ..core.episode import Episode
from ..core.plan import Plan
from ..core.session import Session
from ..data.collect import learners_plan
from ..decision import decision_points
from ..errors import AgentError, OptionValueError, UnknownPointError, annotate, close_after, short_repr, warn_user
from ..hooks.stacks import outside_simulation
from ..many.batch import Group, run, takes_identities
from ..simulation import RULE

TEAM: Final = "team"
"""The value of the column ``agent`` in the row of the team."""

COLUMNS: Final = ("contender", "seed", "agent", "return", "length", "status", "error")
"""The columns of tables besides factors and metrics."""

Policies = Mapping[Any, Any]
Metrics = Mapping[str, Callable[[Any], Any]]


class Outcome(NamedTuple):
    """The results of one episode.

    Attributes:
        returns: The undiscounted return of each agent, in the order of the agents' first decisions.
        lengths: The number of decisions of each agent.
        metrics: The metrics of the simulation, by name.
    """

    returns: dict[str, float]
    lengths: dict[str, int]
    metrics: dict[str, Any]


class Returns(tuple[float, ...]):
    """The returns of an episode's agents: a tuple of numbers, for ``sum`` and ``max``, and a mapping by agent.

    Example:
        ``returns["waterer_0"]``, ``returns.get("waterer_0", 0.0)``, ``min(returns)``, ``returns.items()``
    """

    _names: tuple[str, ...]

    def __new__(cls, returns: Mapping[str, float]) -> Returns:
        """Make the returns from a dict."""
        made = super().__new__(cls, returns.values())
        made._names = tuple(returns)
        return made

    def __getitem__(self, key: Any) -> Any:
        if not isinstance(key, str):
            return super().__getitem__(key)
        if key not in self._names:
            raise KeyError(
                f"{key!r} did not decide in this episode; these agents did: {', '.join(self._names) or 'none'}"
            )
        return super().__getitem__(self._names.index(key))

    def __contains__(self, key: object) -> bool:
        return key in self._names if isinstance(key, str) else super().__contains__(key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return the return of an agent, or the default if it did not decide."""
        return self[key] if key in self._names else default

    def keys(self) -> tuple[str, ...]:
        """Return the names of the agents."""
        return self._names

    def values(self) -> tuple[float, ...]:
        """Return the returns of the agents."""
        return tuple(self)

    def items(self) -> Iterator[tuple[str, float]]:
        """Return pairs of name and return."""
        return zip(self._names, self, strict=True)


def checked_team(team: Any) -> None:
    """Check the argument ``team``.

    Raises:
        OptionValueError: It is not a callable or None.
    """
    if team is not None and not callable(team):
        raise OptionValueError(f"team must be a callable of the returns, or None, not {short_repr(team)}")


def team_value(team: Callable[[Returns], Any] | None, returns: Mapping[str, float]) -> float:
    """Combine the returns of an episode's agents into the team's value.

    Raises:
        OptionValueError: The value is not a number.
    """
    if team is None:
        return float(sum(returns.values()))
    value = team(Returns(returns))
    try:
        return float(value)
    except (TypeError, ValueError):
        raise OptionValueError(f"team must return a number, not {short_repr(value)}") from None


# -- what is checked before anything runs ---------------------------------------------------------


def checked_contenders(contenders: Any, what: str = "contenders", *, batched: bool) -> dict[str, Policies]:
    """Return contenders by name.

    Args:
        contenders: The contenders, as users give them.
        what: The name of the argument.
        batched: Whether their policies answer many decisions at once.

    Raises:
        OptionValueError: These are not contenders.
    """
    if not isinstance(contenders, Mapping):
        raise OptionValueError(f"{what} must be a dict from a name to policies, not {short_repr(contenders)}")
    for name, policies in contenders.items():
        if not isinstance(name, str) or not name:
            raise OptionValueError(f"the name of a contender must be a string, not {short_repr(name)}")
        if not isinstance(policies, Mapping):
            raise OptionValueError(
                f"the contender {name!r} must be a dict from agents or points to policies, {{}} for the model as it is,"
                f" not {short_repr(policies)}"
            )
        for key, policy in policies.items():
            if policy is not RULE and not callable(policy):
                raise OptionValueError(
                    f"the policy of {short_repr(key)} in {name!r} must be callable, not {short_repr(policy)}"
                )
            if not batched and policy is not RULE and takes_identities(policy):
                raise OptionValueError(
                    f"the policy of {short_repr(key)} in {name!r}, {short_repr(policy)}, answers many"
                    " decisions at once, as"
                    " mixtures do; pass batched=True, and only policies as simulate_many takes them"
                )
    return dict(contenders)


def checked_metrics(metric: Any, taken: Sequence[str] = ()) -> dict[str, Callable[[Any], Any]]:
    """Return metrics by name; a single one is called ``metric``.

    Args:
        metric: A callable of the simulation, or a dict of callables.
        taken: The names of the factors.

    Raises:
        OptionValueError: These are not metrics, or a name is that of another column.
    """
    if metric is None:
        return {}
    metrics = dict(metric) if isinstance(metric, Mapping) else {"metric": metric}
    for name, function in metrics.items():
        if not isinstance(name, str) or not callable(function):
            raise OptionValueError(
                f"metric must be a callable of the simulation, or a dict of them, not {short_repr(metric)}"
            )
        if name in COLUMNS or name in taken:
            raise OptionValueError(f"the metric {name!r} has the name of another column; rename it")
    return metrics


def checked_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options that can be used again for each contender.

    Raises:
        OptionValueError: They contain ``policies``; the contenders define these.
    """
    if "policies" in options:
        raise OptionValueError("there is no option policies here; pass the policies of each contender in its dict")
    return {name: list(value) if isinstance(value, Iterator) else value for name, value in options.items()}


def points_of(contenders: Mapping[str, Policies]) -> list[Any]:
    """Return the decision points that contenders name."""
    keys = [key for policies in contenders.values() for key in policies]
    return list(dict.fromkeys(key for key in keys if not isinstance(key, str) or "." in key))


@contextmanager
def telling(contender: str) -> Iterator[None]:
    """Add the name of the contender to errors."""
    try:
        yield
    except BaseException as error:
        annotate(error, f"simenv_marl: of the contender {contender!r}")
        raise


def contender_plan(
    simulation: Any, policies: Policies, points: Any, options: Mapping[str, Any], named: Sequence[Any]
) -> Plan:
    """Return the plan of a contender's episodes. All agents whose rewards count decide in it.

    Args:
        simulation: As ``simulate`` takes it.
        policies: The contender's policies.
        points: The decision points, as ``generate_env`` takes them.
        options: The options of ``simulate``.
        named: The points that any contender names. They are used if the points are not known otherwise.

    Raises:
        SimEnvError: Something in them cannot work.
    """
    try:
        return learners_plan(simulation, policies, points, options, all_points=True)[0]
    except (AgentError, UnknownPointError) as error:
        if points is not None:
            raise
        first = error
    try:
        plan = learners_plan(simulation, policies, named or None, options, all_points=bool(named))[0]
    except (AgentError, UnknownPointError):
        raise first from None
    if not named and decision_points():
        warn_user(f"returns are not counted, because the decision points are not known: {first}")
    return plan


# -- episodes -------------------------------------------------------------------------------------


class Tally:
    """Counts the returns of agents while episodes run: a ``Watcher`` for ``run``, and for one episode alone."""

    def __init__(self, team: Callable[[Returns], Any] | None) -> None:
        self._team = team
        self._books: dict[int, dict[str, list[Any]]] = {}  # by place of the episode, and by agent: return and length

    def count(self, place: int, agent: Agent) -> None:
        """Count a decision of an agent."""
        account = agent.notes
        if account is None:
            account = agent.notes = self._books.setdefault(place, {}).setdefault(agent.name, [0.0, 0])
        account[1] += 1

    def asking(self, group: Group, places: Sequence[int], waiting: Sequence[Episode], observations: Any) -> None:
        """Count the decisions that are about to be answered: see ``Watcher``."""
        for place, episode in zip(places, waiting, strict=True):
            agent: Any = episode.pending
            self.count(place, agent)

    def answered(self, group: Group, actions: list[Any], extras: Mapping[str, Any]) -> None:
        """Do nothing: returns do not depend on the answers."""

    def moved(self, episode: Episode) -> None:
        """Add the reward when an episode reaches its next decision or its end: see ``Watcher``."""
        if episode.pending is not None:
            self._pay(episode.pending)
        for agent in episode.just_ended:
            self._pay(agent)
        episode.just_ended = []
        if episode.over:
            for agent in episode.agents.values():
                self._pay(agent)

    def _pay(self, agent: Agent) -> None:
        account = agent.notes
        if account is not None:
            account[0] += agent.reward

    def outcome(self, place: int, simulation: Any, metrics: Metrics) -> Outcome:
        """Return the results of an episode that is over.

        Raises:
            AgentError: The name of an agent is that of the team's row.
            BaseException: Any exception of a metric or of ``team``.
        """
        accounts = self._books.pop(place, {})
        if TEAM in accounts:
            raise AgentError(f"an agent is called {TEAM!r}, as is the row of all agents together; rename the agent")
        returns = {name: float(account[0]) for name, account in accounts.items()}
        lengths = {name: account[1] for name, account in accounts.items()}
        team_value(self._team, returns)  # called now because it may fail, not when all episodes are over
        return Outcome(returns, lengths, {name: _plain(name, metric(simulation)) for name, metric in metrics.items()})


def _plain(name: str, value: Any) -> Any:
    """Return a metric's value as a Python number or string."""
    if isinstance(value, (np.generic, np.ndarray)) and value.ndim == 0:
        value = value.item()
    if value is not None and type(value) not in (bool, int, float, str):
        raise OptionValueError(f"the metric {name!r} must be a number, a string or None, not {short_repr(value)}")
    return value


def play(plan: Plan, seed: int, metrics: Metrics, team: Callable[[Returns], Any] | None = None) -> Outcome:
    """Play one episode, with policies that answer one decision at a time.

    Raises:
        BaseException: Any exception of the model, a mapping, a policy, a metric or ``team``.
    """
    tally = Tally(team)
    try:
        session = Session(plan)
    except BaseException as error:
        annotate(error, f"simenv_marl: while the simulation was made; seed {seed}")
        raise
    try:
        with outside_simulation():
            episode = session.start(seed, None)
            own_random = plan.options.global_rng
            tally.moved(episode)
            while (agent := episode.pending) is not None:
                tally.count(0, agent)
                if isinstance(agent.policy, AskingPolicy):
                    agent.consultations += 1
                try:
                    with episode.context() if own_random else nullcontext():
                        action = agent.policy(agent.observation, agent.info)
                except BaseException as error:
                    episode.fail(error)
                    raise
                episode.step(action)
                tally.moved(episode)
            session.end()
            try:
                outcome = tally.outcome(0, session.simulation, metrics)
            except BaseException as error:
                annotate(error, f"simenv_marl: after the simulation's end; seed {seed}")
                raise
    except BaseException as error:
        close_after(error, session.close, "the simulation")
        raise
    session.close()
    return outcome


def play_many(
    plan: Plan,
    seeds: Sequence[int],
    batch_size: int,
    metrics: Metrics,
    told: Callable[[int, Outcome], None],
    team: Callable[[Returns], Any] | None = None,
) -> None:
    """Play many episodes, with policies that answer many decisions at once.

    Args:
        plan: The plan of the episodes.
        seeds: The seeds of the simulations.
        batch_size: The largest number of simulations that are suspended together.
        metrics: The metrics.
        told: Called with the index of a seed and its results, as soon as these are known.
        team: A callable that combines the returns of an episode. None: their sum.

    Raises:
        BaseException: Any exception of a model, a mapping, a policy, a metric or ``team``. ``told`` got the results of
            the episodes that had ended before.
    """
    tally = Tally(team)

    def finish(place: int, simulation: Any) -> Callable[[], None]:
        return partial(told, place, tally.outcome(place, simulation, metrics))

    run(plan, seeds, batch_size, finish, tally)
