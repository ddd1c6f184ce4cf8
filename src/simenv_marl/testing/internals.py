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
from ..decision import DecisionPoint, Definition
from ..envs.make import VIEWS, view_class
from ..hooks.patches import Installation
from ..hooks.stacks import outside_simulation, stack_of
from ..simulation import make_simulation, resetter

__all__ = [
    "MASK", "Plan", "SimulationExit", "fitting_views", "make_environment", "make_simulation", "outside_simulation",
    "redefined", "set_up", "watching_rules",
]  # fmt: skip

Begin = Callable[[str], Callable[[Any], None]]
"""Called with the name of a decision point when its rule begins to decide. It returns a callable of the decision, which
is called unless the rule raises."""

_PLAIN_RUNS: Final[list[Any]] = []
"""The simulations whose main loops run without an environment now."""


def redefined(plan: Plan, change: Callable[[Any], Definition]) -> Plan:
    """Return a plan with changed definitions of its active points, of which each is passed to ``change``."""
    for bound in plan.active:
        plan = plan.redefined(bound.point, change(bound))
    return plan


def make_environment(plan: Plan, view: str) -> Any:
    """Make an environment of a plan.

    Raises:
        ViewError: The plan does not allow the view.
    """
    if view != "joint" and plan.options.flatten:
        plan = plan.amended({"flatten": False})
    return view_class(plan, view)(plan)


def fitting_views(plan: Plan) -> tuple[str, ...]:
    """Return the views that a plan allows."""
    found = []
    for view in VIEWS:
        with suppress(Exception):  # of the plan, or of the model if the view resets it
            make_environment(plan, view).close()
            found.append(view)
    return tuple(found)


@contextmanager
def set_up(plan: Plan, seed: int) -> Iterator[tuple[Any, Callable[[], Any]]]:
    """Make a simulation for a run without an environment, with the handlers and random generators of a plan.

    Yields:
        The simulation, and a function that resets it and runs its main loop.
    """
    rng = GlobalRandom() if plan.options.global_rng else None
    held = Installation(plan.patches)

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
        held.uninstall()


@contextmanager
def watching_rules(plan: Plan, begin: Begin) -> Iterator[None]:
    """Watch the rules of a plan's decision points, in environments and in plain runs."""
    points = list(dict.fromkeys(bound.point for bound in plan.points))
    for point in points:
        point.hook.replace_rule(_watched(point, begin))
    try:
        yield
    finally:
        for point in points:
            point.hook.replace_rule()


def _watched(point: DecisionPoint, begin: Begin) -> Callable[..., Any]:
    """Return a rule that reports each of its decisions. A generator or coroutine reports the value it ends with."""
    rule: Any = point.rule

    def watched(*args: Any, **kwargs: Any) -> Any:
        stack = stack_of(getcurrent())
        # In a reset or a mapping, rules do not count as decisions.
        if not (_PLAIN_RUNS if stack is None else stack.decides(point.hook)):
            return rule(*args, **kwargs)
        end = begin(point.name)
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
