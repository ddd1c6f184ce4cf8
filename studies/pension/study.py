"""A study of the pension fund: which policies decide best, and in which worlds?

``python -m studies.pension.study`` (or ``make pension``) searches constant policies and trains
others in one world. They, the model's rules and a planner then run the same funds in eight worlds:
a full factorial design of returns, mortality and population. The criterion was chosen beforehand:
``welfare``. A folder keeps the policies and the runs, so that a second call computes only what is
missing. The table of all runs gives the figures of ``docs/pension.md``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from examples.fin_base.economy import Climate, Mortality
from examples.fin_base.env import (
    INDEXATIONS,
    MIXES,
    OBSERVED,
    OF_A_CLIENT,
    PREMIUMS,
    SURCHARGES,
    TEAM,
    FundSim,
)
from examples.fin_base.pension import Parameters
from examples.fin_base.train import (
    HELD_OUT,
    PAIR,
    Linear,
    Policies,
    Rate,
    nearest_lawful,
    rate,
    train,
)
from numpy.typing import NDArray

from simenv_marl import RULE
from simenv_marl.experiments import design, run_experiment
from simenv_marl.planning import RolloutPolicy

YEARS: Final = 20
CLIENTS: Final = 200
LARGE: Final = 10_000

OUT: Final = Path(__file__).parent / "out"

POINTS: Final = TEAM | PREMIUMS
(PREMIUM,) = PREMIUMS
MANAGER, INDEXER = "manager_0", "indexer_0"

RETURNS: Final = {"expected": 0.03, "poor": 0.01}
"""The equity premium: the annual excess of the return of equities over that of bonds."""

LIVES: Final = {"as expected": 1.0, "longer": 0.75}
"""The force of mortality, relative to the one that the company assumes."""

POPULATION: Final = {"steady": 0.025, "ageing": 0.005}
"""The yearly number of candidates, relative to the initial number of clients."""

FACTORS: Final[Mapping[str, Sequence[str]]] = {
    "returns": tuple(RETURNS),
    "lives": tuple(LIVES),
    "population": tuple(POPULATION),
}

HOME: Final = {name: levels[0] for name, levels in FACTORS.items()}
"""The world in which policies learn."""


def world(
    returns: str = "expected",
    lives: str = "as expected",
    population: str = "steady",
    clients: int = CLIENTS,
    years: int = YEARS,
) -> FundSim:
    """Make a fund.

    Args:
        returns: The level of equity returns: see ``RETURNS``.
        lives: The level of longevity: see ``LIVES``.
        population: The level of new entrants: see ``POPULATION``.
        clients: The initial number of clients.
        years: The number of years after which an episode is truncated.
    """
    parameters = Parameters(
        clients=clients,
        climate=Climate(equity_premium=RETURNS[returns]),
        mortality=Mortality(factor=LIVES[lives]),
        entry=POPULATION[population],
    )
    return FundSim(years, parameters)


# -- learning, in the home world ------------------------------------------------------------------


@dataclass(frozen=True)
class Constant:
    """A constant policy: it chooses the same level each time, or the nearest lawful one."""

    level: int

    def __call__(self, observation: NDArray[np.float32], info: Mapping[str, Any]) -> int:
        """Choose a level."""
        return nearest_lawful(self.level, info["action_mask"])


def best(teams: Sequence[dict[str, Constant]], rate: Rate, seeds: int) -> dict[str, Constant]:
    """Find the best of several constant policies."""
    return teams[int(np.argmax(rate(teams, range(seeds))))]


def learned(
    folder: Path, size: Mapping[str, Any], generations: int, seeds: int, workers: int
) -> dict[str, dict[str, Any]]:
    """Search constants and train policies, or load those found before.

    Args:
        folder: The folder that keeps the policies.
        size: The numbers of clients and years of a fund, where they are not those of ``world``.
        generations: The number of generations of the training.
        seeds: The number of funds on which each constant is tried.
        workers: The number of processes.

    Returns:
        The contenders, by name.
    """
    # returns of other decision points than these would only take time
    of_team, of_premiums = (
        partial(rate, partial(world, **size), points, workers) for points in (TEAM, PREMIUMS)
    )
    pairs = [
        {MANAGER: Constant(mix), INDEXER: Constant(by)}
        for mix in range(len(MIXES))
        for by in range(len(INDEXATIONS))
    ]
    surcharges = [{PREMIUM: Constant(level)} for level in range(len(SURCHARGES))]
    premiums = {PREMIUM: Linear.start(0.5, len(OBSERVED) + len(OF_A_CLIENT))}
    ways: dict[str, tuple[type, Callable[[], Mapping[str, Any]]]] = {
        "constant pair": (Constant, lambda: best(pairs, of_team, seeds)),
        "constant premium": (Constant, lambda: best(surcharges, of_premiums, seeds)),
        "trained pair": (Linear, lambda: train(PAIR, of_team, generations, 1)),
        "trained premiums": (Linear, lambda: train(premiums, of_premiums, generations, 2)),
    }
    found: dict[str, dict[str, Any]] = {}
    for name, (kind, learn) in ways.items():
        path = folder / f"{name.replace(' ', '-')}.json"
        if not path.exists():
            began = time.monotonic()
            stored = {who: asdict(policy) for who, policy in learn().items()}
            path.write_text(json.dumps(stored), encoding="utf-8")
            print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)
        stored = json.loads(path.read_text(encoding="utf-8"))
        found[name] = {who: kind(**own) for who, own in stored.items()}
    return {**found, "both trained": {**found["trained pair"], **found["trained premiums"]}}


def planned() -> dict[str, RolloutPolicy]:
    """Make a planner: the indexer simulates each indexation for a year, in two futures."""
    return {INDEXER: RolloutPolicy(base=RULE, futures=2, horizon=1, horizon_by="time")}


# -- the comparison -------------------------------------------------------------------------------


def mean_premium(simulation: FundSim) -> float:
    """The mean premium over the years, as a share of the wage."""
    return statistics.fmean(year.premium for year in simulation.account.years)


METRICS: Final = {
    "welfare": FundSim.welfare,
    "right": lambda simulation: simulation.account.right(),
    "coverage": lambda simulation: simulation.fund.company.coverage(),
    "premium": mean_premium,
    "short": lambda simulation: simulation.fund.world.counts["short"],
    "cuts": lambda simulation: simulation.fund.world.counts["cut"],
}
"""The metrics of each fund at its end."""


def run(
    folder: Path, rows: Any, contenders: Mapping[str, Policies], seeds: int, workers: int
) -> Any:
    """Run the missing runs of a table.

    Args:
        folder: The folder that keeps the runs.
        rows: The worlds.
        contenders: The policies to compare with the rule, by name.
        seeds: The number of funds in each world.
        workers: The number of processes.

    Returns:
        The table: one row per fund.
    """
    table = run_experiment(
        world,
        rows,
        contenders=contenders,
        seeds=range(HELD_OUT, HELD_OUT + seeds),
        points=POINTS,
        metric=METRICS,
        store=folder,
        workers=workers,
        progress=True,
    )
    if not table.error.isna().all():
        raise RuntimeError(f"runs have failed: {table.error.dropna().unique()}")
    return table[table.agent == "team"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Learn, run, and show the results."""
    parser = argparse.ArgumentParser(
        description="Which policies decide best for a pension fund, and in which worlds?"
    )
    parser.add_argument(
        "--seeds", type=int, default=32, help="funds in each world (default: %(default)s)"
    )
    parser.add_argument(
        "--large", type=int, default=0, help="funds of 10,000 clients (default: %(default)s)"
    )
    parser.add_argument(
        "--generations", type=int, default=24, help="generations of learning (default: %(default)s)"
    )
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=OUT, help="folder for all results (default: %(default)s)"
    )
    parser.add_argument(
        "--figures", type=Path, help="folder for figures and tables (default: the same)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="a small run, to check that everything works"
    )
    size: dict[str, Any] = {}
    if parser.parse_args(arguments).quick:
        parser.set_defaults(seeds=2, generations=1, out=OUT / "quick")
        size = {"clients": 30, "years": 2}
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    found = learned(options.out, size, options.generations, min(options.seeds, 12), options.workers)
    contenders = {**found, "planned": planned()}
    worlds = design({name: list(levels) for name, levels in FACTORS.items()}).assign(**size)
    table = run(options.out / "runs", worlds, contenders, options.seeds, options.workers)
    large = None
    if options.large:
        rows = [{**HOME, **size, "clients": LARGE}]
        without_plans = {
            name: found[name] for name in ("trained pair", "trained premiums", "both trained")
        }
        large = run(options.out / "large", rows, without_plans, options.large, options.workers)

    # imported here, so that forked processes do not load the plotting libraries
    from . import figures

    figures.show(table, large, found, partial(world, **size), options.figures or options.out)


if __name__ == "__main__":
    main()
