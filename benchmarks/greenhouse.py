"""The speed of the example's greenhouse with and without an environment, with the same mappings and days."""

from __future__ import annotations

from typing import Any

import numpy as np
from examples.greenhouse_coop.env import (
    DAYS,
    GreenhouseSim,
    exchange_air,
    observe,
    raw_env,
    reward,
    to_litres,
    watering_env,
)
from examples.greenhouse_coop.model import Greenhouse

from benchmarks.measure import Contender, Section, now, ratio, side_by_side

WATER = np.array([0.065], np.float32)
"""An action that keeps the plants alive for the whole episode, so that all days cost the same."""

AIR = np.array([0.2], np.float32)


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, of one episode each."""
    times = side_by_side(
        {
            "watering, plain loop": plain_days(PlainWatering),
            "watering, single environment": single_days(),
            "both, plain loop": plain_days(PlainCoop),
            "both, AEC environment": aec_days(),
        },
        rounds,
    )
    section = Section("Greenhouse of 200 plants", "microseconds per day")
    section.ratio(
        "greenhouse: days/s through the single environment / plain loop with the same mappings",
        ratio(times, "watering, plain loop", "watering, single environment"),
        bar=0.95,
        aim=0.98,
        digits=3,
        at_least=True,
    )
    section.ratio(
        "the same with two agents, two decisions a day, in the AEC environment",
        ratio(times, "both, plain loop", "both, AEC environment"),
        digits=3,
    )
    section.times(times)
    return section


class PlainWatering(Greenhouse):
    """A greenhouse that evaluates the waterer's mappings where an environment would, and takes a constant action."""

    def choose_water_amount(self) -> float:
        reward(self)
        observe(self)
        return to_litres(WATER)


class PlainCoop(PlainWatering):
    """The same for both agents."""

    def update_air_exchange(self) -> None:
        reward(self)
        observe(self)
        exchange_air(AIR, self)


class PlainSimulation(GreenhouseSim):
    """The simulation's own loop over such a greenhouse."""

    def __init__(self, model: type[Greenhouse]) -> None:
        super().__init__()
        self.model = model

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self.greenhouse = self.model(seed)


def plain_days(model: type[Greenhouse]) -> Contender:
    """Make a contender that runs an episode without an environment: microseconds per day."""
    simulation = PlainSimulation(model)

    def run() -> float:
        simulation.reset(1)
        start = now()
        simulation.run()
        return (now() - start) / DAYS * 1e6

    return run


def single_days() -> Contender:
    """Make a contender that runs the same episode through the waterer's single environment."""
    env: Any = watering_env()

    def run() -> float:
        env.reset(seed=1)
        step = env.step
        start = now()
        truncated = False
        while not truncated:
            truncated = step(WATER)[3]
        return (now() - start) / DAYS * 1e6

    return run


def aec_days() -> Contender:
    """Make a contender that runs the same episode through the AEC environment of both agents."""
    env: Any = raw_env()
    actions = {"waterer_0": WATER, "ventilator_0": AIR}

    def run() -> float:
        env.reset(seed=1)
        last, step = env.last, env.step
        start = now()
        for agent in env.agent_iter():
            _, _, terminated, truncated, _ = last()
            step(None if terminated or truncated else actions[agent])
        elapsed = now() - start
        assert env.simulation.greenhouse.day == DAYS
        return elapsed / DAYS * 1e6

    return run
