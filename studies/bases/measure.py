"""Compare two bases of planners on the same seeds: the others' rules, or their latest choices.

``python -m studies.bases.measure`` runs the comparison, and prints a table. Everything but the base
of the planners is the same.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from examples.greenhouse_coop.env import VENTILATOR, WATERER, GreenhouseSim

from simenv_marl import RULE, evaluate, simulate

from ..report import markdown
from .model import MOST, PLACES, Queues
from .planner import Planner


def planner(begin: Any, follows: bool, **options: Any) -> Planner:
    """Return a planner that tries policies near its incumbent, held to the horizon.

    Args:
        begin: The policy near which it begins. Its ``near`` returns others.
        follows: Whether its latest choice decides in the branches of others. Else the rule does.
        options: Options of the planner.
    """

    def propose(observation: Any, *, _incumbent: Any) -> list[Any]:
        found = _incumbent if isinstance(_incumbent, type(begin)) else begin
        return [found, *found.near()]

    def base(observation: Any) -> Any:
        return RULE if made.latest is RULE else made.latest(observation)

    made = Planner(propose, base=base if follows else RULE, hold=None, **options)
    return made


@dataclass(frozen=True)
class Limit:
    """A porter that admits jobs as long as fewer than a number are at its queue."""

    place: int
    most: int

    def __call__(self, observation: Any) -> int:
        """Decide whether a job is admitted."""
        return int(observation[self.place] < self.most)

    def near(self) -> list[Limit]:
        """Return porters with other limits."""
        limits = {max(1, self.most + change) for change in (-3, -1, 1, 3)} - {self.most}
        return [Limit(self.place, most) for most in sorted(limits)]


@dataclass(frozen=True)
class Target:
    """A policy of the greenhouse: linear in how much an observed value lacks to a target."""

    place: int
    target: float
    slope: float

    def __call__(self, observation: Any) -> list[float]:
        """Return a share of the most water, or of the air."""
        lack = self.target - float(observation[self.place])
        return [min(1.0, max(0.0, self.slope * lack))]

    def near(self) -> list[Target]:
        """Return policies with another target or slope."""
        targets = [
            Target(self.place, self.target + d, self.slope) for d in (-0.1, -0.03, 0.03, 0.1)
        ]
        return [*targets, *(Target(self.place, self.target, self.slope * f) for f in (0.5, 2.0))]


class Case(NamedTuple):
    """A model: the first policies of its planners, their options, and the worth of an episode."""

    first: dict[str, Any]
    options: dict[str, Any]
    worth: Callable[[dict[str, Any], int], float]


def worth_of_queues(planners: dict[str, Any], seed: int) -> float:
    """Return the costs of the queues, negative."""
    return -float(simulate(Queues, planners, points=Queues.admit, seed=seed).costs_now())


def worth_of_greenhouse(planners: dict[str, Any], seed: int) -> float:
    """Return the return that both agents of the greenhouse share."""
    frame = evaluate(GreenhouseSim, {"planners": planners}, seeds=[seed]).frame
    return float(frame.set_index("agent")["return"][VENTILATOR])


CASES: Final = {
    "three queues": Case(
        {f"porter {place}": Limit(place, MOST) for place in range(PLACES)},
        {
            "horizon": 40,
            "horizon_by": "time",
            "every": 10,
            "metric": lambda queues: -queues.costs_now(),
        },
        worth_of_queues,
    ),
    "greenhouse": Case(
        {WATERER: Target(4, 0.5, 0.2), VENTILATOR: Target(1, 0.7, -1.0)},
        {"horizon": 20, "every": 10},
        worth_of_greenhouse,
    ),
}


def main(arguments: Sequence[str] | None = None) -> list[list[str]]:
    """Compare the bases in both models, and print the table."""
    parser = argparse.ArgumentParser(description="Compare the bases of planners.")
    parser.add_argument("--seeds", type=int, default=20, help="(default: %(default)s)")
    parser.add_argument("--futures", type=int, default=4, help="(default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="one seed, one future")
    options = parser.parse_args(arguments)
    if options.quick:
        options.seeds, options.futures = 1, 1
    table = []
    for name, case in CASES.items():
        worths: dict[str, list[float]] = {"rule": [], "their rules": [], "latest choices": []}
        for seed in range(options.seeds):
            worths["rule"].append(case.worth({}, seed))
            for base in ("their rules", "latest choices"):
                follows = base == "latest choices"
                planners = {
                    agent: planner(begin, follows, futures=options.futures, **case.options)
                    for agent, begin in case.first.items()
                }
                worths[base].append(case.worth(planners, seed))
        found = {base: np.array(values) for base, values in worths.items()}
        gains = found["latest choices"] - found["their rules"]
        error = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else np.nan
        means = [f"{values.mean():.2f}" for values in found.values()]
        table.append([name, *means, f"{gains.mean():.2f}", f"{error:.2f}"])
        print(table[-1], flush=True)
    print(markdown(["model", "rule", *list(worths)[1:], "difference", "error"], table))
    return table


if __name__ == "__main__":
    main()
