"""A study of the pension fund: which policies decide best, and in which worlds?

``python -m examples.fin_base.study`` (or ``make pension``) searches constant policies and trains others in one world.
They, the model's rules and a planner then run the same funds in eight worlds: a full factorial design of returns,
mortality and population. The criterion was chosen beforehand: ``welfare``. A folder keeps the policies and the runs, so
that a second call computes only what is missing. The table of all runs gives the figures of ``docs/pension.md``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import RULE, evaluate
from simenv_marl.experiments import design, run_experiment
from simenv_marl.planning import RolloutPolicy

from ..evolution import evolve
from .economy import Climate, Mortality
from .env import INDEXATIONS, MIXES, PREMIUMS, SURCHARGES, TEAM, FundSim
from .observations import OBSERVED, OF_A_CLIENT
from .pension import Parameters
from .policies import Constant, Linear

YEARS: Final = 20
CLIENTS: Final = 200
LARGE: Final = 10_000

HELD_OUT: Final = 1_000_000
"""Seeds from this number on are for the comparison; those below it are for learning."""

OUT: Final = Path(__file__).parent / "out" / "study"

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

Policies = Mapping[str, Any]
"""Policies by agent or decision point; the model's rules decide for all others."""


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


def rate(contenders: Iterable[Policies], points: Any, seeds: Iterable[int], workers: int) -> NDArray[np.float64]:
    """Compute the mean welfare of each of several policies.

    Args:
        contenders: The policies.
        points: The decision points of these policies. Returns of others would only take time.
        seeds: The seeds of the funds, the same for all policies.
        workers: The number of processes.
    """
    named = {str(number): policies for number, policies in enumerate(contenders)}
    found = evaluate(world, named, seeds=seeds, points=points, metric=FundSim.welfare, workers=workers)
    means: NDArray[np.float64] = found.values("metric").mean().to_numpy()
    return means


def best_constants(seeds: int, workers: int) -> dict[str, Constant]:
    """Find the best pair of a constant mix and a constant indexation."""
    pairs = [{MANAGER: Constant(mix), INDEXER: Constant(by)} for mix, by in _pairs(MIXES, INDEXATIONS)]
    return pairs[int(np.argmax(rate(pairs, TEAM, range(seeds), workers)))]


def best_premium(seeds: int, workers: int) -> dict[str, Constant]:
    """Find the best constant surcharge on the premiums of all clients."""
    surcharges = [{PREMIUM: Constant(level)} for level in range(len(SURCHARGES))]
    return surcharges[int(np.argmax(rate(surcharges, PREMIUMS, range(seeds), workers)))]


def _pairs(first: Sequence[Any], second: Sequence[Any]) -> Iterable[tuple[int, int]]:
    return itertools.product(range(len(first)), range(len(second)))


def train(start: Mapping[str, Linear], points: Any, generations: int, seed: int, workers: int) -> dict[str, Linear]:
    """Train policies jointly, by evolution of their weights.

    Args:
        start: The initial policies, by agent or decision point.
        points: Their decision points.
        generations: The number of generations.
        seed: The seed of the training.
        workers: The number of processes.
    """
    sizes = np.cumsum([len(policy.weights) for policy in start.values()])[:-1]

    def team(weights: NDArray[np.float64]) -> dict[str, Linear]:
        return {name: Linear(tuple(own.tolist())) for name, own in zip(start, np.split(weights, sizes), strict=True)}

    def rated(candidates: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        return rate(map(team, candidates), points, rng.integers(HELD_OUT, size=8).tolist(), workers)

    rng = np.random.default_rng(seed)
    first = np.concatenate([policy.weights for policy in start.values()])
    return team(evolve(rated, first, generations, rng, population=14))


def learned(folder: Path, generations: int, seeds: int, workers: int) -> dict[str, dict[str, Any]]:
    """Search constants and train policies, or load those found before.

    Args:
        folder: The folder that keeps the policies.
        generations: The number of generations of the training.
        seeds: The number of funds on which each constant is tried.
        workers: The number of processes.

    Returns:
        The contenders, by name.
    """
    pair = {MANAGER: Linear.start(0.75, len(OBSERVED)), INDEXER: Linear.start(0.9, len(OBSERVED))}
    premiums = {PREMIUM: Linear.start(0.5, len(OBSERVED) + len(OF_A_CLIENT))}
    ways: dict[str, tuple[type, Callable[[], Mapping[str, Any]]]] = {
        "constant pair": (Constant, lambda: best_constants(seeds, workers)),
        "constant premium": (Constant, lambda: best_premium(seeds, workers)),
        "trained pair": (Linear, lambda: train(pair, TEAM, generations, 1, workers)),
        "trained premiums": (Linear, lambda: train(premiums, PREMIUMS, generations, 2, workers)),
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
    """Make a planner: the indexer simulates each indexation for a year, in two futures, before it decides."""
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


def run(folder: Path, rows: Any, contenders: Mapping[str, Policies], seeds: int, workers: int) -> Any:
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
    parser = argparse.ArgumentParser(description="Which policies decide best for a pension fund, and in which worlds?")
    parser.add_argument("--seeds", type=int, default=32, help="funds in each world (default: %(default)s)")
    parser.add_argument("--large", type=int, default=0, help="funds of 10,000 clients (default: %(default)s)")
    parser.add_argument("--generations", type=int, default=24, help="generations of learning (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=OUT, help="folder for all results (default: %(default)s)")
    parser.add_argument("--figures", type=Path, help="folder for figures and tables (default: the same)")
    parser.add_argument("--quick", action="store_true", help="a small run, to check that everything works")
    if parser.parse_args(arguments).quick:
        parser.set_defaults(seeds=2, generations=2, out=OUT.with_name("study-quick"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    found = learned(options.out, options.generations, min(options.seeds, 12), options.workers)
    contenders = {**found, "planned": planned()}
    worlds = design({name: list(levels) for name, levels in FACTORS.items()})
    table = run(options.out / "runs", worlds, contenders, options.seeds, options.workers)
    large = None
    if options.large:
        rows = [{**HOME, "clients": LARGE}]
        without_plans = {name: found[name] for name in ("trained pair", "trained premiums", "both trained")}
        large = run(options.out / "large", rows, without_plans, options.large, options.workers)

    from . import study_figures  # imported here, so that forked processes do not load the plotting libraries

    study_figures.show(table, large, found, options.figures or options.out)


if __name__ == "__main__":
    main()
