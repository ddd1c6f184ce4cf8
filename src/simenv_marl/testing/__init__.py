"""Checks of a simulation and its decision points: what to know before trusting an environment.

``check_simulation`` runs a simulation plainly and behind environments, plays episodes of random actions, and says in
plain words what is wrong; ``inspect_simulation`` tells what there is to be decided. Both are on the command line too::

    python -m simenv_marl check package.module:Simulation
    python -m simenv_marl inspect package.module:Simulation

Nothing else of the library imports this package. Its modules, each importing only from those above it::

    _fingerprint   what a simulation holds, so that two runs can be compared
    _report        findings, reports and their text
    _runs          plain runs, runs with RULE throughout, random episodes; all of them end
    _statistics    what observations and rewards range over
    _words         errors and differences in plain words
    _base          what all checks share
    _plain, _views, _episodes, _conformance    the checks
    _check         all of them, one after the other
    _inspect       what there is to be decided
"""

from __future__ import annotations

import io
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import redirect_stdout
from typing import Any

import numpy as np

from ..core.plan import Plan
from ..core.switch import unattended
from ..envs import SimulationAECEnv, aec_env
from ..errors import OptionValueError, SimEnvError
from .check import Checker
from .inspect import described, ending, fitting_views
from .report import (
    CheckReport,
    ComponentStatistics,
    EpisodeStatistics,
    Finding,
    Inspection,
    PointDescription,
    PointStatistics,
    Timing,
)
from .runs import (
    culprit,
    global_generators,
    plain_run,
    rule_run,
    seed_global_generators,
    set_global_generators,
)
from .words import order_of

__all__ = [
    "CheckReport",
    "ComponentStatistics",
    "EpisodeStatistics",
    "Finding",
    "Inspection",
    "PointDescription",
    "PointStatistics",
    "Timing",
    "check_simulation",
    "inspect_simulation",
]


def check_simulation(
    simulation: Any,
    points: Any = None,
    *,
    seeds: Iterable[int] = (0, 1, 2),
    episodes: int = 10,
    max_steps: int = 1000,
    time_limit: float = 60.0,
    fingerprint: Callable[[Any], Any] | None = None,
    **options: Any,
) -> CheckReport:
    """Check all that is to be known of a simulation before its environments are trusted.

    Compared are plain runs with ``RULE`` throughout in every view that fits, episodes of the same seed in new and used
    environments and side by side, and observations with their spaces; PettingZoo's and Gymnasium's own tests are run.
    Whatever the model raises is a finding. Python's and NumPy's global generators are left as they were.

    Args:
        simulation: A simulation (which is copied), its class, or a zero-argument factory.
        points: The active decision points, as ``generate_env`` takes them.
        seeds: With which seeds plain runs are compared; at least one.
        episodes: How many episodes of random legal actions are played.
        max_steps: After how many decisions a run is cut, so that models that never end can be checked as well.
        time_limit: For about how many seconds to check at most; a single run may take a quarter of it. Running
            Python code is interrupted; what waits outside of Python (in a sleep, say) is not.
        fingerprint: What a simulation is compared by after a run: a callable of it that returns numbers, arrays,
            strings, or containers of these. None: its ``state()``, or else all its attributes.
        **options: Options of the environments, as ``aec_env`` takes them.

    Returns:
        The report: ``print`` it, or let tests call its ``raise_for_errors``.

    Raises:
        SimEnvError: The simulation, the points or the options cannot be used at all; the leaf says why.
    """
    chosen = tuple(seeds)
    if not chosen or any(isinstance(s, bool) or not isinstance(s, (int, np.integer)) or s < 0 for s in chosen):
        raise OptionValueError(f"seeds must be non-negative integers, at least one, not {seeds!r}")
    for name, number in (("episodes", episodes), ("max_steps", max_steps)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise OptionValueError(f"{name} must be a positive integer, not {number!r}")
    if not time_limit > 0:
        raise OptionValueError(f"time_limit must be a positive number of seconds, not {time_limit!r}")
    try:
        plan = _quietly(lambda: Plan.draw_up(simulation, points, options))
        _quietly(lambda: aec_env(simulation, points, **{**options, "flatten": False}))
    except SimEnvError:
        raise
    except Exception as error:  # the model's own, from its constructor
        return _unmade(simulation, error)
    checker = Checker(
        plan,
        seeds=tuple(int(seed) for seed in dict.fromkeys(chosen)),
        episodes=episodes,
        max_steps=max_steps,
        limit=time_limit,
        own=fingerprint,
    )
    return checker.check()


def inspect_simulation(
    simulation: Any,
    points: Any = None,
    *,
    seed: int = 0,
    max_steps: int = 10_000,
    time_limit: float = 30.0,
    **options: Any,
) -> Inspection:
    """Tell what there is to be decided in a simulation, and in what order, by running one episode of its own rules.

    Args:
        simulation: A simulation (which is copied), its class, or a zero-argument factory.
        points: The decision points, as ``generate_env`` takes them.
        seed: Of the episode.
        max_steps: After how many decisions the episode is cut.
        time_limit: After how many seconds it is.
        **options: Options of the environments, as ``aec_env`` takes them.

    Returns:
        What was seen; ``print`` it.

    Raises:
        SimEnvError: The simulation, the points or the options cannot be used at all; the leaf says why.
        Exception: Whatever the model raises when it is made.
    """
    plan = _quietly(lambda: Plan.draw_up(simulation, points, options))
    states = global_generators()
    try:
        with unattended(), warnings.catch_warnings(), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            seed_global_generators(seed)
            run = plain_run(plan, seed, max_steps, time.monotonic() + time_limit, _nothing)
            agents: dict[str, None] = dict.fromkeys(plan.roster)
            if run.decisions and not plan.complete and run.error is None:
                agents |= _agents_of(plan, seed, max_steps, time.monotonic() + time_limit)
            views = tuple(fitting_views(plan))
    finally:
        set_global_generators(states)
    return Inspection(
        simulation=plan.name,
        points=tuple(described(binding) for binding in plan.active),
        views=views,
        calls=order_of(run.decisions),
        counts=dict(Counter(name for name, _ in run.decisions)),
        ended=ending(run),
        agents=tuple(agents),
    )


def _agents_of(plan: Plan, seed: int, max_steps: int, deadline: float) -> dict[str, None]:
    """The agents of an episode with ``RULE`` throughout, in the order in which they joined."""
    env = SimulationAECEnv(plan.amended({"flatten": False}))
    named: dict[str, None] = {}
    select = env._select

    def selected(record: Any) -> None:
        named[record.agent] = None
        select(record)

    env._select = selected  # type: ignore[method-assign]
    seed_global_generators(seed)
    rule_run(env, seed, max_steps, deadline, _nothing)
    env.close()
    return named


def _nothing(simulation: Any) -> None:
    """A fingerprint of nothing."""


def _quietly(make: Callable[[], Any]) -> Any:
    """Make something of a model that may print and warn meanwhile."""
    states = global_generators()
    try:
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            return make()
    finally:
        set_global_generators(states)


def _unmade(simulation: Any, error: Exception) -> CheckReport:
    place = culprit(error)
    name = getattr(simulation, "__name__", None) or type(simulation).__name__
    finding = Finding(
        "error",
        "The simulation cannot be made",
        "Environments make their simulation by calling its class or factory without arguments, or by copying an"
        " instance. Here that fails.",
        f"{type(error).__name__}: {error}" + (f" ({place})" if place else ""),
    )
    return CheckReport(str(name), (finding,), ())
