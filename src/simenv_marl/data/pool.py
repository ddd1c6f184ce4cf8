"""A growing list of policies: another one decides in each episode."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..core import (
    Action,
    AskingPolicy,
    EpisodePolicy,
    Info,
    Observation,
    Policy,
    checked_seed,
    takes_state,
)
from ..errors import OptionValueError, short_repr
from ..simulation import RULE, is_number


class OpponentPool(EpisodePolicy):
    """A policy that draws one of its policies for each episode, for self-play.

    It draws at the first decision of an episode, by the episode's seed. Agents that share a pool
    get the same policy. Worker processes have a copy of the pool as it is when they begin.

    Attributes:
        policies: The policies.
        weights: Their weights.
    """

    looks_back = True
    asks = True

    def __init__(
        self,
        policies: Iterable[Policy],
        *,
        weights: Sequence[float] | None = None,
        seed: int | None = None,
    ) -> None:
        """Begin with some policies.

        Args:
            policies: Functions, or ``RULE``. They answer at once; besides an observation and an
                info they may ask for ``_decision`` and ``_simulation``.
            weights: How often each is drawn, relative to the others. None: equally often.
            seed: Another seed draws other policies. None: 0.

        Raises:
            OptionValueError: An argument is invalid.
        """
        policies = list(policies)
        weights = [1.0] * len(policies) if weights is None else list(weights)
        if len(weights) != len(policies):
            raise OptionValueError(
                f"weights must have one number for each of {len(policies)} policies, not"
                f" {len(weights)}"
            )
        self.policies: list[Policy] = []
        self.weights: list[float] = []
        self.policy = self
        self._asked: list[AskingPolicy | None] = []  # None: the rule
        self._seed = checked_seed(seed) or 0
        for policy, weight in zip(policies, weights, strict=True):
            self.add(policy, weight)

    def add(self, policy: Policy, weight: float = 1.0) -> None:
        """Add a policy. An episode keeps the policy that the pool has drawn for it.

        Args:
            policy: The policy.
            weight: How often it is drawn, relative to the others.

        Raises:
            OptionValueError: It is no policy that answers at once, or the weight is negative.
        """
        if not (is_number(weight) and 0 <= weight < np.inf):
            raise OptionValueError(f"a weight must be a number from 0 on, not {short_repr(weight)}")
        asked = AskingPolicy(policy) if callable(policy) else None
        if asked is None:
            is_fit = policy is RULE
        else:
            is_fit = not (asked.plans or asked.waits or takes_state(policy))
        if not is_fit:
            raise OptionValueError(
                "a pool has functions that answer at once, without _environment and _state, or"
                f" RULE, not {short_repr(policy)}"
            )
        self.policies.append(policy)
        self.weights.append(float(weight))
        self._asked.append(asked)

    def draw(self, seed: int) -> int:
        """Return the index of the policy that decides in the episode with a seed.

        Raises:
            OptionValueError: No policy has a weight.
        """
        total = sum(self.weights)
        if not total:
            raise OptionValueError("the pool has no policy with a weight above 0; add one")
        random = np.random.default_rng([self._seed, seed])
        return int(random.choice(len(self.weights), p=np.divide(self.weights, total)))

    def answer(self, episode: Any, agent: Any, observation: Observation, info: Info) -> Action:
        """Answer by the policy that is drawn for the episode."""
        index = episode.memory.get(self)
        if index is None:
            index = episode.memory[self] = self.draw(episode.seed)
        asked = self._asked[index]
        return RULE if asked is None else asked.answer(episode, agent, observation, info)
