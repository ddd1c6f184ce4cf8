"""The values of candidate actions for a pending decision, from rollouts in branches.

Policies that decide by them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import ceil, log2
from typing import Any, Final
from zlib import crc32

import numpy as np

from ..core import AskingPolicy, Where, branch, checked_seed, pending_view
from ..errors import BranchError, OptionValueError, short_repr, warn_user
from ..many.parallel import progress_bar
from ..simulation import RULE
from .player import Outcome, is_count, is_number, player_of, try_out
from .values import ActionValues, correlation_of, warn_of_futures, warn_of_times

# separates the seeds of futures from others that are derived from the episode's seed
_KEY: Final = 0x706C616E

_FRESH: Final = 8
"""The least number of fresh futures in which a candidate is compared with the rule."""

Plan = tuple[int, ...]
"""The places of the candidates to take at the agent's next decisions, beginning with the pending one."""


def action_values(
    env: Any,
    actions: Any = None,
    *,
    base: Any = RULE,
    futures: int = 16,
    horizon: float | None = None,
    horizon_by: str = "decision",
    terminal_value: Callable[[Any], float] | None = None,
    discount: float = 1.0,
    discount_by: str = "decision",
    seed: int | None = None,
    method: str | None = None,
    time_limit: float = 600.0,
    progress: bool = False,
) -> ActionValues:
    """Estimate the value of each candidate action of the pending decision by trying it in branches.

    In a branch the action is taken, and the agent's base decides from then on, up to the horizon or
    the agent's end. All candidates meet the same futures. ``env`` itself does not move.

    Args:
        env: An environment of one simulation with a pending decision, in any view, with or without
            wrappers. In the parallel view, the agent is the one that is ``"deciding"``, and the
            others play the same rounds. In the joint view, it is the one agent that stands for all.
        actions: The candidates; ``RULE`` may be among them. None: all legal actions of a
            ``Discrete``.
        base: What decides after the candidate: ``RULE``, a policy of the agent (a callable of the
            observation, or of the observation and the info), or a dict of these by agent. Other
            agents of the environment follow their entry in the dict, else their rule. Agents in the
            option ``policies`` keep their policies.
        futures: The number of futures in which each candidate is tried.
        horizon: The number of the agent's decisions whose rewards count, including the candidate.
            With ``horizon_by="time"``: a duration; rewards count up to the agent's first decision
            after at least that time. None: up to the agent's end.
        horizon_by: The unit of the horizon: "decision", or "time" for the simulation's time.
        terminal_value: The value of what comes after the horizon: a callable of the environment. It
            is called in the branch if the agent still lives at the horizon.
        discount: The discount factor, from 0 to 1.
        discount_by: The unit of discounting: "decision" for each decision of the agent before the
            rewarded one, or "time" for each unit of the simulation's time between the candidate and
            the rewarded decision.
        seed: A number that distinguishes the futures from others of the same decision. None: the
            futures that follow from the seed of the episode and the number of the decision.
        method: The method of branching, as ``branch`` takes it.
        time_limit: The time after which a branch is ended, in seconds.
        progress: Whether to show a progress bar, by ``tqdm``.

    Returns:
        The values. If the simulation has no ``reseed`` and the environment was not made with
        ``global_rng=True``, there is only the one exact future, and a warning says so.

    Raises:
        ViewError: ``env`` is not an environment of one simulation.
        ResetNeededError: No decision is pending.
        InvalidActionError: A candidate is not legal.
        UnknownAgentError: The base names an agent that does not exist.
        OptionValueError: An argument has an invalid value.
        BranchError: A branch died, took too long, or cannot be made.
        BaseException: Any exception of the model, a mapping or the base in a branch.
    """
    policy = RolloutPolicy(
        actions, base=base, futures=futures, horizon=horizon, horizon_by=horizon_by, terminal_value=terminal_value,
        discount=discount, discount_by=discount_by, seed=seed, method=method, time_limit=time_limit,
    )  # fmt: skip
    if _is_planned(env):
        return base_value(env, base)
    rollouts = Rollouts(env, policy)
    candidates = range(len(rollouts.actions))
    with progress_bar(len(candidates) * futures, progress, "branch") as bar:
        for number in [1] * futures if progress else [futures]:
            rollouts.add(candidates, number)
            bar.update(number * len(candidates))
    return rollouts.values(candidates)


def _is_planned(env: Any) -> bool:
    """Return whether a planner already tries a candidate in this environment."""
    return pending_view(env, "planning").episode.where is Where.PLAN


def base_value(env: Any, base: Any) -> ActionValues:
    """Return the base's answer as the best action, without rollouts.

    In branches, planners act as their bases.
    """
    action, unknown = player_of(env, base).decide(), np.full(1, np.nan)
    return ActionValues(
        (action,), unknown, unknown, np.zeros(1, np.int64), action, np.zeros((1, 0)), np.nan
    )


class Rollouts:
    """The rollouts of the candidates for a pending decision.

    Future number i is the same for all candidates.
    """

    def __init__(self, env: Any, policy: RolloutPolicy, *, planner: bool = False) -> None:
        """Check the candidates and the base of a policy.

        For a ``planner``, leave out masked ones, and add ``RULE``.
        """
        self.env, self._policy = env, policy
        player = player_of(env, policy.base)
        player.check_base()
        if policy.timed and player.episode.clock is None:
            raise OptionValueError(
                'discount_by="time" and horizon_by="time" need a simulation with a method time()'
            )
        self.actions = player.candidates(policy.actions, legal=planner)
        self.added = (
            planner and len(self.actions) > 1 and not any(action is RULE for action in self.actions)
        )
        if self.added:
            self.actions.append(RULE)
        self.returns: list[list[float]] = [[] for _ in self.actions]
        self.outcomes: dict[Plan, list[Any]] = {}  # what was seen in the futures of each plan
        self.states: Any = None  # those that are kept, if a search keeps some: see ``tree``
        self.seconds = 0.0  # for a step
        # the simulation's times between decisions, in each rollout
        self._times: list[list[float]] = []
        consulted = isinstance(player.record.policy, AskingPolicy)
        number = player.record.answered if consulted else player.episode.turns
        decision = [player.episode.seed, number, crc32(player.agent.encode(errors="surrogatepass"))]
        self._entropy = [*decision, _KEY, *(() if policy.seed is None else (policy.seed,))]
        self._name = player.view.session.plan.name
        try:
            player.view.session.check_reseed()
            self.reseeds = True
        except BranchError:
            self.reseeds = False
            warn_user(
                f"{self._name} cannot draw new random numbers in a branch: the planner tries all"
                " candidates on the one future that will happen, and so foresees chance. Give it a"
                " method reseed(seed), empty if nothing is random, or set global_rng=True if it"
                " draws from random or numpy.random"
            )

    def seeds(self, number: int) -> list[int]:
        """Return the seeds of the first futures."""
        return [int(word) for word in np.random.SeedSequence(self._entropy).generate_state(number)]

    def add(self, candidates: Iterable[int], number: int) -> None:
        """Try candidates, given by their places, in some more futures.

        At most in one if there is only one.
        """
        rollouts = [
            ((place,), future)
            for place in candidates
            for future in range(len(self.returns[place]), len(self.returns[place]) + number)
            if self.reseeds or future == 0
        ]
        self.run(rollouts)

    def run(self, rollouts: Sequence[tuple[Plan, int]]) -> list[list[float]]:
        """Run rollouts, given by their plans and the numbers of their futures.

        Note and return the rewards of each.
        """
        outcomes = self._outcomes_of(rollouts)
        for (plan, _), outcome in zip(rollouts, outcomes, strict=True):
            self.returns[plan[0]].append(sum(outcome.rewards))
            self.outcomes.setdefault(plan, []).append((outcome.rewards, outcome.seen))
            self._times.append(outcome.times)
            self.seconds = max(self.seconds, outcome.seconds)
        return [outcome.rewards for outcome in outcomes]

    def _outcomes_of(self, rollouts: Sequence[tuple[Plan, int]]) -> list[Outcome]:
        policy, seeds = self._policy, None
        if self.states is not None:
            kept: list[Outcome] = self.states.run([plan for plan, _ in rollouts])
            return kept
        if self.reseeds:
            numbers = self.seeds(1 + max((future for _, future in rollouts), default=0))
            seeds = [numbers[future] for _, future in rollouts]
        tries = [([self.actions[place] for place in plan], future) for plan, future in rollouts]
        return branch(
            self.env, partial(try_out, tries=tries, policy=policy), len(tries), method=policy.method, seeds=seeds,
            time_limit=policy.time_limit,
        )  # fmt: skip

    def is_better_than_rule(self, plan: Plan) -> bool:
        """Return whether a plan brings more than the rule, on fresh futures, which have not selected it."""
        rule = next(place for place, action in enumerate(self.actions) if action is RULE)
        if plan[0] == rule:
            return False
        if not self.reseeds:
            return self.certain(plan) > self.certain((rule,))
        begin = max(map(len, self.returns))
        futures = range(begin, begin + max(_FRESH, self._policy.futures))
        outcomes = self._outcomes_of(
            [(tried, future) for tried in (plan, (rule,)) for future in futures]
        )
        returns = np.array([sum(outcome.rewards) for outcome in outcomes]).reshape(2, -1)
        gains = returns[0] - returns[1]
        return bool(gains.mean() > self._policy.margin * gains.std(ddof=1) / np.sqrt(len(gains)))

    def certain(self, plan: Plan) -> float:
        """Return what a plan has brought in the one exact future."""
        return float(sum(self.outcomes[plan][0][0]))

    def values(self, finalists: Sequence[int]) -> ActionValues:
        """Estimate the values.

        The best candidate is one of the finalists, which are given by their places.
        """
        counts = np.array([len(values) for values in self.returns], np.int64)
        returns = np.full((len(counts), counts.max()), np.nan)
        means, errors = np.full((2, len(counts)), np.nan)
        for place, values in enumerate(self.returns):
            returns[place, : len(values)] = values
            if values:
                means[place] = np.mean(values)
            if len(values) > 1:
                errors[place] = np.std(values, ddof=1) / np.sqrt(len(values))
        best = max(finalists, key=lambda place: -np.inf if np.isnan(means[place]) else means[place])
        if self.reseeds:
            warn_of_futures(self._name, self.outcomes.values(), returns)
        if self._policy.horizon is not None and self._policy.horizon_by == "decision":
            warn_of_times(self._name, self._times)
        correlation = correlation_of(returns)
        return ActionValues(
            tuple(self.actions), means, errors, counts, self.actions[best], returns, correlation
        )


# -- policies -------------------------------------------------------------------------------------


@dataclass(kw_only=True, eq=False, repr=False)
class RolloutPolicy:
    """A policy that looks one decision ahead: it tries candidate actions in branches and takes the best one.

    It uses sequential halving (Karnin, Koren and Somekh, 2013). The budget is divided among rounds.
    In each round, all remaining candidates are tried on the same futures, and the better half of
    them remains.

    ``RULE`` is always a candidate. Another one is taken only if its paired advantage over ``RULE``,
    on at least eight fresh futures, exceeds ``margin`` standard errors. Where there is one exact
    future, any gain is taken.

    The policy can be used like any policy that answers one decision at a time; it gets the
    environment as ``_environment``. In a branch of a planner it acts as its own base.

    Its attributes are its arguments. ``action_values`` describes those that are not described here.

    Attributes:
        actions: The candidates. Candidates that are masked at a decision are left out there. None:
            all legal actions of a ``Discrete``.
        budget: The number of branches per decision. None: the number of candidates times
            ``futures``. The comparison with the rule comes on top.
        margin: By how many standard errors a candidate must be better than ``RULE`` to be taken.
        futures: The mean number of futures per candidate, if there is no ``budget``.
        seed: A number that distinguishes the futures from those of another planner.

    Raises:
        OptionValueError: An argument has an invalid value.
    """

    actions: Any = field(default=None, kw_only=False)
    base: Any = RULE
    futures: int = 16
    horizon: float | None = None
    horizon_by: str = "decision"
    terminal_value: Callable[[Any], float] | None = None
    discount: float = 1.0
    discount_by: str = "decision"
    seed: int | None = None
    method: str | None = None
    time_limit: float = 600.0
    budget: int | None = None
    margin: float = 1.0

    def __post_init__(self) -> None:
        self.timed = "time" in (self.discount_by, self.horizon_by)
        for name in ("horizon_by", "discount_by"):
            self.require(name, getattr(self, name) in ("decision", "time"), '"decision" or "time"')
        self.require("futures", is_count(self.futures), "a positive integer")
        horizon: Any = self.horizon
        if self.horizon_by == "time":
            fine, kind = is_number(horizon) and horizon > 0, "a positive time or None"
        else:
            fine, kind = is_count(horizon), "a number of decisions, 1 or more, or None"
        self.require("horizon", horizon is None or fine, kind)
        self.require(
            "discount", is_number(self.discount) and 0 <= self.discount <= 1, "a number from 0 to 1"
        )
        fine = self.terminal_value is None or callable(self.terminal_value)
        self.require("terminal_value", fine, "a callable of the environment")
        self.seed = checked_seed(self.seed)
        self.require(
            "margin", is_number(self.margin) and self.margin >= 0, "a number that is not negative"
        )
        self.require(
            "budget", self.budget is None or is_count(self.budget), "a number of branches or None"
        )
        if isinstance(self.actions, Iterable) and not isinstance(self.actions, (str, Mapping)):
            self.actions = list(self.actions)  # an iterator would be used up by the first decision

    def require(self, name: str, fine: bool, kind: str) -> None:
        """Refuse the value of an option unless it is fine."""
        if not fine:
            raise OptionValueError(f"{name} must be {kind}, not {short_repr(getattr(self, name))}")

    def choose(self, env: Any) -> ActionValues:
        """Find the best candidate for the pending decision of an environment.

        Args:
            env: The environment, as ``action_values`` takes it. It does not move.

        Returns:
            The values. ``best`` is ``RULE`` or a candidate of the last round. A single candidate is
            not tried.

        Raises:
            OptionValueError: The budget is too small to try each candidate.
            BaseException: As ``action_values``.
        """
        if _is_planned(env):
            return base_value(env, self.base)
        rollouts = Rollouts(env, self, planner=True)
        number = len(rollouts.actions)
        budget = number * self.futures if self.budget is None else self.budget
        if budget < number:
            raise OptionValueError(
                f"a budget of {budget} branches is too small to try {number} candidates once"
            )
        if number == 1:
            return rollouts.values([0])
        finalists = self._search(rollouts, budget)
        values = rollouts.values([plan[0] for plan in finalists])
        plan = next(plan for plan in finalists if rollouts.actions[plan[0]] is values.best)
        return values if rollouts.is_better_than_rule(plan) else replace(values, best=RULE)

    def _search(self, rollouts: Rollouts, budget: int) -> list[Plan]:
        """Try candidates; return the plans that are left."""
        left: Sequence[int] = range(len(rollouts.actions))
        for rounds in range(ceil(log2(len(left))), 0, -1):
            more = min(max(1, budget // (len(left) * rounds)), budget // len(left))
            budget -= more * len(left)
            rollouts.add(left, more)
            if rounds > 1:
                means = [np.mean(rollouts.returns[place]) for place in left]
                better = np.argsort(-np.array(means), kind="stable")[: (len(left) + 1) // 2]
                left = [left[place] for place in sorted(better.tolist())]
        return [(place,) for place in left]

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        """Answer a decision, as policies do, with the best action.

        Within a branch, with the answer of the base.
        """
        return self.choose(_environment).best
