"""Checks of a simulation and its decision points, to run before trusting an environment.

``check_simulation`` runs a simulation by itself and in environments, plays episodes of random
actions, and explains what is wrong. ``inspect_simulation`` lists the decision points and their
calls. Both are also on the command line::

    python -m simenv_marl check package.module:Simulation
    python -m simenv_marl inspect package.module:Simulation
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, Unpack

from ..core import CheckOptions, Points, is_seed
from ..envs.single import plan_of
from ..errors import OptionValueError, SimEnvError, short_repr
from ..simulation import TRUNCATED
from .checks import CHECKS, Report, fitting_views, make_environment
from .report import SEVERITIES, CheckReport, Finding, Inspection, PointStatistics, Range, order_of
from .runs import Run, Subject, describe_with_place, quietly

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
    simulation: Any,
    points: Points = None,
    *,
    seeds: Iterable[int] = (0, 1, 2),
    episodes: int = 10,
    max_steps: int = 1000,
    time_limit: float = 60.0,
    fingerprint: Callable[[Any], Any] | None = None,
    **options: Unpack[CheckOptions],
) -> CheckReport:
    """Check a simulation before its environments are used.

    The checks compare plain runs with runs of ``RULE`` throughout in every view that fits; episodes
    of the same seed in new and used environments and side by side; and observations with their
    spaces. They run PettingZoo's and Gymnasium's own tests. Every exception of the model is a
    finding. Python's and NumPy's global generators are left as they were.

    Args:
        simulation: A simulation (which is copied), its class, or a zero-argument factory.
        points: The active decision points, as ``generate_env`` takes them.
        seeds: The seeds of plain runs that are compared; at least one.
        episodes: The number of episodes of random legal actions.
        max_steps: The number of decisions after which a run is cut, so that models that never end
            can be checked, too.
        time_limit: The approximate limit for all checks, in seconds; a single run may take a
            quarter of it. Running Python code is interrupted; waiting outside of Python (in a
            sleep, for example) is not.
        fingerprint: What simulations are compared by after a run: a callable of the simulation that
            returns numbers, arrays, strings, or containers of these. None: its ``state()``, or else
            all its attributes.
        **options: The options of the environments, as ``aec_env`` takes them.

    Returns:
        The report: ``print`` it, or call its ``raise_for_errors`` in tests.

    Raises:
        SimEnvError: The simulation, the points or the options cannot be used at all. The subclass
            tells why.
    """
    chosen = tuple(dict.fromkeys(seeds))
    if not chosen or not all(map(is_seed, chosen)):
        raise OptionValueError(
            f"seeds must be non-negative integers, at least one, not {short_repr(seeds)}"
        )
    for name, number in (("episodes", episodes), ("max_steps", max_steps)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise OptionValueError(f"{name} must be a positive integer, not {short_repr(number)}")
    if not 0 < time_limit < math.inf:
        raise OptionValueError(
            f"time_limit must be a positive number of seconds, not {short_repr(time_limit)}"
        )
    report, calls = Report(), ""
    with quietly() as caught:
        try:
            plan = plan_of(simulation, points, options)
            make_environment(plan, "aec")
            subject = Subject(
                plan=plan,
                max_steps=max_steps,
                seconds=time_limit / 4,
                own=fingerprint,
                seeds=tuple(map(int, chosen)),
                episodes=episodes,
                end=time.monotonic() + time_limit,
            )
            for check in CHECKS:
                if check is CHECKS[0] or subject.views:
                    check(subject, report)
            if subject.late:
                report.add("out_of_time", f"after {time_limit:g} seconds")
            calls = order_of(subject.plain[subject.seeds[0]].calls)
        except SimEnvError:
            raise
        except (Exception, SystemExit) as error:  # of the model's constructor, for example
            report.add_error(Run(error=error), "while the simulation was made or reset")
    for warning in caught:
        report.add("warned", str(warning.message)[:300])
    return CheckReport(
        simulation=str(getattr(simulation, "__name__", None) or type(simulation).__name__),
        findings=tuple(
            sorted(dict.fromkeys(report.findings), key=lambda f: SEVERITIES.index(f.severity))
        ),
        checked=tuple(report.checked),
        statistics=report.statistics,
        episodes=report.episodes,
        calls=calls,
    )


def inspect_simulation(
    simulation: Any,
    points: Points = None,
    *,
    seed: int = 0,
    max_steps: int = 10_000,
    time_limit: float = 30.0,
    **options: Unpack[CheckOptions],
) -> Inspection:
    """List the decision points of a simulation and the order of their calls, by running one episode of its own rules.

    The arguments are those of ``check_simulation``. The episode is cut after ``max_steps``
    decisions, or after ``time_limit`` seconds.

    Returns:
        The inspection; ``print`` it.

    Raises:
        SimEnvError: The simulation, the points or the options cannot be used at all. The subclass
            tells why.
        Exception: Any exception of the model's constructor.
    """
    if not is_seed(seed):
        raise OptionValueError(f"seed must be a non-negative integer, not {short_repr(seed)}")
    with quietly():
        plan = plan_of(simulation, points, options)
        subject = Subject(
            plan=plan, max_steps=max_steps, seconds=time_limit, own=lambda simulation: None
        )
        run = subject.run_plainly(seed)
        views = fitting_views(plan)
    how = (
        "truncated (a limit of time)"
        if run.result is TRUNCATED
        else "terminated (an end of the task)"
    )
    how = describe_with_place(run.error) if run.error is not None else "cut" if run.cut else how
    uses = ("action_mask_mapping", "choices", "apply", "removed_by", "goal_space")
    return Inspection(
        simulation=plan.name,
        points=tuple(
            {
                "point": bound.hook.name,
                "agent": bound.agent or "named by each call",
                "observations": str(bound.definition.observation_space),
                "actions": str(bound.definition.action_space),
                "uses": ", ".join(name for name in uses if getattr(bound.definition, name))
                or "no masks, choices, removals or goals",
            }
            for bound in plan.active
        ),
        views=views,
        calls=order_of(run.calls),
        counts=dict(Counter(run.calls)),
        ended=f"{len(run.calls)} decisions, then {how}",
    )
