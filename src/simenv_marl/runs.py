"""Policies in the model: simulations run their own loops, and policies answer their decisions."""

from collections.abc import Callable, Iterable, Mapping
from itertools import chain
from typing import Any, Unpack

from .core import (
    Episode,
    EpisodeOptions,
    Mode,
    Plan,
    Points,
    Session,
    Source,
    checked_seed,
    is_seed,
    reuse_resources,
)
from .envs.single import plan_of
from .errors import OptionValueError, WorkerError, close_after, short_repr
from .many.batch import BatchRun, policy_keys
from .many.parallel import ProgressBar, import_extra, progress_bar, spread
from .simulation import Model, check_count


def simulate(
    simulation: Source,
    policies: Mapping[Any, Any] | None = None,
    *,
    points: Points = None,
    seed: int | None = None,
    **options: Unpack[EpisodeOptions],
) -> Model:
    """Run a simulation's own loop to its end. Policies answer decisions.

    All other decisions follow the model's rule.

    Args:
        simulation: A simulation (which is copied), its class, a zero-argument factory, or a
            ``Variant``.
        policies: The policies: a dict from an agent or a decision point to a callable. The callable
            gets the observation, or the observation and the info, and returns an action. A
            keyword-only parameter ``_state`` gets the simulation's state, ``_simulation`` the
            simulation itself.
        points: The decision points, as ``generate_env`` takes them. With neither ``points`` nor
            ``policies``, there are no decision points and the plain model runs.
        seed: The seed for the simulation's ``reset``, where ``reset`` takes one. None: a seed is
            drawn.
        **options: The options of ``aec_env``, without ``max_steps``.

    Returns:
        The simulation, after its ``run``.

    Raises:
        SimEnvError: An argument is invalid. The message says which.
        BaseException: Any exception of the model, a mapping or a policy.
    """
    plan = _make_plan(simulation, policies or {}, points, options)
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
    simulation: Source,
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
    """Run one simulation per seed. Policies answer the decisions of many simulations in batches.

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
            spaces. A keyword-only parameter ``_state`` gets the stacked states of the simulations,
            as ``state()`` of an environment returns them. The policies of a ``Variant`` answer one
            decision at a time; so do policies that ask for ``_environment``, ``_decision`` or
            ``_simulation``, and coroutine functions, which are awaited.
        seeds: The seeds of the simulations, non-negative integers.
        points: The decision points, as ``generate_env`` takes them. With neither ``points`` nor
            ``policies``, there are no decision points and the plain models run.
        collect: A callable of a simulation that has just ended, whose result is collected. None:
            collect the simulation itself.
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
        The collected value of each seed, in the order of the seeds. With workers, runs whose
        process dies (killed, out of memory, a crash in C) are run again, each alone. One that ends
        its process then is run again once. If it is lost again, its value is a ``WorkerError``.

    Raises:
        OptionValueError: An argument has an invalid value.
        InvalidActionError: A policy did not return one legal action for each decision.
        MissingExtraError: joblib or tqdm is missing.
        WorkerError: All of several runs are lost.
        SimEnvError: Another argument is invalid. The message says which.
        BaseException: Any exception of a model, a mapping, a policy or ``collect``, with a note
            that names the seed. All other simulations are unwound first.
    """
    all_seeds = checked_seeds(seeds)
    episodes = simulation, policy_keys(checked_policies(policies)), points, options
    check_options(batch_size, workers, collect, concurrency)
    plan = _make_plan(*episodes)  # errors are raised before any work starts
    arguments = episodes, None if workers else plan, collect, batch_size, concurrency
    with progress_bar(len(all_seeds), progress) as bar:
        parts = spread(_simulate, arguments, all_seeds, workers, batch_size, bar, lost=_lost)
    return list(chain.from_iterable(parts))


def _lost(seed: int, error: WorkerError) -> list[Model]:
    """Return the results of a run that was lost twice."""
    return [error]


def _make_plan(
    simulation: Source,
    policies: Mapping[Any, Any],
    points: Points,
    options: Mapping[str, Any],
) -> Plan:
    if options.get("max_steps") is not None:
        raise OptionValueError(
            "max_steps has no effect where simulations run to their own end; evaluate,"
            " collect_episodes and environments truncate episodes"
        )
    return plan_of(simulation, points, {**options, "policies": policies}, mode=Mode.SIMULATE)


def _simulate(
    episodes: tuple[Any, ...],
    plan: Plan | None,
    collect: Callable[[Model], Model] | None,
    batch_size: int,
    concurrency: int,
    seeds: list[int],
    bar: ProgressBar,
) -> list[Model]:
    """Simulate some of the seeds, in this process."""
    results: list[Model] = [None] * len(seeds)

    def finish(place: int, episode: Episode) -> None:
        simulation = episode.simulation
        results[place] = simulation if collect is None else collect(simulation)
        bar.update()

    plan = plan or _make_plan(*episodes)
    BatchRun(plan, seeds, batch_size, finish, concurrency=concurrency).run()
    return results


def checked_seeds(seeds: Iterable[int]) -> list[int]:
    """Return seeds as a list of Python integers.

    Raises:
        OptionValueError: The seeds are not an iterable of non-negative integers.
    """
    if isinstance(seeds, (str, bytes)) or not isinstance(seeds, Iterable):
        raise OptionValueError(
            f"seeds must be an iterable of integers, such as range(100), not {short_repr(seeds)}"
        )
    checked = list(seeds)
    for seed in checked:
        if not is_seed(seed):
            raise OptionValueError(f"seeds must be non-negative integers, not {short_repr(seed)}")
    return list(map(int, checked))


def checked_policies(policies: Mapping[Any, Any] | None) -> Mapping[Any, Any]:
    """Return policies as a mapping. Raise an ``OptionValueError`` if they are none."""
    if policies is not None and not isinstance(policies, Mapping):
        raise OptionValueError(
            "policies must be a dict from agents or points to callables, not"
            f" {short_repr(policies)}"
        )
    return policies or {}


def check_options(
    batch_size: int,
    workers: int,
    collect: Callable[..., Model] | None = None,
    concurrency: int = 1,
) -> None:
    """Check the options of functions that run many simulations: see ``simulate_many``.

    Raises:
        OptionValueError: An option has an invalid value.
        MissingExtraError: There are workers, and joblib is missing.
    """
    if collect is not None and not callable(collect):
        raise OptionValueError(
            f"collect must be a callable of a simulation, or None, not {short_repr(collect)}"
        )
    check_count(batch_size, "batch_size", 1)
    check_count(concurrency, "concurrency", 1)
    check_count(workers, "workers", -1)  # -1: as many as joblib has
    if workers:
        backend, _ = import_extra("joblib.parallel", f"workers={workers}").get_active_backend()
        if type(backend).__name__ == "MultiprocessingBackend":
            raise OptionValueError(
                "joblib's backend 'multiprocessing' waits for ever for a worker that has died; use"
                " 'loky'"
            )
