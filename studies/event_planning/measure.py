"""Compare a planner with the rule on the same seeds: is it worse?

``python -m studies.event_planning.measure`` runs the comparison. It prints a table: the mean paired
difference of costs, its standard error, and the share of decisions left to the rule.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simenv_marl import RULE, simulate
from simenv_marl.planning import RolloutPolicy

from .model import MODELS


class Noted(RolloutPolicy):
    """A planner that counts its decisions, and those that it leaves to the rule."""

    decisions = rule = 0

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        """Decide."""
        action = super().__call__(observation, info, _environment=_environment)
        self.decisions += 1
        self.rule += action is RULE
        return action


@dataclass
class Row:
    """A row of the table.

    Attributes:
        setting: The model, the number of futures, and the horizon.
        gain: The mean paired difference of the costs: the rule's less the planner's.
        error: Its standard error.
        share: The share of decisions that the planner left to the rule.
    """

    setting: tuple[str, int, str]
    gain: float
    error: float
    share: float

    def __str__(self) -> str:
        model, futures, unit = self.setting
        return (
            f"| {model} | {futures} | {unit} | {self.gain:.2f} | {self.error:.2f} |"
            f" {self.share:.0%} |"
        )


def costs(model: Any, policies: Any, point: Any, seed: int) -> float:
    """Return the costs of an episode."""
    return float(simulate(model, policies, points=point, seed=seed).costs)


def compare(
    name: str, futures: int, unit: str, seeds: Sequence[int], horizon: int = 8, margin: float = 1.0
) -> Row:
    """Compare a planner with the rule."""
    model, point = MODELS[name]
    planner = Noted(
        futures=futures, horizon=horizon, horizon_by=unit, margin=margin, method="replay"
    )
    gains = [
        costs(model, {}, point, seed) - costs(model, {point: planner}, point, seed)
        for seed in seeds
    ]
    error = float(np.std(gains, ddof=1) / np.sqrt(len(gains)))
    return Row(
        (name, futures, unit),
        float(np.mean(gains)),
        error,
        planner.rule / max(1, planner.decisions),
    )


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    """Compare in all settings, and print the table."""
    parser = argparse.ArgumentParser(
        description="Compare planners with the rule, in models driven by events."
    )
    parser.add_argument(
        "--seeds", type=int, default=16, help="episodes of each setting (default: %(default)s)"
    )
    parser.add_argument("--futures", type=int, nargs="+", default=[8, 32], help="(default: 8 32)")
    parser.add_argument(
        "--horizon", type=int, default=8, help="decisions, or units of time (default: %(default)s)"
    )
    parser.add_argument(
        "--margin", type=float, default=1.0, help="standard errors (default: %(default)s)"
    )
    parser.add_argument(
        "--models", nargs="+", default=list(MODELS), help="names of models (default: all)"
    )
    parser.add_argument("--quick", action="store_true", help="two episodes, 4 futures")
    options = parser.parse_args(arguments)
    if options.quick:
        options.seeds, options.futures = 2, [4]
    # it is what is measured
    warnings.filterwarnings("ignore", ".*a horizon in decisions|.*a generator for itself")
    print("| model | futures | horizon by | gain | standard error | left to the rule |")
    print("| --- | --- | --- | --- | --- | --- |")
    rows = []
    for name in options.models:
        for futures in options.futures:
            for unit in ("decision", "time"):
                rows.append(
                    compare(
                        name, futures, unit, range(options.seeds), options.horizon, options.margin
                    )
                )
                print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    main()
