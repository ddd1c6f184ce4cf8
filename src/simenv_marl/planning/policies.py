"""Policies that try candidates before they decide."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import ceil, inf, log, log2, sqrt
from typing import Any, Final

import numpy as np

from ..core.planner import PLANNING
from ..errors import OptionValueError
from .values import ActionValues, Plan, RolloutOptions, Rollouts, base_value, is_count, is_number

AT_ONCE: Final = 8
"""The number of branches that run before the tree is updated. It does not depend on the number of cores."""


@dataclass(kw_only=True, eq=False, repr=False)
class RolloutPolicy(RolloutOptions):
    """A policy that looks one decision ahead: it tries candidate actions in branches and takes the best one.

    It uses sequential halving (Karnin, Koren and Somekh, 2013). The budget is divided among rounds. In each round, all
    remaining candidates are tried on the same futures, and the better half of them goes on.

    The policy can be used like any policy that answers one decision at a time; it gets the environment as
    ``_environment``. In a branch of a planner it acts as its own base.

    Its attributes are its arguments. ``action_values`` describes those that are not described here.

    Attributes:
        actions: The candidates. Candidates that are masked at a decision are left out there. None: all legal actions of
            a ``Discrete``.
        budget: The number of branches per decision. None: the number of candidates times ``futures``.
        futures: The mean number of futures per candidate, if there is no ``budget``.
        seed: A number that distinguishes the futures from those of another planner.

    Raises:
        OptionValueError: An argument has an invalid value.
    """

    actions: Any = field(default=None, kw_only=False)
    budget: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("budget", self.budget is None or is_count(self.budget), "a number of branches or None")
        if isinstance(self.actions, Iterable) and not isinstance(self.actions, (str, Mapping)):
            self.actions = list(self.actions)  # an iterator would be used up by the first decision

    def choose(self, env: Any) -> ActionValues:
        """Find the best candidate for the pending decision of an environment.

        Args:
            env: The environment, as ``action_values`` takes it. It does not move.

        Returns:
            The values. ``best`` is one of the candidates of the last round. A single candidate is not tried.

        Raises:
            OptionValueError: The budget is too small to try each candidate.
            BaseException: As ``action_values``.
        """
        if PLANNING.get():
            return base_value(env, self.base)
        rollouts = Rollouts(env, self.actions, self, legal=True)
        number = len(rollouts.actions)
        budget = number * self.futures if self.budget is None else self.budget
        if budget < number:
            raise OptionValueError(f"a budget of {budget} branches is too small to try {number} candidates once")
        return rollouts.values(self._search(rollouts, budget) if number > 1 else [0])

    def _search(self, rollouts: Rollouts, budget: int) -> list[int]:
        """Try candidates; return the places of the finalists."""
        left = list(range(len(rollouts.actions)))
        for rounds in range(ceil(log2(len(left))), 0, -1):
            more = min(max(1, budget // (len(left) * rounds)), budget // len(left))
            budget -= more * len(left)
            rollouts.add(left, more)
            if rounds > 1:
                means = [np.mean(rollouts.returns[place]) for place in left]
                better = np.argsort(-np.array(means), kind="stable")[: (len(left) + 1) // 2]
                left = [left[place] for place in sorted(better.tolist())]
        return left

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        """Answer a decision, as policies do, with the best action; within a branch, with the answer of the base."""
        return self.choose(_environment).best


@dataclass(kw_only=True, eq=False, repr=False)
class TreeSearchPolicy(RolloutPolicy):
    """A policy that looks several decisions ahead, by open-loop UCT over branches.

    At each of the next ``depth`` decisions it tries the candidates that seem best, and those of which it knows little
    (UCB1); then the base decides. A node of the tree is a sequence of candidates, whatever chance events lie between
    them. All candidates for the pending decision meet the same futures in the same order.

    It needs more branches than ``RolloutPolicy``. They pay off if an action is only good with the right actions after
    it.

    Attributes:
        actions: The candidates for this decision and the next ones. If a candidate is masked at a next decision, the
            base decides there.
        depth: The number of decisions that are tried, including this one.
        exploration: The weight of exploration, in units of the spread of the returns.

    Raises:
        OptionValueError: An argument has an invalid value.
    """

    depth: int = 2
    exploration: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        fine = is_number(self.exploration) and self.exploration >= 0
        self.require("depth", is_count(self.depth), "a number of decisions")
        self.require("exploration", fine, "a number that is not negative")

    def _search(self, rollouts: Rollouts, budget: int) -> list[int]:
        tree = _Tree(len(rollouts.actions), self.depth, self.exploration)
        while budget:
            batch: list[tuple[Plan, int]] = []
            for _ in range(min(AT_ONCE, budget)):
                plan = tree.descend()
                batch.append((plan, tree.visits[plan[:1]] - 1 if rollouts.reseeds else 0))
            for (plan, _), rewards in zip(batch, rollouts.run(batch), strict=True):
                tree.learn(plan, rewards)
            budget -= len(batch)
        return [tree.best()]


class _Tree:
    """The results of sequences of candidates."""

    def __init__(self, candidates: int, depth: int, exploration: float) -> None:
        self._candidates, self._depth, self._exploration = candidates, depth, exploration
        self.visits: dict[Plan, int] = {}  # the tries of each node, including those that are running
        self._returns: dict[Plan, list[float]] = {}  # returns from the node's own decision on
        self._least, self._most = inf, -inf

    def descend(self) -> Plan:
        """Choose the sequence to try next: descend to an untried node, or to the depth."""
        node: Plan = ()
        while len(node) < self._depth:
            below = [(*node, place) for place in range(self._candidates)]
            new = [child for child in below if child not in self._returns]
            if new:
                node = min(new, key=lambda child: self.visits.get(child, 0))
                break
            doubt = sqrt(log(sum(self.visits[child] for child in below)))
            node = max(below, key=lambda child: self._bound(child, doubt))
        for depth in range(1, len(node) + 1):
            self.visits[node[:depth]] = self.visits.get(node[:depth], 0) + 1
        return node

    def _bound(self, node: Plan, doubt: float) -> float:
        """Return the confidence bound of a node's value: upper for a positive ``doubt``, lower for a negative one."""
        returns, spread = self._returns[node], self._most - self._least
        return sum(returns) / len(returns) + doubt * self._exploration * spread / sqrt(self.visits[node])

    def learn(self, node: Plan, rewards: list[float]) -> None:
        """Add the rewards of a try, decision by decision; the agent may have ended before the node."""
        for depth in range(min(len(node), len(rewards))):
            self._returns.setdefault(node[: depth + 1], []).append(sum(rewards[depth:]))
        self._least, self._most = min(self._least, sum(rewards)), max(self._most, sum(rewards))

    def best(self) -> int:
        """Return the candidate with the largest lower confidence bound."""
        return max(range(self._candidates), key=lambda place: self._bound((place,), -1.0))
