"""Mixtures of policies, which draw the policy of each decision."""

from collections.abc import Iterable, Mapping, Sequence
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.asking import asks_for_environment
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
            _check_part(policy, weight)
        weights = np.array([weight for _, weight in pairs], np.float64)
        if not weights.sum() > 0:
            raise OptionValueError("at least one weight of a mixture must be positive")
        self.policies: tuple[Any, ...] = tuple(policy for policy, _ in pairs)
        self.weights: NDArray[np.float64] = weights / weights.sum()
        self._bounds = np.cumsum(self.weights)[:-1]
        self._batch_policies = [None if policy is RULE else BatchPolicy(policy) for policy in self.policies]

    def __repr__(self) -> str:
        parts = zip(self.policies, self.weights.tolist(), strict=True)
        return f"<Mixture: {', '.join(f'{weight:.3g} {policy_name(policy)}' for policy, weight in parts)}>"

    def __call__(self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]) -> Any:
        """Answer a batch of decisions, as policies of ``collect_episodes`` do."""
        component = np.searchsorted(self._bounds, _random_numbers(identities), side="right")
        actions: list[Any] = [RULE] * len(identities)
        for number, batch_policy in enumerate(self._batch_policies):
            own = np.flatnonzero(component == number)
            if batch_policy is None or not len(own):
                continue
            places = own.tolist()
            arguments = taken(observations, own), [infos[row] for row in places], [identities[row] for row in places]
            for row, action in zip(places, ask(self.policies[number], batch_policy, *arguments), strict=True):
                actions[row] = action
        return actions, {"component": component}


def _check_part(policy: Any, weight: Any) -> None:
    """Check a policy of a mixture and its weight."""
    if policy is not RULE and not callable(policy):
        raise OptionValueError(f"a mixture consists of policies, callables or RULE, not of {short_repr(policy)}")
    if asks_for_environment(policy):
        raise OptionValueError(f"{short_repr(policy)} asks for the environment, which a mixture does not have")
    number = isinstance(weight, (int, float)) and not isinstance(weight, bool)
    if not number or not isfinite(weight) or weight < 0:
        raise OptionValueError(
            f"the weight of {short_repr(policy)} must be a number that is not negative, not {short_repr(weight)}"
        )


def _random_numbers(identities: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
    """Return a number in [0, 1) for each decision, which depends on its identity alone."""
    # SplitMix64, twice: to make a generator for each decision would take longer than the decision.
    seeds = np.array([seed % 2**64 for seed, _ in identities], np.uint64)
    turns = np.array([turn for _, turn in identities], np.uint64)
    return np.asarray((_splitmix(_splitmix(seeds) + turns) >> np.uint64(11)) * 2.0**-53, np.float64)


def _splitmix(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    state = state + np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


def ask(policy: Any, batch_policy: BatchPolicy, observations: Any, infos: Any, identities: Any) -> list[Any]:
    """Ask a policy for the actions of some decisions, and drop the extras.

    Raises:
        InvalidActionError: The policy did not return one action for each decision.
    """
    number, answers = len(identities), batch_policy.answers(observations, infos, identities)
    if type(answers) is tuple and len(answers) == 2 and isinstance(answers[1], Mapping):
        answers = answers[0]
    actions = [RULE] * number if answers is RULE else rows(answers, integers=False)
    if actions is None or len(actions) != number:
        returned = short_repr(answers) if actions is None else f"{len(actions)} actions"
        raise InvalidActionError(
            f"{short_repr(policy)} was asked for {number} decisions at once and returned {returned}; it must return"
            " one action for each row of the observations, in their order"
        )
    return actions


def policy_name(policy: Any) -> str:
    """Return the name of a policy."""
    return "rule" if policy is RULE else str(getattr(policy, "__qualname__", None) or short_repr(policy))


def follows_rule(policy: Any) -> bool:
    """Return whether a policy certainly leaves decisions to the rule."""
    if isinstance(policy, Mixture):
        return any(follows_rule(part) for part, weight in zip(policy.policies, policy.weights, strict=True) if weight)
    return policy is RULE
