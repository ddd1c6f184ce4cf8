"""LineFlow's complex line, planned beside its heuristic and a bound of its throughput.

``python -m studies.bounds.complex_line`` runs episodes of 4,000 units of time. Three assemblies in
a row need a component each, from one source, through one switch; nine workers move between them. A
component that waits for longer than 30 units is scrap. The line is that of ``lineflow-rl``,
unmodified; its scrap counts a third, as in its example. Its documentation publishes 254 for the
heuristic of the package and more than 540 for recurrent PPO. ``bound`` computes how many parts the
processing times allow at most: fewer than 540.

The rule is that heuristic. The plan tries simple policies near the one that it has chosen last,
held over a horizon of 300. It is informed: branches draw all times anew from the same laws.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from statistics import mean
from typing import Any, Final

import numpy as np
from scipy.optimize import linprog

from simenv_marl import simulate
from simenv_marl.planning import RolloutPolicy

from .control_line import STATIONS, WORKERS, Line, Route
from .measured import cpu_seconds, draw, options_of, read, show, write

PLAN: Final = "plan, held to the horizon"
PUBLISHED: Final = {"heuristic, published": 254.0, "recurrent PPO, published": 540.0}


def propose(observation: Any, *, _incumbent: Any) -> list[Route]:
    """Return policies near the incumbent."""
    found = _incumbent if isinstance(_incumbent, Route) else Route()
    return [found, *found.near()]


def planner(**options: Any) -> RolloutPolicy:
    """Return the planner."""
    return RolloutPolicy(
        propose,
        hold=None,
        every=100,
        horizon=300,
        horizon_by="time",
        metric=lambda line: line.score,
        **options,
    )


def bound() -> float:
    """Return an upper bound of the number of parts, by a linear program.

    Buffers are never empty, workers move in no time, and nothing is scrap. For each assembly, the
    program chooses which share of the parts how many workers assemble, so that neither an assembly
    nor the workers together are busy for longer than the episode.
    """
    numbers = np.arange(WORKERS + 1)
    means = [16 + 4 * place for place in range(STATIONS)]  # without workers; the chance adds 10 %
    times = np.outer(means, np.exp(-0.3 * (numbers - 1)) + 0.1)
    places = np.kron(np.eye(STATIONS), np.ones(len(numbers)))
    busy = np.vstack([places, np.tile(numbers, STATIONS)]) * times.ravel()
    limits = [*[Line.end] * STATIONS, WORKERS * Line.end]
    all_pass = np.hstack([places, -np.ones((STATIONS, 1))])
    found = linprog(
        [*np.zeros(times.size), -1.0],
        A_ub=np.hstack([busy, np.zeros((STATIONS + 1, 1))]),
        b_ub=limits,
        A_eq=all_pass,
        b_eq=np.zeros(STATIONS),
    )
    return float(found.x[-1])


def main(arguments: Sequence[str] | None = None) -> list[list[Any]]:
    """Measure the heuristic and the plan, and write the table and the figure."""
    options = options_of("Plan a complex line.", arguments, seeds=3, futures=2)
    if options.quick:
        options.seeds, options.futures, Line.end = 1, 1, 150
    path = options.out / "complex_line.csv"
    rows = [] if options.quick else read(path, (0, 2, 3))
    policies: dict[str, dict[str, Any]] = {
        "the package's heuristic": {},
        "fewest components first": {"control": Route()},
        PLAN: {"control": planner(futures=options.futures)},
    }
    for seed, (name, decides) in product(range(options.seeds), policies.items()):
        if [seed, name] not in [row[:2] for row in rows]:
            begin = cpu_seconds()
            line = simulate(Line, decides, seed=seed)
            rows.append([seed, name, round(line.score, 3), round(cpu_seconds() - begin, 1)])
            write(path, ["seed", "policy", "score", "seconds"], rows)
    scores, table = {}, []
    for name in policies:
        found = [row for row in rows if row[0] < options.seeds and row[1] == name]
        scores[name] = mean(row[2] for row in found)
        table.append([name, f"{scores[name]:.4g}", f"{mean(row[3] for row in found):.0f}"])
    for name, value in {**PUBLISHED, "bound without transport": bound()}.items():
        scores[name] = value
        table.append([name, f"{value:.4g}", ""])
    show(["policy", f"parts less scrap, {options.seeds} seeds", "CPU seconds"], table)
    draw(options.figures / "bounds-complex-line.png", scores, [PLAN], "parts less scrap")
    return table


if __name__ == "__main__":
    main()
