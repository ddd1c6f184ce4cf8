"""What each decision was worth: exact copies of an episode go on by a baseline."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from math import inf, isfinite, nan, sqrt
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self, Unpack

import numpy as np
from gymnasium import spaces

from ..core import (
    Action,
    Agent,
    Decision,
    Episode,
    EpisodeOptions,
    Labels,
    Model,
    Plan,
    Points,
    Policy,
    Session,
    Where,
    branch,
    duplicate,
    policy_for,
    reuse_resources,
    split_extras,
)
from ..data.collect import learners_plan
from ..data.plots import style
from ..envs.base import View
from ..errors import OptionValueError, close_after, short_repr, warn_user
from ..hooks.stacks import outside_simulation
from ..many.batch import policy_keys
from ..many.parallel import import_extra, progress_bar
from ..runs import checked_policies
from ..simulation import EVERYONE, RULE, check_count, is_number
from .plots import LOOKS
from .runner import Row, distinct_seeds, make_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure
    from pandas import DataFrame, Series

KEY: Final = 0x6C656467
"""Separates the seeds of futures and samples from others that follow from the episode's seed."""

LONG: Final = 300.0
"""The user is told beforehand if it will take more seconds than this."""

MARKED: Final = 10
"""The number of decisions that a plot marks."""

UNSTABLE: Final = 0.1
"""The share of decisions whose best action may change with the horizon without a warning."""

WORTH: Final = ("value", "contribution", "skill", "luck", "error")

COLUMNS: Final = ("seed", "number", "agent", "time", "decision", "action", "rule_action", *WORTH)

Metric = Callable[[Model], float] | None
"""A callable of the simulation, whose result takes the place of rewards."""


@dataclass(frozen=True, eq=False)
class Ledger:
    """What the decisions of episodes were worth. Made by ``ledger``.

    Attributes:
        frame: A ``DataFrame`` with a row for each decision. Columns: ``seed``; ``number``, the
            number of the decision in the episode, from 1; ``agent``; ``time``, nan without a clock;
            ``decision``, the label of the action; ``action``; ``rule_action``, the action of the
            baseline, None if it follows the rule, whose action is not known; ``value``, the return
            if the baseline had decided from here on (``after="policy"``: had decided this once),
            with ``futures`` its mean over them; ``contribution``; ``skill`` and ``luck``; and
            ``error``, the standard error of ``skill``, which is 0.0 without futures, where numbers
            are exact.
        points: The decision point of each row.
        returns: The return of the policies, by seed.
        after: As given to ``ledger``.
    """

    frame: DataFrame
    points: tuple[str, ...]
    returns: Series[float]
    after: str

    def __repr__(self) -> str:
        return f"<Ledger: {len(self.frame)} decisions on {len(self.returns)} seeds>"

    def summary(self) -> DataFrame:
        """Return the means over the seeds of the sums, by agent and decision point.

        Returns:
            A table indexed by ``agent`` and ``point``, with the columns ``decisions`` (their mean
            number), ``contribution``, ``skill`` and ``luck``.
        """
        names = list(WORTH[1:4])
        table = self.frame[["agent", *names]].astype(dict.fromkeys(names, float))
        table = table.assign(point=self.points, decisions=1.0)
        groups = table.groupby(["agent", "point"])[["decisions", *names]]
        return groups.sum(min_count=1) / len(self.returns)

    def plot(self, *, figure: Figure | SubFigure | None = None) -> Figure | SubFigure:
        """Draw the cumulated contributions of each seed, and name the ten largest.

        With ``after="policy"`` they do not add up, and are drawn one by one. ``figure`` and the
        result are as in ``plot_timeline``.
        """
        frame = self.frame
        along = "number" if frame["time"].isna().any() else "time"
        heights = frame["contribution"]
        if self.after == "rule":
            heights = heights.groupby(frame["seed"]).cumsum()
        with style(figure) as make_figure:
            figure = make_figure(9.0, 4.5)
            axes = figure.subplots()
            for _, rows in frame.groupby("seed"):
                axes.plot(rows[along], heights[rows.index], linewidth=1.2)
            axes.axhline(0.0, **LOOKS["zero"])
            marked = frame["contribution"].abs().astype(float).nlargest(MARKED).index
            for index, row in frame.loc[marked].iterrows():
                place = row[along], heights[index]
                text = f"{row['agent']}: {row['decision']} ({row['contribution']:+.3g})"
                axes.plot(*place, "o", color=LOOKS["zero"]["color"])
                axes.annotate(text, place, (6, 0), **LOOKS["number"])
            axes.set_xlabel(along if along == "time" else "number of the decision")
            added = "cumulated contributions" if self.after == "rule" else "contribution"
            axes.set_ylabel(added)
        return figure


def ledger(
    simulation: Model,
    policies: Mapping[Any, Any],
    *,
    seeds: Iterable[int],
    points: Points = None,
    baseline: Policy = RULE,
    after: str = "rule",
    futures: int = 0,
    metric: Metric = None,
    sample: float | None = None,
    method: str | None = None,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> Ledger:
    """Measure what each decision of the policies was worth.

    Episodes run by the policies. Before each decision that they answer, an exact copy of the
    episode goes on to its end by the baseline; its return is the value of the decision. The
    contribution of a decision is the value of the next one (after the last one, the return of the
    episode) less its own. So the contributions of a seed add up to the difference between the
    returns of the policies and of the baseline on that seed.

    The return is the sum of the rewards of all agents that the policies answer, or the total of
    ``team_reward=``, or the metric.

    With ``futures``, chance is separated. The chance ahead of each decision is drawn anew several
    times, alike for the chosen action and for the baseline's. ``skill`` is the mean return of the
    chosen action, after which the baseline decides, less that of the baseline; ``luck`` is the next
    value less the mean of the chosen action. The first value, all skill and all luck of a seed add
    up to its return. Without futures, both are nan. Where nothing is random (``deterministic = True``
    of the simulation), skill is the contribution.

    Each decision takes one branch to the end of the episode, and two more for each future.

    Args:
        simulation: As ``simulate`` takes it.
        policies: The policies, as ``simulate`` takes them.
        seeds: The seeds of the episodes, all different.
        points: As ``simulate`` takes them.
        baseline: ``RULE``, a policy, or policies by agent or point, which answer in place of the
            policies. Agents that they do not name follow their rule.
        after: "rule": in the copy, the baseline answers all further decisions. "policy": it answers
            this one, and then the policies go on. The contribution is then the return of the
            episode less that of the copy: the cost of this decision, as everything else was done.
            Such contributions do not add up. ``luck`` is then the return less the mean of the
            chosen action.
        futures: The number of futures for each decision.
        metric: A callable of the simulation at its end, in place of rewards. Larger is better.
        sample: The share of the decisions, drawn at random, that have rows. It is for screening:
            the sum over a sample does not estimate the sum over all.
        method: The method of branching, as ``branch`` takes it. "replay" is faster if a whole
            episode takes less than a few milliseconds.
        progress: Whether to show a progress bar, by ``tqdm``.
        **options: The options of ``evaluate``.

    Returns:
        The ledger.

    Raises:
        OptionValueError: An argument has an invalid value, or a policy that decides in copies waits
            or records, so that a fallback would answer there.
        BranchError: An episode cannot be copied, or with ``futures`` not be reseeded.
        MissingExtraError: pandas or tqdm is missing.
        BaseException: Any exception of the model, a mapping, a policy or the metric.
    """
    pandas = import_extra("pandas", "ledger")
    if after not in ("rule", "policy"):
        raise OptionValueError(f'after must be "rule" or "policy", not {short_repr(after)}')
    check_count(futures, "futures")
    if after == "policy":
        _check_in_copies(policies, "policies")
    accounts = _Accounts(simulation, policies, points, baseline, metric, sample, method, options)
    all_seeds = distinct_seeds(seeds)
    rows: list[Row] = []
    returns: dict[int, float] = {}
    with progress_bar(len(all_seeds), progress, "episode") as bar:
        for seed in all_seeds:
            own, returns[seed] = accounts.book(seed, after, futures, 0 if rows else len(all_seeds))
            rows += own
            bar.update()
    by_seed = pandas.Series(returns, name="return", dtype=float).rename_axis("seed")
    places = tuple(str(row["point"]) for row in rows)
    return Ledger(make_table(COLUMNS, rows), places, by_seed, after)


def decision_values(
    simulation: Model,
    policies: Mapping[Any, Any] | None = None,
    *,
    seeds: Iterable[int],
    points: Points = None,
    baseline: Policy = RULE,
    horizon: int | None = None,
    futures: int = 16,
    metric: Metric = None,
    describe: Callable[[Decision], str] | None = None,
    sample: float | None = None,
    method: str | None = None,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> DataFrame:
    """Measure the value of each legal action at each decision of episodes.

    It is the mean return of the deciding agent over futures in which the action is taken, and the
    baseline decides from then on.

    Args:
        simulation: As ``simulate`` takes it.
        policies: The policies that run the episodes, as ``simulate`` takes them. The decisions of
            other agents have no rows. None: all agents follow their rule, and have rows.
        seeds: The seeds of the episodes, all different.
        points: As ``simulate`` takes them.
        baseline: As ``ledger`` takes it.
        horizon: The number of the agent's decisions whose rewards count, including the action. With
            it, a warning tells if the best action is another one with twice the horizon, at more
            than a tenth of the decisions. None: up to the agent's end.
        futures: The number of futures, alike for all actions of a decision. 0, and a simulation
            that is ``deterministic``: the exact one.
        metric: A callable of the simulation at the horizon, or at the agent's end, in place of
            rewards.
        describe: A callable of the ``Decision`` that returns the prompt, such as
            ``simenv_marl.seats.describe``.
        sample: As ``ledger`` takes it.
        method: As ``ledger`` takes it.
        progress: As ``ledger`` takes it.
        **options: The options of ``evaluate``.

    Returns:
        A ``DataFrame`` with a row for each decision and legal action. Columns: ``seed``,
        ``number``, ``agent``, ``time``, ``action``, ``label``, ``value``, ``error`` (the standard
        error; 0.0 in the exact future), ``by_rule`` (whether the rule takes this action; None if
        its action is not known), and with ``describe`` the ``prompt``.

    Raises:
        OptionValueError: An argument has an invalid value, or an action space is not ``Discrete``.
        BaseException: Any other error of ``ledger``.
    """
    import_extra("pandas", "decision_values")
    check_count(futures, "futures")
    if horizon is not None:
        check_count(horizon, "horizon", 1)
    played = checked_policies(policies) or {EVERYONE: RULE}
    accounts = _Accounts(simulation, played, points, baseline, metric, sample, method, options)
    all_seeds = distinct_seeds(seeds)
    rows: list[Row] = []
    changes: list[bool] = []
    with progress_bar(len(all_seeds), progress, "episode") as bar:
        for seed in all_seeds:
            for own, changed in accounts.compare(seed, horizon or inf, futures, describe):
                rows += own
                changes.append(changed)
            bar.update()
    if sum(changes) > UNSTABLE * len(changes):
        warn_user(
            f"the best action changes between the horizons {horizon} and {2 * (horizon or 0)} at"
            f" {sum(changes)} of {len(changes)} decisions: values at this horizon do not tell which"
            " action is best; pass a longer horizon, or more futures"
        )
    columns = ["seed", "number", "agent", "time", "action", "label", "value", "error", "by_rule"]
    return make_table([*columns, *(["prompt"] if describe else [])], rows)


# -- who decides ----------------------------------------------------------------------------------


class _Stand(View):
    """The view of an episode that stands at a decision, for ``branch``."""

    @property
    def unwrapped(self) -> Self:
        """The view itself."""
        return self


class _Side:
    """The policies of a plan, which answer the decisions of an episode."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._by_point = {point.hook: point.policy for point in plan.points}

    def answer(self, episode: Episode) -> Action:
        """Answer the pending decision."""
        agent = _pending(episode)
        policy = self._policy_of(agent)
        if policy is RULE:
            return RULE
        try:
            with episode.context() if self._plan.options.global_rng else nullcontext():
                seen = duplicate(agent.raw_observation)
                answer = policy.answer(episode, agent, seen, agent.take_info())
        except BaseException as error:
            episode.annotate(error)
            raise
        action, _ = split_extras(answer, agent.point.definition.action_space)
        return action

    def pass_over(self, episode: Episode) -> None:
        """Let a policy for all agents begin a round although another side answers now."""
        if getattr(self._policy_of(_pending(episode)), "sees_all", False):
            self.answer(episode)

    def _policy_of(self, agent: Agent) -> Policy:
        plan = self._plan
        own = plan.policies.get(agent.name) or self._by_point.get(agent.point.hook)
        return own or plan.everyone or RULE


def _pending(episode: Episode) -> Agent:
    agent = episode.pending
    assert agent is not None
    return agent


def _check_in_copies(policies: object, name: str) -> None:
    """Refuse policies that are not asked in copies."""
    parts = policies.values() if isinstance(policies, Mapping) else [policies]
    for policy in parts:
        if policy is not RULE and policy_for(policy, "", Where.CLONE) is not policy:
            raise OptionValueError(
                f"{short_repr(policy)} in {name} waits or records its answers, and its fallback, or"
                " the rule, answers in copies of the episode; pass a policy that answers at once"
            )


# -- the engine -----------------------------------------------------------------------------------


class _End(NamedTuple):
    """The result of a copy.

    Attributes:
        value: The return at its end.
        near: The return at the horizon.
        action: The first action. That of the rule if it is known, else None.
        turns: The number of decisions of the episode.
    """

    value: float
    near: float
    action: Action
    turns: int


class _Accounts:
    """Runs episodes by policies, and copies of them by the baseline."""

    def __init__(
        self,
        simulation: Model,
        policies: Mapping[Any, Any],
        points: Points,
        baseline: Policy,
        metric: Metric,
        sample: float | None,
        method: str | None,
        options: EpisodeOptions,
    ) -> None:
        if metric is not None and not callable(metric):
            raise OptionValueError(
                f"metric must be a callable of the simulation, not {short_repr(metric)}"
            )
        if sample is not None and not (is_number(sample) and 0 < sample <= 1):
            raise OptionValueError(
                f"sample must be a share of the decisions, above 0 and up to 1, not"
                f" {short_repr(sample)}"
            )
        _check_in_copies(baseline, "baseline")
        plan = learners_plan(simulation, policies, points, options, alone=True)
        self._plan = replace(plan, has_planner=True)  # so that answers are kept for replays
        self._own = _Side(self._plan)
        named = baseline if isinstance(baseline, Mapping) else {EVERYONE: baseline}
        self._by_rule = baseline is RULE
        self._baseline = _Side(plan.amended({"policies": policy_keys(named, alone=True)}))
        self._metric = metric
        self._sample = 1.0 if sample is None else sample
        self._method = method

    @contextmanager
    def _standing(self, seed: int) -> Iterator[tuple[Episode, _Stand, np.random.Generator]]:
        """Begin an episode. Yield it, its view, and the generator of the sample."""
        with outside_simulation(), reuse_resources():
            session = Session(self._plan)
            try:
                episode = session.start(seed, None)
                yield episode, _Stand.of_session(session), np.random.default_rng([seed, KEY])
            except BaseException as error:
                close_after(error, session.close, "the simulation")
                raise
            session.close()

    def book(self, seed: int, after: str, futures: int, episodes: int) -> tuple[list[Row], float]:
        """Run an episode. Return the rows of its decisions, and its return.

        ``episodes``: the number of episodes in all, if the user must be told how long they take.
        """
        rows: list[Row] = []
        waiting: list[dict[str, Any]] = []  # rows that need the next value
        then = self._baseline if after == "rule" else self._own
        with self._standing(seed) as (episode, view, rng):
            is_fixed = getattr(episode.simulation, "deterministic", False) is True
            number = 0 if is_fixed else futures
            earned = _paid(episode)
            while episode.pending is not None:
                agent = episode.pending
                is_drawn = rng.random() < self._sample
                begun = perf_counter()
                copies = partial(self._copies, view, seed, then=then, earned=earned)
                row: dict[str, Any] = {}
                if is_drawn or (after == "rule" and waiting):
                    [exact] = copies(0, first=None)
                    if episodes:
                        branches = exact.turns * episodes * self._sample * (1 + 2 * number)
                        _warn_of_time(branches, branches * (perf_counter() - begun) / 2)
                        episodes = 0
                    ruled = _values(copies(number, first=None)) if number else [exact.value]
                    value = np.mean(ruled)
                    if after == "rule":
                        _settle(waiting, exact.value, value)
                    row = _heading(episode, agent) | {"value": value, "rule_action": exact.action}
                labels = agent.point.action_labels(agent.choices, *agent.arguments.recall())
                action = self._own.answer(episode)
                if is_drawn:
                    row["contribution"] = -exact.value
                    row["skill"], row["luck"], row["error"] = nan, nan, 0.0
                    if number:
                        chosen = _values(copies(number, first=action))
                        row["skill"] = np.mean(gains := np.subtract(chosen, ruled))
                        row["luck"] = -np.mean(chosen)
                        row["error"] = _error(gains)
                    taken = exact.action if action is RULE and self._by_rule else action
                    row["action"] = _plain(RULE if taken is None else taken)
                    row["decision"] = _words(row["action"], labels)
                    rows.append(row)
                    waiting.append(row)
                episode.step(action)
                earned += _paid(episode)
            total = self._return(episode, earned)
        _settle(waiting, total, total)
        for row in rows if is_fixed else ():
            row["skill"], row["luck"] = row["contribution"], 0.0
        return rows, total

    def compare(
        self,
        seed: int,
        horizon: float,
        futures: int,
        describe: Callable[[Decision], str] | None,
    ) -> Iterator[tuple[list[Row], bool]]:
        """Run an episode. Yield the rows of each decision, a row for each legal action.

        And whether another action is best at twice the horizon.
        """
        with self._standing(seed) as (episode, view, rng):
            is_fixed = getattr(episode.simulation, "deterministic", False) is True
            number = 0 if is_fixed else futures
            while episode.pending is not None:
                agent = episode.pending
                if rng.random() < self._sample:
                    told = agent.describe(episode.seed, episode.where)
                    copies = partial(self._copies, view, seed, then=self._baseline)
                    [by_rule] = copies(0, first=RULE, horizon=0)
                    heading = _heading(episode, agent)
                    if describe is not None:
                        heading["prompt"] = describe(told)
                    rows: list[Row] = []
                    later = []
                    for action in _legal(agent):
                        ends = copies(number, first=action, horizon=horizon)
                        near = [end.near for end in ends]
                        later.append(np.mean(_values(ends)))
                        known = by_rule.action
                        worth = {"value": np.mean(near), "error": _error(near) if number else 0.0}
                        chosen = {"action": action, "label": _words(action, told.action_labels)}
                        same = {"by_rule": None if known is None else bool(known == action)}
                        rows.append(heading | chosen | worth | same)
                    best = int(np.argmax([row["value"] for row in rows]))
                    yield rows, bool(later[best] < max(later))
                episode.step(self._own.answer(episode))

    # -- copies -----------------------------------------------------------------------------------

    def _copies(self, view: _Stand, seed: int, futures: int, **given: Any) -> list[_End]:
        """Let copies go on in futures that are drawn anew; 0: one exact copy."""
        seeds = None
        if futures:
            sequence = np.random.SeedSequence([seed, view.episode.turns, KEY])
            seeds = [int(number) for number in sequence.generate_state(futures)]
        go_on = partial(self._go_on, **given)
        return branch(view, go_on, max(1, futures), method=self._method, seeds=seeds)

    def _go_on(
        self,
        view: _Stand,
        number: int,
        *,
        first: Action,
        then: _Side,
        earned: float | None = None,
        horizon: float = inf,
    ) -> _End:
        """In a copy, take an action (None: that of the baseline), and go on by a side to the end.

        Args:
            view: The copy.
            number: Its number.
            first: The action.
            then: The side that answers from then on.
            earned: The return so far. None: the return of the agent from here on counts, up to
                twice the horizon.
            horizon: The number of its decisions.
        """
        episode: Any = view.session.episode
        agent = _pending(episode)
        action = self._baseline.answer(episode) if first is None else first
        if (first is None) is not (then is self._baseline):
            then.pass_over(episode)
        taken = action
        awaits = action is RULE  # until the rule's action is known
        total, near, decisions = earned or 0.0, None, 0
        is_alone = earned is None
        while True:
            episode.step(action)
            is_over = episode.pending is None or (is_alone and agent.ended)
            if not is_alone:
                total += _paid(episode)
            elif is_over or episode.pending is agent:
                total += agent.reward
                decisions += 1
            if awaits:
                taken = agent.take_rule_action()
                awaits = taken is None and episode.pending is not agent and not is_over
            if near is None and decisions >= horizon:
                near = self._return(episode, total, is_alone)
            if is_over or (decisions >= 2 * horizon and not awaits):
                value = self._return(episode, total, is_alone)
                return _End(value, value if near is None else near, _plain(taken), episode.turns)
            action = then.answer(episode)

    def _return(self, episode: Episode, earned: float, is_alone: bool = False) -> float:
        """Return the metric, or what the agents, or the team, have earned."""
        if self._metric is not None:
            value = self._metric(episode.simulation)
            if not is_number(value) or not isfinite(value):
                raise OptionValueError(
                    f"metric must return a finite number, not {short_repr(value)}"
                )
            return float(value)
        return earned if is_alone or episode.team is None else episode.team.total


def _paid(episode: Episode) -> float:
    """Return the rewards that the latest step has brought. Ended agents get theirs at the end."""
    if episode.pending is not None:
        return episode.pending.reward
    agents = (*episode.ended.values(), *episode.agents.values())
    return sum(agent.reward for agent in agents)


def _settle(waiting: list[dict[str, Any]], value: float, mean: float) -> None:
    """Add the next value to the rows that wait for it."""
    for row in waiting:
        row["contribution"] += value
        row["luck"] += mean
    waiting.clear()


def _warn_of_time(branches: float, seconds: float) -> None:
    """Tell beforehand that it takes long."""
    if seconds > LONG:
        warn_user(
            f"the ledger takes about {branches:.0f} branches, and {seconds / 60:.0f} minutes; fewer"
            ' seeds or futures, a sample=, or method="replay" for quick episodes, take less'
        )


# -- rows -----------------------------------------------------------------------------------------


def _heading(episode: Episode, agent: Agent) -> dict[str, Any]:
    """Return the first columns of the pending decision."""
    return {
        "seed": episode.seed,
        "number": episode.turns + 1,
        "agent": agent.name,
        "time": nan if agent.now is None else agent.now,
        "point": agent.point.hook.name,
    }


def _legal(agent: Agent) -> list[int]:
    """Return the legal actions of the pending decision."""
    space = agent.point.definition.action_space
    if not isinstance(space, spaces.Discrete):
        raise OptionValueError(
            f"the values of all actions need Discrete action spaces; that of {agent.name!r} is"
            f" {short_repr(space)}. Name other agents in policies=, or other points"
        )
    first = int(space.start)
    return [action for action in range(first, first + int(space.n)) if agent.allows(action)]


def _values(ends: Iterable[_End]) -> list[float]:
    return [end.value for end in ends]


def _error(sample: Sequence[float]) -> float:
    """Return the standard error of a mean; nan with fewer than two numbers."""
    return float(np.std(sample, ddof=1)) / sqrt(len(sample)) if len(sample) > 1 else nan


def _plain(action: Action) -> Action:
    """Return an action without NumPy's types."""
    return action.tolist() if hasattr(action, "tolist") else action


def _words(action: Action, labels: Labels) -> str:
    """Return an action in the words of its labels."""
    if action is RULE:
        return "the rule"
    if isinstance(labels, Mapping):
        parts = action if isinstance(action, Mapping) else None
        if parts is None:
            return labels.get(action, str(action))
        return ", ".join(f"{labels[key]}: {value}" for key, value in parts.items())
    numbers = np.ravel(action)
    if labels is None or len(labels) != len(numbers):
        return str(action)
    return ", ".join(f"{label}: {value:.4g}" for label, value in zip(labels, numbers, strict=True))
