"""Compare the farms' rule with two simple policies, on the same seeds.

By their rule, farms sow much while the price of wheat is high. All farms do so at once, and four
weeks later the price is low: prices oscillate, and the farms that sowed most give up. If farms
always sow the same amount, prices oscillate less; if they sow by the stock of the granary, hardly
at all.

``python -m examples.jvm_market.compare --seeds 20`` prints the total earnings of farms and shops,
and other metrics.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from simenv_marl import evaluate
from simenv_marl.experiments import Evaluation
from simenv_marl.remote import ProcessSimulation

from .env import PLOTS, SOW, WEEKS, market


def steadily(farm: Any) -> int:
    """Always sow the same amount."""
    return 10


def by_the_granary(farm: Any) -> int:
    """Sow less, the more wheat is in the granary."""
    return int(np.clip(26 - farm[3] / 20, 0, PLOTS))


CONTENDERS: Final[Mapping[str, Mapping[str, Any]]] = {
    "rule": {},
    "steadily": {SOW: steadily},
    "by the granary": {SOW: by_the_granary},
}
"""The farms' policies by name; shops follow their rule."""

METRICS: Final[Mapping[str, Callable[[ProcessSimulation], float]]] = {
    "loaves": lambda simulation: simulation.result["fed"],
    "gave up": lambda simulation: simulation.result["closed"],
    "swing": lambda simulation: float(
        np.std([wheat for _, _, wheat, _ in simulation.result["trace"]])
    ),
}
"""The metrics: loaves sold, farms and shops that gave up, the deviation of the wheat price."""


def compare(seeds: Sequence[int], weeks: int = WEEKS) -> Evaluation:
    """Compare all contenders on the same seeds.

    Args:
        seeds: The seeds of the episodes.
        weeks: The number of weeks after which an episode is truncated.
    """
    return evaluate(market(weeks), CONTENDERS, seeds=seeds, baseline="rule", metric=METRICS)


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare the policies, and print the results."""
    parser = argparse.ArgumentParser(
        description="Compare the farms' rule with two simple policies."
    )
    parser.add_argument("--seeds", type=int, default=20, help="number of seeds (default: 20)")
    found = compare(range(parser.parse_args(arguments).seeds))
    print("total earnings of farms and shops:", found.summary().round(1).to_string(), sep="\n")
    print(
        "means:",
        *(f"{metric}: {found.values(metric).mean().round(2).to_dict()}" for metric in METRICS),
        sep="\n",
    )


if __name__ == "__main__":
    main()
