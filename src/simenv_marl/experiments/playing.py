"""Episodes that are played for what they bring: the return of each agent, and what is measured of the model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from ..core.agent import Agent
from ..core.episode import Episode, When
from ..core.plan import Plan
from ..core.session import Session
from ..decision import decision_points
from ..errors import AgentError, OptionValueError, UnknownPointError, annotate, close_after, shown, warn_user
from ..hooks.stacks import outside_simulation
from ..many.batch import Group, run, takes_identities
from ..many.collect import learners_plan
from ..simulation import RULE

TEAM: Final = "team"
"""What stands in the column ``agent`` of the row of all agents together."""

COLUMNS: Final = ("contender", "seed", "agent", "return", "length", "status", "error")
"""The columns of tables that are no factors and no metrics."""

Policies = Mapping[Any, Any]
Metrics = Mapping[str, Callable[[Any], Any]]


class Outcome(NamedTuple):
    """What has come of one episode.

    Attributes:
        returns: By agent, the sum of its rewards, in the order in which agents first decided.
        lengths: By agent, how many decisions it has taken.
        metrics: By name, what was measured of the simulation.
    """

    returns: dict[str, float]
    lengths: dict[str, int]
    metrics: dict[str, Any]


class Returns(tuple[float, ...]):
    """The returns of the agents of an episode: their numbers, as ``sum`` and ``max`` want them, and a mapping by agent.

    Example:
        ``returns["waterer_0"]``, ``returns.get("waterer_0", 0.0)``, ``min(returns)``, ``returns.items()``
    """

    _names: tuple[str, ...]

    def __new__(cls, returns: Mapping[str, float]) -> Returns:
        """Make them of a dict."""
        made = super().__new__(cls, returns.values())
        made._names = tuple(returns)
        return made

    def __getitem__(self, key: Any) -> Any:
        if not isinstance(key, str):
            return super().__getitem__(key)
        if key not in self._names:
            raise KeyError(f"{key!r} has not decided in this episode; {', '.join(self._names) or 'no agent'} has")
        return super().__getitem__(self._names.index(key))

    def __contains__(self, key: object) -> bool:
        return key in self._names if isinstance(key, str) else super().__contains__(key)

    def get(self, key: str, default: Any = None) -> Any:
        """The return of an agent, or the default where it has not decided."""
        return self[key] if key in self._names else default

    def keys(self) -> tuple[str, ...]:
        """The names of the agents."""
        return self._names

    def values(self) -> tuple[float, ...]:
        """Their returns."""
        return tuple(self)

    def items(self) -> Iterator[tuple[str, float]]:
        """Both."""
        return zip(self._names, self, strict=True)


def checked_team(team: Any) -> None:
    """Make sure that something can make one value of the returns of agents.

    Raises:
        OptionValueError: It cannot.
    """
    if team is not None and not callable(team):
        raise OptionValueError(f"team must be a callable of the returns, or None, not {shown(team)}")


def team_value(team: Callable[[Returns], Any] | None, returns: Mapping[str, float]) -> float:
    """What the returns of all agents of an episode make together.

    Raises:
        OptionValueError: It is no number.
    """
    if team is None:
        return float(sum(returns.values()))
    value = team(Returns(returns))
    try:
        return float(value)
    except (TypeError, ValueError):
        raise OptionValueError(f"team must return a number, not {shown(value)}") from None


# -- what is checked before anything runs ---------------------------------------------------------


def checked_contenders(contenders: Any, what: str = "contenders", *, batched: bool) -> dict[str, Policies]:
    """Contenders by name.

    Args:
        contenders: As users give them.
        what: The argument in which they stand.
        batched: Whether their policies answer many decisions at once.

    Raises:
        OptionValueError: They are none.
    """
    if not isinstance(contenders, Mapping):
        raise OptionValueError(f"{what} must be a dict from a name to policies, not {shown(contenders)}")
    for name, policies in contenders.items():
        if not isinstance(name, str) or not name:
            raise OptionValueError(f"the name of a contender must be a string, not {shown(name)}")
        if not isinstance(policies, Mapping):
            raise OptionValueError(
                f"the contender {name!r} must be a dict from agents or points to policies, {{}} for the model as it is,"
                f" not {shown(policies)}"
            )
        for key, policy in policies.items():
            if policy is not RULE and not callable(policy):
                raise OptionValueError(f"the policy of {shown(key)} in {name!r} must be callable, not {shown(policy)}")
            if not batched and policy is not RULE and takes_identities(policy):
                raise OptionValueError(
                    f"the policy of {shown(key)} in {name!r}, {shown(policy)}, answers many decisions at once, as"
                    " mixtures do; give batched=True, with which all policies are those of simulate_many"
                )
    return dict(contenders)


def checked_metrics(metric: Any, taken: Sequence[str] = ()) -> dict[str, Callable[[Any], Any]]:
    """Metrics by name; a single one is called ``metric``.

    Args:
        metric: A callable of the simulation, or a dict of them.
        taken: The names of the factors.

    Raises:
        OptionValueError: They are none, or a name is that of another column.
    """
    if metric is None:
        return {}
    metrics = dict(metric) if isinstance(metric, Mapping) else {"metric": metric}
    for name, function in metrics.items():
        if not isinstance(name, str) or not callable(function):
            raise OptionValueError(
                f"metric must be a callable of the simulation, or a dict of them, not {shown(metric)}"
            )
        if name in COLUMNS or name in taken:
            raise OptionValueError(f"the metric {name!r} is called like another column; rename it")
    return metrics


def checked_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options that can be used again for each contender.

    Raises:
        OptionValueError: They say who decides, which is for contenders to say.
    """
    if "policies" in options:
        raise OptionValueError("who decides is said by contenders: there is no option policies here")
    return {name: list(value) if isinstance(value, Iterator) else value for name, value in options.items()}


def points_of(contenders: Mapping[str, Policies]) -> list[Any]:
    """The decision points that contenders name."""
    keys = [key for policies in contenders.values() for key in policies]
    return list(dict.fromkeys(key for key in keys if not isinstance(key, str) or "." in key))


@contextmanager
def telling(contender: str) -> Iterator[None]:
    """Have errors say of which contender they are."""
    try:
        yield
    except BaseException as error:
        annotate(error, f"simenv_marl: of the contender {contender!r}")
        raise


def contender_plan(
    simulation: Any, policies: Policies, points: Any, options: Mapping[str, Any], named: Sequence[Any]
) -> Plan:
    """The plan of a contender's episodes, in which all decide whose rewards are counted.

    Args:
        simulation: As ``simulate`` takes it.
        policies: The contender's policies.
        points: The decision points, as ``generate_env`` takes them.
        options: As ``simulate`` takes them.
        named: The points that any contender names. If it is not known which points are meant, it is these.

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
        warn_user(f"no returns are counted, since it is not known which decision points are meant: {first}")
    return plan


# -- episodes -------------------------------------------------------------------------------------


class Tally:
    """The returns of agents, while episodes run: a watcher of ``run``, and of one episode alone."""

    def __init__(self, team: Callable[[Returns], Any] | None) -> None:
        self._team = team
        self._books: dict[int, dict[str, list[Any]]] = {}  # by place of the episode and agent: return, and length

    def count(self, place: int, agent: Agent) -> None:
        """An agent decides."""
        account = agent.notes
        if account is None:
            account = agent.notes = self._books.setdefault(place, {}).setdefault(agent.name, [0.0, 0])
        account[1] += 1

    def asking(self, group: Group, places: Sequence[int], waiting: Sequence[Episode], observations: Any) -> None:
        """Decisions are going to be answered: see ``Watcher``."""
        for place, episode in zip(places, waiting, strict=True):
            agent: Any = episode.pending
            self.count(place, agent)

    def answered(self, group: Group, actions: list[Any], extras: Mapping[str, Any]) -> None:
        """They have been: see ``Watcher``."""

    def moved(self, episode: Episode) -> None:
        """An episode stands at its next decision, or is over: see ``Watcher``."""
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
        """What has come of an episode that is over.

        Raises:
            AgentError: An agent is called as the row of all agents is.
            BaseException: What a metric raises, or what makes one value of the returns.
        """
        accounts = self._books.pop(place, {})
        if TEAM in accounts:
            raise AgentError(f"an agent is called {TEAM!r}, which is what the row of all agents is called; rename it")
        returns = {name: float(account[0]) for name, account in accounts.items()}
        lengths = {name: account[1] for name, account in accounts.items()}
        team_value(self._team, returns)  # now, and not when all have been played: it may fail
        return Outcome(returns, lengths, {name: _plain(name, metric(simulation)) for name, metric in metrics.items()})


def _plain(name: str, value: Any) -> Any:
    """What a metric has returned, as a value of Python's own."""
    if isinstance(value, (np.generic, np.ndarray)) and value.ndim == 0:
        value = value.item()
    if value is not None and type(value) not in (bool, int, float, str):
        raise OptionValueError(f"the metric {name!r} must be a number, a string or None, not {shown(value)}")
    return value


def play(plan: Plan, seed: int, metrics: Metrics, team: Callable[[Returns], Any] | None = None) -> Outcome:
    """Play one episode, with policies of one decision at a time.

    Raises:
        BaseException: Whatever the model, a mapping, a policy, a metric or ``team`` raises.
    """
    tally = Tally(team)
    try:
        session = Session(plan)
    except BaseException as error:
        annotate(error, f"simenv_marl: while the simulation was made; seed {seed}")
        raise
    try:
        with outside_simulation():
            episode = session.start(seed, None, When.DECISION)
            own_random = plan.options.global_rng
            tally.moved(episode)
            while (agent := episode.pending) is not None:
                tally.count(0, agent)
                if agent.looks:
                    agent.consultations += 1
                try:
                    with episode.at_work() if own_random else nullcontext():
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
    """Play many episodes, with policies of many decisions at once.

    Args:
        plan: Of the episodes.
        seeds: What they are reset with.
        batch_size: How many may be suspended together.
        metrics: What is measured.
        told: Called with the place of a seed and what has come of it, as soon as that is known.
        team: What the returns of an episode make together; None: their sum.

    Raises:
        BaseException: Whatever a model, a mapping, a policy, a metric or ``team`` raises. What others came to was told
            before.
    """
    tally = Tally(team)

    def finish(place: int, simulation: Any) -> Callable[[], None]:
        return partial(told, place, tally.outcome(place, simulation, metrics))

    run(plan, seeds, batch_size, finish, tally)
