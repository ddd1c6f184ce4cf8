"""A presence-based policy: the colder the room is, the earlier it heats.

The model's own policy is a time switch. ``python -m examples.energyplus_zones.policy`` compares
both on the same days.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from math import atan2, pi
from typing import Any, Final

from numpy.typing import NDArray

from simenv_marl import evaluate
from simenv_marl.experiments import Evaluation

from .env import AGENTS, BuildingSim, to_action
from .model import COMFORT

WARM, COLD = COMFORT + 0.2, 15.0

BEGIN, LATEST = 8.5, 10.0
"""The hour at which the room should be warm, and the hour after which no people arrive."""

HOURS_PER_DEGREE: Final = 1.0
"""The time that the heater takes to warm the room by one degree, in hours."""


def by_presence(observation: NDArray[Any], info: dict[str, Any]) -> list[float]:
    """Heat while people are present, and in the morning in time for their arrival."""
    sine, cosine, _, temperature, _, people = observation.tolist()
    hour = atan2(sine, cosine) / pi * 12 % 24
    early = max(0.0, COMFORT - temperature) * HOURS_PER_DEGREE
    return to_action(WARM if people or BEGIN - early <= hour < LATEST else COLD)


def compare(seeds: range, workers: int = 0) -> Evaluation:
    """Compare the policy with the time switch on the same days."""
    contenders = {"time switch": {}, "by presence": dict.fromkeys(AGENTS, by_presence)}
    return evaluate(BuildingSim, contenders, seeds=seeds, baseline="time switch", workers=workers)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description="Compare two policies for thermostats.")
    parser.add_argument(
        "--seeds", type=int, default=20, help="number of days (default: %(default)s)"
    )
    print(compare(range(parser.parse_args(arguments).seeds)).summary().round(2).to_string())


if __name__ == "__main__":
    main()
