"""The states that a tree search keeps, as clones, where there is one exact future: none is reached twice."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import Any, Final

from ..core.clone import branch, clone
from .player import Progress, rollout_from

Plan = tuple[int, ...]
"""The places of the candidates to take at the agent's next decisions, beginning with the pending one."""

_MOST: Final = 200
"""The largest number of states that are kept. Each takes some megabytes."""


class Node:
    """A clone that has taken the candidates of a plan.

    Attributes:
        env: The clone, which is never stepped again; None if there were too many already.
        progress: What the candidates have brought.
        outcome: What they bring in the end, if the base decides from there.
        lock: Held while the clone is cloned.
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
        with parent.lock:
            env = clone(parent.env, time_limit=self._policy.time_limit)
        node = Node(None, parent.progress)
        try:
            actions = [self._actions[place] for place in plan]
            node.progress, node.outcome = env.unwrapped.call(_take, actions, self._policy, parent.progress)
            if len(self._nodes) < _MOST:
                node.env = env
            return node
        finally:
            if node.env is None:
                env.close()

    def close(self) -> None:
        """End all clones."""
        for node in self._nodes.values():
            if node.env is not None:
                node.env.close()


def _take(env: Any, actions: list[Any], policy: Any, progress: Progress) -> tuple[Progress, Any]:
    """In a clone, take the actions that are still to take; return the progress, and the outcome with the base."""
    progress, outcome = rollout_from(env, actions, policy, progress, stop=len(actions))
    if not progress.over:
        [outcome] = branch(
            env, lambda twin, number: rollout_from(twin, actions, policy, progress)[1], time_limit=policy.time_limit
        )
    return progress, outcome
