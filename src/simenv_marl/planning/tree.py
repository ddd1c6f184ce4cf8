"""The tree search: a policy that looks several decisions ahead, and its checkpoints."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain
from math import log, sqrt
from threading import Lock
from time import perf_counter
from typing import Any, ClassVar, Final

from ..core import branch, clone, pending_view
from ..envs import SimulationJointEnv, SimulationTurnEnv
from ..errors import BranchError, OptionValueError
from .candidates import First
from .rollout import BEGIN, Indices, Rollout, Try
from .rollouts import CHECKS, Checks, RolloutPolicy, Rollouts, is_count, is_weight

_AT_ONCE: Final = 8
"""The number of branches that run before a tree is updated.

It does not depend on the number of cores, so that results do not.
"""

_MOST: Final = 200
"""The largest number of checkpoints that are kept. Each takes some megabytes."""


class Tree(Rollouts):
    """The rollouts of sequences of candidates, which are the nodes of a tree.

    Candidates that decide to the horizon, and those that were added, are leaves.
    """

    policy: TreeSearchPolicy

    def search(self, budget: int) -> Indices:
        """Try nodes; return the best one."""
        self._candidates = list(range(len(self.courses)))
        given = self.courses[: self.given]
        self._inner = [
            index for index, course in enumerate(given) if not isinstance(course.candidate, First)
        ]
        self._visits: Counter[Indices] = Counter()  # also by tries that are running
        self._returns: dict[Indices, list[float]] = {}  # from the node's own decision on
        self._totals: list[float] = []
        checkpoints: Checkpoints | None = None
        try:
            for begin in range(0, budget, _AT_ONCE):
                tries = [self.next_try() for _ in range(min(_AT_ONCE, budget - begin))]
                results = (checkpoints or self).make(tries)
                self.record(tries, results)
                for (node, _), rollout in zip(tries, results, strict=True):
                    self.learn(node, rollout)
                if begin == 0:
                    checkpoints = self.begin_checkpoints()
        finally:
            if checkpoints is not None:
                checkpoints.close()
        if self.reseeds:
            return self.best()
        return max(self.rollouts, key=self.exact_return)

    def begin_checkpoints(self) -> Checkpoints | None:
        """Begin to keep checkpoints, if there is one exact future and they save time.

        A checkpoint spares a try half of the depth in the mean, and costs a fork. Processes of
        clones have neither the wrappers of an environment nor the infos of joint or turn views.
        """
        policy = self.policy
        if self.reseeds or policy.method == "replay" or policy.depth == 1:
            return None
        view = pending_view(self.env, "planning")
        if view is not self.env or isinstance(view, (SimulationJointEnv, SimulationTurnEnv)):
            return None
        began = perf_counter()
        try:
            root = clone(view, method="fork", time_limit=policy.time_limit)
        except (BranchError, OptionValueError):  # only a replay is possible
            return None
        cost = perf_counter() - began
        step = max(rollout.seconds for rollout in chain(*self.rollouts.values()))
        if step * policy.depth / 2 > cost:
            return Checkpoints(root, self)
        root.close()
        return None

    def next_try(self) -> Try:
        """Choose the next try: descend to an untried node, or to the depth."""
        node: Indices = ()
        while len(node) < self.policy.depth and (not node or node[0] in self._inner):
            indices = self._candidates
            if node:
                indices = self._inner
            children = [(*node, index) for index in indices]
            untried = [child for child in children if child not in self._returns]
            if untried:
                node = min(untried, key=self._visits.__getitem__)
                break
            visits = sum(self._visits[child] for child in children)
            upper = partial(self._bound, doubt=sqrt(log(visits)))
            node = max(children, key=upper)
        for length in range(1, len(node) + 1):
            self._visits[node[:length]] += 1
        future = 0
        if self.reseeds:
            future = self._visits[node[:1]] - 1
        return node, future

    def _bound(
        self,
        node: Indices,
        doubt: float,
    ) -> float:
        """Return the bound of a node's value: upper for a positive doubt, else lower."""
        returns = self._returns[node]
        spread = max(self._totals) - min(self._totals)
        error = self.policy.exploration * spread / sqrt(self._visits[node])
        return sum(returns) / len(returns) + doubt * error

    def learn(
        self,
        node: Indices,
        rollout: Rollout,
    ) -> None:
        """Add the rewards of a try, by candidate. The agent may have ended before the last."""
        for depth, begin in enumerate(rollout.begins):
            returned = sum(rollout.rewards[begin:])
            self._returns.setdefault(node[: depth + 1], []).append(returned)
        self._totals.append(sum(rollout.rewards))

    def best(self) -> Indices:
        """Return the best node but for ``RULE``: by lower bound, then by visits."""
        lower = partial(self._bound, doubt=-1.0)
        first = [(index,) for index in self._candidates if index != self.rule]
        node: Indices = max(first, key=lower)
        while len(node) < self.policy.depth and node[0] in self._inner:
            children = [(*node, index) for index in self._inner]
            tried = [child for child in children if child in self._returns]
            if not tried:
                break
            node = max(tried, key=lambda child: (self._visits[child], lower(child)))
        return node


# -- checkpoints, where there is one exact future: no state is reached twice -----------------------


class Checkpoints:
    """The checkpoints of one search: clones that have taken candidates, and are not stepped again.

    A lock is held while a clone is cloned, or ends, because the process of the first one waits.
    """

    def __init__(
        self,
        root: Any,
        rollouts: Rollouts,
    ) -> None:
        """Begin with a clone of the environment, which is the root."""
        self._search = rollouts
        self._lock = Lock()
        self._clones = [root]
        # The clones and the rollouts up to there, by the candidates that they have taken.
        self._checkpoints: dict[Indices, tuple[Any, Rollout]] = {(): (root, BEGIN)}
        self._rollouts: dict[Indices, Rollout] = {}

    def make(self, tries: Sequence[Try]) -> list[Rollout]:
        """Make rollouts, each from the nearest checkpoint."""
        nodes = [node for node, _ in tries]
        new = dict.fromkeys(node for node in nodes if node not in self._rollouts)
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:  # they wait for processes
            results = pool.map(self._make, new)
            self._rollouts |= zip(new, results, strict=True)
        return [self._rollouts[node] for node in nodes]

    def _make(self, node: Indices) -> Rollout:
        """Make a rollout, and a checkpoint after its candidates."""
        lengths = [length for length in range(len(node)) if node[:length] in self._checkpoints]
        nearest, begun = self._checkpoints[node[: lengths[-1]]]
        if begun.over:  # further candidates are never taken
            return begun
        function = self._search.trying([(node, 0)])
        limit = self._search.policy.time_limit
        with self._lock:
            try:
                env = clone(nearest, method="fork", time_limit=limit)
            except BranchError:  # the model has opened something since
                [rollout] = branch(self._clones[0], function, time_limit=limit)
                return rollout
        self._clones.append(env)
        reached: Rollout = env.call(partial(function, begun=begun, stop=len(node)), 0)
        rollout = reached
        if not reached.over:
            [rollout] = branch(env, partial(function, begun=reached), time_limit=limit)
        if len(self._checkpoints) < _MOST:
            self._checkpoints[node] = env, reached
        else:
            with self._lock:
                env.close()
        return rollout

    def close(self) -> None:
        """Close all clones."""
        for env in self._clones:
            env.close()


# -- the policy -----------------------------------------------------------------------------------


@dataclass(kw_only=True, eq=False, repr=False)
class TreeSearchPolicy(RolloutPolicy):
    """A policy that looks several decisions ahead, by open-loop UCT over branches.

    At each of the next ``depth`` decisions it tries the candidates that seem best, or that were
    tried little (UCB1); then the base decides. A node of the tree is a sequence of candidates,
    for any chance events between them. All candidates for the pending decision meet the same
    futures in the same order.

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

    _rollouts: ClassVar[type[Rollouts]] = Tree
    _checks: ClassVar[Checks] = {
        **CHECKS,
        "depth": (is_count, "a number of decisions"),
        "exploration": (is_weight, "a number that is not negative"),
    }
