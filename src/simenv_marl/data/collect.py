"""Trajectories for learning: episodes of many simulations at once, with policies that answer in batches."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Unpack

from ..core.options import EpisodeOptions
from ..core.plan import Plan
from ..core.points import Points
from ..errors import DefinitionError
from ..many.batch import BatchPolicy, PolicyKey, policy_keys, run
from ..many.parallel import progress_bar, spread
from ..many.simulate import check_collect, check_numbers, checked_policies, checked_seeds
from ..simulation import RULE
from .trajectories import Recorder, Records, Trajectories, combine, is_answered_by


def collect_episodes(
    simulation: Any,
    policies: Mapping[Any, Any],
    *,
    seeds: Iterable[int],
    points: Points = None,
    collect: Callable[[Any], Any] | None = None,
    batch_size: int = 1024,
    workers: int = 0,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> dict[Any, Trajectories]:
    """Play one episode per seed with policies that answer in batches, and return the trajectories for learning.

    Agents that have a policy are rewarded and end as in an AEC environment that is played with the same policies. All
    other agents follow their rule. An episode without decisions yields no trajectory and is not an error.

    Args:
        simulation: As ``simulate_many`` takes it.
        policies: The policies, as ``simulate_many`` takes them. ``RULE`` is a policy like any other. A policy may
            return a tuple of the actions and a dict of arrays of shape ``(batch, ...)`` (log-probabilities, values).
            The arrays become ``extras``; the dict must always have the same keys.
        seeds: As ``simulate_many`` takes them.
        points: As ``simulate_many`` takes them.
        collect: A callable of a simulation that has just ended. What it returns is in ``collected``.
        batch_size: As ``simulate_many`` takes it.
        workers: As ``simulate_many`` takes them.
        progress: As ``simulate_many`` takes it.
        **options: The options of ``aec_env``. ``max_steps`` truncates episodes. Every agent that has a policy counts as
            declared, whatever ``possible_agents`` says.

    Returns:
        A dict from each key of ``policies`` to the trajectories of the agents that its policy answered for.

    Raises:
        OptionValueError: An argument has an invalid value, or the extras do not fit the decisions.
        BaseException: All other errors are those of ``simulate_many``.
    """
    episodes = list(enumerate(checked_seeds(seeds)))
    check_numbers(batch_size, workers)
    check_collect(collect)
    policies = checked_policies(policies)
    plan, keys = learners_plan(simulation, policies, points, options)
    with progress_bar(len(episodes)) if progress else nullcontext() as bar:
        parts = []
        if not workers or not episodes:
            parts.append(_play(plan, keys, collect, int(batch_size), episodes, bar))
        else:
            arguments = ((simulation, policies, points, options), collect, int(batch_size))
            for number, part in spread(_play_part, arguments, episodes, int(workers), int(batch_size)):
                parts.append(part)
                if bar is not None:
                    bar.update(number)
    all_seeds = tuple(seed for _, seed in episodes)
    collected = None if collect is None else tuple(value for _, values in parts for value in values)
    return {key: combine([records[place] for records, _ in parts], all_seeds, collected) for key, place in keys.items()}


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
) -> tuple[Plan, dict[Any, int]]:
    """Return the plan of the episodes, and the place of each policy by its key.

    With ``all_points``, entities without a policy are agents as well, whose decisions follow the rule.
    """
    left = [key for key, policy in policies.items() if isinstance(policy, LeftToRule)]
    policies = {**policies, **{key: policies[key].policy for key in left}}
    callables = {key: _follow_rule if policy is RULE else policy for key, policy in policies.items()}
    entries = policy_keys(callables, rewarded=True)
    keys = {key: entry.place for key, entry in entries.items() if isinstance(entry, PolicyKey)}
    others = PolicyKey(len(entries), BatchPolicy(_follow_rule)) if all_points else None
    options = {**options, "policies": entries}
    plan = Plan(simulation, points, options, unattended=True, rewarded=True, others=others)
    for key in left:
        for point in plan.points:
            if point.report is None and is_answered_by(plan, point, keys[key]):
                raise DefinitionError(
                    f"the actions of the rule of {point.point.name} are not known; give its make_step a"
                    " rule_action_mapping, which maps the rule's decision to an action"
                )
    return plan, keys


def _follow_rule(observations: Any) -> Any:
    return RULE


Part = tuple[dict[int, Records], list[Any]]
"""The results of some episodes: the records by the place of their policy, and what ``collect`` returned."""


def _play_part(arguments: tuple[Any, ...], collect: Any, batch_size: int, episodes: list[tuple[int, int]]) -> Part:
    """Play a part of the episodes, in a worker process."""
    return _play(*learners_plan(*arguments), collect, batch_size, episodes, None)


def _play(
    plan: Plan,
    keys: Mapping[Any, int],
    collect: Callable[[Any], Any] | None,
    batch_size: int,
    episodes: list[tuple[int, int]],
    bar: Any,
) -> Part:
    """Play episodes, which are pairs of number and seed, in this process."""
    recorder = Recorder(episodes[0][0] if episodes else 0)
    collected: list[Any] = [None] * len(episodes)

    def finish(place: int, simulation: Any) -> None:
        if collect is not None:
            collected[place] = collect(simulation)
        if bar is not None:
            bar.update()

    run(plan, [seed for _, seed in episodes], batch_size, finish, recorder)
    return recorder.records(plan, keys), collected
