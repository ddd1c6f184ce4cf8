"""What each decision was worth: exact copies of an episode go on by a baseline."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import inf, nan
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final
from warnings import catch_warnings

import numpy as np
from gymnasium.spaces import Discrete

from ..core import (
    Action,
    Decision,
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
from ..errors import OptionValueError, short_repr, warn_user
from ..many.batch import policy_keys
from ..many.parallel import import_extra
from ..simulation import EVERYONE, RULE, Model, check_count, is_deterministic, is_number
from .plots import LOOKS
from .runner import distinct_seeds, error_note, make_table

if TYPE_CHECKING:
    from pandas import DataFrame

KEY: Final = 0x6C656467
"""Separates the seeds of futures and samples from others that follow from the episode's seed."""

LONG: Final = 300.0
"""The user is told beforehand if it will take more seconds than this."""

FIRST: Final = ("seed", "number", "agent", "time")

WORTH: Final = ("contribution", "skill", "luck")

Metric = Callable[[Model], float] | None
"""A callable of the simulation, whose result takes the place of rewards."""

Row = dict[str, Any]
"""A row of a table, by column."""


@dataclass(frozen=True, eq=False)
class Ledger:
    """The worth of the decisions of episodes. Made by ``ledger``.

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
    points: list[str]
    returns: dict[int, float]
    after: str

    def summary(self) -> DataFrame:
        """Return the means over the seeds of the sums, by agent and decision point.

        Returns:
            A table indexed by ``agent`` and ``point``, with the columns ``decisions`` (their mean
            number), ``contribution``, ``skill`` and ``luck``.
        """
        table = self.frame.assign(point=self.points, decisions=1.0)
        sums = table.groupby(["agent", "point"])[["decisions", *WORTH]].sum(min_count=1)
        return sums / len(self.returns)

    def plot(self, *, figure: Any = None) -> Any:
        """Draw the cumulated contributions of each seed. Number and name the ten largest.

        With ``after="policy"`` they do not add up, and are drawn one by one. ``figure`` and the
        result are as in ``plot_timeline``.
        """
        table = self.frame
        along = "number" if table["time"].isna().any() else "time"
        worth = table.groupby("seed")["contribution"]
        heights = worth.cumsum() if self.after == "rule" else table["contribution"]
        with style(figure) as make_figure:
            figure = make_figure(10.0, 4.2)
            axes = figure.subplots()
            axes.set(xlabel=along, ylabel="contributions")
            axes.axhline(0.0, **LOOKS["zero"])
            for rows in worth.groups.values():
                axes.plot(table[along][rows], heights[rows])
            largest = table["contribution"].abs().nlargest(10).index
            for number, row in enumerate(largest, 1):
                text = "{agent}: {decision} ({contribution:+.3g})".format(**table.loc[row])
                place = table[along][row], heights[row]
                axes.plot(*place, "k", marker=f"${number}$", markersize=9, ls="", label=text)
            if len(largest):
                axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
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
    **options: Any,
) -> Ledger:
    """Measure the worth of each decision of the policies.

    Episodes run by the policies. At each decision that they answer, an exact copy of the episode
    goes on to its end by the baseline; its return is the value of the decision. The contribution of
    a decision is the value of the next one (after the last one, the return of the episode) less its
    own. So the contributions of a seed add up to the difference between the returns of the policies
    and of the baseline on that seed.

    The return is the sum of the rewards of all agents that the policies answer, or the total of
    ``team_reward=``, or the metric.

    With ``futures``, chance is separated. The chance ahead of each decision is drawn anew several
    times, alike for the chosen action and for the baseline's. ``skill`` is the mean return of the
    chosen action, after which the baseline decides, less that of the baseline; ``luck`` is the next
    value less the mean of the chosen action. The first value, all skill and all luck of a seed add
    up to its return; contributions are those of the exact copies all the same. Without futures,
    skill and luck are nan. If nothing is random (``deterministic = True`` of the simulation), there
    is one future, and skill is the contribution.

    Each decision takes one branch to the end of the episode, and two more for each future.

    Args:
        simulation: As ``simulate`` takes it.
        policies: The policies, as ``simulate`` takes them.
        seeds: The seeds of the episodes, all different.
        points: As ``simulate`` takes them.
        baseline: ``RULE``, a policy, or policies as ``simulate`` takes them, which answer in place
            of the policies. Agents that it does not name follow their rule.
        after: "rule": in the copy, the baseline answers all further decisions. "policy": it answers
            this one, and then the policies go on. The contribution is then the return of the
            episode less that of the copy: the worth of this decision among all the others. Such
            contributions do not add up. ``luck`` is then the return less the mean of the chosen
            action.
        futures: The number of futures for each decision.
        metric: A callable of the simulation at its end, in place of rewards. Larger is better.
        sample: The share of the decisions, drawn at random, that have rows. It is for screening:
            the sum over a sample does not estimate the sum over all.
        method: The method of branching, as ``branch`` takes it. "replay" is faster if a whole
            episode takes less than a few milliseconds.
        **options: The options of ``evaluate``.

    Returns:
        The ledger.

    Raises:
        OptionValueError: An argument has an invalid value, or a policy that decides in copies waits
            or records, so that a fallback would answer there.
        BranchError: An episode cannot be copied, or with ``futures`` not be reseeded.
        MissingExtraError: pandas is missing.
        BaseException: Any exception of the model, a mapping, a policy or the metric.
    """
    adds_up = after == "rule"
    if not adds_up:
        if after != "policy":
            raise OptionValueError(f'after must be "rule" or "policy", not {short_repr(after)}')
        _check_in_copies(policies)
    plan = learners_plan(simulation, policies, points, options, alone=True)
    copies = _Copies(plan, baseline, adds_up, futures, metric, sample, method)
    rows: list[Row] = []
    own: list[Row] = []  # of the present episode; values are also needed after each drawn decision
    returns: dict[int, float] = {}
    all_seeds = distinct_seeds(seeds)
    with closing(copies.run(all_seeds)) as stands:
        for stand, action, is_drawn in stands:
            agent = stand.episode.pending
            if agent is None:
                returns[stand.episode.seed] = total = stand.earned
                own.append({"exact": total, "value": total})
                for row, following in pairwise(own):
                    later = following if adds_up else own[-1]
                    row["contribution"] = later["exact"] - row["exact"]
                    row["luck"] = later["value"] - row["chosen"]
                    if copies.futures is None:
                        row |= {"skill": row["contribution"], "luck": 0.0}
                rows += [row for row in own if row.get("is_drawn")]
                own = []
            elif is_drawn or (adds_up and own and own[-1]["is_drawn"]):
                begun = perf_counter()
                [exact], _, known, turns = copies.ahead(stand, None)
                seconds = (perf_counter() - begun) / 2 * turns * len(all_seeds) * (1 + 2 * futures)
                if not (own or returns) and seconds * copies.share > LONG:
                    warn_user(
                        f"the ledger takes about {seconds * copies.share / 60:.0f} minutes; pass"
                        " fewer seeds or futures, a sample=, or, for quick episodes,"
                        ' method="replay"'
                    )
                ruled, chosen = np.array([exact]), np.array([nan])
                if copies.futures:
                    ruled = copies.ahead(stand, None, copies.futures)[0]
                    chosen = copies.ahead(stand, action, copies.futures)[0]
                if action is RULE and baseline is RULE and known is not None:
                    action = known
                action = _plain(action)
                labels = agent.point.action_labels(agent.choices, *agent.arguments.recall())
                row = stand.heading | {
                    "decision": _words(action, labels),
                    "action": action,
                    "rule_action": known,
                    "value": ruled.mean(),
                    "chosen": chosen.mean(),
                    "skill": (chosen - ruled).mean(),
                    "error": _error(chosen - ruled) if copies.futures else 0.0,
                    "exact": exact,
                    "point": agent.point.hook.name,
                    "is_drawn": is_drawn,
                }
                own.append(row)
    columns = ["decision", "action", "rule_action", "value", *WORTH, "error"]
    numbers = dict.fromkeys(("time", "value", *WORTH, "error"), float)
    frame = make_table([*FIRST, *columns], rows).astype(numbers)
    return Ledger(frame, [row["point"] for row in rows], returns, after)


def decision_values(
    simulation: Model,
    policies: Mapping[Any, Any] | None = None,
    *,
    seeds: Iterable[int],
    points: Points = None,
    horizon: int | None = None,
    futures: int = 16,
    metric: Metric = None,
    describe: Callable[[Decision], str] | None = None,
    sample: float | None = None,
    method: str | None = None,
    **options: Any,
) -> DataFrame:
    """Measure the value of each legal action at each decision of episodes.

    It is the mean return of the deciding agent over futures in which the action is taken, and the
    rules of all agents decide from then on.

    Args:
        simulation: As ``simulate`` takes it.
        policies: The policies that run the episodes, as ``simulate`` takes them. The decisions of
            other agents have no rows. None: all agents follow their rule, and have rows.
        seeds: The seeds of the episodes, all different.
        points: As ``simulate`` takes them.
        horizon: The number of the agent's decisions whose rewards count, including the action. With
            it, a warning tells if the best action is not the best with twice the horizon, at more
            than a tenth of the decisions. None: up to the agent's end.
        futures: The number of futures, alike for all actions of a decision. 0, and a simulation
            that is ``deterministic``: the exact one.
        metric: A callable of the simulation at the horizon, or at the agent's end, in place of
            rewards.
        describe: A callable of the ``Decision`` that returns the prompt, such as
            ``simenv_marl.seats.describe``.
        sample: As ``ledger`` takes it.
        method: As ``ledger`` takes it.
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
    if horizon is not None:
        check_count(horizon, "horizon", 1)
    plan = learners_plan(simulation, policies or {EVERYONE: RULE}, points, options, alone=True)
    copies = _Copies(plan, RULE, True, futures, metric, sample, method, horizon or inf)
    rows: list[Row] = []
    changes: list[bool] = []
    with closing(copies.run(distinct_seeds(seeds))) as stands:
        for stand, _, is_drawn in stands:
            agent = stand.episode.pending
            if agent is None or not is_drawn:
                continue
            decision = agent.describe(stand.episode.seed, Where.USER)
            labels: Any = decision.action_labels
            if not isinstance(decision.action_space, Discrete):
                raise OptionValueError(
                    f"the values of all actions need Discrete action spaces; {agent.name!r} has"
                    f" {short_repr(decision.action_space)}. Name other agents in policies=, or"
                    " other points"
                )
            heading = stand.heading
            if describe:
                heading["prompt"] = describe(decision)
            *_, known, _ = copies.ahead(stand, RULE)
            means = []
            for action, label in labels.items():
                if agent.allows(action):
                    near, far, *_ = copies.ahead(stand, action, copies.futures)
                    means.append((near.mean(), far.mean()))
                    row = heading | {"action": action, "label": label, "value": near.mean()}
                    row["error"] = _error(near) if copies.futures else 0.0
                    row["by_rule"] = None if known is None else known == action
                    rows.append(row)
            changes.append(max(means)[1] < max(later for _, later in means))
    if 10 * sum(changes) > len(changes):
        warn_user(
            f"the best action changes between the horizons {horizon} and {2 * (horizon or 0)} at"
            f" {sum(changes)} of {len(changes)} decisions: values at this horizon do not tell which"
            " action is best; pass a longer horizon, or more futures"
        )
    columns = [*FIRST, "action", "label", "value", "error", "by_rule", "prompt"]
    return make_table(columns if describe else columns[:-1], rows).astype({"time": float})


# -- the engine -----------------------------------------------------------------------------------


class _Stand(View):
    """The view of an episode that stands at a decision, for ``branch``.

    Attributes:
        earned: The return of the episode so far.
    """

    earned = 0.0

    @property
    def unwrapped(self) -> View:
        """The view itself."""
        return self

    @property
    def heading(self) -> Row:
        """The first columns of the pending decision."""
        episode: Any = self.episode
        agent = episode.pending
        row = episode.seed, episode.turns + 1, agent.name, agent.now
        return dict(zip(FIRST, row, strict=True))


@dataclass
class _Copies:
    """Runs the episodes of a plan, and copies of them.

    Attributes:
        plan: The plan of the policies.
        baseline: The baseline.
        adds_up: Whether the baseline goes on in copies, and not the policies.
        futures: The number of futures. None: there is one, because nothing is random.
        metric: The metric.
        sample: The share of the decisions that are drawn. None: all.
        method: The method of branching.
        horizon: The number of decisions of the agent after which its own return is read. None: the
            return of the episode is read at its end.
    """

    plan: Plan
    baseline: Any
    adds_up: bool
    futures: int | None
    metric: Metric
    sample: float | None
    method: str | None
    horizon: float | None = None

    def __post_init__(self) -> None:
        import_extra("pandas", "a ledger")
        check_count(self.futures, "futures")
        if not isinstance(self.baseline, Mapping):
            self.baseline = {EVERYONE: self.baseline}
        _check_in_copies(self.baseline)
        self.ruled = self.plan.amended({"policies": policy_keys(self.baseline, alone=True)})
        if not (self.metric is None or callable(self.metric)):
            raise OptionValueError(
                f"metric must be a callable of the simulation, not {short_repr(self.metric)}"
            )
        self.share = 1.0 if self.sample is None else self.sample
        if not (is_number(self.share) and 0 < self.share <= 1):
            raise OptionValueError(
                "sample must be a share of the decisions, above 0 and up to 1, not"
                f" {short_repr(self.sample)}"
            )

    def run(self, seeds: list[int]) -> Generator[tuple[_Stand, Action, bool]]:
        """Run episodes by the policies.

        Yield each decision before its answer moves the simulation: the view, the answer, and
        whether the decision is drawn. At the end of an episode, yield the view once more.
        """
        plan = replace(self.plan, has_planner=True)  # so that answers are kept for replays
        for seed in seeds:
            rng = np.random.default_rng([seed, KEY])
            with (
                error_note(f"in the episode of seed {seed}"),
                reuse_resources(),
                closing(Session(plan)) as session,
            ):
                episode: Any = session.start(seed, None)
                if is_deterministic(episode.simulation):
                    self.futures = None
                stand = _Stand.of_session(session)
                stand.earned = _paid(episode)
                while episode.pending:
                    action = _answer(episode, plan)
                    yield stand, action, rng.random() < self.share
                    episode.step(action)
                    stand.earned += _paid(episode)
                stand.earned = self._read(episode, stand.earned)
                yield stand, RULE, False

    def ahead(self, stand: _Stand, first: Action, futures: int | None = None) -> tuple[Any, ...]:
        """Let copies go on to the end, or to twice the horizon.

        Args:
            stand: The view.
            first: The first action. None: that of the baseline.
            futures: The number of copies, whose chance is drawn anew. None, 0: one exact copy.

        Returns:
            The return of each copy at the horizon, and at the end. The first action, None if it is
            the rule's and not known. The number of decisions of the episode.
        """
        seeds = None
        if futures:
            sequence = np.random.SeedSequence([stand.episode.seed, stand.episode.turns, KEY])
            seeds = sequence.generate_state(futures).tolist()
        go_on = partial(self._go_on, first=first)
        with catch_warnings(action="ignore"):  # because the episode itself warns of the same
            ends = branch(stand, go_on, futures or 1, method=self.method, seeds=seeds)
        near, far, (known, *_), (turns, *_) = zip(*ends, strict=True)
        return np.array(near), np.array(far), known, turns

    def _go_on(self, stand: _Stand, number: int, *, first: Action) -> tuple[Any, ...]:
        """In a copy, take the first action, and go on."""
        episode: Any = stand.episode
        agent = episode.pending
        # Also if another action is taken, because its answer may begin a round of all agents.
        action = _answer(episode, self.ruled)
        if first is not None:
            action = first
        known = action
        is_awaited = action is RULE  # until the rule's action is known
        horizon = self.horizon
        earned = stand.earned if horizon is None else 0.0
        values: list[float] = []
        decisions = 0
        while True:
            episode.step(action)
            is_last = not episode.pending
            if horizon is None:
                earned += _paid(episode)
            elif is_last or agent.ended or episode.pending is agent:
                earned += agent.reward
                decisions += 1
                is_last |= agent.ended or decisions >= 2 * horizon
            if is_awaited:
                known = agent.take_rule_action()
                is_awaited = known is None and episode.pending is not agent
            if is_last or decisions == horizon:
                values.append(self._read(episode, earned))
            if is_last:
                return values[0], values[-1], _plain(known), episode.turns
            action = _answer(episode, self.ruled if self.adds_up else self.plan)

    def _read(self, episode: Any, earned: float) -> float:
        """Return the metric, or the rewards of the agent, the agents or the team."""
        if self.metric is None:
            return earned if self.horizon or not episode.team else float(episode.team.total)
        value = self.metric(episode.simulation)
        if not is_number(value):
            raise OptionValueError(f"metric must return a number, not {short_repr(value)}")
        return float(value)


def _answer(episode: Any, plan: Plan) -> Action:
    """Answer the pending decision by the policies of a plan."""
    agent = episode.pending
    by_point = {point.hook: point.policy for point in plan.points}
    policy: Any = plan.policies.get(agent.name) or by_point.get(agent.point.hook) or RULE
    if policy is RULE:
        return RULE
    with episode.context():
        seen = duplicate(agent.raw_observation), duplicate(agent.info)
        answer = policy.answer(episode, agent, *seen)
    return split_extras(answer, agent.point.definition.action_space)[0]


def _paid(episode: Any) -> float:
    """Return the rewards that the latest step has brought. Ended agents get theirs at the end."""
    if episode.pending:
        return float(episode.pending.reward)
    agents = (*episode.ended.values(), *episode.agents.values())
    return float(sum(agent.reward for agent in agents if agent.asked))  # as evaluate counts


def _check_in_copies(policies: Mapping[Any, Any]) -> None:
    """Refuse policies that do not decide in copies."""
    for policy in policies.values():
        is_policy = policy is RULE or callable(policy)
        if not is_policy or policy_for(policy, "", Where.CLONE) is not policy:
            raise OptionValueError(
                f"{short_repr(policy)} cannot decide in copies of an episode: it is no policy, or"
                " it waits or records its answers, so that its fallback would decide; pass RULE, or"
                " a policy that answers at once"
            )


# -- rows -----------------------------------------------------------------------------------------


def _error(sample: Any) -> float:
    """Return the standard error of a mean; nan with fewer than two numbers."""
    return float(sample.std(ddof=1) / len(sample) ** 0.5) if len(sample) > 1 else nan


def _plain(action: Action) -> Action:
    """Return an action without NumPy's types."""
    return action.tolist() if hasattr(action, "tolist") else action


def _words(action: Action, labels: Any) -> str:
    """Return a plain action in the words of labels."""
    if action is RULE:
        return "the rule"
    if isinstance(action, int) and labels:
        return str(labels.get(action))
    if not isinstance(action, list) or not labels:
        return str(action)
    parts = zip(labels, action, strict=False)
    return ", ".join(f"{label}: {part:.4g}" for label, part in parts)
