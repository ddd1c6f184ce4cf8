"""A policy that looks several decisions ahead."""

from math import inf, log, sqrt
from typing import Any, Final

from ..errors import OptionValueError, shown
from .futures import Futures
from .lookahead import is_count, is_number
from .policy import RolloutPolicy

AT_ONCE: Final = 8
"""So many branches are under way between two looks at what was found: the same for every number of cores."""

Node = tuple[int, ...]
"""The places of the candidates that lead to it, decision by decision."""


class TreeSearchPolicy(RolloutPolicy):
    """A policy that tries out what it does now together with what it does next: open-loop UCT over branches.

    At each of the next ``depth`` decisions it tries the candidates that seem best, and those that it knows little of
    (UCB1); then the base decides. A node of the tree is a sequence of candidates, whatever chance has brought in
    between. Each candidate for the pending decision meets the same futures in the same order.

    It needs more branches than ``RolloutPolicy``, and is worth them where the worth of an action shows only with the
    right ones after it.
    """

    def __init__(self, actions: Any = None, *, depth: int = 2, exploration: float = 1.0, **options: Any) -> None:
        """Make a policy.

        Args:
            actions: The candidates, for this decision and the next ones; at those the base decides where one is masked.
            depth: How many decisions are tried out, this one included.
            exploration: How much is spent on candidates of which little is known, by the spread of the returns.
            **options: As ``RolloutPolicy`` takes them.

        Raises:
            OptionValueError: An argument cannot have its value.
        """
        if not is_count(depth):
            raise OptionValueError(f"depth must be a number of decisions, not {shown(depth)}")
        if not is_number(exploration) or exploration < 0:
            raise OptionValueError(f"exploration must be a number that is not negative, not {shown(exploration)}")
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
    """What was found out about sequences of candidates.

    Attributes:
        visits: By node, how often it was tried, tries under way included.
    """

    def __init__(self, candidates: int, depth: int, exploration: float) -> None:
        self._candidates, self._depth, self._exploration = candidates, depth, exploration
        self.visits: dict[Node, int] = {}
        self._returns: dict[Node, list[float]] = {}  # from the node's own decision on
        self._least, self._most = inf, -inf

    def descend(self) -> Node:
        """Choose what is tried out next: down to a node that was not tried, or to the depth."""
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
        """What a node is worth, and so much more as is in doubt; or less."""
        returns, spread = self._returns[node], self._most - self._least
        return sum(returns) / len(returns) + doubt * self._exploration * spread / sqrt(self.visits[node])

    def learn(self, node: Node, brought: list[float]) -> None:
        """Note what a try has brought, decision by decision; the agent may have ended before the node."""
        for depth in range(min(len(node), len(brought))):
            self._returns.setdefault(node[: depth + 1], []).append(sum(brought[depth:]))
        self._least, self._most = min(self._least, sum(brought)), max(self._most, sum(brought))

    def best(self) -> int:
        """The candidate that is worth most when all doubts are held against it."""
        return max(range(self._candidates), key=lambda place: self._bound((place,), -1.0))
