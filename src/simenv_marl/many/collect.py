"""Many simulations at once: policies that answer the decisions of all of them together."""

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
    """Run one simulation per seed, with policies that answer the decisions of many simulations at once.

    What becomes of each simulation is what ``simulate`` makes of it, with the same policies for one decision at a
    time; for every ``batch_size`` and number of workers, as long as what a policy answers to one row does not depend on
    the others.

    Args:
        simulation: A simulation (which is copied for each seed), its class, a zero-argument factory, or a ``Variant``.
        policies: Who decides: from agent or decision point to a callable of the observations, or of the observations
            and the infos, or of these and the identities, of as many decisions as wait for it. The observations are
            stacked, ``(batch, *shape)``; where the space is a ``Dict`` or a ``Tuple``, a dict or a tuple of stacks. The
            infos are a list of dicts, the identities one of pairs: the seed of the episode, and the number of the
            decision among all in it.
            It returns as many actions, in the same order: an array, what becomes one (a tensor), a sequence, or a dict
            of these. ``RULE`` in place of an action, or of all of them, leaves it to the model. A tuple of the actions
            and a dict is taken for actions alone (see ``collect_episodes``). Policies that are the same object are
            asked together; a policy is never asked for decisions in different spaces at once. A ``Variant``'s own
            policies are asked one by one.
        seeds: What the simulations are reset with, non-negative integers.
        points: The decision points, as ``generate_env`` takes them. None and no policies: none.
        collect: Called with each simulation as soon as it has ended; returns what is to be kept of it. None: the
            simulation itself.
        batch_size: How many simulations may be suspended together; in each worker. No more than 256 of them are
            as long as policies take less time than simulations do.
        workers: How many processes share the work, by ``joblib``: 0 for none but this one, -1 for as many as
            joblib's backend has. The simulation, the points, the policies, the options and what is collected have to
            be such as can be pickled, by reference or by value.
        progress: Whether to show a bar, by ``tqdm``.
        **options: As ``simulate`` takes them.

    Returns:
        What was collected for each seed, in the order of the seeds.

    Raises:
        OptionValueError: An argument cannot have its value.
        InvalidActionError: A policy has not returned one legal action for each decision.
        MissingExtraError: joblib or tqdm is missing.
        SimEnvError: Something else cannot work; the leaf says what.
        BaseException: Whatever a model, a mapping, a policy or ``collect`` raises, with a note that says of which
            seed. All other simulations are unwound before.
    """
    checked = checked_seeds(seeds)
    check_numbers(batch_size, workers)
    _check_collect(collect)
    arguments = (simulation, _checked_policies(policies), points, collect, int(batch_size), options)
    # Made here also where the work is done elsewhere, so that what cannot work is found out before.
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
    """In a worker: simulate a part of the seeds."""
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
    """Play one episode per seed, with policies that answer many at once, and keep what learners learn from.

    Those for whom policies answer are rewarded and end as the agents of an AEC environment are that is played with the
    same policies; all others run their rule. An episode in which nobody decides is none here, and no error.

    Args:
        simulation: A simulation (which is copied for each seed), its class, a zero-argument factory, or a ``Variant``.
        policies: Who decides, as in ``simulate_many``; ``RULE`` is a policy like any other. A policy may return
            a tuple of the actions and a dict of arrays of shape ``(batch, ...)`` (log-probabilities, values), which
            become ``extras``; always of the same names.
        seeds: What the simulations are reset with, non-negative integers.
        points: The decision points, as ``generate_env`` takes them.
        collect: Called with each simulation as soon as it has ended; what it returns stands in ``collected``.
        batch_size: How many simulations may be suspended together; in each worker. No more than 256 of them are
            as long as policies take less time than simulations do.
        workers: How many processes share the work: see ``simulate_many``.
        progress: Whether to show a bar, by ``tqdm``.
        **options: As ``aec_env`` takes them. ``max_steps`` truncates. Whoever has a policy is declared, whatever
            ``possible_agents`` says.

    Returns:
        By the keys of ``policies``, what those have lived through for whom each policy has answered.

    Raises:
        OptionValueError: An argument cannot have its value, or the extras do not fit the decisions.
        InvalidActionError: A policy has not returned one legal action for each decision.
        MissingExtraError: joblib or tqdm is missing.
        SimEnvError: Something else cannot work; the leaf says what.
        BaseException: Whatever a model, a mapping or a policy raises, with a note that says of which seed. All other
            simulations are unwound before.
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
    """The plan of the episodes, and the places of the policies by their keys.

    Args:
        simulation: As ``collect_episodes`` takes it.
        policies: As well.
        points: As well.
        options: As well.
        all_points: Whether those for whom no policy answers are agents as well, whose decisions are left to the rule.
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
    """In a worker: play a part of the episodes."""
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
    """Seeds as a list of python integers.

    Raises:
        OptionValueError: They are none.
    """
    if isinstance(seeds, (str, bytes)) or not isinstance(seeds, Iterable):
        raise OptionValueError(f"seeds must be an iterable of integers, such as range(100), not {shown(seeds)}")
    checked = []
    for seed in seeds:
        if seed is None:
            raise OptionValueError("seeds must be integers: None would draw one, and nobody would know which")
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
    """Make sure that there may be so many simulations, and so many processes.

    Raises:
        OptionValueError: There may not.
    """
    for name, value, least in (("batch_size", batch_size, 1), ("workers", workers, -1)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            what = "a positive integer" if least == 1 else "a non-negative integer, or -1 for as many as there are"
            raise OptionValueError(f"{name} must be {what}, not {shown(value)}")
