"""Check and inspection of a simulation: the two functions of this package."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, Final, Unpack

import numpy as np

from ..core.options import CheckOptions
from ..core.points import Points
from ..errors import OptionValueError, SimEnvError, short_repr
from ..simulation import TRUNCATED
from .checks import CHECKS, Report, Subject
from .internals import Plan, fitting_views, make_environment
from .report import SEVERITIES, CheckReport, Inspection, PointDescription, finding, order_of
from .runs import Run, Runner, TimeUp, describe_with_place, play_rules, quietly, seed_global_generators, within

_WARNINGS: Final = {
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
    chosen = tuple(dict.fromkeys(seeds))
    if not chosen or any(isinstance(s, bool) or not isinstance(s, (int, np.integer)) or s < 0 for s in chosen):
        raise OptionValueError(f"seeds must be non-negative integers, at least one, not {short_repr(seeds)}")
    for name, number in (("episodes", episodes), ("max_steps", max_steps)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise OptionValueError(f"{name} must be a positive integer, not {short_repr(number)}")
    if not time_limit > 0:
        raise OptionValueError(f"time_limit must be a positive number of seconds, not {short_repr(time_limit)}")
    report = Report()
    with quietly() as caught:
        try:
            plan = Plan.draw_up(simulation, points, options)
            make_environment(plan, "aec")
        except SimEnvError:
            raise
        except Exception as error:  # of the model's constructor
            name = getattr(simulation, "__name__", None) or type(simulation).__name__
            return CheckReport(str(name), (finding("unmade", describe_with_place(error)),), ())
        for pattern in _WARNINGS:
            warnings.filterwarnings("always", f".*{pattern}")
        subject = Subject(
            plan=plan,
            max_steps=max_steps,
            seconds=time_limit / 4,
            own=fingerprint,
            seeds=tuple(map(int, chosen)),
            episodes=episodes,
            end=time.monotonic() + time_limit,
        )
        _run_checks(subject, report)
    for warning in caught:
        message = str(warning.message)
        report.add(next(name for pattern, name in _WARNINGS.items() if pattern in message), message[:300])
    if subject.late:
        report.add("out_of_time", seconds=time_limit)
    plain = subject.plain.get(subject.seeds[0])
    return CheckReport(
        simulation=plan.name,
        findings=tuple(sorted(dict.fromkeys(report.findings), key=lambda f: SEVERITIES.index(f.severity))),
        checked=tuple(report.checked),
        observations=report.observations,
        episodes=report.episodes,
        calls=order_of(plain.calls) if plain else "",
        timing=report.timing,
    )


def _run_checks(subject: Subject, report: Report) -> None:
    for check in CHECKS:
        try:
            check(subject, report)
        except (Exception, SystemExit) as error:  # an unexpected exception of the model
            report.add_error(error, "while it was checked")
            return
        if not subject.playable:
            return


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

    Args:
        simulation: A simulation (which is copied), its class, or a zero-argument factory.
        points: The decision points, as ``generate_env`` takes them.
        seed: The seed of the episode.
        max_steps: The number of decisions after which the episode is cut.
        time_limit: The time after which the episode is cut, in seconds.
        **options: The options of the environments, as ``aec_env`` takes them.

    Returns:
        The inspection; ``print`` it.

    Raises:
        SimEnvError: The simulation, the points or the options cannot be used at all. The subclass tells why.
        Exception: Any exception of the model's constructor.
    """
    with quietly():
        plan = Plan.draw_up(simulation, points, options)
        seed_global_generators(seed)
        run = Runner(plan=plan, max_steps=max_steps, seconds=time_limit, own=lambda simulation: None).run_plainly(seed)
        agents: dict[str, None] = dict.fromkeys(plan.roster)
        if run.entries and not plan.complete and run.error is None:
            env = make_environment(plan.amended({"max_steps": max_steps}), "aec")
            seed_global_generators(seed)
            with suppress(Exception, SystemExit):  # report the agents that were seen until then
                within(time_limit, lambda: play_rules(env, seed, agents))
            env.close()
        views = fitting_views(plan)
    return Inspection(
        simulation=plan.name,
        points=tuple(_describe_point(bound) for bound in plan.active),
        views=views,
        calls=order_of(run.calls),
        counts=dict(Counter(run.calls)),
        ended=_describe_end(run),
        agents=tuple(agents),
    )


def _describe_point(bound: Any) -> PointDescription:
    definition = bound.definition
    details = {
        "a mask says which actions are legal": definition.action_mask_mapping is not None,
        "the legal answers come with each call": definition.choices is not None,
        "actions are carried out in place of the rule": definition.apply is not None,
        f"agents end by {', '.join(definition.removed_by)}": definition.removed_by,
        f"has goals in {definition.goal_space}": definition.goal_space is not None,
    }
    return PointDescription(
        name=bound.point.name,
        agents=bound.agent or "agents named by each call",
        observation_space=str(definition.observation_space),
        action_space=str(definition.action_space),
        details=tuple(text for text, applies in details.items() if applies),
    )


def _describe_end(run: Run) -> str:
    number = f"{len(run.entries)} decisions"
    if run.cut:
        return f"cut after {number}"
    if isinstance(run.error, TimeUp):
        return f"stopped by the time limit after {number}"
    if run.error is not None:
        return f"{number}, then {describe_with_place(run.error)}"
    how = "truncated (a limit of time)" if run.result is TRUNCATED else "terminated (an end of the task)"
    return f"{number}, then {how}"
