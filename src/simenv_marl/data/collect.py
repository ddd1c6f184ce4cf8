"""Trajectories for learning: episodes of many simulations at once, with policies that answer in batches."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from typing import Any, Unpack

import numpy as np

from ..core.options import EpisodeOptions
from ..core.plan import Plan
from ..core.points import Points
from ..errors import DefinitionError
from ..many.batch import BatchPolicy, PolicyKey, policy_keys, run
from ..many.simulate import check_collect, check_numbers, checked_policies, checked_seeds
from ..many.spread import progress_bar, spread
from ..simulation import RULE
from .trajectories import Recorder, Trajectories, concatenate, is_answered_by


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
        simulation: A simulation (which is copied for each seed), its class, a zero-argument factory, or a ``Variant``.
        policies: The policies, as ``simulate_many`` takes them. ``RULE`` is a policy like any other. A policy may
            return a tuple of the actions and a dict of arrays of shape ``(batch, ...)`` (log-probabilities, values).
            The arrays become ``extras``; the dict must always have the same keys.
        seeds: The seeds of the simulations, non-negative integers.
        points: The decision points, as ``generate_env`` takes them.
        collect: A callable of a simulation that has just ended. What it returns is in ``collected``.
        batch_size: The largest number of simulations that are suspended together, in each worker process. At most 256
            are suspended while the policies take less time than the simulations.
        workers: The number of worker processes: see ``simulate_many``.
        progress: Whether to show a progress bar, by ``tqdm``.
        **options: The options of ``aec_env``. ``max_steps`` truncates episodes. Every agent that has a policy counts as
            declared, whatever ``possible_agents`` says.

    Returns:
        A dict from each key of ``policies`` to the trajectories of the agents that its policy answered for.

    Raises:
        OptionValueError: An argument has an invalid value, or the extras do not fit the decisions.
        InvalidActionError: A policy did not return one legal action for each decision.
        MissingExtraError: joblib or tqdm is missing.
        SimEnvError: Something else cannot work. The subclass tells what.
        BaseException: Any exception of a model, a mapping or a policy, with a note that names the seed. All other
            simulations are unwound first.
    """
    return play_episodes(
        simulation, policies, seeds=seeds, points=points, collect=collect, batch_size=batch_size, workers=workers,
        progress=progress, **options,
    )  # fmt: skip


def play_episodes(
    simulation: Any,
    policies: Any,
    *,
    seeds: Any,
    rule_keys: Iterable[Any] = (),
    points: Points = None,
    collect: Callable[[Any], Any] | None = None,
    batch_size: int = 1024,
    workers: int = 0,
    progress: bool = False,
    **options: Any,
) -> dict[Any, Trajectories]:
    """Do what ``collect_episodes`` does.

    Before anything runs, check that the actions of the rule can be known where a policy of ``rule_keys`` decides.
    """
    checked = checked_seeds(seeds)
    check_numbers(batch_size, workers)
    check_collect(collect)
    policies = checked_policies(policies)
    plan, keys = learners_plan(simulation, policies, points, options)
    for key in rule_keys:
        _check_rule_actions(plan, keys[key])
    with progress_bar(len(checked)) if progress else nullcontext() as bar:
        parts = []
        if not workers or not checked:
            parts.append(_play(plan, keys, collect, int(batch_size), checked, bar))
        else:
            arguments = ((simulation, policies, points, options), collect, int(batch_size))
            for number, part in spread(_play_part, arguments, checked, int(workers), int(batch_size)):
                parts.append(part)
                if bar is not None:
                    bar.update(number)
    return {key: concatenate([part[place] for part in parts]) for key, place in keys.items()}


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
    callables = {key: _follow_rule if policy is RULE else policy for key, policy in policies.items()}
    entries = policy_keys(callables, rewarded=True)
    keys = {key: entry.place for key, entry in entries.items() if isinstance(entry, PolicyKey)}
    others = PolicyKey(len(entries), BatchPolicy(_follow_rule)) if all_points else None
    options = {**options, "policies": entries}
    return Plan.draw_up(simulation, points, options, unanswered=True, rewarded=True, others=others), keys


def _follow_rule(observations: Any) -> Any:
    return RULE


def _play_part(
    planned: tuple[Any, Any, Any, Any], collect: Callable[[Any], Any] | None, batch_size: int, seeds: list[int]
) -> dict[int, Trajectories]:
    """Play a part of the episodes, in a worker process."""
    return _play(*learners_plan(*planned), collect, batch_size, seeds, None)


def _play(
    plan: Plan,
    keys: Mapping[Any, int],
    collect: Callable[[Any], Any] | None,
    batch_size: int,
    seeds: list[int],
    bar: Any,
) -> dict[int, Trajectories]:
    """Play episodes in this process; return the trajectories by the place of their policy."""
    recorder = Recorder()
    collected: list[Any] = [None] * len(seeds)

    def finish(place: int, simulation: Any) -> None:
        if collect is not None:
            collected[place] = collect(simulation)
        if bar is not None:
            bar.update()

    run(plan, seeds, batch_size, finish, recorder)
    return recorder.trajectories(plan, keys, seeds, None if collect is None else tuple(collected))


# -- the rule's actions ---------------------------------------------------------------------------


def _check_rule_actions(plan: Plan, place: int) -> None:
    """Check that the actions of the rule can be known where the policy at this place answers."""
    for point in plan.points:
        if not point.recorded and is_answered_by(plan, point, place):
            raise DefinitionError(
                f"the actions of the rule of {point.point.name} are not known; give its make_step a"
                " rule_action_mapping, which maps the rule's decision to an action"
            )


def check_known(found: Trajectories) -> None:
    """Check that the action of each decision is known, also of those that were left to the rule.

    Raises:
        DefinitionError: Some actions are not known.
    """
    unknown = np.flatnonzero(~found.known)
    if len(unknown):
        agent, seed = found.names[found.agents[unknown[0]]], found.seeds[found.episodes[unknown[0]]]
        raise DefinitionError(
            f"in {len(unknown)} of {len(found)} decisions the action of the rule is not known, first for {agent!r} at"
            f" turn {found.turns[unknown[0]]} of the episode of seed {seed}; its decision point needs a"
            " rule_action_mapping that returns an action for every decision of the rule"
        )
