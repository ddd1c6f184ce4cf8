"""Planning in the greenhouse, without training.

``python -m examples.greenhouse_coop.plan`` (or ``make plan``) lets the waterer try out nine amounts of water each day,
in branches of a few days with newly drawn weather, before it pours the best one. One planner continues its branches
with the model's own rule, another with the best constant amount. The script prints a table and draws a figure.

Branches run on all cores, so the greenhouses run one after another. The cost of a branch is mostly the start of its
process, which grows with the number of imported modules. So the script imports the plotting libraries only after all
greenhouses have run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import RULE
from simenv_marl.data import collect_episodes
from simenv_marl.planning import RolloutPolicy

from .env import DAYS, MOST_WATER, OBSERVED, GreenhouseSim
from .model import PLANTS, Greenhouse

WATERER, VENTILATOR = "waterer_0", "ventilator_0"

HELD_OUT: Final = 1_000_000
"""The seeds of the greenhouses of ``make demo`` start here."""

LITRES: Final = tuple(range(0, 161, 20))
"""The amounts that the waterer tries out each day, in litres."""

EXCHANGES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
"""The fractions of air that the ventilator tries out, where it plans as well."""

OUT: Final = Path(__file__).parent / "out"


# -- policies -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Constant:
    """A constant policy, for one observation or a batch."""

    value: float

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Choose an action."""
        return np.full((*observation.shape[:-1], 1), self.value, np.float32)


BEST: Final = {WATERER: Constant(0.084), VENTILATOR: Constant(1.0)}
"""The best constant pair that ``make demo`` finds: 84 litres, and a full exchange of the air."""


def days_left(env: Any) -> float:
    """Return an upper bound of the future reward: all living plants stay alive until the end."""
    greenhouse: Greenhouse = env.unwrapped.simulation.greenhouse
    return greenhouse.alive / len(greenhouse.pots) * (DAYS - greenhouse.day)


def share_alive(env: Any) -> float:
    """Return a low estimate of the future reward: as if there were one more day."""
    greenhouse: Greenhouse = env.unwrapped.simulation.greenhouse
    return greenhouse.alive / len(greenhouse.pots)


class CountingPlanner(RolloutPolicy):
    """A planner that reports, as the extra ``days`` of each action, how many days its branches have simulated."""

    def __init__(self, actions: Sequence[float], horizon: int, **options: Any) -> None:
        """Make a planner.

        Args:
            actions: The candidate actions, as numbers.
            horizon: The number of days for which they are tried out.
            **options: The options of ``RolloutPolicy``.
        """
        super().__init__([np.array([action], np.float32) for action in actions], horizon=horizon, **options)
        self._horizon = horizon

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        """Choose an action. In a branch of another planner, this tries nothing out and returns the action alone."""
        values = self.choose(_environment)
        if not values.counts.any():
            return values.best
        day = _environment.simulation.greenhouse.day
        return values.best, {"days": int(values.counts.sum()) * min(self._horizon, DAYS - day)}


def water_planner(
    base: Any = RULE, horizon: int = 3, futures: int = 2, rest: Callable[[Any], float] | None = days_left
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


PORTIONS: Final = tuple(tenths / 10 for tenths in range(7))
"""The litres per pot that ``PortionPlanner`` tries out."""


@dataclass(frozen=True)
class PortionPlanner:
    """A waterer that plans for any number of pots: it tries out portions per pot, for one day, in one future.

    The terminal value after that day is ``days_left``, so the portion itself is the only decision in a branch.

    Attributes:
        portions: The portions to try out, in litres per pot.
        base: The policy that pours where this planner is the base of another one.
    """

    portions: tuple[float, ...] = PORTIONS
    base: Any = RULE

    def __call__(self, observation: Any, info: Any, *, _environment: Any) -> Any:
        """Choose an action."""
        pots = len(_environment.simulation.greenhouse.pots)
        actions = [np.array([portion * pots / MOST_WATER], np.float32) for portion in self.portions]
        planner = RolloutPolicy(actions, base=self.base, futures=1, horizon=1, terminal_value=days_left)
        return planner(observation, info, _environment=_environment)


def air_planner(base: Any = RULE, horizon: int = 3, futures: int = 2) -> CountingPlanner:
    """Make a ventilator that plans, with the arguments of ``water_planner``."""
    return CountingPlanner(EXCHANGES, horizon, base=base, futures=futures, terminal_value=days_left)


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
    simulated = sum(float(each.extras["days"].sum()) for each in found.values() if "days" in each.extras)
    return Kept(air.returns, alive, poured, simulated / len(seeds))


def teams(futures: int) -> dict[str, Mapping[str, Any]]:
    """Return the teams to compare, by title."""
    air = {VENTILATOR: BEST[VENTILATOR]}
    return {
        "rule": {},
        "best constant pair": BEST,
        "watering planned over the rule": air | {WATERER: water_planner(RULE, 3, futures)},
        "watering planned over the pair": air | {WATERER: water_planner(BEST[WATERER], 3, futures)},
    }


def main(arguments: Sequence[str] | None = None) -> dict[str, Kept]:
    """Run greenhouses with each team, and show the results as a table and a figure."""
    parser = argparse.ArgumentParser(description="Run a greenhouse by plans, without training.")
    parser.add_argument("--seeds", type=int, default=32, help="number of greenhouses (default: %(default)s)")
    parser.add_argument("--futures", type=int, default=2, help="futures per amount of water (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=OUT, help="folder for the figure (default: beside this file)")
    options = parser.parse_args(arguments)
    kept = {}
    for title, policies in teams(options.futures).items():
        print(title, flush=True)
        kept[title] = keep(policies, range(HELD_OUT, HELD_OUT + options.seeds), progress=True)

    from rich.console import Console
    from rich.table import Table

    from .picture import draw

    table = Table(title=f"{options.seeds} greenhouses of make demo: mean ± standard deviation")
    table.add_column("who decides")
    for column in ("return", f"alive, day {DAYS}", "litres poured", "days in branches"):
        table.add_column(column, justify="right")
    for title, own in kept.items():
        values = (own.returns, ".1f"), (own.alive[:, -1], ".0f"), (own.poured.sum(axis=1), ".0f")
        cells = [f"{np.mean(each):{form}} ± {np.std(each):<4{form}}" for each, form in values]
        table.add_row(title, *cells, f"{own.simulated:,.0f}")
    console = Console()
    console.print(table)
    path = draw(
        {title: own.returns.tolist() for title, own in kept.items()},
        {title: own.alive for title, own in kept.items()},
        {title: own.poured for title, own in kept.items()},
        options.out,
        "plan.png",
        title="Plans keep a greenhouse: the waterer tries out amounts of water before it pours",
    )
    console.print(f"Picture: {path}", soft_wrap=True)
    return kept


if __name__ == "__main__":
    main()
