"""A policy that looks several decisions ahead."""

from math import inf, log, sqrt
from typing import Any, Final

from ..errors import OptionValueError, short_repr
from .futures import Futures
from .lookahead import is_count, is_number
from .policy import RolloutPolicy

AT_ONCE: Final = 8
"""The number of branches that run before the tree is updated. It does not depend on the number of cores."""

Node = tuple[int, ...]
"""A node: the places of the candidates that lead to it, decision by decision."""


class TreeSearchPolicy(RolloutPolicy):
    """A policy that looks several decisions ahead, by open-loop UCT over branches.

    At each of the next ``depth`` decisions it tries the candidates that seem best, and those of which it knows little
    (UCB1); then the base decides. A node of the tree is a sequence of candidates, whatever chance events lie between
    them. All candidates for the pending decision meet the same futures in the same order.

    It needs more branches than ``RolloutPolicy``. They pay off if an action is only good with the right actions after
    it.
    """

    def __init__(self, actions: Any = None, *, depth: int = 2, exploration: float = 1.0, **options: Any) -> None:
        """Make a policy.

        Args:
            actions: The candidates for this decision and the next ones. If a candidate is masked at a next decision,
                the base decides there.
            depth: The number of decisions that are tried, including this one.
            exploration: The weight of exploration, in units of the spread of the returns.
            **options: The arguments of ``RolloutPolicy``.

        Raises:
            OptionValueError: An argument has an invalid value.
        """
        if not is_count(depth):
            raise OptionValueError(f"depth must be a number of decisions, not {short_repr(depth)}")
        if not is_number(exploration) or exploration < 0:
            raise OptionValueError(f"exploration must be a number that is not negative, not {short_repr(exploration)}")
        super().__init__(actions, **options)
        self._depth, self._exploration = int(depth), float(exploration)

    def _search(self, found: Futures, budget: int) -> list[int]:
        tree, left = _Tree(len(found.actions), self._depth, self._exploration), budget
        while left:
            tries: list[tuple[Node, int]] = []
            for _ in range(min(AT_ONCE, left)):
                node = tree.descend()
                tries.append((node, tree.visits[node[:1]] - 1 if found.endless else 0))
            for (node, _), brought in zip(tries, found.play(tries), strict=True):
                tree.learn(node, brought)
            left -= len(tries)
        return [tree.best()]


class _Tree:
    """The results of sequences of candidates.

    Attributes:
        visits: The number of tries of each node, including those that are running.
    """

    def __init__(self, candidates: int, depth: int, exploration: float) -> None:
        self._candidates, self._depth, self._exploration = candidates, depth, exploration
        self.visits: dict[Node, int] = {}
        self._returns: dict[Node, list[float]] = {}  # returns from the node's own decision on
        self._least, self._most = inf, -inf

    def descend(self) -> Node:
        """Choose the sequence to try next: descend to an untried node, or to the depth."""
        node: Node = ()
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

    def _bound(self, node: Node, doubt: float) -> float:
        """Return the confidence bound of a node's value: upper for a positive ``doubt``, lower for a negative one."""
        returns, spread = self._returns[node], self._most - self._least
        return sum(returns) / len(returns) + doubt * self._exploration * spread / sqrt(self.visits[node])

    def learn(self, node: Node, brought: list[float]) -> None:
        """Add the rewards of a try, decision by decision; the agent may have ended before the node."""
        for depth in range(min(len(node), len(brought))):
            self._returns.setdefault(node[: depth + 1], []).append(sum(brought[depth:]))
        self._least, self._most = min(self._least, sum(brought)), max(self._most, sum(brought))

    def best(self) -> int:
        """Return the candidate with the largest lower confidence bound."""
        return max(range(self._candidates), key=lambda place: self._bound((place,), -1.0))
