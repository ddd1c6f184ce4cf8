"""A serial supply chain of stockpyl, planned by three stages beside the exact optimum.

``python -m studies.bounds.serial_supply`` runs ten episodes of 60 periods for each way to decide,
and keeps what is finished.
The chain is example 6.1 of Snyder and Shen, *Fundamentals of Supply Chain Theory*; its optimal
echelon base stocks are 6.48, 12.03 and 22.72, and cost 47.665 a period in the long run. The model
is ``examples/serial_supply``. All its random numbers are those of the demand, which branches draw
anew from the same law: the planners are informed.

Each stage has a planner. Its candidates are echelon base stocks near the incumbent, which hold to
the horizon. What stands for the other planners in its branches is the question beside it: their
rule, or what they have chosen last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
from examples.serial_supply.env import (
    MOST,
    OPTIMAL,
    OPTIMUM,
    OPTIONS,
    RULE_LEVELS,
    STAGES,
    SerialSupply,
)
from stockpyl.sim import simulation

from simenv_marl import RULE, TRUNCATED, simulate

from ..bases.planner import Planner
from .measured import cpu_seconds, draw, options_of, read, show, write

FACTORS: Final = (0.9, 1.1, 1.25)
"""The candidates, in units of the incumbent."""


class Chain(SerialSupply):
    """The chain of the example, with shorter episodes."""

    periods = 60

    def run(self) -> Any:
        """Run stockpyl's loop."""
        options = {"rand_seed": self._seed, "progress_bar": False, "consistency_checks": "N"}
        simulation(self.network, self.periods, **options)
        self.network.period += 1
        return TRUNCATED


@dataclass(frozen=True)
class Level:
    """A policy: orders up to an echelon base stock."""

    stage: int
    level: float

    def __call__(self, observation: Any, *, _simulation: Chain) -> list[float]:
        """Return the quantity."""
        return [float(np.clip(self.level - _simulation.position(self.stage), 0.0, MOST))]


def planner(stage: int, follow: bool, **options: Any) -> Planner:
    """Return the planner of a stage.

    Args:
        stage: The stage, from 0.
        follow: Whether the latest choice decides in the branches of others. Else the rule does.
        options: Options of the planner.
    """
    begin = Level(stage, sum(RULE_LEVELS[: stage + 1]))

    def propose(observation: Any, *, _incumbent: Any) -> list[Level]:
        found = _incumbent if isinstance(_incumbent, Level) else begin
        return [Level(stage, factor * found.level) for factor in FACTORS]

    def base(observation: Any, *, _simulation: Chain) -> Any:
        latest = made.latest
        return latest if latest is RULE else latest(observation, _simulation=_simulation)

    made = Planner(
        propose,
        base=base if follow else RULE,
        hold=None,
        horizon=15,
        horizon_by="time",
        every=15,
        metric=lambda chain: -chain.cost,
        **options,
    )
    return made


CONTENDERS: Final[dict[str, Callable[..., dict[str, Any]]]] = {
    "rule": lambda **options: {},
    "optimal base stocks": lambda **options: {
        name: Level(stage, OPTIMAL[stage]) for stage, name in enumerate(STAGES)
    },
    "plans, others by rule": lambda **options: {
        name: planner(stage, follow=False, **options) for stage, name in enumerate(STAGES)
    },
    "plans, others by choice": lambda **options: {
        name: planner(stage, follow=True, **options) for stage, name in enumerate(STAGES)
    },
}


def main(arguments: Sequence[str] | None = None) -> list[list[Any]]:
    """Measure the rule, the plans and the optimum, and write the table and the figure."""
    options = options_of("Plan a supply chain.", arguments, seeds=10, futures=4)
    if options.quick:
        options.seeds, options.futures, Chain.periods = 1, 1, 6
    path = options.out / "serial_supply.csv"
    rows = [] if options.quick else read(path, (0, 2, 3))
    for seed, (name, make) in product(range(options.seeds), CONTENDERS.items()):
        if [seed, name] not in [row[:2] for row in rows]:
            begin = cpu_seconds()
            chain = simulate(Chain, make(futures=options.futures), seed=seed, **OPTIONS)
            cost = chain.cost / Chain.periods
            rows.append([seed, name, round(cost, 4), round(cpu_seconds() - begin, 1)])
            write(path, ["seed", "policy", "cost", "seconds"], rows)
    rows = [row for row in rows if row[0] < options.seeds]
    costs = {
        name: np.array([cost for _, contender, cost, _ in rows if contender == name])
        for name in CONTENDERS
    }
    best = costs["optimal base stocks"]
    table = []
    for name, values in costs.items():
        spent = np.mean([seconds for _, contender, _, seconds in rows if contender == name])
        ratio = f"{values.sum() / best.sum():.3f}"
        table.append([name, f"{values.mean():.2f}", ratio, f"{spent:.1f}"])
    show(["policy", f"cost a period, {len(best)} seeds", "of the optimum", "CPU seconds"], table)
    bars = {name: float(values.mean()) for name, values in costs.items()}
    plans = [name for name in bars if name.startswith("plans")]
    label = f"cost of a period; {OPTIMUM} in the long run with optimal base stocks"
    draw(options.figures / "bounds-serial-supply.png", bars, plans, label)
    return table


if __name__ == "__main__":
    main()
