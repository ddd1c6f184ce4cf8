"""Many simulations at once, with policies that answer the decisions of all of them in batches."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, Unpack

import numpy as np

from ..core.options import EpisodeOptions
from ..core.plan import Plan
from ..core.points import Points
from ..core.session import checked_seed
from ..errors import OptionValueError, shown
from ..simulation import RULE
from .batch import BatchPolicy, PolicyKey, Watcher, policy_keys, run
from .spread import progress_bar, spread
from .trajectories import Ledger, Trajectories, merged

__all__ = ["Trajectories", "collect_episodes", "simulate_many"]


def simulate_many(
    simulation: Any,
    policies: Mapping[Any, Any] | None = None,
    *,
    seeds: Iterable[int],
    points: Points = None,
    collect: Callable[[Any], Any] | None = None,
    batch_size: int = 1024,
    workers: int = 0,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> list[Any]:
    """Run one simulation per seed, with policies that answer the decisions of many simulations in batches.

    Each simulation ends as it would end with ``simulate`` and the same policies. The results do not depend on
    ``batch_size`` and ``workers``, as long as a policy's answer to one row does not depend on the other rows.

    Args:
        simulation: A simulation (which is copied for each seed), its class, a zero-argument factory, or a ``Variant``.
        policies: The policies: a dict from an agent or a decision point to a callable. The callable gets the
            observations of all decisions that wait for it; or the observations and the infos; or the observations, the
            infos and the identities. Observations are stacked, ``(batch, *shape)``; for a ``Dict`` or ``Tuple`` space
            they are a dict or a tuple of stacks. The infos are a list of dicts. The identities are a list of pairs: the
            seed of the episode, and the number of the decision among all decisions of the episode. The callable returns
            as many actions, in the same order: an array, something that NumPy can convert to one (a tensor), a
            sequence, or a dict of these. ``RULE`` in place of one action, or of all, leaves the decision to the model.
            A tuple of actions and a dict is allowed; the dict is ignored here (see ``collect_episodes``). If several
            keys have the same policy object, their decisions share batches. One batch never mixes different spaces. The
            policies of a ``Variant`` answer one decision at a time.
        seeds: The seeds of the simulations, non-negative integers.
        points: The decision points, as ``generate_env`` takes them. With neither ``points`` nor ``policies``, there are
            no decision points and the plain models run.
        collect: A callable of a simulation that has just ended. It returns what to keep of it. None: keep the
            simulation itself.
        batch_size: The largest number of simulations that are suspended together, in each worker process. At most 256
            are suspended while the policies take less time than the simulations.
        workers: The number of worker processes, which ``joblib`` runs. 0: this process alone. -1: as many as joblib's
            backend has. The simulation, points, policies, options and collected values must be picklable, by reference
            or by value.
        progress: Whether to show a progress bar, by ``tqdm``.
        **options: The options of ``simulate``.

    Returns:
        The collected value of each seed, in the order of the seeds.

    Raises:
        OptionValueError: An argument has an invalid value.
        InvalidActionError: A policy did not return one legal action for each decision.
        MissingExtraError: joblib or tqdm is missing.
        SimEnvError: Something else cannot work. The subclass tells what.
        BaseException: Any exception of a model, a mapping, a policy or ``collect``, with a note that names the seed.
            All other simulations are unwound first.
    """
    checked = checked_seeds(seeds)
    check_numbers(batch_size, workers)
    _check_collect(collect)
    arguments = (simulation, _checked_policies(policies), points, collect, int(batch_size), options)
    # The plan is made here even if workers do the work: errors show up before any work starts.
    plan = Plan.draw_up(simulation, points, {**options, "policies": policy_keys(arguments[1])}, unanswered=True)
    with progress_bar(len(checked)) if progress else nullcontext() as bar:
        if not workers or not checked:
            return _simulate(plan, collect, int(batch_size), checked, bar)
        results: list[Any] = []
        for number, part in spread(_simulate_part, arguments, checked, int(workers), int(batch_size)):
            results += part
            if bar is not None:
                bar.update(number)
        return results


def _simulate_part(
    simulation: Any,
    policies: Mapping[Any, Any],
    points: Any,
    collect: Callable[[Any], Any] | None,
    batch_size: int,
    options: dict[str, Any],
    seeds: list[int],
) -> list[Any]:
    """Simulate a part of the seeds, in a worker process."""
    plan = Plan.draw_up(simulation, points, {**options, "policies": policy_keys(policies)}, unanswered=True)
    return _simulate(plan, collect, batch_size, seeds, None)


def _simulate(
    plan: Plan, collect: Callable[[Any], Any] | None, batch_size: int, seeds: list[int], bar: Any
) -> list[Any]:
    results: list[Any] = [None] * len(seeds)

    def finish(place: int, simulation: Any) -> None:
        results[place] = simulation if collect is None else collect(simulation)
        if bar is not None:
            bar.update()

    run(plan, seeds, batch_size, finish)
    return results


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
    _check_collect(collect)
    given = _checked_policies(policies)
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


def checked_seeds(seeds: Any) -> list[int]:
    """Return seeds as a list of Python integers.

    Raises:
        OptionValueError: These are not valid seeds.
    """
    if isinstance(seeds, (str, bytes)) or not isinstance(seeds, Iterable):
        raise OptionValueError(f"seeds must be an iterable of integers, such as range(100), not {shown(seeds)}")
    checked = []
    for seed in seeds:
        if seed is None:
            raise OptionValueError("seeds must be integers, not None: an unknown seed could not be repeated")
        checked.append(checked_seed(seed))
    return checked  # type: ignore[return-value]


def _checked_policies(policies: Any) -> Mapping[Any, Any]:
    if policies is not None and not isinstance(policies, Mapping):
        raise OptionValueError(f"policies must be a dict from agents or points to callables, not {shown(policies)}")
    return policies or {}


def _check_collect(collect: Any) -> None:
    if collect is not None and not callable(collect):
        raise OptionValueError(f"collect must be a callable of a simulation, or None, not {shown(collect)}")


def check_numbers(batch_size: Any, workers: Any) -> None:
    """Check ``batch_size`` and ``workers``.

    Raises:
        OptionValueError: One of the numbers is invalid.
    """
    for name, value, least in (("batch_size", batch_size, 1), ("workers", workers, -1)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            what = "a positive integer" if least == 1 else "a non-negative integer, or -1 for as many as joblib has"
            raise OptionValueError(f"{name} must be {what}, not {shown(value)}")
