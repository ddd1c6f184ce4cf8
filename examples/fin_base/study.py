"""One study of the pension fund: who decides best, and in which worlds?

``python -m examples.fin_base.study`` (or ``make pension``) searches constants and trains policies in one world, and has
them, the model's rules and a planner run the same funds in eight worlds: a full factorial design of returns, mortality
and population. What decides between them was chosen beforehand: ``welfare``. What has been learned or run is kept in a
folder, and is not done again. From the table of all runs come the figures of ``docs/pension.md``.
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

from simenv_marl import RULE, RolloutPolicy, design, evaluate, run_experiment

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
"""Seeds from here on are for the comparison; all others may be learned from."""

OUT: Final = Path(__file__).parent / "out" / "study"

POINTS: Final = TEAM | PREMIUMS
(PREMIUM,) = PREMIUMS
MANAGER, INDEXER = "manager_0", "indexer_0"

RETURNS: Final = {"expected": 0.03, "poor": 0.01}
"""By how much equities earn more than bonds, by the year."""

LIVES: Final = {"as expected": 1.0, "longer": 0.75}
"""The force of mortality, by that which the company reckons with."""

POPULATION: Final = {"steady": 0.025, "ageing": 0.005}
"""How many candidates there are a year, by the number of clients in the beginning."""

FACTORS: Final[Mapping[str, Sequence[str]]] = {
    "returns": tuple(RETURNS),
    "lives": tuple(LIVES),
    "population": tuple(POPULATION),
}

HOME: Final = {name: levels[0] for name, levels in FACTORS.items()}
"""The world in which is learned."""

Policies = Mapping[str, Any]
"""Who decides, by agent or decision point; the model's rules decide for all others."""


def world(
    returns: str = "expected",
    lives: str = "as expected",
    population: str = "steady",
    clients: int = CLIENTS,
    years: int = YEARS,
) -> FundSim:
    """Make a fund.

    Args:
        returns: What equities earn: see ``RETURNS``.
        lives: How long people live: see ``LIVES``.
        population: Whether clients are followed by others: see ``POPULATION``.
        clients: How many there are in the beginning.
        years: For how long it is run.
    """
    parameters = Parameters(
        clients=clients,
        climate=Climate(equity_premium=RETURNS[returns]),
        mortality=Mortality(factor=LIVES[lives]),
        entry=POPULATION[population],
    )
    return FundSim(years, parameters)


# -- learning, at home ----------------------------------------------------------------------------


def rate(contenders: Iterable[Policies], seeds: Iterable[int], workers: int) -> NDArray[np.float64]:
    """The mean welfare that each of some policies comes to.

    Args:
        contenders: The policies.
        seeds: What the funds are reset with, the same for all of them.
        workers: How many processes share the work.
    """
    named = {str(number): policies for number, policies in enumerate(contenders)}
    found = evaluate(world, named, seeds=seeds, points=POINTS, metric=FundSim.welfare, workers=workers)
    means: NDArray[np.float64] = found.values("metric").mean().to_numpy()
    return means


def best_constants(seeds: int, workers: int) -> dict[str, Constant]:
    """The constant mix and indexation that do best together."""
    pairs = [{MANAGER: Constant(mix), INDEXER: Constant(by)} for mix, by in _pairs(MIXES, INDEXATIONS)]
    return pairs[int(np.argmax(rate(pairs, range(seeds), workers)))]


def best_premium(seeds: int, workers: int) -> dict[str, Constant]:
    """The constant surcharge on the premiums of all clients that does best."""
    surcharges = [{PREMIUM: Constant(level)} for level in range(len(SURCHARGES))]
    return surcharges[int(np.argmax(rate(surcharges, range(seeds), workers)))]


def _pairs(first: Sequence[Any], second: Sequence[Any]) -> Iterable[tuple[int, int]]:
    return itertools.product(range(len(first)), range(len(second)))


def train(start: Mapping[str, Linear], generations: int, seed: int, workers: int) -> dict[str, Linear]:
    """Train policies together, by evolution of their weights.

    Args:
        start: By agent or decision point, the policy that learning begins with.
        generations: For how long.
        seed: Determines everything.
        workers: How many processes share the work.
    """
    sizes = np.cumsum([len(policy.weights) for policy in start.values()])[:-1]

    def team(weights: NDArray[np.float64]) -> dict[str, Linear]:
        return {name: Linear(tuple(own.tolist())) for name, own in zip(start, np.split(weights, sizes), strict=True)}

    def rated(candidates: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        return rate(map(team, candidates), rng.integers(HELD_OUT, size=8).tolist(), workers)

    rng = np.random.default_rng(seed)
    first = np.concatenate([policy.weights for policy in start.values()])
    return team(evolve(rated, first, generations, rng, population=14))


def learned(folder: Path, generations: int, seeds: int, workers: int) -> dict[str, dict[str, Any]]:
    """Search constants and train policies, or load those that were found before.

    Args:
        folder: Where they are kept.
        generations: For how long policies are trained.
        seeds: How many funds each constant is tried on.
        workers: How many processes share the work.

    Returns:
        The contenders, by name.
    """
    pair = {MANAGER: Linear.start(0.75, len(OBSERVED)), INDEXER: Linear.start(0.9, len(OBSERVED))}
    premiums = {PREMIUM: Linear.start(0.5, len(OBSERVED) + len(OF_A_CLIENT))}
    ways: dict[str, tuple[type, Callable[[], Mapping[str, Any]]]] = {
        "constant pair": (Constant, lambda: best_constants(seeds, workers)),
        "constant premium": (Constant, lambda: best_premium(seeds, workers)),
        "trained pair": (Linear, lambda: train(pair, generations, 1, workers)),
        "trained premiums": (Linear, lambda: train(premiums, generations, 2, workers)),
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
    """Have the indexer try out each indexation for a year, in two futures, before it decides. Nothing is trained."""
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
"""What is noted of each fund at its end."""


def run(folder: Path, rows: Any, contenders: Mapping[str, Policies], seeds: int, workers: int) -> Any:
    """Run what is missing of a table.

    Args:
        folder: Where its runs are kept.
        rows: The worlds.
        contenders: Who decides, besides the rule.
        seeds: How many funds there are in each world.
        workers: How many processes share the work.

    Returns:
        The table: a row for each fund.
    """
    table = run_experiment(
        world,
        rows,
        policies=contenders,
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
    """Learn, run, and show what came of it."""
    parser = argparse.ArgumentParser(description="Who decides best for a pension fund, and in which worlds?")
    parser.add_argument("--seeds", type=int, default=32, help="funds in each world (default: %(default)s)")
    parser.add_argument("--large", type=int, default=8, help="funds of 10,000 clients (default: %(default)s)")
    parser.add_argument("--generations", type=int, default=24, help="of learning (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=OUT, help="folder for all of it (default: %(default)s)")
    parser.add_argument("--figures", type=Path, help="folder for pictures and tables (default: the same)")
    parser.add_argument("--quick", action="store_true", help="little of everything, to see that it works")
    if parser.parse_args(arguments).quick:
        parser.set_defaults(seeds=2, large=0, generations=2, out=OUT.with_name("study-quick"))
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

    from . import study_figures  # here, for no process that forks is to carry what draws

    study_figures.show(table, large, found, options.figures or options.out)


if __name__ == "__main__":
    main()
