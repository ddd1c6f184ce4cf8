"""All that the checks use of the library's internals. Other modules here use public names and this module."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from greenlet import getcurrent

from ..core.actions import MASK
from ..core.context import environment_context
from ..core.driver import SimulationExit
from ..core.plan import Plan
from ..core.rng import GlobalRandom
from ..decision import DecisionPoint
from ..envs import VIEWS, view_class
from ..hooks.patches import Installation
from ..hooks.stacks import outside_simulation, stack_of
from ..simulation import make_simulation, resetter

__all__ = [
    "MASK", "Plan", "SimulationExit", "fitting_views", "make_environment", "make_simulation", "outside_simulation",
    "point_of", "set_up", "watching_rules",
]  # fmt: skip

_PLAIN_RUNS: Final[list[Any]] = []
"""The simulations whose main loops run without an environment now."""


def make_environment(plan: Plan, view: str, **options: Any) -> Any:
    """Make an environment of a plan with changed options."""
    if view != "joint" and plan.options.flatten:
        options["flatten"] = False
    plan = plan.amended(options)
    return view_class(plan, view)(plan)


def fitting_views(plan: Plan) -> tuple[str, ...]:
    """Return the views that a plan allows."""
    found = []
    for view in VIEWS:
        with suppress(Exception):  # of the plan, or of the model if the view resets it
            make_environment(plan, view).close()
            found.append(view)
    return tuple(found)


def point_of(env: Any, agent: str) -> Any:
    """Return the decision point at which an agent of an AEC environment decides."""
    return env._point(agent)


@contextmanager
def set_up(plan: Plan, seed: int) -> Iterator[tuple[Any, Callable[[], Any]]]:
    """Make a simulation for a run without an environment, with the handlers and random generators of a plan.

    Yields:
        The simulation, and a function that resets it and runs its main loop.
    """
    rng = GlobalRandom() if plan.options.global_rng else None
    installation = Installation(plan.patches)

    def start() -> Any:
        if rng is not None:
            rng.begin(seed)
        resetter(simulation)(seed, None)
        _PLAIN_RUNS.append(simulation)
        try:
            return simulation.run()
        finally:
            _PLAIN_RUNS.pop()

    try:
        with environment_context(plan.plugins, rng):
            simulation = make_simulation(plan.source)
            yield simulation, start
    finally:
        installation.uninstall()


@contextmanager
def watching_rules(plan: Plan, decided: Callable[[str], Callable[[Any], None]]) -> Iterator[None]:
    """Watch the rules of a plan's decision points, in environments and in plain runs.

    ``decided`` is called with the name of a point when its rule begins, and returns a callable of the rule's result.
    """
    points = list(dict.fromkeys(bound.point for bound in plan.points))
    for point in points:
        point.hook.replace_rule(_watched(point, decided))
    try:
        yield
    finally:
        for point in points:
            point.hook.replace_rule()


def _watched(point: DecisionPoint, decided: Callable[[str], Callable[[Any], None]]) -> Callable[..., Any]:
    """Return a rule that reports each of its decisions. A generator or coroutine reports the value it ends with."""
    rule: Any = point.rule

    def watched(*args: Any, **kwargs: Any) -> Any:
        stack = stack_of(getcurrent())
        # In a reset or a mapping, rules do not count as decisions.
        if not (_PLAIN_RUNS if stack is None else stack.decides(point.hook)):
            return rule(*args, **kwargs)
        end = decided(point.name)
        value = rule(*args, **kwargs)
        if point.hook.kind == "generator":
            return generator(value, end)
        if point.hook.kind == "coroutine":
            return coroutine(value, end)
        end(value)
        return value

    def generator(items: Any, end: Callable[[Any], None]) -> Any:
        value = yield from items
        end(value)
        return value

    async def coroutine(task: Any, end: Callable[[Any], None]) -> Any:
        value = await task
        end(value)
        return value

    return watched
