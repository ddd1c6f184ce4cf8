"""Trajectories for learning: episodes of many simulations at once, with policies that answer in batches."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, Unpack

from ..core.options import EpisodeOptions
from ..core.plan import Plan
from ..core.points import Points
from ..many.batch import BatchPolicy, PolicyKey, Watcher, policy_keys, run
from ..many.parallel import progress_bar, spread
from ..many.simulate import check_collect, check_numbers, checked_policies, checked_seeds
from ..simulation import RULE
from .trajectories import Ledger, Trajectories, merged


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
    checked = checked_seeds(seeds)
    check_numbers(batch_size, workers)
    check_collect(collect)
    given = checked_policies(policies)
    plan, keys = learners_plan(simulation, given, points, options)
    with progress_bar(len(checked)) if progress else nullcontext() as bar:
        if not workers or not checked:
            found = _collect(plan, keys, collect, int(batch_size), checked, bar)
        else:
            parts = []
            arguments = (simulation, given, points, collect, int(batch_size), options)
            for number, part in spread(_collect_part, arguments, checked, int(workers), int(batch_size)):
                parts.append(part)
                if bar is not None:
                    bar.update(number)
            found = {place: merged([part[place] for part in parts]) for place in keys.values()}
    return {key: found[place] for key, place in keys.items()}


def learners_plan(
    simulation: Any,
    policies: Mapping[Any, Any],
    points: Any,
    options: Mapping[str, Any],
    *,
    all_points: bool = False,
) -> tuple[Plan, dict[Any, int]]:
    """Return the plan of the episodes, and the place of each policy by its key.

    Args:
        simulation: As ``collect_episodes`` takes it.
        policies: As ``collect_episodes`` takes them.
        points: As ``collect_episodes`` takes them.
        options: As ``collect_episodes`` takes them.
        all_points: Whether entities without a policy are agents as well, whose decisions follow the rule.
    """
    asked = {key: _left_to_the_rule if policy is RULE else policy for key, policy in policies.items()}
    found = policy_keys(asked, rewarded=True)
    keys = {key: entry.place for key, entry in found.items() if isinstance(entry, PolicyKey)}
    others = PolicyKey(len(found), BatchPolicy(_left_to_the_rule)) if all_points else None
    given = {**options, "policies": found}
    return Plan.draw_up(simulation, points, given, unanswered=True, rewarded=True, others=others), keys


def _left_to_the_rule(observations: Any) -> Any:
    return RULE


def _collect_part(
    simulation: Any,
    policies: Mapping[Any, Any],
    points: Any,
    collect: Callable[[Any], Any] | None,
    batch_size: int,
    options: dict[str, Any],
    seeds: list[int],
) -> dict[int, Trajectories]:
    """Play a part of the episodes, in a worker process."""
    plan, keys = learners_plan(simulation, policies, points, options)
    return _collect(plan, keys, collect, batch_size, seeds, None)


def _collect(
    plan: Plan,
    keys: Mapping[Any, int],
    collect: Callable[[Any], Any] | None,
    batch_size: int,
    seeds: list[int],
    bar: Any,
) -> dict[int, Trajectories]:
    ledger = Ledger()
    watcher: Watcher = ledger
    collected: list[Any] = [None] * len(seeds)

    def finish(place: int, simulation: Any) -> None:
        if collect is not None:
            collected[place] = collect(simulation)
        if bar is not None:
            bar.update()

    run(plan, seeds, batch_size, finish, watcher)
    found = ledger.trajectories(plan, keys, seeds)
    if collect is None:
        return found
    return {place: replace(own, collected=tuple(collected)) for place, own in found.items()}
