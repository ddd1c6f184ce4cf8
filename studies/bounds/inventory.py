"""Inventory networks of gym-invmgmt, planned beside its oracle, its programs and its learners.

``python -m studies.bounds.inventory`` plans scenarios of the benchmark of Barati (package
``gym-invmgmt``, repository ``gym-invmgmt-paper``). ``data/invmgmt.csv`` has its published profits
by seed: of the oracle, which knows the demand; of its stochastic program (MSSP, informed); and of
that one of its eleven learned policies which is best there. Two of its 22 scenarios need the data
of a competition, and are left out. Finished episodes are kept.

The rule is the informed (s, S) rule of the benchmark; its profits are the published ones. The plan
searches near the rule that it has chosen last: factors of stocks, lots and suppliers, held to the
end of the episode. It is informed: branches draw the demand from its law.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from random import Random
from statistics import mean
from typing import Any, Final

from simenv_marl import RULE, simulate
from simenv_marl.planning import RolloutPolicy

from .measured import cpu_seconds, draw, options_of, read, show, write
from .warehouse import RULE_ORDERS, Orders, Warehouse

SEEDS: Final = (42, 123, 456, 789, 1011, 2022, 3033, 4044, 5055, 6066)
"""The seeds of the benchmark."""

NEAR: Final = 8
"""The number of rules near the incumbent that are tried at a plan."""

COLUMNS: Final = ("scenario", "seed", "policy", "profit", "seconds")

SIZES: Final = {"network": (6, 11), "serial": (3, 3)}
"""The numbers of nodes and of links."""


def changed(factors: Mapping[int, float], key: int, factor: float) -> dict[int, float]:
    """Return factors with one of them multiplied."""
    return {**factors, key: factors.get(key, 1.0) * factor}


def near(orders: Orders, nodes: int, links: int, random: Random) -> Orders:
    """Return a rule with two other factors."""
    factors, lots, shares = orders.factors, orders.lots, orders.shares
    for _ in range(2):
        kind, node = random.randrange(3), random.randint(1, nodes)
        if kind == 0:
            factors = changed(factors, node, random.choice((0.6, 0.8, 0.9, 1.1, 1.25)))
        elif kind == 1:
            lots = changed(lots, node, random.choice((0.0, 0.5, 2.0)))
        else:
            shares = changed(shares, random.randrange(links), random.choice((0.1, 0.5, 4.0)))
    return Orders(factors, lots, shares)


def local_search(network: str) -> Any:
    """Return what proposes candidates: rules near the incumbent."""
    random = Random(0)
    nodes, links = SIZES[network]

    def scaled(orders: Orders, factor: float, lot: float) -> Orders:
        factors, lots = orders.factors, orders.lots
        for node in range(1, nodes + 1):
            factors, lots = changed(factors, node, factor), changed(lots, node, lot)
        return Orders(factors, lots, orders.shares)

    def propose(observation: Any, *, _incumbent: Any) -> list[Orders]:
        if _incumbent is None:
            return [
                scaled(RULE_ORDERS, f, lot) for f in (0.5, 0.7, 0.85, 1.0) for lot in (0.0, 1.0)
            ]
        orders = RULE_ORDERS if _incumbent is RULE else _incumbent
        found = [near(orders, nodes, links, random) for _ in range(NEAR)]
        return [*found, *(scaled(orders, factor, 1.0) for factor in (0.0, 0.8, 0.9, 1.1))]

    return propose


def plan(network: str, futures: int) -> RolloutPolicy:
    """Return a planner that compares profits at the end."""
    return RolloutPolicy(
        local_search(network),
        hold=None,
        every=2,
        metric=lambda warehouse: warehouse.profit,
        futures=futures,
        method="replay",  # a whole episode takes less than a fork
    )


def published() -> list[dict[str, Any]]:
    """Return the published results, a row for each scenario."""
    path = Path(__file__).parent / "data" / "invmgmt.csv"
    with path.open(newline="", encoding="utf-8") as file:
        rows: list[dict[str, Any]] = [*csv.DictReader(file)]
    for row in rows:
        for name in ("oracle", "mssp", "learned"):
            row[name] = [float(value) for value in row[name].split()]
        row |= {name: row[name] == "yes" for name in ("shock", "goodwill", "backlog")}
    return rows


def main(arguments: Sequence[str] | None = None) -> list[list[Any]]:
    """Measure the rule and the plan, and write the table and the figure."""
    options = options_of("Plan inventories.", arguments, seeds=10, scenarios=20, futures=2)
    if options.quick:
        options.seeds, options.scenarios, options.futures = 1, 1, 1
    chosen = published()
    chosen = chosen[:: max(1, len(chosen) // options.scenarios)][: options.scenarios]
    path = options.out / "inventory.csv"
    rows = [] if options.quick else read(path, (1, 3, 4))
    table: list[list[Any]] = []
    shares: dict[str, list[float]] = {}
    for row in chosen:
        names = [name for name in ("shock", "goodwill", "backlog") if row[name]]
        title = f"{row['network']}, {row['demand']}{''.join(f', {name}' for name in names)}"
        kind = type("Scenario", (Warehouse,), row)
        profits: dict[str, list[float]] = {"rule": [], "plan": []}
        spent = []
        for seed, (name, values) in product(SEEDS[: options.seeds], profits.items()):
            found = [other for other in rows if other[:3] == [title, seed, name]]
            if not found:
                begin = cpu_seconds()
                policies = {"planner": plan(row["network"], options.futures)}
                done = simulate(kind, policies if name == "plan" else {}, seed=seed)
                seconds = round(cpu_seconds() - begin, 1)
                found = [[title, seed, name, round(done.profit, 2), seconds]]
                rows += found
                write(path, COLUMNS, rows)
            values.append(found[0][3])
            spent.append(found[0][4])
        oracle = sum(row["oracle"][: options.seeds])
        parts = {"(s, S), informed": sum(profits["rule"]) / oracle}
        parts["best learned"] = sum(row["learned"][: options.seeds]) / oracle
        parts["plan"] = sum(profits["plan"]) / oracle
        parts["MSSP, informed"] = sum(row["mssp"][: options.seeds]) / oracle
        for name, value in parts.items():
            shares.setdefault(name, []).append(100 * value)
        table.append([title, *(f"{100 * value:.1f}" for value in parts.values()), row["learner"]])
        table[-1].append(f"{mean(spent[1::2]):.1f}")
    means = {name: mean(values) for name, values in shares.items()}
    table.append(["mean", *(f"{value:.1f}" for value in means.values()), "", ""])
    show(["% of the oracle's profit", *means, "learner", "CPU seconds of a plan"], table)
    label = f"% of the oracle's profit, {len(chosen)} scenarios, {options.seeds} seeds"
    draw(options.figures / "bounds-inventory.png", means, ["plan"], label)
    return table


if __name__ == "__main__":
    main()
