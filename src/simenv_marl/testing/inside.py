"""All that the checks use of the library's internals. Other modules here use public names and this module."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

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
    "MASK", "VIEWS", "ActivePoint", "Plan", "SimulationExit", "active_points", "make_environment", "make_simulation",
    "outside_simulation", "plain_loop", "redefined", "watching_rules",
]  # fmt: skip


@dataclass(frozen=True)
class ActivePoint:
    """A decision point that an environment decides: its dotted name, its definition, and its agent (None: several)."""

    name: str
    definition: Definition
    agent: str | None

    @property
    def agents(self) -> str:
        """The agents that decide there, in words."""
        return self.agent if self.agent is not None else "agents named by each call"


def active_points(plan: Plan) -> list[ActivePoint]:
    """Return the decision points that environments of a plan decide."""
    return [ActivePoint(binding.point.name, binding.definition, binding.agent) for binding in plan.active]


def redefined(plan: Plan, change: Callable[[ActivePoint], Definition]) -> Plan:
    """Return the same plan with other definitions of its active points."""
    for binding, point in zip(plan.active, active_points(plan), strict=True):
        plan = plan.redefined(binding.point, change(point))
    return plan


def make_environment(plan: Plan, view: str) -> Any:
    """Make an environment of a plan.

    Raises:
        ViewError: The plan does not allow the view.
    """
    if view != "joint" and plan.options.flatten:
        plan = plan.amended({"flatten": False})
    return view_class(plan, view)(plan)


Reset = Callable[[Any, int], None]
Main = Callable[[Any], Any]


_PLAIN_RUNS: list[Any] = []
"""The simulations whose main loops run without an environment now."""


@contextmanager
def plain_loop(plan: Plan, *, watched: bool) -> Iterator[tuple[Reset, Main]]:
    """Set up the model as environments of a plan do: handlers, and generators of its own.

    Args:
        plan: The plan.
        watched: Whether calls of decision functions go to the rules that ``watching_rules`` has set.

    Yields:
        A function that resets a simulation with a seed, and one that runs its main loop.
    """
    rng = GlobalRandom() if plan.options.global_rng else None

    def reset(simulation: Any, seed: int) -> None:
        if rng is not None:
            rng.begin(seed)
        resetter(simulation)(seed, None)

    def main(simulation: Any) -> Any:
        if not watched:
            return simulation.run()
        _PLAIN_RUNS.append(simulation)
        try:
            return simulation.run()
        finally:
            _PLAIN_RUNS.pop()

    installation = Installation(plan.patches if watched else ())
    try:
        with environment_context(plan.plugins, rng):
            yield reset, main
    finally:
        installation.uninstall()


@contextmanager
def watching_rules(plan: Plan, begin: Callable[[str], Callable[[Any], None]]) -> Iterator[None]:
    """Watch the rules of a plan's decision points, in environments and in plain loops.

    Args:
        plan: The plan.
        begin: Called with the name of the point when its rule begins to decide. What it returns is called with the
            decision, unless the rule raises.
    """
    points = list(dict.fromkeys(point.point for point in plan.points))
    for point in points:
        point.hook.replace_rule(_watched(point, begin))
    try:
        yield
    finally:
        for point in points:
            point.hook.replace_rule()


def _decides(point: DecisionPoint) -> bool:
    """Return whether this runs in a main loop. In a reset or a mapping, rules do not count as decisions."""
    stack = stack_of(getcurrent())
    return bool(_PLAIN_RUNS) if stack is None else stack.decides(point.hook)


def _watched(point: DecisionPoint, begin: Callable[[str], Callable[[Any], None]]) -> Any:
    """Return a watched rule of a point; it stays a function, a generator function or a coroutine function."""
    rule: Any = point.rule

    def function(*args: Any, **kwargs: Any) -> Any:
        if not _decides(point):
            return rule(*args, **kwargs)
        end = begin(point.name)
        value = rule(*args, **kwargs)
        end(value)
        return value

    def generator(*args: Any, **kwargs: Any) -> Any:
        if not _decides(point):
            return (yield from rule(*args, **kwargs))
        end = begin(point.name)
        value = yield from rule(*args, **kwargs)
        end(value)
        return value

    async def coroutine(*args: Any, **kwargs: Any) -> Any:
        if not _decides(point):
            return await rule(*args, **kwargs)
        end = begin(point.name)
        value = await rule(*args, **kwargs)
        end(value)
        return value

    return {"function": function, "generator": generator, "coroutine": coroutine}[point.hook.kind]
