"""Trajectories of many simulations for learning, mixtures of policies, and comparisons."""

from collections.abc import (
    Callable,
    Iterable,
    Mapping,
    Sequence,
)
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from math import inf
from typing import Any, Final, Unpack

import numpy as np

from ..core import (
    Episode,
    EpisodeOptions,
    Mode,
    Plan,
    Points,
    PolicyWrapper,
    StateReader,
    is_asked_alone,
    same,
    split_extras,
    stacker,
    taken,
    takes_state,
    when_answered,
)
from ..envs.single import plan_of
from ..errors import (
    DefinitionError,
    OptionValueError,
    WorkerError,
    name_of,
    short_repr,
)
from ..many.batch import (
    BatchPolicy,
    BatchRun,
    PolicyKey,
    policy_keys,
)
from ..many.parallel import NO_BAR, progress_bar, spread
from ..runs import check_options, checked_policies, checked_seeds
from ..simulation import (
    EVERYONE,
    RULE,
    Action,
    Model,
    Observation,
    Sentinel,
    is_number,
)
from .trajectories import (
    Array,
    Bools,
    Floats,
    Recorder,
    Records,
    Trajectories,
    action_arrays,
    combine,
    points_of,
)

Policy = Callable[..., Action] | Sentinel
"""A policy that answers many decisions at once, or ``RULE``."""

Policies = Mapping[Any, Any]
"""Policies by agent or decision point, as ``simulate_many`` takes them."""

Infos = Sequence[dict[str, Any]]
"""The infos of the agents of many decisions."""

Identities = Sequence[tuple[int, int]]
"""For each of many decisions, the seed of its episode and the number of its turn."""

SHADOW: Final = "shadow action"
"""The extra with the actions of the compared policies."""


def collect_episodes(
    simulation: Model,
    policies: Policies,
    *,
    seeds: Iterable[int],
    points: Points = None,
    collect: Callable[[Model], Any] | None = None,
    batch_size: int = 1024,
    concurrency: int = 64,
    workers: int = 0,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> dict[Any, Trajectories]:
    """Play one episode per seed, and return the trajectories for learning.

    Policies answer the decisions of many simulations in batches.

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
        collect: A callable of a simulation that has just ended. Its results are in
            ``collected``.
        batch_size: As ``simulate_many`` takes it.
        concurrency: As ``simulate_many`` takes it.
        workers: As ``simulate_many`` takes them.
        progress: As ``simulate_many`` takes it.
        **options: The options of ``aec_env``. ``max_steps`` truncates episodes. Every agent that
            has a policy counts as declared, even if ``possible_agents`` omits it. With
            ``state_space`` or ``state_in_info``, the trajectories have ``states``.

    Returns:
        A dict from each key of ``policies`` to the trajectories of the agents of its policy. Of a
        policy for all agents (``turn_policy``): from the name of each decision point. With workers,
        lost episodes are played again, as in ``simulate_many``. One that is lost again is left out,
        and its seed is in ``lost``.

    Raises:
        OptionValueError: An argument has an invalid value, or the extras do not fit the decisions.
        BaseException: Any other error of ``simulate_many``.
    """
    policies = checked_policies(policies)
    if EVERYONE in policies:
        # One for each point, because the points of one learner may have different spaces.
        plan = learners_plan(simulation, policies, points, options)
        named = dict.fromkeys([point.hook.name for point in plan.points], policies[EVERYONE])
        policies = named | {key: each for key, each in policies.items() if key is not EVERYONE}
    seed_list = checked_seeds(seeds)
    check_options(batch_size, workers, collect, concurrency)
    make_plan = partial(learners_plan, simulation, policies, points, options)
    arguments = make_plan, list(policies), collect, batch_size, concurrency
    lost: list[int] = []

    def lose(episode: tuple[int, int], error: WorkerError) -> Any:
        lost.append(episode[0])
        return _play(*arguments, [], NO_BAR)

    items = list(enumerate(seed_list))
    with progress_bar(len(seed_list), progress) as bar:
        parts = spread(_play, arguments, items, workers, batch_size, bar, lost=lose)
    collected = None
    if collect is not None:
        collected = tuple(chain.from_iterable(values for _, values, _ in parts))
    errors = tuple(chain.from_iterable(texts for *_, texts in parts))
    return {
        key: combine(
            [records[place] for records, *_ in parts], tuple(seed_list), collected, errors, lost
        )
        for place, key in enumerate(policies)
    }


@dataclass(frozen=True)
class LeftToRule:
    """A policy that leaves decisions to the rule. The rule's actions must be known."""

    policy: Policy


def learners_plan(
    simulation: Model,
    policies: Policies,
    points: Points,
    options: Mapping[str, Any],
    *,
    all_points: bool = False,
    alone: bool = False,
) -> Plan:
    """Return the plan of the episodes. Its ``PolicyKey``s have the places of the policies.

    With ``all_points``, entities without a policy are agents as well, and follow the rule. With
    ``alone``, each policy answers one decision at a time.
    """
    callables = {}
    for key, policy in policies.items():
        if isinstance(policy, LeftToRule):
            policy = policy.policy
        callables[key] = _follow_rule if policy is RULE else policy
    options = {**options, "policies": policy_keys(callables, alone=alone)}
    others = None
    if all_points:
        others = PolicyKey(len(policies), BatchPolicy(_follow_rule, alone=alone))
    plan = plan_of(simulation, points, options, mode=Mode.COLLECT, default_policy=others)
    for place, policy in enumerate(policies.values()):
        for point in points_of(plan, place):
            if isinstance(policy, LeftToRule) and not point.reports_rule:
                raise DefinitionError(
                    f"the actions of the rule of {point.hook.name} are not known; give its"
                    " make_step a rule_action_mapping, which maps the rule's decision to an action"
                )
    return plan


def _follow_rule(observations: Observation) -> Action:
    return RULE


def _play(
    make_plan: Callable[[], Plan],
    keys: list[Any],
    collect: Callable[[Model], Any] | None,
    batch_size: int,
    concurrency: int,
    episodes: list[tuple[int, int]],
    bar: Any,
) -> tuple[list[Records], list[Any], list[str]]:
    """Play episodes, given as pairs of number and seed.

    Return the records of each policy, and the result of ``collect`` and the error of each episode.
    """
    plan = make_plan()
    options = plan.options
    keeps_states = options.state_in_info or options.state_space is not None
    keeps_states |= any(map(takes_state, (options.policies or {}).values()))
    stack_states = plan.derive(StateReader).stack if keeps_states else None
    recorder = Recorder(episodes[0][0] if episodes else 0, stack_states)
    collected: list[Any] = [None] * len(episodes)
    errors = [""] * len(episodes)

    def finish(place: int, episode: Episode) -> None:
        errors[place] = episode.fault
        if collect is not None:
            collected[place] = collect(episode.simulation)
        bar.update()

    seeds = [seed for _, seed in episodes]
    BatchRun(plan, seeds, batch_size, finish, recorder, concurrency).run()
    return recorder.records(plan, keys), collected, errors


# -- mixtures -------------------------------------------------------------------------------------


class Mixture:
    """A policy for ``collect_episodes`` that draws one of several policies for each decision.

    The draw depends only on the seed of the episode and the number of the decision in it. It does
    not depend on other simulations or on the number of processes. ``extras["component"]`` has the
    index of the policy that decided; the extras of the policies themselves are dropped.

    Example:
        ``Mixture({RULE: 0.8, trained: 0.2})``

    Attributes:
        takes_state: Whether one of the policies takes the states.
    """

    def __init__(self, parts: Mapping[Any, float] | Iterable[tuple[Any, float]]) -> None:
        """Mix policies.

        Args:
            parts: A dict from policy to weight, or an iterable of such pairs. A policy is anything
                that ``collect_episodes`` takes. Weights are not negative and need not sum to one.

        Raises:
            OptionValueError: There are no policies, or a weight is invalid.
        """
        try:
            policies, weights = zip(
                *(parts.items() if isinstance(parts, Mapping) else parts), strict=True
            )
        except (TypeError, ValueError):
            raise OptionValueError(
                "a mixture needs a dict from policies to weights, or pairs of these, not"
                f" {short_repr(parts)}"
            ) from None
        for policy, weight in zip(policies, weights, strict=True):
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
            if not is_number(weight) or not 0 <= weight < inf:
                raise OptionValueError(
                    f"the weight of {short_repr(policy)} must be a number that is not negative, not"
                    f" {short_repr(weight)}"
                )
        if not any(weights):
            raise OptionValueError("at least one weight of a mixture must be positive")
        self.policies: tuple[Policy, ...] = policies
        self.weights: Floats = np.array(weights, np.float64) / sum(weights)
        self._bounds = np.cumsum(self.weights)[:-1]
        self._parts = [
            BatchPolicy(_follow_rule if policy is RULE else policy) for policy in policies
        ]
        self.takes_state = any(part.takes_state for part in self._parts)

    def __repr__(self) -> str:
        parts = [
            f"{weight:.3g} {policy_name(policy)}"
            for policy, weight in zip(self.policies, self.weights, strict=True)
        ]
        return f"<Mixture: {', '.join(parts)}>"

    def __call__(
        self,
        observations: Observation,
        infos: Infos,
        identities: Identities,
        *,
        _state: Any = None,
    ) -> Any:
        """Answer a batch of decisions, as policies of ``collect_episodes`` do."""
        component = np.searchsorted(self._bounds, _random_numbers(identities), side="right")
        answers: list[Action] = [RULE] * len(identities)
        for number, part in enumerate(self._parts):
            index = np.flatnonzero(component == number)
            rows = index.tolist()
            if not rows:
                continue
            actions, _ = part.answers(
                taken(observations, index),
                [infos[row] for row in rows],
                [identities[row] for row in rows],
                taken(_state, index) if part.takes_state else None,
            )
            for row, action in zip(rows, actions, strict=True):
                answers[row] = action
        return answers, {"component": component}


def _random_numbers(identities: Identities) -> Array:
    """Return a float64 number in [0, 1) for each decision, by its identity alone."""
    # SplitMix64, twice: to make a generator for each decision would take longer than the decision.
    pairs = [(seed % 2**64, turn) for seed, turn in identities]
    seeds, turns = np.array(pairs, np.uint64).reshape(-1, 2).T
    return (_splitmix(_splitmix(seeds) + turns) >> 11) * 2.0**-53


def _splitmix(state: Array) -> Array:
    """Return the output of SplitMix64 for each uint64 state."""
    state = state + 0x9E3779B97F4A7C15
    state ^= state >> 30
    state *= 0xBF58476D1CE4E5B9
    state ^= state >> 27
    state *= 0x94D049BB133111EB
    state ^= state >> 31
    return state


# -- comparisons ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Comparison:
    """The decisions of the model's own rule beside a policy's, from ``compare_with_rule``.

    Attributes:
        trajectories: The trajectories of the rule.
        policy_actions: The actions that the policy would have taken on the same observations, in
            the form of ``trajectories.actions``. Where the policy would have left the decision to
            the rule, the rule's action.
        agreements: ``(N,)`` bool: whether both agree, for each decision.
    """

    trajectories: Trajectories
    policy_actions: Action
    agreements: Bools

    @property
    def agreement(self) -> float:
        """The share of agreements among the decisions, 0 to 1; nan without decisions."""
        return float(self.agreements.mean()) if len(self.agreements) else float("nan")

    def __repr__(self) -> str:
        return f"<Comparison: agreement {self.agreement:.3f} in {len(self.agreements)} decisions>"


def compare_with_rule(
    simulation: Model,
    policies: Policies,
    *,
    seeds: Iterable[int],
    points: Points = None,
    others: Policies | None = None,
    tolerance: float = 0.0,
    **options: Unpack[EpisodeOptions],
) -> dict[Any, Comparison]:
    """Let the model's own rule decide, and record the actions of policies beside it.

    At each decision the policy gets the same arguments as if it decided; then the rule decides. So
    the plain model would run the same episodes, unless ``others`` names policies that decide.

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
        BaseException: Any other error of ``collect_episodes``.
    """
    if not isinstance(policies, Mapping) or not all(map(callable, policies.values())):
        raise OptionValueError(
            "policies must be a dict from agents or points to callables, not"
            f" {short_repr(policies)}"
        )
    if not isinstance(tolerance, (int, float)) or not tolerance >= 0:
        raise OptionValueError(
            f"tolerance must be a number that is not negative, not {short_repr(tolerance)}"
        )
    if others is not None and (not isinstance(others, Mapping) or others.keys() & policies.keys()):
        raise OptionValueError(
            "others must be a dict of policies for agents or points that policies does not name,"
            f" not {short_repr(others)}"
        )
    # One shadow for each policy, so that keys share batches.
    shadows = {
        id(policy): (_Shadow if is_asked_alone(policy) else _BatchedShadow)(policy)
        for policy in policies.values()
    }
    to_rule = {key: LeftToRule(shadows[id(policy)]) for key, policy in policies.items()}
    collected = collect_episodes(
        simulation, {**to_rule, **(others or {})}, seeds=seeds, points=points, **options
    )
    return {key: _compare(collected[key], tolerance) for key in policies}


class _BatchedShadow:
    """Records the actions of a policy as an extra, and leaves the decisions to the rule."""

    def __init__(self, policy: Callable[..., Action]) -> None:
        self._policy = BatchPolicy(policy)
        self.takes_state = takes_state(policy)

    def __call__(
        self,
        observations: Observation,
        infos: Infos,
        identities: Identities,
        *,
        _state: Any = None,
    ) -> Any:
        actions, _ = self._policy.answers(observations, infos, identities, _state)
        return RULE, {SHADOW: np.fromiter(actions, object, len(actions))}


class _Shadow(PolicyWrapper):
    """Does the same for a policy that answers one decision at a time."""

    def __call__(
        self,
        observation: Observation,
        info: dict[str, Any],
        **context: Any,
    ) -> Any:
        return when_answered(self.ask(observation, info, context), self._record)

    def _record(self, answer: Action) -> Any:
        shadow_actions = np.empty((), object)
        shadow_actions[()], _ = split_extras(answer)
        return RULE, {SHADOW: shadow_actions}


def _compare(trajectories: Trajectories, tolerance: float) -> Comparison:
    """Compare the rule's actions with the actions that a shadow has recorded."""
    extras = dict(trajectories.extras)
    shadow_actions = extras.pop(SHADOW, ())
    trajectories = replace(trajectories, extras=extras)
    rule_actions = trajectories.actions
    if trajectories.action_space is None:
        return Comparison(trajectories, rule_actions, np.zeros(0, np.bool_))
    check_known(trajectories)
    policy_actions = stacker(trajectories.action_space)(
        [
            taken(rule_actions, row) if action is RULE else action
            for row, action in enumerate(shadow_actions)
        ]
    )
    agreements = np.ones(len(trajectories), np.bool_)
    pairs = zip(action_arrays(rule_actions), action_arrays(policy_actions), strict=True)
    for (_, one), (_, other) in pairs:
        agreements &= _agreements(one, other, tolerance)
    return Comparison(trajectories, policy_actions, agreements)


def _agreements(
    one: Array,
    other: Array,
    tolerance: float,
) -> Bools:
    """Return ``(N,)``: whether two arrays agree, for each row."""
    equal = one == other
    if one.dtype == object:
        equal = np.array(list(map(same, one, other)))
    elif one.dtype.kind == "f":
        equal = np.abs(one - other) <= tolerance
    agree: Bools = equal.all(axis=tuple(range(1, one.ndim)))
    return agree


# -- properties of policies -----------------------------------------------------------------------


def policy_name(policy: Policy) -> str:
    """Return the name of a policy."""
    return "rule" if policy is RULE else name_of(policy)


def follows_rule(policy: Policy) -> bool:
    """Return whether a policy certainly leaves decisions to the rule."""
    if isinstance(policy, Mixture):
        parts = zip(policy.policies, policy.weights, strict=True)
        return any(weight > 0 and follows_rule(part) for part, weight in parts)
    return policy is RULE


def check_known(trajectories: Trajectories) -> None:
    """Check that the action of each decision is known, also where the rule decided."""
    unknown = np.flatnonzero(~trajectories.known)
    if len(unknown):
        first = unknown[0]
        agent = trajectories.names[trajectories.agents[first]]
        seed = trajectories.seeds[trajectories.episodes[first]]
        raise DefinitionError(
            f"in {len(unknown)} of {len(trajectories)} decisions the action of the rule is not"
            f" known, first for {agent!r} at turn {trajectories.turns[first]} of the episode of"
            f" seed {seed}; its decision point needs a rule_action_mapping that returns an action"
            " for every decision of the rule"
        )
