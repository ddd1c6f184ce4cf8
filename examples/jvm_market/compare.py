"""Other farmers for the market town: the model's rule beside two simple policies, on the same seeds.

By their rule, farms sow much while wheat is dear. So do all others, and four weeks later it is worth little: prices
swing, and those that have sown most give up. With farms that always sow the same, prices swing less; with farms that
look into the granary, hardly.

``python -m examples.jvm_market.compare --seeds 20`` prints what all farms and shops earned, and what else came of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from simenv_marl import Evaluation, ProcessSimulation, evaluate

from .env import PLOTS, SOW, WEEKS, market


def steadily(farm: Any) -> int:
    """Sow the same, whatever there is to see."""
    return 10


def by_the_granary(farm: Any) -> int:
    """Sow the less the more there is in the granary."""
    return int(np.clip(26 - farm[3] / 20, 0, PLOTS))


CONTENDERS: Final[Mapping[str, Mapping[str, Any]]] = {
    "rule": {},
    "steadily": {SOW: steadily},
    "by the granary": {SOW: by_the_granary},
}
"""By name, policies of farms; shops follow their rule."""

METRICS: Final[Mapping[str, Callable[[ProcessSimulation], float]]] = {
    "loaves": lambda simulation: simulation.result["fed"],
    "gave up": lambda simulation: simulation.result["closed"],
    "swing": lambda simulation: float(np.std([wheat for _, _, wheat, _ in simulation.result["trace"]])),
}
"""Loaves sold, farms and shops that gave up, and the standard deviation of the price of wheat."""


def compare(seeds: Sequence[int], weeks: int = WEEKS) -> Evaluation:
    """Let all contenders meet the same seeds.

    Args:
        seeds: Of the episodes.
        weeks: After how many each is truncated.
    """
    return evaluate(market(weeks), CONTENDERS, seeds=seeds, baseline="rule", metric=METRICS)


def main() -> None:
    """Compare, and print what came out."""
    parser = argparse.ArgumentParser(description="Other farmers for the market town")
    parser.add_argument("--seeds", type=int, default=20, help="how many")
    found = compare(range(parser.parse_args().seeds))
    print("what all farms and shops earned:", found.summary().round(1).to_string(), sep="\n")
    print("means:", *(f"{metric}: {found.values(metric).mean().round(2).to_dict()}" for metric in METRICS), sep="\n")


if __name__ == "__main__":
    main()
