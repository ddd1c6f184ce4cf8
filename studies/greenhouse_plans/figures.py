"""Figures of the value of plans for the greenhouse, by their cost and their horizon.

``python -m studies.greenhouse_plans.figures`` writes the figures ``plan-budget.png`` and
``plan-horizon.png`` and the table ``plan.md`` to ``docs/figures``. It takes about ten minutes on
two cores.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from examples.greenhouse_coop.env import VENTILATOR, WATERER
from examples.greenhouse_coop.model import Greenhouse
from examples.greenhouse_coop.plan import (
    BEST,
    LITRES,
    CountingPlanner,
    Kept,
    days_left,
    keep,
    water_planner,
)
from examples.greenhouse_coop.train import HELD_OUT

from simenv_marl import RULE

FIGURES: Final = Path(__file__).parents[2] / "docs" / "figures"

EXCHANGES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
"""The fractions of air that the ventilator tries out, where it plans as well."""

BEST_TRAINED: Final = 84.9
"""The best mean return of a trained policy: CMA-ES, by ``make demo``."""

Make = Callable[[int, int], Mapping[str, Any]]
"""Makes a team from a horizon in days and a number of futures."""


@dataclass(frozen=True)
class Line:
    """A line in a figure.

    Attributes:
        title: The label of the line.
        make: The function that makes its teams.
        style: The style of the line, as Matplotlib's keyword arguments.
    """

    title: str
    make: Make
    style: Mapping[str, Any]


def water(base: Any, rest: Any) -> Make:
    """Return a maker of teams with planned watering and ventilation at 100 %."""
    return lambda horizon, futures: {
        WATERER: water_planner(base, horizon, futures, rest),
        VENTILATOR: BEST[VENTILATOR],
    }


def both(horizon: int, futures: int) -> Mapping[str, Any]:
    """Make a team in which both agents plan over the model's own rules."""
    air = CountingPlanner(EXCHANGES, horizon, base=RULE, futures=futures, terminal_value=days_left)
    return {WATERER: water_planner(RULE, horizon, futures), VENTILATOR: air}


def share_alive(env: Any) -> float:
    """Return a low estimate of the future reward: as if there were one more day."""
    greenhouse: Greenhouse = env.unwrapped.simulation.greenhouse
    return greenhouse.alive / len(greenhouse.pots)


LINES: Final = (
    Line("over the pair, all days left", water(BEST[WATERER], days_left), {"color": "#1b6f5f"}),
    Line(
        "over the pair, one more day",
        water(BEST[WATERER], share_alive),
        {"color": "#1b6f5f", "linestyle": "--"},
    ),
    Line("over the rule, all days left", water(RULE, days_left), {"color": "#d1812c"}),
    Line(
        "over the rule, one more day",
        water(RULE, share_alive),
        {"color": "#d1812c", "linestyle": "--"},
    ),
    Line("both planned over the rules, all days left", both, {"color": "#8c8c8c"}),
)

Point = tuple[str, int, int, Kept]
"""The title of a line, the horizon, the number of futures, and the results."""


def sweep(
    lines: Sequence[Line], horizons: Sequence[int], futures: Sequence[int], seeds: Sequence[int]
) -> list[Point]:
    """Run greenhouses with plans of each kind, and print the mean returns."""
    found = []
    for line in lines:
        for horizon in horizons:
            for number in futures:
                kept = keep(line.make(horizon, number), seeds)
                print(
                    f"{line.title}; {horizon} days, {number} futures: {kept.returns.mean():.1f}",
                    flush=True,
                )
                found.append((line.title, horizon, number, kept))
    return found


def draw(points: Sequence[Point], along: Callable[[Point], float], label: str, path: Path) -> None:
    """Draw the mean return of each line.

    Args:
        points: The results.
        along: The function that returns a point's position on the x axis.
        label: The label of the x axis.
        path: The file to write.
    """
    from ..report import new_figure  # imported here, so that forks do not load Matplotlib

    figure = new_figure(8, 4.2)
    axes = figure.add_subplot()
    for line in LINES:
        own = [point for point in points if point[0] == line.title]
        if own:
            means = [point[3].returns.mean() for point in own]
            axes.plot(
                [along(point) for point in own],
                means,
                marker="o",
                markersize=4,
                label=line.title,
                **line.style,
            )
    axes.axhline(BEST_TRAINED, color="#7fb3d3", linewidth=1, label="best trained policy")
    axes.set_xscale("log")
    ticks = sorted({along(point) for point in points})
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel(label)
    axes.set_ylabel("mean return")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(title="base policy, terminal value", frameon=False, fontsize=8, title_fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def table(points: Sequence[Point]) -> str:
    """Make the table, in Markdown."""
    lines = [
        "| base policy, and terminal value | horizon in days | branches per decision | return |"
        " days in branches, per episode |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for title, horizon, number, kept in points:
        lines.append(
            f"| {title} | {horizon} | {number * len(LITRES)} | {kept.returns.mean():.1f} |"
            f" {kept.simulated:,.0f} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run greenhouses, draw both figures and write the table."""
    parser = argparse.ArgumentParser(
        description="Draw the value of plans by their cost and their horizon."
    )
    parser.add_argument(
        "--seeds", type=int, default=3, help="greenhouses for each point (default: %(default)s)"
    )
    parser.add_argument("--horizons", type=int, nargs="+", default=[1, 2, 3, 6, 12], metavar="DAYS")
    parser.add_argument("--futures", type=int, nargs="+", default=[1, 2, 4, 8], metavar="NUMBER")
    parser.add_argument(
        "--figures",
        type=Path,
        default=FIGURES,
        help="folder for the results (default: %(default)s)",
    )
    options = parser.parse_args(arguments)
    seeds = range(HELD_OUT, HELD_OUT + options.seeds)
    reaching = sweep(LINES, options.horizons, [1], seeds)
    spending = sweep(LINES[:2], [3], options.futures, seeds)
    draw(
        reaching,
        lambda point: point[1],
        "horizon in days (nine branches per decision)",
        options.figures / "plan-horizon.png",
    )
    branches = f"branches per decision ({len(LITRES)} amounts, horizon of three days)"
    draw(
        spending,
        lambda point: point[2] * len(LITRES),
        branches,
        options.figures / "plan-budget.png",
    )
    (options.figures / "plan.md").write_text(table([*reaching, *spending]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
