"""Compares the model's own rule with policies, decision by decision."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Unpack

import numpy as np
from numpy.typing import NDArray

from ..core.options import EpisodeOptions
from ..core.planner import PlannerPolicy, is_planner
from ..core.points import Points
from ..core.spaces import same as alike
from ..core.stacking import stacker
from ..errors import OptionValueError, short_repr
from ..many.batch import BatchPolicy
from ..simulation import RULE
from .collect import collect_episodes
from .mixture import actions_of
from .rule_actions import check_knowable, check_known
from .trajectories import Trajectories

PLAYING: Final = ("batch_size", "collect", "progress", "workers")
"""Options of ``collect_episodes`` that are not options of the environment."""


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
    by_rule = dict.fromkeys(policies, RULE)
    checked = {name: value for name, value in options.items() if name not in PLAYING}
    check_knowable(simulation, {**by_rule, **(others or {})}, by_rule, points, checked)
    asked = {id(policy): _onlooker(policy) for policy in policies.values()}
    onlookers = {key: asked[id(policy)] for key, policy in policies.items()}
    collected = collect_episodes(simulation, {**onlookers, **(others or {})}, seeds=seeds, points=points, **options)
    return {key: _compared(collected[key], float(tolerance)) for key in policies}


class _Onlooker:
    """A policy that records what another policy would do, and leaves the decision to the rule."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy
        self.asked = BatchPolicy(policy)

    def __call__(self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]) -> Any:
        noted = np.empty(len(identities), object)
        returned = self.asked.answers(observations, infos, identities)
        for place, action in enumerate(actions_of(returned, len(identities), self.policy)):
            noted[place] = action
        return RULE, {"noted": noted}


class _AskingOnlooker:
    """An ``_Onlooker`` for a policy that asks for the environment."""

    def __init__(self, policy: Any) -> None:
        self.asked = PlannerPolicy(policy)

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        noted = np.empty((), object)
        noted[()] = self.asked.answer(observation, info, _environment)
        return RULE, {"noted": noted}


def _onlooker(policy: Any) -> Any:
    return _AskingOnlooker(policy) if is_planner(policy) else _Onlooker(policy)


def _compared(found: Trajectories, tolerance: float) -> Comparison:
    """Make a comparison from the records of an onlooker."""
    noted = found.extras.get("noted", np.zeros(0)).tolist()
    found = replace(found, extras={name: values for name, values in found.extras.items() if name != "noted"})
    if not len(found):
        return Comparison(found, found.actions, np.zeros(0, np.bool_))
    check_known(found)
    assert found.action_space is not None
    actions = [_row(found.actions, row) if action is RULE else action for row, action in enumerate(noted)]
    policy_actions = stacker(found.action_space)(actions)
    return Comparison(found, policy_actions, _agreeing(found.actions, policy_actions, tolerance))


def _row(stack: Any, row: int) -> Any:
    if isinstance(stack, Mapping):
        return {key: _row(part, row) for key, part in stack.items()}
    if isinstance(stack, tuple):
        return tuple(_row(part, row) for part in stack)
    return stack[row]


def _agreeing(one: Any, other: Any, tolerance: float) -> NDArray[np.bool_]:
    """Return in which rows two stacks agree."""
    if isinstance(one, Mapping):
        return _everywhere([_agreeing(part, other[key], tolerance) for key, part in one.items()])
    if isinstance(one, tuple):
        return _everywhere([_agreeing(*parts, tolerance) for parts in zip(one, other, strict=True)])
    if one.dtype.kind == "f":
        same = np.abs(one - other) <= tolerance
    elif one.dtype == object:
        same = np.array(list(map(alike, one, other)))
    else:
        same = one == other
    return np.asarray(same.reshape(len(one), -1).all(axis=1), np.bool_)


def _everywhere(parts: Sequence[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    return np.asarray(np.all(parts, axis=0), np.bool_)
