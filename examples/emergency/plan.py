"""Plan one kind of decision of the department over its rule: whom the doctors call next.

``python -m examples.emergency.plan`` compares doctors that plan with doctors that follow the rule,
on the same seeds, by ``simulate`` and by ``evaluate``. It prints what the planners save, with the
standard error. A day takes about ten seconds of a core.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np

from simenv_marl import evaluate, simulate
from simenv_marl.planning import RolloutPolicy

from .env import EmergencySimulation, cost
from .model import Doctor


def make_planners(futures: int = 8, horizon: float = 120.0) -> dict[Any, RolloutPolicy]:
    """Make the policies: both doctors plan, and all others follow their rules.

    Args:
        futures: The number of futures in which each patient is tried as the next one.
        horizon: The time for which a future is simulated, in minutes.
    """
    planner = RolloutPolicy(futures=futures, horizon=horizon, horizon_by="time", method="replay")
    return {Doctor.call_next: planner}


def gains(seeds: Sequence[int], **options: Any) -> list[float]:
    """Return what the planners save on each seed, by the costs of two runs of the model."""
    return [
        cost(simulate(EmergencySimulation, seed=seed))
        - cost(simulate(EmergencySimulation, make_planners(**options), seed=seed, skip_forced=True))
        for seed in seeds
    ]


def compare(seeds: Sequence[int], workers: int = 0, **options: Any) -> Any:
    """Compare planners and rule by ``evaluate``, in workers."""
    return evaluate(
        EmergencySimulation,
        {"rule": {}, "doctors plan": make_planners(**options)},
        seeds=seeds,
        metric={"cost": cost},
        baseline="rule",
        skip_forced=True,
        workers=workers,
    )


def report(name: str, saved: Sequence[float]) -> None:
    """Print what the planners save in a day, in the mean, with its standard error."""
    error = np.std(saved, ddof=1) / len(saved) ** 0.5
    print(f"{name}, {len(saved)} days: {np.mean(saved):.0f} saved, standard error {error:.0f}")


def main(arguments: Sequence[str] | None = None) -> Any:
    """Compare on seeds, and print the costs. Returns the evaluation."""
    parser = argparse.ArgumentParser(description="Plan whom the doctors call next.")
    parser.add_argument("--seeds", type=int, default=24, help="days (default: %(default)s)")
    parser.add_argument("--first", type=int, default=8, help="by simulate (default: %(default)s)")
    parser.add_argument("--futures", type=int, default=8, help="(default: %(default)s)")
    parser.add_argument("--horizon", type=float, default=120.0, help="(default: %(default)s)")
    parser.add_argument("--workers", type=int, default=0, help="processes (default: none)")
    chosen = parser.parse_args(arguments)
    options = {"futures": chosen.futures, "horizon": chosen.horizon}
    report("by simulate", gains(range(chosen.first), **options))
    found = compare(range(chosen.seeds), chosen.workers, **options)
    costs = found.values(metric="cost")
    report("by evaluate", costs["rule"] - costs["doctors plan"])
    columns = ["mean", "difference", "difference_low", "difference_high"]
    print(found.summary(metric="cost")[columns].round(0).to_string())
    return found


if __name__ == "__main__":
    main()
