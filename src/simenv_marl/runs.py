"""Policies in the model: simulations run their own loops, and policies answer their decisions."""

from collections.abc import Callable, Iterable, Mapping
from itertools import chain
from typing import Any, Unpack

import numpy as np

from .core import EpisodeOptions, Mode, Plan, Points, Session, checked_seed, reuse_resources
from .envs.single import plan_of
from .errors import OptionValueError, close_after, short_repr
from .many.batch import policy_keys, run
from .many.parallel import import_extra, progress_bar, spread


def simulate(
    simulation: Any,
    policies: Mapping[Any, Any] | None = None,
    *,
    points: Points = None,
    seed: int | None = None,
    **options: Unpack[EpisodeOptions],
) -> Any:
    """Run a simulation's own loop to its end. Policies answer decisions.

    All other decisions follow the model's rule.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a
            ``Variant``.
        policies: The policies: a dict from an agent or a decision point to a callable. The callable
            gets the observation, or the observation and the info, and returns an action.
        points: The decision points, as ``generate_env`` takes them. With neither ``points`` nor
            ``policies``, there are no decision points and the plain model runs.
        seed: The seed for the simulation's ``reset``, where ``reset`` takes one. None: a seed is
            drawn.
        **options: The options of ``aec_env``, without ``max_steps``.

    Returns:
        The simulation, after its ``run``.

    Raises:
        SimEnvError: Something cannot work. The subclass tells what.
        BaseException: Any exception of the model, a mapping or a policy.
    """
    plan = _draw_up(simulation, policies or {}, points, options)
    with reuse_resources():  # policies may branch
        session = Session(plan)
        try:
            session.start(checked_seed(seed), None)
        except BaseException as error:
            close_after(error, session.close, "the simulation")
            raise
        session.close()
    return session.simulation


def simulate_many(
    simulation: Any,
    policies: Mapping[Any, Any] | None = None,
    *,
    seeds: Iterable[int],
    points: Points = None,
    collect: Callable[[Any], Any] | None = None,
    batch_size: int = 1024,
    concurrency: int = 64,
    workers: int = 0,
    progress: bool = False,
    **options: Unpack[EpisodeOptions],
) -> list[Any]:
    """Run one simulation per seed, with policies that answer the decisions of many simulations in batches.

    Each simulation ends as it would end with ``simulate`` and the same policies. The results do not
    depend on ``batch_size``, ``concurrency`` and ``workers``, as long as a policy's answer to one
    row does not depend on others.

    Args:
        simulation: A simulation (which is copied for each seed), its class, a zero-argument
            factory, or a ``Variant``.
        policies: The policies: a dict from an agent or a decision point to a callable. The callable
            gets the observations of all decisions that wait for it; or the observations and the
            infos; or the observations, the infos and the identities. Observations are stacked,
            ``(batch, *shape)``; for a ``Dict`` or ``Tuple`` space they are a dict or a tuple of
            stacks. The infos are a list of dicts. The identities are a list of pairs: the seed of
            the episode, and the number of the decision among all decisions of the episode. The
            callable returns as many actions, in the same order: an array, something that NumPy can
            convert to one (a tensor), a sequence, or a dict of these. ``RULE`` in place of one
            action, or of all, leaves the decision to the model. A tuple of actions and a dict is
            allowed; the dict is ignored here (see ``collect_episodes``). If several keys have the
            same policy object, their decisions share batches. One batch never mixes different
            spaces. The policies of a ``Variant`` answer one decision at a time; so do policies that
            ask for ``_environment`` or ``_decision``, and coroutine functions, which are awaited.
        seeds: The seeds of the simulations, non-negative integers.
        points: The decision points, as ``generate_env`` takes them. With neither ``points`` nor
            ``policies``, there are no decision points and the plain models run.
        collect: A callable of a simulation that has just ended. It returns what to keep of it.
            None: keep the simulation itself.
        batch_size: The largest number of simulations that are suspended together, in each worker
            process. At most 256 are suspended while the policies take less time than the
            simulations.
        concurrency: How many decisions of each process wait at once for policies that are coroutine
            functions.
        workers: The number of worker processes, which ``joblib`` runs. 0: this process alone. -1:
            as many as joblib's backend has. The simulation, points, policies, options and collected
            values must be picklable, by reference or by value.
        progress: Whether to show a progress bar, by ``tqdm``.
        **options: The options of ``simulate``.

    Returns:
        The collected value of each seed, in the order of the seeds.

    Raises:
        OptionValueError: An argument has an invalid value.
        InvalidActionError: A policy did not return one legal action for each decision.
        MissingExtraError: joblib or tqdm is missing.
        SimEnvError: Something else cannot work. The subclass tells what.
        BaseException: Any exception of a model, a mapping, a policy or ``collect``, with a note
            that names the seed. All other simulations are unwound first.
    """
    checked, episodes = (
        checked_seeds(seeds),
        (simulation, checked_policies(policies), points, options),
    )
    check_options(batch_size, workers, collect, concurrency)
    plan = _draw_up_keyed(*episodes)  # errors show up before any work starts
    arguments = episodes, None if workers else plan, collect, batch_size, concurrency
    with progress_bar(len(checked), progress) as bar:
        return list(
            chain.from_iterable(spread(_simulate, arguments, checked, workers, batch_size, bar))
        )


def _draw_up(
    simulation: Any, policies: Mapping[Any, Any], points: Any, options: Mapping[str, Any]
) -> Plan:
    if options.get("max_steps") is not None:
        raise OptionValueError(
            "max_steps has no effect where simulations run to their own end; evaluate,"
            " collect_episodes and environments truncate episodes"
        )
    return plan_of(simulation, points, {**options, "policies": policies}, mode=Mode.SIMULATE)


def _draw_up_keyed(
    simulation: Any, policies: Mapping[Any, Any], points: Any, options: Mapping[str, Any]
) -> Plan:
    return _draw_up(simulation, policy_keys(policies), points, options)


def _simulate(
    episodes: tuple[Any, ...],
    plan: Plan | None,
    collect: Any,
    batch_size: int,
    concurrency: int,
    seeds: list[int],
    bar: Any,
) -> list[Any]:
    """Simulate some of the seeds, in this process."""
    results: list[Any] = [None] * len(seeds)

    def finish(place: int, ended: Any) -> None:
        results[place] = ended if collect is None else collect(ended)
        bar.update()

    run(plan or _draw_up_keyed(*episodes), seeds, batch_size, finish, concurrency=concurrency)
    return results


def checked_seeds(seeds: Any) -> list[int]:
    """Return seeds as a list of Python integers, or raise an error that says why they are not valid."""
    if isinstance(seeds, (str, bytes)) or not isinstance(seeds, Iterable):
        raise OptionValueError(
            f"seeds must be an iterable of integers, such as range(100), not {short_repr(seeds)}"
        )
    checked = []
    for seed in seeds:
        if seed is None:
            raise OptionValueError(
                "seeds must be integers, not None: an unknown seed could not be repeated"
            )
        checked.append(checked_seed(seed))
    return checked  # type: ignore[return-value]


def checked_policies(policies: Any) -> Mapping[Any, Any]:
    """Return policies as a mapping."""
    if policies is not None and not isinstance(policies, Mapping):
        raise OptionValueError(
            "policies must be a dict from agents or points to callables, not"
            f" {short_repr(policies)}"
        )
    return policies or {}


def check_options(batch_size: Any, workers: Any, collect: Any = None, concurrency: Any = 1) -> None:
    """Check the options that all functions for many simulations have."""
    if collect is not None and not callable(collect):
        raise OptionValueError(
            f"collect must be a callable of a simulation, or None, not {short_repr(collect)}"
        )
    for name, value, least in (
        ("batch_size", batch_size, 1),
        ("concurrency", concurrency, 1),
        ("workers", workers, -1),
    ):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            what = (
                "a positive integer"
                if least == 1
                else "a non-negative integer, or -1 for as many as joblib has"
            )
            raise OptionValueError(f"{name} must be {what}, not {short_repr(value)}")
    if workers:
        backend, _ = import_extra("joblib.parallel", f"workers={workers}").get_active_backend()
        if type(backend).__name__ == "MultiprocessingBackend":
            raise OptionValueError(
                "joblib's backend 'multiprocessing' waits for ever for a worker that has died; use"
                " 'loky'"
            )
