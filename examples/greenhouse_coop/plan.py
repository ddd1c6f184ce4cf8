"""Planning in the greenhouse, without training.

``python -m examples.greenhouse_coop.plan`` lets the waterer try out nine amounts of water each day,
in branches of a few days with newly drawn weather, before it pours the best one. One planner
continues its branches with the model's own rule, another with the best constant amount. The script
prints a table, and writes the results to a file; ``make plan`` draws a figure of them, too.

Branches run on all cores, so the greenhouses run one after another. The cost of a branch is mostly
the start of its process, which grows with the number of imported modules.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import RULE
from simenv_marl.data import collect_episodes
from simenv_marl.planning import RolloutPolicy

from .env import DAYS, MOST_WATER, OBSERVED, VENTILATOR, WATERER, GreenhouseSim
from .model import PLANTS, Greenhouse
from .train import HELD_OUT, OUT, Constant, tabulate

LITRES: Final = tuple(range(0, 161, 20))
"""The amounts that the waterer tries out each day, in litres."""

BEST: Final = {WATERER: Constant(0.084), VENTILATOR: Constant(1.0)}
"""The best constant pair that ``make demo`` finds: 84 litres, and a full exchange of the air."""


def days_left(env: Any) -> float:
    """Return an upper bound of the future reward: all living plants stay alive until the end."""
    greenhouse: Greenhouse = env.unwrapped.simulation.greenhouse
    return greenhouse.alive / len(greenhouse.pots) * (DAYS - greenhouse.day)


class CountingPlanner(RolloutPolicy):
    """A planner that reports the number of days that its branches have simulated.

    The number is the extra ``days`` of each action.
    """

    def __init__(self, actions: Sequence[float], horizon: int, **options: Any) -> None:
        """Make a planner.

        Args:
            actions: The candidate actions, as numbers.
            horizon: The number of days for which they are tried out.
            **options: The options of ``RolloutPolicy``.
        """
        super().__init__(
            [np.array([action], np.float32) for action in actions], horizon=horizon, **options
        )
        self.days = horizon

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        """Choose an action.

        In a branch of another planner, this tries nothing out and returns the action alone.
        """
        values = self.choose(_environment)
        if not values.counts.any():
            return values.best
        day = _environment.simulation.greenhouse.day
        return values.best, {"days": int(values.counts.sum()) * min(self.days, DAYS - day)}


def water_planner(
    base: Any = RULE,
    horizon: int = 3,
    futures: int = 2,
    rest: Callable[[Any], float] | None = days_left,
) -> CountingPlanner:
    """Make a waterer that plans.

    Args:
        base: The waterer in branches from the second day on: ``RULE`` or a policy.
        horizon: The number of days for which an amount is tried out.
        futures: The number of futures (draws of the weather) per amount, on average.
        rest: The terminal value, which stands for the time after the horizon.
    """
    litres = [amount / MOST_WATER for amount in LITRES]
    return CountingPlanner(litres, horizon, base=base, futures=futures, terminal_value=rest)


# -- running greenhouses --------------------------------------------------------------------------


@dataclass(frozen=True)
class Kept:
    """The results of greenhouses.

    Attributes:
        returns: ``(seeds,)``: the team's return, which is the ventilator's.
        alive: ``(seeds, days + 1)``: the plants alive at the beginning of each day and at the end.
        poured: ``(seeds, days)``: the litres poured.
        simulated: The mean number of days in branches per episode.
    """

    returns: NDArray[np.float64]
    alive: NDArray[np.float64]
    poured: NDArray[np.float64]
    simulated: float


def keep(policies: Mapping[str, Any], seeds: Sequence[int], *, progress: bool = False) -> Kept:
    """Run greenhouses with policies.

    Args:
        policies: Policies by agent; agents without one follow their rule.
        seeds: The seeds of the greenhouses.
        progress: Whether to show a progress bar.
    """
    team = {WATERER: RULE, VENTILATOR: RULE} | dict(policies)
    found = collect_episodes(GreenhouseSim, team, seeds=seeds, batch_size=1, progress=progress)
    air, water = found[VENTILATOR], found[WATERER]
    share = OBSERVED.index("share of the plants that are alive")
    alive, poured = np.zeros((len(seeds), DAYS + 1)), np.zeros((len(seeds), DAYS))
    alive[air.episodes, air.steps] = air.observations[:, share] * PLANTS
    alive[range(len(seeds)), air.lengths] = air.last_observations[:, share] * PLANTS
    poured[water.episodes, water.steps] = water.actions[:, 0] * MOST_WATER
    simulated = sum(
        float(each.extras["days"].sum()) for each in found.values() if "days" in each.extras
    )
    return Kept(air.returns, alive, poured, simulated / len(seeds))


def main(arguments: Sequence[str] | None = None) -> dict[str, Kept]:
    """Run greenhouses with each team, print the results as a table, and write them to a file."""
    parser = argparse.ArgumentParser(description="Run a greenhouse by plans, without training.")
    parser.add_argument(
        "--seeds", type=int, default=32, help="number of greenhouses (default: %(default)s)"
    )
    parser.add_argument(
        "--futures", type=int, default=2, help="futures per amount of water (default: %(default)s)"
    )
    parser.add_argument(
        "--out", type=Path, default=OUT, help="folder for the results (default: beside this file)"
    )
    options = parser.parse_args(arguments)
    teams: dict[str, Mapping[str, Any]] = {
        "rule": {},
        "best constant pair": BEST,
        "watering planned over the rule": {
            **BEST,
            WATERER: water_planner(RULE, 3, options.futures),
        },
        "watering planned over the pair": {
            **BEST,
            WATERER: water_planner(BEST[WATERER], 3, options.futures),
        },
    }
    kept = {}
    for title, policies in teams.items():
        print(title, flush=True)
        kept[title] = keep(policies, range(HELD_OUT, HELD_OUT + options.seeds), progress=True)
    tabulate(
        f"{options.seeds} greenhouses of make demo: mean ± standard deviation",
        {
            "return": ".1f",
            f"alive, day {DAYS}": ".0f",
            "litres poured": ".0f",
            "days in branches": ",.0f",
        },
        {
            who: (own.returns, own.alive[:, -1], own.poured.sum(axis=1), own.simulated)
            for who, own in kept.items()
        },
    )
    options.out.mkdir(parents=True, exist_ok=True)
    told = {
        "returns": {who: own.returns.tolist() for who, own in kept.items()},
        "alive": {who: own.alive.tolist() for who, own in kept.items()},
        "poured": {who: own.poured.tolist() for who, own in kept.items()},
    }
    (options.out / "plan.json").write_text(json.dumps(told), encoding="utf-8")
    print(f"Results: {options.out / 'plan.json'}")
    return kept


if __name__ == "__main__":
    main()
