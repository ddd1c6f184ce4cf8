"""Policies that try candidates before they decide."""

from collections.abc import Callable, Iterable, Mapping
from math import ceil, log2
from typing import Any

import numpy as np

from ..core.session import checked_seed
from ..errors import OptionValueError, short_repr
from ..simulation import RULE
from .futures import Futures
from .lookahead import Lookahead, is_count, within_a_branch
from .values import ActionValues, base_value, valued


class RolloutPolicy:
    """A policy that looks one decision ahead: it tries candidate actions in branches and takes the best one.

    It uses sequential halving (Karnin, Koren and Somekh, 2013). The budget is divided among rounds. In each round, all
    remaining candidates are tried on the same futures, and the better half of them goes on.

    The policy can be used like any policy that answers one decision at a time; it gets the environment as
    ``_environment``. In a branch of a planner it acts as its own base.

    Attributes:
        base: What decides after a candidate.
        budget: The number of branches per decision. None: the number of candidates times ``futures``.
    """

    def __init__(
        self,
        actions: Any = None,
        *,
        base: Any = RULE,
        futures: int = 16,
        horizon: float | None = None,
        horizon_by: str = "decision",
        terminal_value: Callable[[Any], float] | None = None,
        discount: float = 1.0,
        discount_by: str = "decision",
        budget: int | None = None,
        seed: int | None = None,
        method: str | None = None,
        time_limit: float = 600.0,
    ) -> None:
        """Make a policy.

        Args:
            actions: The candidates. Candidates that are masked at a decision are left out there. None: all legal
                actions of a ``Discrete``.
            base: What decides after a candidate, as ``action_values`` takes it.
            futures: The mean number of futures per candidate, if there is no ``budget``.
            horizon: The length of a future, as ``action_values`` takes it.
            horizon_by: The unit of the horizon, as ``action_values`` takes it.
            terminal_value: The value after the horizon, as ``action_values`` takes it.
            discount: The discount factor, as ``action_values`` takes it.
            discount_by: The unit of discounting, as ``action_values`` takes it.
            budget: The number of branches per decision.
            seed: A number that distinguishes the futures from those of another planner.
            method: The method of branching, as ``branch`` takes it.
            time_limit: The time after which a branch is ended, in seconds.

        Raises:
            OptionValueError: An argument has an invalid value.
        """
        if budget is not None and not is_count(budget):
            raise OptionValueError(f"budget must be a number of branches or None, not {short_repr(budget)}")
        self._look = Lookahead(
            base=base, futures=futures, horizon=horizon, horizon_by=horizon_by, terminal_value=terminal_value,
            discount=discount, discount_by=discount_by, method=method, time_limit=time_limit,
        )  # fmt: skip
        self.base, self.budget = base, budget
        self._actions: Any = actions
        if isinstance(actions, Iterable) and not isinstance(actions, (str, Mapping)):
            self._actions = list(actions)  # an iterator would be used up by the first decision
        self._seed = checked_seed(seed)

    def choose(self, env: Any) -> ActionValues:
        """Find the best candidate for the pending decision of an environment.

        Args:
            env: The environment, as ``action_values`` takes it. It does not move.

        Returns:
            The values. ``best`` is one of the candidates of the last round. A single candidate is not tried.

        Raises:
            OptionValueError: The budget is too small to try each candidate.
            SimEnvError: As ``action_values`` raises it; this holds for all other errors, too.
        """
        if within_a_branch():
            return base_value(env, self.base)
        found = Futures(env, self._actions, self._look, self._seed, legal=True)
        number = len(found.actions)
        budget = number * self._look.futures if self.budget is None else self.budget
        if budget < number:
            raise OptionValueError(f"a budget of {budget} branches is too small to try {number} candidates once")
        return valued(found, self._search(found, budget) if number > 1 else [0])

    def _search(self, found: Futures, budget: int) -> list[int]:
        """Try candidates; return the places of the finalists."""
        left = list(range(len(found.actions)))
        for rounds in range(ceil(log2(len(left))), 0, -1):
            more = min(max(1, budget // (len(left) * rounds)), budget // len(left))
            budget -= more * len(left)
            found.run(left, more)
            if rounds > 1:
                means = [np.mean(found.returns[place]) for place in left]
                better = np.argsort(-np.array(means), kind="stable")[: (len(left) + 1) // 2]
                left = [left[place] for place in sorted(better.tolist())]
        return left

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        """Answer a decision, as policies do.

        Returns:
            The best action; within a branch, the answer of the base.
        """
        return self.choose(_environment).best
