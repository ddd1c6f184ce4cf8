"""Production lines of LineFlow, planned beside published learners and heuristics.

``python -m studies.bounds.lines`` runs episodes of 4,000 units of time. The lines are those of the
package ``lineflow-rl``, unmodified; its documentation has the results to compare with (Müller,
Wenzel and Windisch, "LineFlow: A Framework to Learn Active Control of Production Lines", ICML
2025): the waiting time reaches nearly 160 parts; with a jump in the assembly's time, 115 at most,
106 by recurrent PPO and more than 100 by A2C; the complex line more than 540 by recurrent PPO and
254 by the heuristic of the package.

The score is the number of parts less that of scrapped ones. The planners are informed: branches
draw all times anew from the same laws, and so they do with a jump that has not begun yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import mean
from typing import Any, Final

from simenv_marl import simulate
from simenv_marl.planning import RolloutPolicy

from .measured import cpu_seconds, draw, options_of, show, write
from .waiting_line import STEP, JumpingLine, Line, best_known

EVERY: Final = 100
"""The time between two plans."""

HORIZON: Final = 300
"""The horizon, which is long enough for five parts in a jump."""

CONSTANTS: Final[tuple[int, ...]] = (16, 18, 19, 20, 22, 26, 30)
"""The constant waiting times that are tried."""

PLAN: Final = "plan, held to the horizon"

COLUMNS: Final = ("line", "seed", "policy", "score", "seconds")


def propose(observation: Any, *, _incumbent: Any) -> list[int]:
    """Return waiting times: all over their range at first, and then near the incumbent."""
    if not isinstance(_incumbent, int):
        return [*range(0, 60, 6)]
    near = {_incumbent + change for change in (-30, -10, -3, -1, 1, 3, 10, 30)}
    return sorted(waiting for waiting in near if 0 <= waiting < 100)


def planner(**options: Any) -> RolloutPolicy:
    """Return the planner, whose candidates hold to the horizon."""
    return RolloutPolicy(
        propose,
        hold=None,
        every=EVERY // STEP,
        horizon=HORIZON,
        horizon_by="time",
        metric=lambda line: line.score,
        **options,
    )


def constant(waiting: int) -> Any:
    """Return a policy that always waits equally long."""
    return lambda observation: waiting


LINES: Final = {
    "waiting time": (Line, {"recurrent PPO, published": 160.0}),
    "with a jump": (JumpingLine, {"recurrent PPO, published": 106.0, "A2C, published": 100.0}),
}
"""The lines, and what is published."""


def main(arguments: Sequence[str] | None = None) -> list[list[Any]]:
    """Measure the rules and the plan, and write the table and the figure."""
    options = options_of("Plan production lines.", arguments, seeds=6, futures=2)
    constants = CONSTANTS
    if options.quick:
        options.seeds, options.futures, constants = 1, 1, (19,)
        Line.end = 200
    rows: list[list[Any]] = []
    table: list[list[Any]] = []
    for name, (kind, published) in LINES.items():
        policies: dict[str, Any] = {f"always {each}": constant(each) for each in constants}
        policies["the package's heuristic, knows the time"] = best_known
        policies[PLAN] = planner(futures=options.futures)
        means: dict[str, float] = {}
        for policy, function in policies.items():
            scores, spent = [], []
            for seed in range(options.seeds):
                begin = cpu_seconds()
                line = simulate(kind, {"source": function}, seed=seed, global_rng=True)
                scores.append(line.score)
                spent.append(cpu_seconds() - begin)
                rows.append([name, seed, policy, line.score, round(spent[-1], 1)])
                write(options.out / "lines.csv", COLUMNS, rows)
            means[policy] = mean(scores)
        best = max((each for each in means if each.startswith("always")), key=means.__getitem__)
        bars = {f"best constant, {best.removeprefix('always ')}": means[best]} | published
        bars |= {each: value for each, value in means.items() if not each.startswith("always")}
        file = f"bounds-lines-{name.replace(' ', '-')}.png"
        draw(options.figures / file, bars, [PLAN], f"parts less scrap, {name}")
        table += [[name, each, f"{value:.4g}", ""] for each, value in bars.items()]
        table[-1][-1] = f"{mean(spent):.0f}"
    show(["line", "policy", f"parts less scrap, {options.seeds} seeds", "CPU seconds"], table)
    return table


if __name__ == "__main__":
    main()
