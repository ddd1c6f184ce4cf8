"""Inspection of a simulation: its decision points and their calls."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Unpack

from ..core.options import CheckOptions
from ..core.points import Points
from ..simulation import TRUNCATED
from .inside import VIEWS, ActivePoint, Plan, active_points, make_environment
from .report import Inspection, PointDescription, order_of
from .runs import Run, TimeUp, error_in_words, plain_run, play_rules, quietly, seed_global_generators, within


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
        run = plain_run(plan, seed, max_steps, time.monotonic() + time_limit, lambda simulation: None)
        agents: dict[str, None] = dict.fromkeys(plan.roster)
        if run.decisions and not plan.complete and run.error is None:
            agents |= _agents_of(plan, seed, max_steps, time.monotonic() + time_limit)
        views = tuple(_fitting_views(plan))
    return Inspection(
        simulation=plan.name,
        points=tuple(_described(point) for point in active_points(plan)),
        views=views,
        calls=order_of(run.calls),
        counts=dict(Counter(run.calls)),
        ended=_ending(run),
        agents=tuple(agents),
    )


def _agents_of(plan: Plan, seed: int, max_steps: int, deadline: float) -> dict[str, None]:
    """Return the agents of an episode with ``RULE`` throughout, in the order in which they joined."""
    named: dict[str, None] = {}
    env = make_environment(plan.amended({"max_steps": max_steps}), "aec")

    def play() -> None:
        env.reset(seed=seed)
        play_rules(env, named)

    seed_global_generators(seed)
    with suppress(Exception, SystemExit):  # report the agents that were seen until then
        within(deadline, play)
    env.close()
    return named


def _described(point: ActivePoint) -> PointDescription:
    """Describe a decision point."""
    definition = point.definition
    details = []
    if definition.action_mask_mapping is not None:
        details.append("a mask says which actions are legal")
    if definition.choices is not None:
        details.append("the legal answers come with each call")
    if definition.apply is not None:
        details.append("actions are carried out in place of the rule")
    if definition.removed_by:
        details.append(f"agents end by {', '.join(definition.removed_by)}")
    if definition.goal_space is not None:
        details.append(f"has goals in {definition.goal_space}")
    return PointDescription(
        name=point.name,
        agents=point.agents,
        observation_space=str(definition.observation_space),
        action_space=str(definition.action_space),
        details=tuple(details),
    )


def _ending(run: Run) -> str:
    """Describe how a plain run ended."""
    number = f"{len(run.decisions)} decisions"
    if run.cut:
        return f"cut after {number}"
    if isinstance(run.error, TimeUp):
        return f"stopped by the time limit after {number}"
    if run.error is not None:
        return f"{number}, then {error_in_words(run.error)}"
    how = "truncated (a limit of time)" if run.result is TRUNCATED else "terminated (an end of the task)"
    return f"{number}, then {how}"


def _fitting_views(plan: Plan) -> Iterator[str]:
    """Yield the views that a plan allows."""
    for view in VIEWS:
        try:
            make_environment(plan, view).close()
        except Exception:  # of the plan, or of the model if the view resets it
            continue
        yield view
