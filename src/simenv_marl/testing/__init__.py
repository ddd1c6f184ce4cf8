"""Checks of a simulation and its decision points, to run before trusting an environment.

``check_simulation`` runs a simulation by itself and in environments, plays episodes of random
actions, and explains every problem. ``inspect_simulation`` lists the decision points and their
calls. Both are also on the command line::

    python -m simenv_marl check package.module:Simulation
    python -m simenv_marl inspect package.module:Simulation
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from typing import Unpack

from ..core import CheckOptions, Point, Points, is_seed
from ..envs import VIEWS
from ..envs.single import plan_of
from ..errors import OptionValueError, short_repr
from ..simulation import Model, check_count, check_seconds
from .checks import Check
from .report import (
    CheckReport,
    Finding,
    Inspection,
    PointStatistics,
    Range,
    order_of,
)
from .runs import (
    WARNINGS,
    Run,
    Runner,
    describe_with_place,
    silence,
)

__all__ = [
    "CheckReport",
    "Finding",
    "Inspection",
    "PointStatistics",
    "Range",
    "check_simulation",
    "inspect_simulation",
]


def check_simulation(
    simulation: Model,
    points: Points = None,
    *,
    seeds: Iterable[int] = (0, 1, 2),
    episodes: int = 10,
    max_steps: int = 1000,
    time_limit: float = 60.0,
    fingerprint: Callable[[Model], Model] | None = None,
    **options: Unpack[CheckOptions],
) -> CheckReport:
    """Check a simulation before its environments are used.

    The checks compare plain runs with runs of ``RULE`` throughout in every view that fits; episodes
    of the same seed in new and used environments, side by side, and in new processes with other
    hash seeds; and observations with their spaces. They watch the rules, and run PettingZoo's and
    Gymnasium's own tests. Every exception of the model is a finding. The global generators of
    Python and NumPy keep their states.

    Args:
        simulation: A simulation (which is copied), its class, or a zero-argument factory.
        points: The active decision points, as ``generate_env`` takes them.
        seeds: The seeds of plain runs that are compared; at least one.
        episodes: The number of episodes of random legal actions.
        max_steps: The number of decisions after which a run is cut, so that the check also ends for
            models that never end.
        time_limit: The limit for all checks, in seconds; a single run may take a quarter of it.
            Running Python code is interrupted, in the main thread also a sleep; calculations
            outside of Python are not.
        fingerprint: A callable of the simulation after a run, whose results are compared: numbers,
            arrays, strings, or containers of these. None: the simulation's ``state()``, or else all
            its attributes.
        **options: The options of the environments, as ``aec_env`` takes them.

    Returns:
        The report: ``print`` it, or call its ``raise_for_errors`` in tests.

    Raises:
        SimEnvError: The simulation, the points or an option is invalid. The message says which.
    """
    unique_seeds = list(dict.fromkeys(seeds))
    if not unique_seeds or not all(map(is_seed, unique_seeds)):
        raise OptionValueError(
            f"seeds must be non-negative integers, at least one, not {short_repr(seeds)}"
        )
    check_count(episodes, "episodes", 1)
    check_count(max_steps, "max_steps", 1)
    check_seconds(time_limit, "time_limit")
    check = Check(
        partial(plan_of, simulation, points, options),
        max_steps,
        time_limit / 4,
        fingerprint,
        list(map(int, unique_seeds)),
        episodes,
    )
    with silence() as warnings:
        check.run()
    for text in (str(warning.message) for warning in warnings):
        for part, name in WARNINGS.items():
            if part in text:
                check.add(name, text[:400], kind=part)
    return check.report(getattr(simulation, "__name__", type(simulation).__name__))


def inspect_simulation(
    simulation: Model,
    points: Points = None,
    *,
    seed: int = 0,
    max_steps: int = 10_000,
    time_limit: float = 30.0,
    **options: Unpack[CheckOptions],
) -> Inspection:
    """List the decision points of a simulation, and the order of their calls in one plain run.

    It takes the same arguments as ``check_simulation``. The episode is cut after ``max_steps``
    decisions, or after ``time_limit`` seconds.

    Returns:
        The inspection; ``print`` it.

    Raises:
        SimEnvError: The simulation, the points or an option is invalid. The message says which.
        Exception: Any exception of the model's constructor.
    """
    if not is_seed(seed):
        raise OptionValueError(f"seed must be a non-negative integer, not {short_repr(seed)}")
    with silence():
        runner = Runner(
            partial(plan_of, simulation, points, options),
            max_steps,
            time_limit,
            lambda simulation: None,
        )
        run = runner.run_plainly(seed)
        refused = runner.refused_views()
    return Inspection(
        runner.plan.name,
        tuple(map(_describe, runner.plan.active)),
        tuple(view for view in VIEWS if view not in refused),
        order_of(run.calls),
        dict(Counter(run.calls)),
        f"{len(run.calls)} decisions, then {_describe_end(run)}",
    )


def _describe(point: Point) -> dict[str, str]:
    """Describe a decision point for an inspection."""
    definition = point.definition
    options = ("action_mask_mapping", "choices", "apply", "removed_by", "goal_space")
    uses = ", ".join(name for name in options if getattr(definition, name))
    return {
        "point": point.hook.name,
        "agent": point.agent or "named by each call",
        "observations": str(definition.observation_space),
        "actions": str(definition.action_space),
        "uses": uses or "no masks, choices, removals or goals",
    }


def _describe_end(run: Run) -> str:
    """Describe the end of a plain run for an inspection."""
    if run.error is not None:
        return describe_with_place(run.error)
    if run.is_cut:
        return "cut"
    ends = {"truncated": "a limit of time", "terminated": "an end of the task"}
    return f"{run.end} ({ends[run.end]})"
