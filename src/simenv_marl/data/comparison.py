"""Compares the model's own rule with policies, decision by decision."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, Unpack

import numpy as np
from numpy.typing import NDArray

from ..core.asking import AskingPolicy, asks_for_environment
from ..core.options import EpisodeOptions
from ..core.points import Points
from ..core.spaces import same
from ..core.stacking import stacker, taken
from ..errors import OptionValueError, short_repr
from ..many.batch import BatchPolicy
from ..simulation import RULE
from .collect import LeftToRule, check_known, collect_episodes
from .mixture import ask
from .trajectories import Trajectories, leaves

SHADOW: Final = "shadow action"
"""The extra in which the actions of the compared policies are recorded."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The decisions of the model's own rule, and what a policy would have decided. Made by ``compare_with_rule``.

    Attributes:
        trajectories: The trajectories of the rule.
        policy_actions: The actions that the policy would have taken on the same observations, in the form of
            ``trajectories.actions``. Where the policy would have left the decision to the rule, the rule's action.
        agreements: ``(N,)`` bool: whether both agree, for each decision.
    """

    trajectories: Trajectories
    policy_actions: Any
    agreements: NDArray[np.bool_]

    @property
    def agreement(self) -> float:
        """The share of decisions in which both agree, 0 to 1; nan if there are no decisions."""
        return float(self.agreements.mean()) if len(self.agreements) else float("nan")

    def __repr__(self) -> str:
        return f"<Comparison: agreement {self.agreement:.3f} in {len(self.agreements)} decisions>"


def compare_with_rule(
    simulation: Any,
    policies: Mapping[Any, Any],
    *,
    seeds: Iterable[int],
    points: Points = None,
    others: Mapping[Any, Any] | None = None,
    tolerance: float = 0.0,
    **options: Unpack[EpisodeOptions],
) -> dict[Any, Comparison]:
    """Let the model's own rule decide, and record what policies would have decided instead.

    At each decision the policy gets what it would get if it decided; then the rule decides. So the episodes are those
    of the plain model, unless ``others`` names policies that decide.

    Args:
        simulation: As ``collect_episodes`` takes it.
        policies: The policies to compare, as ``collect_episodes`` takes them. Their actions are not checked for being
            legal.
        seeds: The seeds of the simulations.
        points: The decision points, as ``generate_env`` takes them.
        others: Policies that decide instead of the rule, as ``collect_episodes`` takes policies. They are not compared.
        tolerance: The largest difference between numbers in two actions that agree. It applies to ``Box`` spaces of
            floats.
        **options: As ``collect_episodes`` takes them.

    Returns:
        A dict from each key of ``policies`` to its comparison.

    Raises:
        DefinitionError: The actions that correspond to the rule's decisions are unknown.
        OptionValueError: An argument has an invalid value.
        InvalidActionError: A policy did not return one action for each decision.
        SimEnvError: As ``collect_episodes`` raises it; this holds for all other errors, too.
    """
    if not isinstance(policies, Mapping) or not all(callable(policy) for policy in policies.values()):
        raise OptionValueError(
            f"policies must be a dict from agents or points to callables, not {short_repr(policies)}"
        )
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)) or not tolerance >= 0:
        raise OptionValueError(f"tolerance must be a number that is not negative, not {short_repr(tolerance)}")
    if others is not None and (not isinstance(others, Mapping) or others.keys() & policies.keys()):
        raise OptionValueError(
            "others must be a dict of policies for agents or points that policies does not name, not"
            f" {short_repr(others)}"
        )
    shadows = {id(policy): _shadow(policy) for policy in policies.values()}  # one for each, so that keys share batches
    deciding = {key: LeftToRule(shadows[id(policy)]) for key, policy in policies.items()}
    collected = collect_episodes(simulation, {**deciding, **(others or {})}, seeds=seeds, points=points, **options)
    return {key: _compare(collected[key], float(tolerance)) for key in policies}


# -- the policy beside the rule -------------------------------------------------------------------


def _shadow(policy: Any) -> Any:
    """Make a policy that records the action of another policy as an extra, and leaves the decision to the rule."""
    if asks_for_environment(policy):
        return partial(_record_one, AskingPolicy(policy))
    return partial(_record, policy, BatchPolicy(policy))


def _record(policy: Any, batch_policy: BatchPolicy, observations: Any, infos: Any, identities: Any) -> Any:
    recorded = np.empty(len(identities), object)
    for place, action in enumerate(ask(policy, batch_policy, observations, infos, identities)):
        recorded[place] = action
    return RULE, {SHADOW: recorded}


def _record_one(policy: AskingPolicy, observation: Any, info: Any, *, _environment: Any) -> Any:
    recorded = np.empty((), object)
    recorded[()] = policy.answer(observation, info, _environment)
    return RULE, {SHADOW: recorded}


# -- the comparison -------------------------------------------------------------------------------


def _compare(found: Trajectories, tolerance: float) -> Comparison:
    """Compare the rule's actions with those that a shadow has recorded."""
    recorded = found.extras.get(SHADOW, ())
    found = replace(found, extras={name: values for name, values in found.extras.items() if name != SHADOW})
    if not len(found):
        return Comparison(found, found.actions, np.zeros(0, np.bool_))
    check_known(found)
    assert found.action_space is not None
    actions = [taken(found.actions, np.array(row)) if action is RULE else action for row, action in enumerate(recorded)]
    policy_actions = stacker(found.action_space)(actions)
    pairs = zip(leaves(found.actions), leaves(policy_actions), strict=True)
    agreements = [_agreements(one, other, tolerance) for (_, one), (_, other) in pairs]
    return Comparison(found, policy_actions, np.all(agreements, axis=0))


def _agreements(one: NDArray[Any], other: NDArray[Any], tolerance: float) -> NDArray[np.bool_]:
    """Return in which rows two arrays agree."""
    if one.dtype == object:
        return np.array([same(*pair) for pair in zip(one, other, strict=True)], np.bool_)
    equal = np.abs(one - other) <= tolerance if one.dtype.kind == "f" else one == other
    return np.asarray(equal.reshape(len(one), -1).all(axis=1), np.bool_)
