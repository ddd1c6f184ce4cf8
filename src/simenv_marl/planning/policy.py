"""Policies that try out candidates before they decide."""

from collections.abc import Callable, Iterable, Mapping
from math import ceil, log2
from typing import Any

import numpy as np

from ..core.session import checked_seed
from ..errors import OptionValueError, shown
from ..simulation import RULE
from .futures import Futures
from .lookahead import Lookahead, is_count, within_a_branch
from .values import ActionValues, base_value, valued


class RolloutPolicy:
    """A policy that looks one decision ahead of a base, and spends its branches on the candidates that are in the race.

    By sequential halving (Karnin, Koren and Somekh, 2013): the budget is divided among rounds, in each of which all
    candidates that are left are tried out on the same futures; the better half of them goes on.

    It serves wherever a policy for one decision at a time does, by ``_environment``. In a branch of a planner it is its
    own base.

    Attributes:
        base: Who decides after a candidate.
        budget: How many branches a decision may take; None: as many as candidates times ``futures``.
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
            actions: The candidates. Those that are masked at a decision are left out there. None: all legal actions of
                a ``Discrete``.
            base: As ``action_values`` takes it, and so are all others that are not named here.
            futures: In how many futures a candidate is tried on average, where there is no ``budget``.
            horizon: How far a future reaches.
            horizon_by: By what it is counted.
            terminal_value: What comes after it.
            discount: By what a reward is discounted.
            discount_by: By what that is counted.
            budget: How many branches a decision may take.
            seed: Tells the futures from those of another planner.
            method: As ``branch`` takes it.
            time_limit: After how many seconds a branch is ended.

        Raises:
            OptionValueError: An argument cannot have its value.
        """
        if budget is not None and not is_count(budget):
            raise OptionValueError(f"budget must be a number of branches or None, not {shown(budget)}")
        self._look = Lookahead(
            base=base, futures=futures, horizon=horizon, horizon_by=horizon_by, terminal_value=terminal_value,
            discount=discount, discount_by=discount_by, method=method, time_limit=time_limit,
        )  # fmt: skip
        self.base, self.budget = base, budget
        self._actions: Any = actions
        if isinstance(actions, Iterable) and not isinstance(actions, (str, Mapping)):
            self._actions = list(actions)  # which are asked for at each decision
        self._seed = checked_seed(seed)

    def choose(self, env: Any) -> ActionValues:
        """Find out which candidate for the pending decision of an environment is best.

        Args:
            env: The environment, as ``action_values`` takes it. It does not move.

        Returns:
            The values. ``best`` is one of those that were in the race to the end. Where there is one candidate, it is
            not tried.

        Raises:
            OptionValueError: The budget is too small to try each candidate.
            SimEnvError: As ``action_values`` does; so are all other errors.
        """
        if within_a_branch():
            return base_value(env, self.base)
        found = Futures(env, self._actions, self._look, self._seed, legal=True)
        number = len(found.actions)
        budget = number * self._look.futures if self.budget is None else self.budget
        if budget < number:
            raise OptionValueError(f"a budget of {budget} branches does not suffice to try {number} candidates once")
        return valued(found, self._search(found, budget) if number > 1 else [0])

    def _search(self, found: Futures, budget: int) -> list[int]:
        """Try out candidates; return the places of those that the best is one of."""
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
        """Decide, as policies do.

        Returns:
            The best action; within a branch what the base decides.
        """
        return self.choose(_environment).best
