"""The cost of a decision with a clock, with a plugin that is not called, and beside other objects in the process.

Run it with ``make benchmark``, or alone with ``python -m benchmarks.core --only extras``. Each extra has a separate
process: a ``difference`` stays once it is made, and the features of one environment may slow down its neighbours.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from benchmarks.measure import Elsewhere, Section, Times, ratio, serve, side_by_side
from benchmarks.noop import DEFINITION, Alone, Model, Turns, aec, single
from simenv_marl import aec_env, difference, make_step, single_env
from simenv_marl.plugins import expose_to_plugins

GENERATIONS = 5
"""How often the processes are restarted, because two equal processes differ by some per cent."""

NEIGHBOURS = 1_000
"""The number of other environments or decision points."""


class TimedTurns(Turns):
    """Two agents, whose simulation has a clock."""

    def time(self) -> float:
        return 1.0


class TimedAlone(Alone):
    """One agent, whose simulation has a clock."""

    def time(self) -> float:
        return 1.0


@expose_to_plugins
def idle() -> None:
    """A function of the model that is not called during the measurement."""


def nothing() -> None:
    """Handle nothing."""


def plain() -> dict[str, Any]:
    return views()


def clock() -> dict[str, Any]:
    return views(TimedTurns, TimedAlone)


def plugin() -> dict[str, Any]:
    return views(plugins=[(nothing, idle, "before")])


def elsewhere() -> dict[str, Any]:
    """Views beside a ``difference`` of another environment, which is in mid-episode."""
    rewarded = make_step(**DEFINITION | {"reward_mapping": difference(lambda model: 1.0)})
    other = single_env(Alone, {Model.left: rewarded})
    other.reset(seed=0)
    return {**views(), "others": other}


def environments() -> dict[str, Any]:
    """Views beside very many other environments in mid-episode."""
    others = [single_env(Alone, Model.left) for _ in range(NEIGHBOURS)]
    for env in others:
        env.reset(seed=0)
    return {**views(), "others": others}


def points() -> dict[str, Any]:
    """Views beside very many other decision points."""
    return {**views(), "others": [other_point(number) for number in range(NEIGHBOURS)]}


def other_point(number: int) -> Any:
    def decide(model: Any) -> int:
        return 0

    decide.__qualname__ = decide.__name__ = f"decide_{number}"
    return make_step(**DEFINITION)(decide)


def views(turns: type = Turns, alone: type = Alone, **options: Any) -> dict[str, Any]:
    """Make an AEC and a single environment of the no-op simulation."""
    return {
        "AEC": aec_env(turns, [Model.left, Model.right], **options),
        "single": single_env(alone, Model.left, **options),
    }


EXTRAS: dict[str, Callable[[], dict[str, Any]]] = {
    "without": plain,
    "with a clock": clock,
    "with an idle plugin": plugin,
    "with a difference elsewhere": elsewhere,
    f"with {NEIGHBOURS:,} other environments": environments,
    f"with {NEIGHBOURS:,} other decision points": points,
}
HELD = ("AEC, with a clock", "AEC, with an idle plugin", "AEC, with a difference elsewhere")


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, with a number of decisions of each contender."""
    times: Times = {}
    generations = min(GENERATIONS, rounds)
    for _ in range(generations):
        processes = {extra: Elsewhere(__name__, extra, str(number)) for extra in EXTRAS}
        contenders = {
            f"{view}, {extra}": process.contender(view)
            for view in ("AEC", "single")
            for extra, process in processes.items()
        }
        for name, values in side_by_side(contenders, max(rounds // generations, 1)).items():
            times.setdefault(name, []).extend(values)
        for process in processes.values():
            process.close()
    section = Section("Additional features in use", "microseconds per decision")
    for name in times:
        view, _, extra = name.partition(", ")
        if extra != "without":
            limits = (1.08, 1.04) if name in HELD else ()
            section.ratio(f"{name} / without", ratio(times, name, f"{view}, without"), *limits)
    section.times(times)
    return section


def main(extra: str, number: int) -> None:
    """Measure one extra in this process, on request."""
    made = EXTRAS[extra]()
    serve({"AEC": aec(made["AEC"], number), "single": single(made["single"], number)})


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
