"""The model's own rule and policies, decision by decision."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Unpack

import numpy as np
from numpy.typing import NDArray

from ..core.asking import AskingPolicy, asks_for_environment
from ..core.options import EpisodeOptions
from ..core.points import Points
from ..core.spaces import same as alike
from ..core.stacking import stacker
from ..errors import OptionValueError, shown
from ..simulation import RULE
from .batch import BatchPolicy
from .collect import collect_episodes
from .mixture import actions_of
from .rule_actions import check_knowable, check_known
from .trajectories import Trajectories

PLAYING: Final = ("batch_size", "collect", "progress", "workers")
"""Options of ``collect_episodes`` that are none of the environment."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """What the model's own rule has decided, and what a policy would have. Made by ``compare_with_rule``.

    Attributes:
        trajectories: What the rule has lived through, and decided.
        policy_actions: Like ``trajectories.actions``: what the policy would have done on the same observation. Where it
            would have left the decision to the rule, the rule's action.
        agreements: ``(N,)`` bool: in which decisions they agree.
    """

    trajectories: Trajectories
    policy_actions: Any
    agreements: NDArray[np.bool_]

    @property
    def agreement(self) -> float:
        """In which share of the decisions they agree; nan of none."""
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
    """Let the model's own rule decide, and ask policies what they would have done instead.

    At each decision the policy sees what it would see if it decided; then the rule decides. So the episodes are those
    of the plain model, unless there are others.

    Args:
        simulation: As ``collect_episodes`` takes it.
        policies: Who is asked, as ``collect_episodes`` takes them. It is not checked whether an
            action would have been legal.
        seeds: What the simulations are reset with.
        points: The decision points, as ``generate_env`` takes them.
        others: Who decides where no rule does, as ``collect_episodes`` takes policies. They are not compared.
        tolerance: By how much numbers in actions may differ for the two to agree; those of ``Box`` spaces of floats.
        **options: As ``collect_episodes`` takes them.

    Returns:
        For each key of ``policies``, the comparison.

    Raises:
        DefinitionError: It is not known which actions the rule's decisions are.
        OptionValueError: An argument cannot have its value.
        InvalidActionError: A policy has not returned one action for each decision.
        SimEnvError: As ``collect_episodes`` does; so are all other errors.
    """
    if not isinstance(policies, Mapping) or not all(callable(policy) for policy in policies.values()):
        raise OptionValueError(f"policies must be a dict from agents or points to callables, not {shown(policies)}")
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)) or not tolerance >= 0:
        raise OptionValueError(f"tolerance must be a number that is not negative, not {shown(tolerance)}")
    if others is not None and (not isinstance(others, Mapping) or others.keys() & policies.keys()):
        raise OptionValueError(f"others must be a dict of policies for those who are not compared, not {shown(others)}")
    by_rule = dict.fromkeys(policies, RULE)
    checked = {name: value for name, value in options.items() if name not in PLAYING}
    check_knowable(simulation, {**by_rule, **(others or {})}, by_rule, points, checked)
    asked = {id(policy): _onlooker(policy) for policy in policies.values()}
    onlookers = {key: asked[id(policy)] for key, policy in policies.items()}
    collected = collect_episodes(simulation, {**onlookers, **(others or {})}, seeds=seeds, points=points, **options)
    return {key: _compared(collected[key], float(tolerance)) for key in policies}


class _Onlooker:
    """A policy that notes what another would do, and leaves it to the rule."""

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
    """The same for a policy that asks for the environment."""

    def __init__(self, policy: Any) -> None:
        self.asked = AskingPolicy(policy)

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        noted = np.empty((), object)
        noted[()] = self.asked.answer(observation, info, _environment)
        return RULE, {"noted": noted}


def _onlooker(policy: Any) -> Any:
    return _AskingOnlooker(policy) if asks_for_environment(policy) else _Onlooker(policy)


def _compared(found: Trajectories, tolerance: float) -> Comparison:
    """Make the comparison of what an onlooker has noted."""
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
    """In which rows two stacks agree."""
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
