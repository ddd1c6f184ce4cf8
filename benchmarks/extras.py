"""The cost of a decision with a clock, with an uncalled plugin, and beside other objects.

Each figure comes from a process of its own: a ``difference`` stays once it is made, and the
features of one environment may slow down its neighbours. The processes take turns.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from benchmarks.measure import Contender, Group, Row, alone
from benchmarks.noop import DEFINITION, Alone, Model, Turns, aec
from simenv_marl import aec_env, difference, make_step, single_env

NEIGHBOURS = 1_000
"""The number of other environments or decision points."""

REPEATS = 5


class ClockTurns(Turns):
    """Two agents, whose simulation has a clock."""

    def time(self) -> float:
        return 1.0


class IdleTurns(Turns):
    """Two agents, whose simulation has a method that it does not call."""

    def idle(self) -> None:
        """Do nothing."""


def nothing(model: Model) -> None:
    """Handle nothing."""


def other_environment(step: Any = Model.left) -> Any:
    """Make an environment in mid-episode."""
    env = single_env(Alone, step)
    env.reset(seed=0)
    return env


def other_point(number: int) -> Any:
    """Make a decision point."""

    def decide(model: Any) -> int:
        return 0

    decide.__qualname__ = decide.__name__ = f"decide_{number}"
    return make_step(**DEFINITION)(decide)


POINTS = [Model.left, Model.right]
OURS = partial(aec_env, Turns, POINTS)
EXTRAS: dict[str, Callable[[], tuple[Any, Any]]] = {
    "without": lambda: (OURS(), None),
    "a clock": lambda: (aec_env(ClockTurns, POINTS), None),
    "an idle plugin": lambda: (
        aec_env(IdleTurns, POINTS, plugins=[(nothing, f"{__name__}.IdleTurns.idle", "before")]),
        None,
    ),
    "a difference elsewhere": lambda: (
        OURS(),
        other_environment(
            {
                Model.left: make_step(
                    **DEFINITION | {"reward_mapping": difference(lambda model: 1.0)}
                )
            }
        ),
    ),
    f"{NEIGHBOURS:,} other environments": lambda: (
        OURS(),
        [other_environment() for _ in range(NEIGHBOURS)],
    ),
    f"{NEIGHBOURS:,} other decision points": lambda: (
        OURS(),
        [other_point(number) for number in range(NEIGHBOURS)],
    ),
}
"""Functions that make the environment to measure, and what stands beside it."""

LIMITS = {
    "a clock": (1.08, 1.04),
    "an idle plugin": (1.08, 1.04),
    "a difference elsewhere": (1.08, 1.04),
}


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with a number of decisions of each contender."""
    without, *others = ((extra, apart(extra, number)) for extra in EXTRAS)
    rows = [
        Row(f"AEC, {extra} / without", run, without[1], *LIMITS.get(extra, ()))
        for extra, run in others
    ]
    yield Group(rows, most=9)


def apart(extra: str, number: int) -> Contender:
    """Make a contender that measures an extra in a new process.

    For a smoke test, this one will do.
    """
    return (
        partial(measure, extra, number)
        if number < 1_000
        else partial(alone, "extras", extra, str(number))
    )


def measure(extra: str, number: int) -> float:
    """Measure the microseconds of a decision in this process, in the quickest of some repeats."""
    env, _beside = EXTRAS[extra]()
    run = aec(env, number)
    return min(run() for _ in range(REPEATS))


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], int(sys.argv[2]))))
