"""The values of candidate actions for a pending decision, from rollouts in branches.

Policies that decide by these values.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, product
from math import ceil, inf, isfinite, log2
from numbers import Real
from time import perf_counter
from typing import Any, ClassVar, Final, TypeAlias, TypeGuard
from zlib import crc32

import numpy as np

from ..core import (
    Agent,
    AskingPolicy,
    Info,
    Policy,
    branch,
    checked_seed,
    is_seed,
)
from ..errors import BranchError, OptionValueError, annotate, short_repr, warn_user
from ..many.parallel import progress_bar
from ..simulation import RULE, Action, Observation
from .player import Environment, Player, player_of
from .values import ActionValues, estimate, warn_of_futures, warn_of_times

_KEY: Final = 0x706C616E
"""Separates the seeds of futures from other seeds that follow from the episode's seed."""

_FRESH: Final = 8
"""The least number of fresh futures for the comparison of a candidate with the rule."""

Indices = tuple[int, ...]
"""The indices of the candidates at the agent's next decisions, beginning with the pending one."""

Try = tuple[Indices, int]
"""A rollout to make: its candidates, and the number of its future."""


# -- rollouts, in branches ------------------------------------------------------------------------


@dataclass(frozen=True)
class Rollout:
    """A rollout at its end, or where it can be continued.

    Attributes:
        rewards: The discounted reward of each decision of the agent.
        times: The simulation's times between the agent's decisions.
        start: The simulation's time at its begin. None before that.
        over: Whether the agent's episode has ended.
        digest: A digest of the agent's last observation and info.
        seconds: The mean real time for a step, in seconds.
    """

    rewards: Sequence[float] = ()
    times: Sequence[float] = ()
    start: float | None = None
    over: bool = False
    digest: int = 0
    seconds: float = 0.0


BEGIN: Final = Rollout()
"""A rollout before its first decision."""


def try_out(
    env: Environment,
    number: int,
    tries: Sequence[Try],
    actions: Sequence[Action],
    policy: RolloutPolicy,
    begun: Rollout = BEGIN,
    stop: int | None = None,
) -> Rollout:
    """In a branch, make one of several rollouts.

    The agent takes the actions, one at each decision, and then follows the base. If an action is
    illegal when its decision arises, the base decides. The terminal value is added to the last
    reward.

    Args:
        env: The environment of the branch.
        number: The number of the rollout.
        tries: The rollouts to make.
        actions: The candidates.
        policy: The planner.
        begun: The rollout to continue.
        stop: The index of the decision where it stops. None: it runs to its end.
    """
    indices, future = tries[number]
    path = [actions[index] for index in indices]
    began = perf_counter()
    try:
        player = player_of(env, policy.base)
        player.start()
        rewards = list(begun.rewards)
        times = list(begun.times)
        now = player.time()
        start = now if begun.start is None else begun.start
        horizon = policy.horizon or inf
        while not player.over and len(rewards) != stop:
            decision = len(rewards)
            elapsed = {
                "decision": decision,
                "time": now - start,
            }
            weight = policy.discount ** elapsed[policy.discount_by]
            if decision > 0 and elapsed[policy.horizon_by] >= horizon:
                if policy.terminal_value is not None and stop is None:
                    rewards[-1] += weight * _terminal_value(policy.terminal_value, env)
                break
            if decision == 0 or (decision < len(path) and player.allows(path[decision])):
                action = path[decision]
                player.replace_decision()
            else:
                action = player.decide()
            rewards.append(weight * player.step(action))
            if not player.over:
                before = now
                now = player.time()
                times.append(now - before)
    except BaseException as error:
        tried = ", ".join(map(short_repr, path))
        annotate(error, f"simenv_marl: while {tried} was tried out in future {future}")
        raise
    seconds = (perf_counter() - began) / max(1, len(rewards))
    return Rollout(
        rewards,
        times,
        start,
        player.over,
        _digest(player.agent),
        seconds,
    )


def _terminal_value(
    function: Callable[[Any], float],
    env: Environment,
) -> float:
    value = function(env)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if not is_number(value):
        raise OptionValueError(
            f"terminal_value must return a finite number, not {short_repr(value)}"
        )
    return float(value)


def _digest(agent: Agent) -> int:
    last = (agent.observation, agent.info)
    try:
        return crc32(pickle.dumps(last, 5))  # much faster than a text
    except Exception:
        return crc32(repr(last).encode(errors="replace"))


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is one finite number."""
    return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)


def is_count(value: object) -> TypeGuard[int]:
    """Return whether a value is a positive integer."""
    return is_seed(value) and value != 0


def is_positive(value: object) -> TypeGuard[float]:
    """Return whether a value is a positive number."""
    return is_number(value) and value > 0


def is_weight(value: object) -> TypeGuard[float]:
    """Return whether a value is a number that is not negative."""
    return is_number(value) and value >= 0


_UNITS: Final = ("decision", "time")

Checks: TypeAlias = dict[str, tuple[Callable[[Any], bool], str]]
"""Checks of options: for each a function, and the kind of valid values."""

CHECKS: Final[Checks] = {
    "futures": (is_count, "a positive integer"),
    "horizon_by": (_UNITS.__contains__, '"decision" or "time"'),
    "terminal_value": (callable, "a callable of the environment"),
    "discount": (lambda value: is_weight(value) and value <= 1, "a number from 0 to 1"),
    "discount_by": (_UNITS.__contains__, '"decision" or "time"'),
    "budget": (is_count, "a number of branches or None"),
    "margin": (is_weight, "a number that is not negative"),
}
"""The checks of the options of planners."""

_HORIZON: Final = 'a number of decisions, a positive time with horizon_by="time", or None'

_OPTIONAL: Final = ("horizon", "terminal_value", "budget")
"""The options that may be None."""


# -- values ---------------------------------------------------------------------------------------


def action_values(
    env: Environment,
    actions: Iterable[Action] | None = None,
    *,
    base: Policy = RULE,
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
            others play the same rounds. In the joint view, one agent acts for all. In the turn
            view, one learner does, and its decisions are the steps.
        actions: The candidates; ``RULE`` may be among them. None: all legal actions of a
            ``Discrete``.
        base: The policy that decides after the candidate: ``RULE``, a callable of the observation,
            or of the observation and the info, a dict of these by agent, or the policies of
            ``turn_policy`` or ``joint_policy``. Other agents of the environment follow their entry
            in the dict, else their rule. Agents in the option ``policies`` keep their policies. A
            planner is replaced by its attribute ``base``.
        futures: The number of futures in which each candidate is tried.
        horizon: The number of the agent's decisions whose rewards count, including the candidate.
            With ``horizon_by="time"``: a duration; rewards count up to the agent's first decision
            after at least that time. None: up to the agent's end.
        horizon_by: The unit of the horizon: "decision", or "time" for the simulation's time.
        terminal_value: A callable of the environment that returns the value of the time after the
            horizon. It is called in the branch if the agent still lives at the horizon.
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
        actions,
        base=base,
        futures=futures,
        horizon=horizon,
        horizon_by=horizon_by,
        terminal_value=terminal_value,
        discount=discount,
        discount_by=discount_by,
        seed=seed,
        method=method,
        time_limit=time_limit,
    )
    player = player_of(env, base)
    if player.is_planned:
        return _base_value(player)
    rollouts = Rollouts(player, policy)
    candidates = range(len(rollouts.actions))
    with progress_bar(len(candidates) * futures, progress, "branch") as bar:
        for number in [1] * futures if progress else [futures]:
            rollouts.add(candidates, number)
            bar.update(number * len(candidates))
    best = max(candidates, key=rollouts.mean)
    return rollouts.values(best)


def _base_value(player: Player) -> ActionValues:
    """Return the base's answer as the best action, as planners act in branches."""
    return estimate([player.decide()], [[]], 0)


class Rollouts:
    """The rollouts of the candidates for a pending decision.

    A future is the same for all candidates. It is given by its number, from 0.

    Attributes:
        env: The environment.
        actions: The candidates.
        rule: The index of ``RULE``. Only planners need it.
        added: Whether ``RULE`` was added to them, as the last one.
        returns: For each candidate, the returns of its rollouts.
        rollouts: For each sequence of candidates, its rollouts.
        reseeds: Whether chance can be drawn anew. Otherwise there is one exact future.
    """

    def __init__(
        self,
        player: Player,
        policy: RolloutPolicy,
        *,
        planner: bool = False,
    ) -> None:
        """Check the candidates and the base of a policy.

        For a ``planner``, leave out masked candidates, and add ``RULE``.
        """
        self.env = player.env
        self.policy = policy
        player.check()
        episode = player.episode
        is_timed = "time" in (policy.discount_by, policy.horizon_by)
        if is_timed and episode.clock is None:
            raise OptionValueError(
                'discount_by="time" and horizon_by="time" need a simulation with a method time()'
            )
        self.actions = player.candidates(policy.actions, legal=planner)
        rules = [index for index, action in enumerate(self.actions) if action is RULE]
        number = len(self.actions)
        self.rule = rules[0] if rules else number
        self.added = planner and not rules and number > 1
        if self.added:
            self.actions.append(RULE)
        self.returns: list[list[float]] = [[] for _ in self.actions]
        self.rollouts: dict[Indices, list[Rollout]] = {}
        agent = player.agent
        self._entropy = [
            episode.seed,
            agent.answered if isinstance(agent.policy, AskingPolicy) else episode.turns,
            crc32(player.name.encode(errors="surrogatepass")),
            _KEY,
        ]
        if policy.seed is not None:
            self._entropy.append(policy.seed)
        self._name = episode.plan.name
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
        sequence = np.random.SeedSequence(self._entropy)
        return [int(seed) for seed in sequence.generate_state(number)]

    def add(
        self,
        candidates: Iterable[int],
        number: int,
    ) -> None:
        """Try candidates, given by their indices, in some more futures, or in the exact one."""
        tries: list[Try] = []
        for index in candidates:
            begin = len(self.returns[index])
            end = begin + number if self.reseeds else 1
            tries += [((index,), future) for future in range(begin, end)]
        self.record(tries, self.make(tries))

    def trying(self, tries: Sequence[Try]) -> partial[Rollout]:
        """Return the function that makes tries in branches."""
        return partial(try_out, tries=tries, actions=self.actions, policy=self.policy)

    def make(self, tries: Sequence[Try]) -> list[Rollout]:
        """Make rollouts, each in a branch."""
        seeds: list[int] | None = None
        if self.reseeds:
            futures = [future for _, future in tries]
            known = self.seeds(1 + max(futures, default=0))
            seeds = [known[future] for future in futures]
        return branch(
            self.env,
            self.trying(tries),
            len(tries),
            method=self.policy.method,
            seeds=seeds,
            time_limit=self.policy.time_limit,
        )

    def record(
        self,
        tries: Sequence[Try],
        rollouts: Sequence[Rollout],
    ) -> None:
        """Record the results of tries."""
        for (indices, _), rollout in zip(tries, rollouts, strict=True):
            self.returns[indices[0]].append(sum(rollout.rewards))
            self.rollouts.setdefault(indices, []).append(rollout)

    def search(self, budget: int) -> Indices:
        """Try candidates; return the best ones for the next decisions."""
        left = list(range(len(self.actions)))
        for rounds in range(ceil(log2(len(left))), 0, -1):
            most = budget // len(left)
            number = min(max(1, most // rounds), most)
            budget -= number * len(left)
            self.add(left, number)
            if rounds > 1:
                left.sort(key=self.mean, reverse=True)
                left = sorted(left[: (len(left) + 1) // 2])
        best = max(left, key=self.mean)
        return (best,)

    def is_better_than_rule(self, indices: Indices) -> bool:
        """Return whether candidates have a larger return than the rule.

        They are compared on fresh futures, because the others have selected them.
        """
        if indices[0] == self.rule:
            return False
        rule = (self.rule,)
        if not self.reseeds:
            return self.exact_return(indices) > self.exact_return(rule)
        begin = max(map(len, self.returns))
        futures = range(begin, begin + max(_FRESH, self.policy.futures))
        tries = list(product((indices, rule), futures))
        returns = np.array([sum(rollout.rewards) for rollout in self.make(tries)])
        planned, ruled = np.split(returns, 2)
        gains = planned - ruled
        error = gains.std(ddof=1) / np.sqrt(len(gains))
        return bool(gains.mean() > self.policy.margin * error)

    def exact_return(self, indices: Indices) -> float:
        """Return the return of candidates in the one exact future."""
        return sum(self.rollouts[indices][0].rewards)

    def mean(self, index: int) -> float:
        """Return the mean return of a candidate."""
        return float(np.mean(self.returns[index]))

    def values(self, best: int) -> ActionValues:
        """Estimate the values. The best candidate is given by its index."""
        values = estimate(self.actions, self.returns, best)
        rollouts = self.rollouts.values()
        if self.reseeds:
            futures = [[(each.rewards, each.digest) for each in same] for same in rollouts]
            warn_of_futures(self._name, futures, values.returns)
        if self.policy.horizon is not None and self.policy.horizon_by == "decision":
            warn_of_times(self._name, [each.times for each in chain(*rollouts)])
        return values


# -- policies -------------------------------------------------------------------------------------


@dataclass(kw_only=True, eq=False, repr=False)
class RolloutPolicy:
    """A policy that looks one decision ahead: it takes the candidate that is best in branches.

    It uses sequential halving (Karnin, Koren and Somekh, 2013). The budget is divided among rounds.
    In each round, all remaining candidates are tried on the same futures, and the better half of
    them remains.

    ``RULE`` is always a candidate. Another one is taken only if its paired advantage over ``RULE``,
    on at least eight fresh futures, exceeds ``margin`` standard errors. Where there is one exact
    future, any gain is taken.

    The policy can be used like any policy that answers one decision at a time; it gets the
    environment as ``_environment``. In a branch of a planner it acts as its own base.

    Its attributes are its arguments. ``action_values`` describes the others.

    Attributes:
        actions: The candidates. Candidates that are masked at a decision are left out there. None:
            all legal actions of a ``Discrete``.
        budget: The number of branches per decision. None: the number of candidates times
            ``futures``. The comparison with the rule comes on top.
        margin: By how many standard errors a candidate must be better than ``RULE`` to be taken.
        futures: The mean number of futures per candidate, if there is no ``budget``.
        seed: A number that distinguishes the futures from the ones of another planner.

    Raises:
        OptionValueError: An argument has an invalid value.
    """

    actions: Iterable[Action] | None = field(default=None, kw_only=False)
    base: Policy = RULE
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
    _checks: ClassVar[Checks] = CHECKS
    _rollouts: ClassVar[type[Rollouts]] = Rollouts

    def __post_init__(self) -> None:
        horizon = is_count if self.horizon_by == "decision" else is_positive
        checks = self._checks | {"horizon": (horizon, _HORIZON)}
        for name, (is_valid, kind) in checks.items():
            value = vars(self)[name]
            is_left_out = value is None and name in _OPTIONAL
            if not is_left_out and not is_valid(value):
                raise OptionValueError(f"{name} must be {kind}, not {short_repr(value)}")
        self.seed = checked_seed(self.seed)
        if isinstance(self.actions, Iterable) and not isinstance(self.actions, (str, Mapping)):
            self.actions = list(self.actions)  # the first decision would use up an iterator

    def choose(self, env: Environment) -> ActionValues:
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
        player = player_of(env, self.base)
        if player.is_planned:
            return _base_value(player)
        rollouts = self._rollouts(player, self, planner=True)
        number = len(rollouts.actions)
        budget = self.budget
        if budget is None:
            budget = number * self.futures
        if budget < number:
            raise OptionValueError(
                f"a budget of {budget} branches is too small to try {number} candidates once"
            )
        if number == 1:
            return rollouts.values(0)
        best = rollouts.search(budget)
        if rollouts.is_better_than_rule(best):
            return rollouts.values(best[0])
        return rollouts.values(rollouts.rule)

    def __call__(
        self, observation: Observation, info: Info, *, _environment: Environment
    ) -> Action:
        """Answer a decision with the best action. In a branch, with the answer of the base."""
        return self.choose(_environment).best
