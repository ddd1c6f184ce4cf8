"""All checks of a simulation, one after the other."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from typing import Any, Final, Unpack

import numpy as np

from ..core.options import CheckOptions
from ..core.points import Points
from ..errors import OptionValueError, SimEnvError, short_repr
from .checks import check_plain_runs, check_repeated_run, check_views
from .conformance import check_conformance, check_timing
from .episodes import check_early_end, check_episodes
from .inside import Plan, make_environment
from .report import CheckReport, finding
from .runs import error_in_words, quietly
from .subject import Report, Subject

CHECKS: Final[tuple[Callable[[Subject, Report], None], ...]] = (
    check_plain_runs,
    check_repeated_run,
    check_views,
    check_episodes,
    check_early_end,
    check_conformance,
    check_timing,
)
"""All checks, the more basic first: if the plain run fails, the others are left out."""


TOLD: Final = {
    "refuses to end": "refusal",
    "several objects decide at": "shared_agent",
    "did not appear in the episode": "absent_agents",
}
"""Texts in the warnings of environments, and the findings that say the same."""


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

    The checks compare plain runs with runs of ``RULE`` throughout in every view that fits; episodes of the same seed in
    new and used environments and side by side; and observations with their spaces. They run PettingZoo's and
    Gymnasium's own tests. Every exception of the model is a finding. Python's and NumPy's global generators are left as
    they were.

    Args:
        simulation: A simulation (which is copied), its class, or a zero-argument factory.
        points: The active decision points, as ``generate_env`` takes them.
        seeds: The seeds of plain runs that are compared; at least one.
        episodes: The number of episodes of random legal actions.
        max_steps: The number of decisions after which a run is cut, so that models that never end can be checked, too.
        time_limit: The approximate limit for all checks, in seconds; a single run may take a quarter of it. Running
            Python code is interrupted; waiting outside of Python (in a sleep, for example) is not.
        fingerprint: What simulations are compared by after a run: a callable of the simulation that returns numbers,
            arrays, strings, or containers of these. None: its ``state()``, or else all its attributes.
        **options: The options of the environments, as ``aec_env`` takes them.

    Returns:
        The report: ``print`` it, or call its ``raise_for_errors`` in tests.

    Raises:
        SimEnvError: The simulation, the points or the options cannot be used at all. The subclass tells why.
    """
    chosen = tuple(seeds)
    if not chosen or any(isinstance(s, bool) or not isinstance(s, (int, np.integer)) or s < 0 for s in chosen):
        raise OptionValueError(f"seeds must be non-negative integers, at least one, not {short_repr(seeds)}")
    for name, number in (("episodes", episodes), ("max_steps", max_steps)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise OptionValueError(f"{name} must be a positive integer, not {short_repr(number)}")
    if not time_limit > 0:
        raise OptionValueError(f"time_limit must be a positive number of seconds, not {short_repr(time_limit)}")
    try:
        with quietly():
            plan = Plan.draw_up(simulation, points, options)
            make_environment(plan, "aec")
    except SimEnvError:
        raise
    except Exception as error:  # an exception of the model's constructor
        return _unmade(simulation, error)
    subject = Subject(
        plan, tuple(int(seed) for seed in dict.fromkeys(chosen)), episodes, max_steps, time_limit, fingerprint
    )
    report = Report()
    with quietly() as caught:
        for pattern in TOLD:
            warnings.filterwarnings("always", f".*{pattern}")
        _run_checks(subject, report)
    for warning in caught:
        message = str(warning.message)
        report.add(next(found for pattern, found in TOLD.items() if pattern in message), message[:300])
    if subject.late:
        report.add("out_of_time", seconds=time_limit)
    return report.finished(subject)


def _run_checks(subject: Subject, report: Report) -> None:
    for check in CHECKS:
        try:
            check(subject, report)
        except (Exception, SystemExit) as error:  # an unexpected exception of the model
            report.add_error(error, "while it was checked")
            return
        if not subject.playable:
            return


def _unmade(simulation: Any, error: Exception) -> CheckReport:
    name = getattr(simulation, "__name__", None) or type(simulation).__name__
    return CheckReport(str(name), (finding("unmade", error_in_words(error)),), ())
