"""The values of candidate actions for a pending decision, from rollouts in branches.

Policies that decide by these values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, product
from math import ceil, log2
from typing import Any, ClassVar, Final, TypeAlias, TypeGuard
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from ..core import Info, Policy, branch, checked_seed, is_seed, same
from ..errors import BranchError, OptionValueError, short_repr, warn_user
from ..many.parallel import progress_bar
from ..simulation import RULE, Action, Observation, is_deterministic
from .candidates import Candidate, Choice, Course, First, Metric, Propose, Task, is_policy
from .costs import say_costs
from .player import Environment, Player, is_finite
from .players import player_of
from .rollout import Indices, Rollout, Try, try_out
from .values import ActionValues, estimate, warn_of_futures, warn_of_times

_KEY: Final = 0x706C616E
"""Separates the seeds of futures from other seeds that follow from the episode's seed."""

_FRESH: Final = 8
"""The least number of fresh futures for the comparison of a candidate with the rule."""


def is_count(value: object) -> TypeGuard[int]:
    """Return whether a value is a positive integer."""
    return is_seed(value) and value != 0


def is_positive(value: object) -> TypeGuard[float]:
    """Return whether a value is a positive number."""
    return is_finite(value) and value > 0


def is_weight(value: object) -> TypeGuard[float]:
    """Return whether a value is a number that is not negative."""
    return is_finite(value) and value >= 0


_UNITS: Final = ("decision", "time")

Checks: TypeAlias = dict[str, tuple[Callable[[Any], bool], str]]
"""Checks of options: for each a function, and the kind of valid values."""

CHECKS: Final[Checks] = {
    "futures": (is_count, "a positive integer"),
    "horizon_by": (_UNITS.__contains__, '"decision" or "time"'),
    "terminal_value": (callable, "a callable of the environment"),
    "metric": (callable, "a callable of the simulation"),
    "hold_by": (_UNITS.__contains__, '"decision" or "time"'),
    "every": (is_count, "a number of decisions"),
    "discount": (lambda value: is_weight(value) and value <= 1, "a number from 0 to 1"),
    "discount_by": (_UNITS.__contains__, '"decision" or "time"'),
    "budget": (is_count, "a number of branches or None"),
    "margin": (is_weight, "a number that is not negative"),
}
"""The checks of the options of planners."""

_OPTIONAL: Final = ("horizon", "hold", "terminal_value", "metric", "budget")
"""The options that may be None."""


# -- values ---------------------------------------------------------------------------------------


def action_values(
    env: Environment,
    actions: Iterable[Candidate] | Propose | None = None,
    *,
    base: Policy = RULE,
    hold: float | None = 1,
    hold_by: str = "decision",
    futures: int = 16,
    horizon: float | None = None,
    horizon_by: str = "decision",
    terminal_value: Callable[[Any], float] | None = None,
    metric: Metric | None = None,
    discount: float = 1.0,
    discount_by: str = "decision",
    seed: int | None = None,
    method: str | None = None,
    time_limit: float = 600.0,
    progress: bool = False,
) -> ActionValues:
    """Estimate the value of each candidate for the pending decision by trying it in branches.

    In a branch the candidate decides as long as it is held, and the agent's base from then on, up
    to the horizon or the agent's end. All candidates meet the same futures. ``env`` itself does not
    move.

    Args:
        env: An environment of one simulation with a pending decision, in any view, with or without
            wrappers. In the parallel view, the agent is the one that is ``"deciding"``, and the
            others play the same rounds. In the joint view, one agent acts for all. In the turn
            view, one learner does, and its decisions are the steps.
        actions: The candidates: actions, policies, ``RULE``, or those of ``first``. Or a callable
            of the observation, or of the observation and the info, that returns them; it gets the
            pending ``Decision`` as ``_decision``, and the simulation as ``_simulation``, if it
            asks. None: all legal actions of a ``Discrete``.
        base: The policy that decides after the candidate: ``RULE``, a callable of the observation,
            or of the observation and the info, a dict of these by agent, or the policies of
            ``turn_policy`` or ``joint_policy``. Other agents of the environment follow their entry
            in the dict, else their rule. Agents in the option ``policies`` keep their policies. A
            planner is replaced by its attribute ``base``.
        hold: The number of decisions that a candidate answers before the base. With
            ``hold_by="time"``: a duration. None: up to the horizon.
        hold_by: The unit of ``hold``: "decision", or "time" for the simulation's time.
        futures: The number of futures in which each candidate is tried.
        horizon: The number of the agent's decisions whose rewards count, including the candidate.
            With ``horizon_by="time"``: a duration. The reward of the last interval counts by its
            share before the horizon; it is exact if another agent decides at that time. None: up to
            the agent's end.
        horizon_by: The unit of the horizon: "decision", or "time" for the simulation's time.
        terminal_value: A callable of the environment that returns the value of the time after the
            horizon. It is called in the branch at the agent's first decision after the horizon, if
            there is one. The rewards before that decision count in full.
        metric: A callable of the simulation that returns how well it stands; larger is better. It
            is read at the horizon or the agent's end, and takes the place of rewards. None: rewards
            count.
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
        The values. There is only the one exact future if the simulation says by an attribute
        ``deterministic = True`` that it has no chance; also, with a warning, if it has no
        ``reseed`` and the environment was not made with ``global_rng=True``.

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
        hold=hold,
        hold_by=hold_by,
        futures=futures,
        horizon=horizon,
        horizon_by=horizon_by,
        terminal_value=terminal_value,
        metric=metric,
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
    candidates = range(len(rollouts.courses))
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
        courses: The candidates.
        given: How many of them were given, before ``RULE`` and the incumbent.
        rule: The index of ``RULE``. Only planners need it.
        incumbent: The index of the latest choice of a planner. ``RULE`` without one.
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
        choice: Choice | None = None,
    ) -> None:
        """Check the candidates and the base of a policy.

        For a ``planner``, leave out masked candidates, and add ``RULE`` and the latest ``choice``.
        """
        self.env = player.env
        self.policy = policy
        player.check()
        episode = player.episode
        is_timed = "time" in (policy.discount_by, policy.horizon_by, policy.hold_by)
        if is_timed and episode.clock is None:
            raise OptionValueError(
                'discount_by="time", horizon_by="time" and hold_by="time" need a simulation with a'
                " method time()"
            )
        incumbent = None if choice is None else choice.candidate
        found = player.candidates(policy.actions, legal=planner, incumbent=incumbent)
        self.courses = [Course(candidate) for candidate in found]
        self.given = len(found)
        self.rule = self.incumbent = 0
        if planner:
            self.rule = self.incumbent = self._include(Course(RULE))
        if choice is not None:
            course = choice.resume(policy, player.time())
            if player.allows(course.part(0)):
                self.incumbent = self._include(course)
        agent = player.agent
        self.returns: list[list[float]] = [[] for _ in self.courses]
        self.rollouts: dict[Indices, list[Rollout]] = {}
        self._entropy = [
            episode.seed,
            agent.answered if getattr(agent.policy, "plans", False) else episode.turns,
            crc32(player.name.encode(errors="surrogatepass")),
            _KEY,
        ]
        if policy.seed is not None:
            self._entropy.append(policy.seed)
        self._name = episode.plan.name
        self.reseeds = not player.view.call(_is_deterministic) and self._can_reseed(player)

    def _include(self, course: Course) -> int:
        """Return the index of a candidate. Add it if it is new."""
        if not course.decisions:
            for index, other in enumerate(self.courses):
                if _is_same(course.candidate, other.candidate):
                    return index
        self.courses.append(course)
        return len(self.courses) - 1

    def _can_reseed(self, player: Player) -> bool:
        """Return whether chance can be drawn anew. Warn if not."""
        try:
            player.view.session.check_reseed()
        except BranchError:
            warn_user(
                f"{self._name} cannot draw new random numbers in a branch: the planner tries all"
                " candidates on the one future that will happen, and so foresees chance. Give it a"
                " method reseed(seed), or set global_rng=True if it draws from random or"
                " numpy.random, or deterministic = True if nothing is random"
            )
            return False
        return True

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
        return partial(try_out, tries=tries, courses=self.courses, task=self.policy)

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
        left = list(range(len(self.courses)))
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

    def settle(self, best: Indices) -> int:
        """Return the index of the candidate that is taken: the best, the incumbent or ``RULE``.

        The best must be better than both, on fresh futures, because the others have selected it.
        """
        if best[0] == self.rule == self.incumbent:
            return self.rule
        contenders = list(dict.fromkeys([best, (self.incumbent,), (self.rule,)]))
        if self.reseeds:
            returns = self._make_fresh(contenders)
        else:
            returns = np.array([[self.exact_return(indices)] for indices in contenders])
        means = returns.mean(axis=1)
        rule = contenders.index((self.rule,))
        incumbent = contenders.index((self.incumbent,))
        safe = incumbent if means[incumbent] >= means[rule] else rule
        gains = returns[0] - returns[[rule, incumbent]]
        margins = np.zeros(2)
        if self.reseeds:
            errors = gains.std(axis=1, ddof=1) / np.sqrt(gains.shape[1])
            margins = self.policy.margin * errors
        is_better = (gains.mean(axis=1) > margins).all()
        return contenders[0 if is_better else safe][0]

    def _make_fresh(self, contenders: Sequence[Indices]) -> NDArray[np.float64]:
        """Return the returns of candidates, a row for each, in futures that were not tried yet."""
        begin = max(map(len, self.returns))
        futures = range(begin, begin + max(_FRESH, self.policy.futures))
        tries = list(product(contenders, futures))
        returns = [sum(rollout.rewards) for rollout in self.make(tries)]
        return np.reshape(returns, (len(contenders), len(futures)))

    def exact_return(self, indices: Indices) -> float:
        """Return the return of candidates in the one exact future."""
        return sum(self.rollouts[indices][0].rewards)

    def mean(self, index: int) -> float:
        """Return the mean return of a candidate."""
        return float(np.mean(self.returns[index]))

    def values(self, best: int) -> ActionValues:
        """Estimate the values. The best candidate is given by its index."""
        candidates = [course.candidate for course in self.courses]
        values = estimate(candidates, self.returns, best)
        rollouts = self.rollouts.values()
        if self.reseeds:
            futures = [[(each.rewards, each.digest) for each in same] for same in rollouts]
            warn_of_futures(self._name, futures, values.returns)
        if self.policy.horizon is not None and self.policy.horizon_by == "decision":
            warn_of_times(self._name, [each.times for each in chain(*rollouts)])
        return values


def _is_deterministic(view: Any) -> bool:
    return is_deterministic(view.episode.simulation)


def _is_same(one: Candidate, other: Candidate) -> bool:
    """Return whether two candidates are the same."""
    if is_policy(one) or is_policy(other) or isinstance(one, First) or isinstance(other, First):
        return one is other
    return same(one, other)


# -- policies -------------------------------------------------------------------------------------


@dataclass(kw_only=True, eq=False, repr=False)
class RolloutPolicy(Task):
    """A policy that looks one decision ahead: it takes the candidate that is best in branches.

    It uses sequential halving (Karnin, Koren and Somekh, 2013). The budget is divided among rounds.
    In each round, all remaining candidates are tried on the same futures, and the better half of
    them remains.

    ``RULE`` is always a candidate, and so is the incumbent: the planner's latest choice for the
    agent, for as long as it was to be held. Another one is taken only if its paired advantages over
    both, on at least eight fresh futures, exceed ``margin`` standard errors. Otherwise the
    incumbent stays if its mean there is at least that of ``RULE``; else ``RULE`` decides. Where
    there is one exact future, any gain is taken.

    The policy can be used like any policy that answers one decision at a time; it gets the
    environment as ``_environment``. In a branch of a planner it acts as its own base.

    Its attributes are its arguments. ``action_values`` describes the others.

    Attributes:
        actions: The candidates. Candidates that are masked at a decision are left out there. A
            callable gets the incumbent, or None, as ``_incumbent``, if it asks. None: all legal
            actions of a ``Discrete``.
        every: It plans at each decision with that number. In between, its choice goes on.
        budget: The number of branches per decision. None: the number of candidates times
            ``futures``. The comparison with the rule and the incumbent comes on top.
        margin: By how many standard errors a candidate must be better to be taken.
        futures: The mean number of futures per candidate, if there is no ``budget``.
        seed: A number that distinguishes the futures from the ones of another planner.

    Raises:
        OptionValueError: An argument has an invalid value.
    """

    actions: Iterable[Candidate] | Propose | None = field(default=None, kw_only=False)
    futures: int = 16
    seed: int | None = None
    method: str | None = None
    time_limit: float = 600.0
    budget: int | None = None
    margin: float = 1.0
    _checks: ClassVar[Checks] = CHECKS
    _rollouts: ClassVar[type[Rollouts]] = Rollouts

    def __post_init__(self) -> None:
        checks = dict(self._checks)
        for name, unit in (("horizon", self.horizon_by), ("hold", self.hold_by)):
            kind = f'a number of decisions, a positive time with {name}_by="time", or None'
            checks[name] = (is_positive if unit == "time" else is_count), kind
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
            The values. ``best`` is ``RULE``, the incumbent or a candidate of the last round.
            ``RULE`` alone is not tried.

        Raises:
            OptionValueError: The budget is too small to try each candidate.
            BaseException: As ``action_values``.
        """
        player = player_of(env, self.base)
        if player.is_planned:
            return _base_value(player)
        choice = self._latest(player)
        rollouts = self._rollouts(player, self, planner=True, choice=choice)
        number = len(rollouts.courses)
        budget = self.budget
        if budget is None:
            budget = number * self.futures
        if budget < number:
            raise OptionValueError(
                f"a budget of {budget} branches is too small to try {number} candidates once"
            )
        taken = rollouts.rule
        if number > 1:
            branches = budget if rollouts.reseeds else number
            say_costs(player, self, number, branches, self.method, self.time_limit)
            taken = rollouts.settle(rollouts.search(budget))
        values = rollouts.values(taken)
        if choice is None or not rollouts.courses[taken].decisions:
            choice = Choice(values.best, player.time(), player.number)
        self._keep(player, replace(choice, age=0))
        return values

    def _latest(self, player: Player) -> Choice | None:
        """Return the latest choice for an agent, as it stands at the pending decision."""
        choice: Choice | None = player.episode.memory.get((self, player.name))
        return None if choice is None else self._keep(player, choice.at(player.number))

    def _keep(self, player: Player, choice: Choice) -> Choice:
        """Keep a choice for the agent's next decision."""
        player.episode.memory[self, player.name] = choice
        return choice

    def __call__(
        self, observation: Observation, info: Info, *, _environment: Environment
    ) -> Action:
        """Answer a decision with the best candidate. In a branch, with the answer of the base."""
        player = player_of(_environment, self.base)
        if player.is_planned:
            return player.decide()
        choice = self._latest(player)
        if choice is None or choice.age >= self.every:
            self.choose(_environment)
            choice = self._latest(player)
        return RULE if choice is None else player.answer(choice.part)
