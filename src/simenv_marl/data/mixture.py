"""Mixtures of policies, and helpers for the policies that users give."""

from collections.abc import Iterable, Mapping, Sequence
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.planner import is_planner
from ..core.stacking import rows, taken
from ..errors import InvalidActionError, OptionValueError, short_repr
from ..many.batch import BatchPolicy
from ..simulation import RULE


class Mixture:
    """A policy for ``collect_episodes`` that draws, for each decision, which of several policies answers it.

    The draw depends only on the seed of the episode and the number of the decision in it. It does not depend on other
    simulations or on the number of processes. ``extras["component"]`` has the index of the policy that decided; the
    extras of the policies themselves are dropped.

    Example:
        ``Mixture({RULE: 0.8, trained: 0.2})``
    """

    def __init__(self, parts: Mapping[Any, float] | Iterable[tuple[Any, float]]) -> None:
        """Mix policies.

        Args:
            parts: A dict from policy to weight, or an iterable of such pairs. A policy is anything that
                ``collect_episodes`` takes. Weights are not negative and need not sum to one.

        Raises:
            OptionValueError: There are no policies, or a weight is invalid.
        """
        pairs = list(parts.items() if isinstance(parts, Mapping) else parts)
        if not pairs or any(not isinstance(pair, tuple) or len(pair) != 2 for pair in pairs):
            raise OptionValueError(
                f"a mixture needs a dict from policies to weights, or pairs of these, not {short_repr(parts)}"
            )
        for policy, weight in pairs:
            if policy is not RULE and not callable(policy):
                raise OptionValueError(
                    f"a mixture consists of policies, callables or RULE, not of {short_repr(policy)}"
                )
            if is_planner(policy):
                raise OptionValueError(f"{short_repr(policy)} asks for the environment, which a mixture does not have")
            if (
                isinstance(weight, bool)
                or not isinstance(weight, (int, float))
                or not (isfinite(weight) and weight >= 0)
            ):
                raise OptionValueError(
                    f"the weight of {short_repr(policy)} must be a number that is not negative, not"
                    f" {short_repr(weight)}"
                )
        weights = np.array([weight for _, weight in pairs], np.float64)
        if not weights.sum() > 0:
            raise OptionValueError("at least one weight of a mixture must be positive")
        self.policies: tuple[Any, ...] = tuple(policy for policy, _ in pairs)
        self.weights: NDArray[np.float64] = weights / weights.sum()
        self._bounds = np.cumsum(self.weights)[:-1]
        self._asked = [None if policy is RULE else BatchPolicy(policy) for policy in self.policies]

    def __repr__(self) -> str:
        parts = zip(self.policies, self.weights.tolist(), strict=True)
        return f"<Mixture: {', '.join(f'{weight:.3g} {name_of(policy)}' for policy, weight in parts)}>"

    def __call__(self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]) -> Any:
        """Answer a batch of decisions, as policies of ``collect_episodes`` do."""
        component = np.searchsorted(self._bounds, _drawn(identities), side="right")
        actions: list[Any] = [RULE] * len(identities)
        for number, asked in enumerate(self._asked):
            own = np.flatnonzero(component == number)
            if asked is None or not len(own):
                continue
            where = own.tolist()
            returned = asked.answers(
                taken(observations, own), [infos[row] for row in where], [identities[row] for row in where]
            )
            for row, action in zip(where, actions_of(returned, len(where), self.policies[number]), strict=True):
                actions[row] = action
        return actions, {"component": component}


def _drawn(identities: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
    """Return a number in [0, 1) for each decision, which depends on its identity alone."""
    # SplitMix64, twice: a generator of its own for each decision would take longer than the decision.
    state = np.array([seed % 2**64 for seed, _ in identities], np.uint64)
    turns = np.array([turn for _, turn in identities], np.uint64)
    return np.asarray((_mixed(_mixed(state) + turns) >> np.uint64(11)) * 2.0**-53, np.float64)


def _mixed(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    state = state + np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


def actions_of(returned: Any, number: int, policy: Any) -> list[Any]:
    """Return the actions that a policy returned for ``number`` decisions, without its extras."""
    if type(returned) is tuple and len(returned) == 2 and isinstance(returned[1], Mapping):
        returned = returned[0]
    actions = [RULE] * number if returned is RULE else rows(returned, integers=False)
    if actions is None or len(actions) != number:
        what = short_repr(returned) if actions is None else f"{len(actions)} actions"
        raise InvalidActionError(
            f"{short_repr(policy)} was asked for {number} decisions at once and has returned {what}"
        )
    return actions


def name_of(policy: Any) -> str:
    """Return the name of a policy."""
    return "rule" if policy is RULE else str(getattr(policy, "__qualname__", None) or short_repr(policy))


def defers(policy: Any) -> bool:
    """Return whether a policy certainly leaves decisions to the rule."""
    if isinstance(policy, Mixture):
        return any(defers(part) for part, weight in zip(policy.policies, policy.weights, strict=True) if weight)
    return policy is RULE
