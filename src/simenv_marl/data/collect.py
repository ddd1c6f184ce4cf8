"""Episodes of many simulations at once: their trajectories for learning, mixtures of policies, and comparisons."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from typing import Any, Final, Unpack

import numpy as np
from numpy.typing import NDArray

from ..core import (
    EpisodeOptions,
    Mode,
    Plan,
    Points,
    PolicyWrapper,
    is_asked_alone,
    same,
    stacker,
    taken,
    when_answered,
)
from ..envs.single import plan_of
from ..errors import DefinitionError, OptionValueError, short_repr
from ..many.batch import BatchPolicy, BatchRun, PolicyKey, policy_keys, read_answers
from ..many.parallel import progress_bar, spread
from ..runs import check_options, checked_policies, checked_seeds
from ..simulation import RULE
from .trajectories import Recorder, Records, Trajectories, combine, is_answered_by, leaves

SHADOW: Final = "shadow action"
"""The extra in which the actions of the compared policies are recorded."""


def collect_episodes(
    simulation: Any,
    policies: Mapping[Any, Any],
    *,
    seeds: Iterable[int],
    points: Points = None,
    collect: Callable[[Any], Any] | None = None,
    batch_size: int = 1024,
    concurrency: int = 64,
    workers: int = 0,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> dict[Any, Trajectories]:
    """Play one episode per seed with policies that answer in batches, and return the trajectories for learning.

    Agents that have a policy are rewarded and end as in an AEC environment that is played with the
    same policies. All other agents follow their rule. An episode without decisions yields no
    trajectory and is not an error.

    Args:
        simulation: As ``simulate_many`` takes it.
        policies: The policies, as ``simulate_many`` takes them. ``RULE`` is a policy like any
            other. A policy may return a tuple of the actions and a dict of arrays of shape
            ``(batch, ...)`` (log-probabilities, values). The arrays become ``extras``; the dict
            must always have the same keys.
        seeds: As ``simulate_many`` takes them.
        points: As ``simulate_many`` takes them.
        collect: A callable of a simulation that has just ended. What it returns is in
            ``collected``.
        batch_size: As ``simulate_many`` takes it.
        concurrency: As ``simulate_many`` takes it.
        workers: As ``simulate_many`` takes them.
        progress: As ``simulate_many`` takes it.
        **options: The options of ``aec_env``. ``max_steps`` truncates episodes. Every agent that
            has a policy counts as declared, whatever ``possible_agents`` says.

    Returns:
        A dict from each key of ``policies`` to the trajectories of the agents that its policy
        answered for.

    Raises:
        OptionValueError: An argument has an invalid value, or the extras do not fit the decisions.
        BaseException: All other errors are those of ``simulate_many``.
    """
    policies, episodes = checked_policies(policies), list(enumerate(checked_seeds(seeds)))
    check_options(batch_size, workers, collect, concurrency)
    plan = learners_plan(simulation, policies, points, options)
    arguments = (
        (simulation, policies, points, options),
        None if workers else plan,
        collect,
        batch_size,
        concurrency,
    )
    with progress_bar(len(episodes), progress) as bar:
        parts = spread(_play, arguments, episodes, workers, batch_size, bar)
    all_seeds = tuple(seed for _, seed in episodes)
    collected = None if collect is None else tuple(value for _, values in parts for value in values)
    return {
        key: combine([records[place] for records, _ in parts], all_seeds, collected)
        for place, key in enumerate(policies)
    }


@dataclass(frozen=True)
class LeftToRule:
    """A policy that leaves decisions to the rule, whose actions must be known."""

    policy: Any


def learners_plan(
    simulation: Any,
    policies: Mapping[Any, Any],
    points: Any,
    options: Mapping[str, Any],
    *,
    all_points: bool = False,
    alone: bool = False,
) -> Plan:
    """Return the plan of the episodes, in which a ``PolicyKey`` has the place of each policy.

    With ``all_points``, entities without a policy are agents as well, whose decisions follow the
    rule. ``alone``: each policy answers one decision at a time.
    """
    callables = {
        key: policy.policy if isinstance(policy, LeftToRule) else policy
        for key, policy in policies.items()
    }
    callables = {
        key: _follow_rule if policy is RULE else policy for key, policy in callables.items()
    }
    options = {**options, "policies": policy_keys(callables, rewarded=True, alone=alone)}
    others = (
        PolicyKey(len(policies), BatchPolicy(_follow_rule, alone=alone)) if all_points else None
    )
    plan = plan_of(simulation, points, options, mode=Mode.COLLECT, default_policy=others)
    for place, policy in enumerate(policies.values()):
        for point in plan.points if isinstance(policy, LeftToRule) else ():
            if not point.reports_rule and is_answered_by(plan, point, place):
                raise DefinitionError(
                    f"the actions of the rule of {point.hook.name} are not known; give its"
                    " make_step a rule_action_mapping, which maps the rule's decision to an action"
                )
    return plan


def _follow_rule(observations: Any) -> Any:
    return RULE


def _play(
    arguments: tuple[Any, ...],
    plan: Plan | None,
    collect: Callable[[Any], Any] | None,
    batch_size: int,
    concurrency: int,
    episodes: list[tuple[int, int]],
    bar: Any,
) -> tuple[list[Records], list[Any]]:
    """Play episodes, which are pairs of number and seed.

    Return the records by place of their policy, and values.
    """
    plan = plan or learners_plan(*arguments)
    recorder = Recorder(episodes[0][0] if episodes else 0)
    collected: list[Any] = [None] * len(episodes)

    def finish(place: int, simulation: Any) -> None:
        if collect is not None:
            collected[place] = collect(simulation)
        bar.update()

    seeds = [seed for _, seed in episodes]
    BatchRun(plan, seeds, batch_size, finish, recorder, concurrency).run()
    _, policies, *_ = arguments
    return recorder.records(plan, policies), collected


# -- mixtures -------------------------------------------------------------------------------------


class Mixture:
    """A policy for ``collect_episodes`` that draws, for each decision, which of several policies answers it.

    The draw depends only on the seed of the episode and the number of the decision in it. It does
    not depend on other simulations or on the number of processes. ``extras["component"]`` has the
    index of the policy that decided; the extras of the policies themselves are dropped.

    Example:
        ``Mixture({RULE: 0.8, trained: 0.2})``
    """

    def __init__(self, parts: Mapping[Any, float] | Iterable[tuple[Any, float]]) -> None:
        """Mix policies.

        Args:
            parts: A dict from policy to weight, or an iterable of such pairs. A policy is anything
                that ``collect_episodes`` takes. Weights are not negative and need not sum to one.

        Raises:
            OptionValueError: There are no policies, or a weight is invalid.
        """
        pairs = list(parts.items() if isinstance(parts, Mapping) else parts)
        if not pairs or any(not isinstance(pair, tuple) or len(pair) != 2 for pair in pairs):
            raise OptionValueError(
                "a mixture needs a dict from policies to weights, or pairs of these, not"
                f" {short_repr(parts)}"
            )
        for policy, weight in pairs:
            if policy is not RULE and not callable(policy):
                raise OptionValueError(
                    "a mixture consists of policies, callables or RULE, not of"
                    f" {short_repr(policy)}"
                )
            if is_asked_alone(policy):
                raise OptionValueError(
                    f"{short_repr(policy)} answers one decision at a time, and a mixture asks in"
                    " batches"
                )
            number = isinstance(weight, (int, float)) and not isinstance(weight, bool)
            if not number or not isfinite(weight) or weight < 0:
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
        self._batch_policies = [
            None if policy is RULE else BatchPolicy(policy) for policy in self.policies
        ]

    def __repr__(self) -> str:
        parts = zip(self.policies, self.weights.tolist(), strict=True)
        return (
            "<Mixture:"
            f" {', '.join(f'{weight:.3g} {policy_name(policy)}' for policy, weight in parts)}>"
        )

    def __call__(
        self, observations: Any, infos: Sequence[Any], identities: Sequence[tuple[int, int]]
    ) -> Any:
        """Answer a batch of decisions, as policies of ``collect_episodes`` do."""
        component = np.searchsorted(self._bounds, _random_numbers(identities), side="right")
        actions: list[Any] = [RULE] * len(identities)
        for number, batch_policy in enumerate(self._batch_policies):
            own = np.flatnonzero(component == number)
            if batch_policy is None or not len(own):
                continue
            places = own.tolist()
            arguments = (
                taken(observations, own),
                [infos[row] for row in places],
                [identities[row] for row in places],
            )
            for row, action in zip(
                places, _ask(self.policies[number], batch_policy, *arguments), strict=True
            ):
                actions[row] = action
        return actions, {"component": component}


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


# -- comparisons ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Comparison:
    """The decisions of the model's own rule, and what a policy would have decided. Made by ``compare_with_rule``.

    Attributes:
        trajectories: The trajectories of the rule.
        policy_actions: The actions that the policy would have taken on the same observations, in
            the form of ``trajectories.actions``. Where the policy would have left the decision to
            the rule, the rule's action.
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

    At each decision the policy gets what it would get if it decided; then the rule decides. So the
    episodes are those of the plain model, unless ``others`` names policies that decide.

    Args:
        simulation: As ``simulate_many`` takes it.
        policies: The policies to compare, as ``collect_episodes`` takes them. Their actions may be
            illegal.
        seeds: As ``simulate_many`` takes them.
        points: As ``simulate_many`` takes them.
        others: Policies that decide instead of the rule, as ``collect_episodes`` takes policies.
            They are not compared.
        tolerance: The largest difference between numbers in two actions that agree. It applies to
            ``Box`` spaces of floats.
        **options: As ``collect_episodes`` takes them.

    Returns:
        A dict from each key of ``policies`` to its comparison.

    Raises:
        DefinitionError: The actions that correspond to the rule's decisions are unknown.
        OptionValueError: An argument has an invalid value.
        BaseException: All other errors are those of ``collect_episodes``.
    """
    if not isinstance(policies, Mapping) or not all(
        callable(policy) for policy in policies.values()
    ):
        raise OptionValueError(
            "policies must be a dict from agents or points to callables, not"
            f" {short_repr(policies)}"
        )
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)) or not tolerance >= 0:
        raise OptionValueError(
            f"tolerance must be a number that is not negative, not {short_repr(tolerance)}"
        )
    if others is not None and (not isinstance(others, Mapping) or others.keys() & policies.keys()):
        raise OptionValueError(
            "others must be a dict of policies for agents or points that policies does not name,"
            f" not {short_repr(others)}"
        )
    # policies that record an action; one for each, so that keys share batches
    shadows: dict[int, Any] = {}
    for policy in policies.values():
        shadows[id(policy)] = partial(_record, policy, BatchPolicy(policy))
        if is_asked_alone(policy):
            shadows[id(policy)] = _Shadow(policy)
    deciding = {key: LeftToRule(shadows[id(policy)]) for key, policy in policies.items()}
    collected = collect_episodes(
        simulation, {**deciding, **(others or {})}, seeds=seeds, points=points, **options
    )
    return {key: _compare(collected[key], float(tolerance)) for key in policies}


def _record(
    policy: Any, batch_policy: BatchPolicy, observations: Any, infos: Any, identities: Any
) -> Any:
    """Record the actions of a policy as an extra, and leave the decisions to the rule."""
    actions = _ask(policy, batch_policy, observations, infos, identities)
    return RULE, {SHADOW: np.fromiter(actions, object, len(actions))}


class _Shadow(PolicyWrapper):
    """The same for a policy that answers one decision at a time."""

    def __call__(self, observation: Any, info: Any, **asked: Any) -> Any:
        return when_answered(self.ask(observation, info, asked), self._record)

    def _record(self, action: Any) -> Any:
        recorded = np.empty((), object)
        recorded[()] = action
        return RULE, {SHADOW: recorded}


def _compare(found: Trajectories, tolerance: float) -> Comparison:
    """Compare the rule's actions with those that a shadow has recorded."""
    recorded = found.extras.get(SHADOW, ())
    found = replace(
        found, extras={name: values for name, values in found.extras.items() if name != SHADOW}
    )
    if not len(found):
        return Comparison(found, found.actions, np.zeros(0, np.bool_))
    check_known(found)
    assert found.action_space is not None
    actions = [
        taken(found.actions, row) if action is RULE else action
        for row, action in enumerate(recorded)
    ]
    policy_actions = stacker(found.action_space)(actions)
    pairs = zip(leaves(found.actions), leaves(policy_actions), strict=True)
    agreements = [_agreements(one, other, tolerance) for (_, one), (_, other) in pairs]
    return Comparison(found, policy_actions, np.all(agreements, axis=0))


def _agreements(one: NDArray[Any], other: NDArray[Any], tolerance: float) -> Any:
    """Return in which rows two arrays agree."""
    if one.dtype == object:
        return [same(*pair) for pair in zip(one, other, strict=True)]
    equal = np.abs(one - other) <= tolerance if one.dtype.kind == "f" else one == other
    return equal.reshape(len(one), -1).all(axis=1)


# -- policies and their answers -------------------------------------------------------------------


def _ask(
    policy: Any, batch_policy: BatchPolicy, observations: Any, infos: Any, identities: Any
) -> list[Any]:
    """Ask a policy for one action for each decision, and drop the extras."""
    answers = batch_policy.answers(observations, infos, identities)
    return read_answers(answers, policy, len(identities))[0]


def policy_name(policy: Any) -> str:
    """Return the name of a policy."""
    return (
        "rule"
        if policy is RULE
        else str(getattr(policy, "__qualname__", None) or short_repr(policy))
    )


def follows_rule(policy: Any) -> bool:
    """Return whether a policy certainly leaves decisions to the rule."""
    if isinstance(policy, Mixture):
        return any(
            follows_rule(part)
            for part, weight in zip(policy.policies, policy.weights, strict=True)
            if weight
        )
    return policy is RULE


def check_known(found: Trajectories) -> None:
    """Check that the action of each decision is known, also of those that were left to the rule."""
    unknown = np.flatnonzero(~found.known)
    if len(unknown):
        agent, seed = found.names[found.agents[unknown[0]]], found.seeds[found.episodes[unknown[0]]]
        raise DefinitionError(
            f"in {len(unknown)} of {len(found)} decisions the action of the rule is not known,"
            f" first for {agent!r} at turn {found.turns[unknown[0]]} of the episode of seed"
            f" {seed}; its decision point needs a rule_action_mapping that returns an action for"
            " every decision of the rule"
        )
