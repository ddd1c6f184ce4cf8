"""The tree search: a policy that looks several decisions ahead, and the states that it keeps."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from math import inf, log, sqrt
from threading import Lock
from time import perf_counter
from typing import Any, Final

from ..core import branch, clone
from ..errors import BranchError, OptionValueError
from .player import Progress, is_count, is_number, rollout_from, try_out
from .rollouts import Plan, RolloutPolicy, Rollouts

_AT_ONCE: Final = 8
"""The number of branches that run before a tree is updated.

It does not depend on the number of cores.
"""

_MOST: Final = 200
"""The largest number of states that are kept. Each takes some megabytes."""


@dataclass(kw_only=True, eq=False, repr=False)
class TreeSearchPolicy(RolloutPolicy):
    """A policy that looks several decisions ahead, by open-loop UCT over branches.

    At each of the next ``depth`` decisions it tries the candidates that seem best, and those of
    which it knows little (UCB1); then the base decides. A node of the tree is a sequence of
    candidates, whatever chance events lie between them. All candidates for the pending decision
    meet the same futures in the same order.

    It needs more branches than ``RolloutPolicy``. They pay off if an action is only good with the
    right actions after it.

    Attributes:
        actions: The candidates for this decision and the next ones. If a candidate is masked at a
            next decision, the base decides there.
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

    def _search(self, rollouts: Rollouts, budget: int) -> list[Plan]:
        tree = _Tree(len(rollouts.actions), self.depth, self.exploration, rollouts.added)
        try:
            for begin in range(0, budget, _AT_ONCE):
                batch: list[tuple[Plan, int]] = []
                for _ in range(min(_AT_ONCE, budget - begin)):
                    plan = tree.descend()
                    batch.append((plan, tree.visits[plan[:1]] - 1 if rollouts.reseeds else 0))
                for (plan, _), rewards in zip(batch, rollouts.run(batch), strict=True):
                    tree.learn(plan, rewards)
                if begin == 0:
                    rollouts.states = self._states_of(rollouts)
        finally:
            if rollouts.states is not None:
                rollouts.states.close()
        return [tree.best() if rollouts.reseeds else max(rollouts.outcomes, key=rollouts.certain)]

    def _states_of(self, rollouts: Rollouts) -> States | None:
        """Begin to keep states, if there is one exact future and this saves more steps than a fork costs."""
        if rollouts.reseeds or self.method == "replay" or self.depth == 1:
            return None
        if rollouts.env is not rollouts.env.unwrapped:  # wrappers are not in a clone's process
            return None
        began = perf_counter()
        try:
            root = clone(rollouts.env, method="fork", time_limit=self.time_limit)
        except (BranchError, OptionValueError):  # only a replay is possible
            return None
        # a try repeats half of the depth in the mean
        if rollouts.seconds * self.depth / 2 > perf_counter() - began:
            return States(root, self, rollouts.actions)
        root.close()
        return None


class _Tree:
    """The results of sequences of candidates.

    If ``RULE`` was ``added`` as the last one, it is a leaf.
    """

    def __init__(self, candidates: int, depth: int, exploration: float, added: bool) -> None:
        self._first, self._others = range(candidates), range(candidates - added)
        self._depth, self._exploration = depth, exploration
        # the tries of each node, including those that are running
        self.visits: dict[Plan, int] = {}
        self._returns: dict[Plan, list[float]] = {}  # returns from the node's own decision on
        self._least, self._most = inf, -inf

    def descend(self) -> Plan:
        """Choose the sequence to try next: descend to an untried node, or to the depth."""
        node: Plan = ()
        while len(node) < self._depth and (not node or node[0] in self._others):
            below = [(*node, place) for place in (self._others if node else self._first)]
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
        return sum(returns) / len(returns) + doubt * self._exploration * spread / sqrt(
            self.visits[node]
        )

    def learn(self, node: Plan, rewards: list[float]) -> None:
        """Add the rewards of a try, decision by decision.

        The agent may have ended before the node.
        """
        for depth in range(min(len(node), len(rewards))):
            self._returns.setdefault(node[: depth + 1], []).append(sum(rewards[depth:]))
        self._least, self._most = min(self._least, sum(rewards)), max(self._most, sum(rewards))

    def best(self) -> Plan:
        """Return the best plan, which the added ``RULE`` is compared with later: by lower bound, then by visits."""
        plan: Plan = (max(self._others, key=lambda place: self._bound((place,), -1.0)),)
        while len(plan) < self._depth:
            below = [child for place in self._others if (child := (*plan, place)) in self._returns]
            if not below:
                break
            plan = max(below, key=lambda child: (self.visits[child], self._bound(child, -1.0)))
        return plan


# -- states that are kept where there is one exact future: none is reached twice -------------------


class Node:
    """A clone that has taken the candidates of a plan.

    Attributes:
        env: The clone, which is never stepped again; None if there were too many already.
        progress: What the candidates have brought.
        outcome: What they bring in the end, if the base decides from there.
        lock: Held while the clone, or one of its clones, is used here.
    """

    def __init__(self, env: Any, progress: Progress, outcome: Any = None) -> None:
        self.env, self.progress, self.outcome, self.lock = env, progress, outcome, Lock()


class States:
    """The states of one search, by plan."""

    def __init__(self, root: Any, policy: Any, actions: Sequence[Any]) -> None:
        """Begin with a clone of the environment, which is the root."""
        self._policy, self._actions = policy, actions
        self._nodes: dict[Plan, Node] = {(): Node(root, Progress())}

    def run(self, plans: Sequence[Plan]) -> list[Any]:
        """Return the outcome of each plan."""
        new = [plan for plan in dict.fromkeys(plans) if plan not in self._nodes]
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:  # they wait for processes
            self._nodes.update(zip(new, pool.map(self._reach, new), strict=True))
        return [self._nodes[plan].outcome for plan in plans]

    def _reach(self, plan: Plan) -> Node:
        """Reach the state of a plan from that of its longest part that was reached before."""
        parts = (self._nodes.get(plan[:length]) for length in range(len(plan) - 1, -1, -1))
        parent = next(node for node in parts if node is not None and node.env is not None)
        root, actions = self._nodes[()], [self._actions[place] for place in plan]
        node = Node(None, parent.progress)
        try:
            with parent.lock:
                env = clone(parent.env, method="fork", time_limit=self._policy.time_limit)
        # it has opened something since; a replay belongs to the thread that makes it
        except BranchError:
            once = partial(try_out, tries=[(actions, 0)], policy=self._policy)
            with root.lock:
                [node.outcome] = branch(root.env, once, time_limit=self._policy.time_limit)
            return node
        try:
            node.progress, node.outcome = env.unwrapped.call(
                _take, actions, self._policy, parent.progress
            )
            if len(self._nodes) < _MOST:
                node.env = env
            return node
        finally:
            if node.env is None:
                with parent.lock:  # whose process waits for it
                    env.close()

    def close(self) -> None:
        """End all clones."""
        for node in self._nodes.values():
            if node.env is not None:
                node.env.close()


def _take(env: Any, actions: list[Any], policy: Any, progress: Progress) -> tuple[Progress, Any]:
    """In a clone, take the actions that are still to take.

    Return the progress, and the outcome with the base.
    """
    progress, outcome = rollout_from(env, actions, policy, progress, stop=len(actions))
    if not progress.over:
        [outcome] = branch(
            env,
            lambda twin, number: rollout_from(twin, actions, policy, progress)[1],
            time_limit=policy.time_limit,
        )
    return progress, outcome
