"""Figures and tables of the matrix, from one tidy table.

They are made with pandas, seaborn, statsmodels and the library.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import seaborn
from matplotlib import pyplot
from matplotlib.lines import Line2D
from pandas import DataFrame
from statsmodels.formula.api import ols
from statsmodels.stats.anova import anova_lm

from simenv_marl.experiments import Evaluation, effects

from ..report import markdown, new_figure
from .matrix import FACTORS, HOME, SCHOOLS

AT_HOME, ALL_OVER = SCHOOLS

NUMBER: Final = " 0123456789"
"""The characters of the number that ends a learner's name, after the name of its training set."""

COLOURS: Final = {"rule": "#8c8c8c", AT_HOME: "#d1812c", ALL_OVER: "#7fb3d3", "planned": "#1b6f5f"}


def averaged(table: Any) -> Any:
    """Select the team's rows, and average the learners of each training set to one contender."""
    team = table[table.agent == "team"]
    keys = [*FACTORS, "contender", "seed", "agent", "status"]
    values = ["return", "length", "alive", "litres"]
    schools = team.assign(contender=team.contender.str.rstrip(NUMBER))
    return schools.groupby(keys, sort=False, as_index=False)[values].mean()


# -- tables ---------------------------------------------------------------------------------------


def compared(means: Any) -> str:
    """Tabulate results by number of plants, and differences to the learners trained at home.

    The comparison is of means over all climates and exchanges, seed by seed: intervals are over
    seeds.
    """
    rows = []
    for plants, own in means.groupby("plants"):
        by_seed = own.groupby(["contender", "seed"], sort=False, as_index=False)[
            ["return", "alive", "litres"]
        ].mean()
        evaluation = Evaluation(by_seed.assign(agent="team"), AT_HOME, 0.95)
        others = by_seed.groupby("contender")[["alive", "litres"]].mean()
        for name, found in evaluation.summary().iterrows():
            apart = "" if name == AT_HOME else _between(found, "difference", "+.1f")
            alive, litres = others.loc[name]
            rows.append(
                (
                    plants,
                    name,
                    _between(found, "mean", ".1f"),
                    apart,
                    f"{alive:.0%}",
                    f"{litres:.2f}",
                )
            )
    return markdown(
        ("plants", "policy", "return", f"gain over {AT_HOME}", "alive", "litres per pot and day"),
        rows,
    )


def _between(found: Any, name: str, form: str) -> str:
    low, high = ("low", "high") if name == "mean" else (f"{name}_low", f"{name}_high")
    return f"{found[name]:{form}} ({found[low]:{form}} to {found[high]:{form}})"


def moved(means: Any) -> str:
    """Tabulate the range of mean returns over each factor's levels, for each contender."""
    rows = []
    for name in dict.fromkeys(means.contender):
        levels = effects(means, contender=name).main["mean"].groupby("factor", sort=False)
        rows.append((name, *(f"{value:.1f}" for value in levels.max() - levels.min())))
    return markdown(("policy", *FACTORS), rows)


def learners(table: Any) -> str:
    """Tabulate each learner's mean return in the paper's greenhouse and per number of plants."""
    team = table[(table.agent == "team") & table.contender.str.startswith(tuple(SCHOOLS))]
    home = (
        team[(team[list(HOME)] == list(HOME.values())).all(axis=1)]
        .groupby("contender")["return"]
        .mean()
    )
    by_plants = team.pivot_table(index="contender", columns="plants", values="return", sort=False)
    rows = [
        (name, *(f"{value:.1f}" for value in (home[name], *own)))
        for name, own in by_plants.iterrows()
    ]
    return markdown(
        ("policy", "the paper's greenhouse", *(f"{plants} plants" for plants in by_plants)), rows
    )


def shares(means: Any) -> str:
    """Tabulate the shares of the variance of returns, by an analysis of variance."""
    varied = [name for name in (*FACTORS, "contender") if means[name].nunique() > 1]
    formula = f'Q("return") ~ ({" + ".join(f"C({name})" for name in varied)}) ** 2 + C(seed)'
    found = anova_lm(ols(formula, means).fit(), typ=2)
    share = (found["sum_sq"] / found["sum_sq"].sum()).sort_values(ascending=False)
    rows = [
        (name.replace("C(", "").replace(")", "").replace(":", " x "), f"{own:.1%}")
        for name, own in share.items()
    ]
    return markdown(("due to", "share of the variance"), rows)


# -- figures --------------------------------------------------------------------------------------


def draw_returns(means: Any, table: Any) -> Any:
    """Draw the whole matrix: a panel per climate and exchange, a thin line per learner."""
    grid = seaborn.catplot(
        means, x="plants", y="return", hue="contender", row="climate", col="exchange", kind="point",
        palette=COLOURS, height=2.1, aspect=1.35, margin_titles=True, markersize=5, linewidth=1.6,
        err_kws={"linewidth": 1.2}, seed=0,
    )  # fmt: skip
    grid.set_titles(row_template="{row_name}", col_template="exchange: {col_name}")
    grid.set_axis_labels("plants", "return")
    names = [name for name in dict.fromkeys(table.contender) if name.startswith(tuple(SCHOOLS))]
    colours = {name: COLOURS[name.rstrip(NUMBER)] for name in names}
    for (climate, exchange), axes in grid.axes_dict.items():
        own = table[
            (table.climate == climate) & (table.exchange == exchange) & table.contender.isin(names)
        ]
        seaborn.pointplot(
            own, x="plants", y="return", hue="contender", palette=colours, errorbar=None,
            markers="", linewidth=0.8, alpha=0.6, legend=False, ax=axes,
        )  # fmt: skip
        axes.grid(axis="y", color="#e6e6e6", linewidth=0.7)
    place = sorted(set(means.plants)).index(HOME["plants"])
    grid.axes_dict[HOME["climate"], HOME["exchange"]].axvspan(
        place - 0.2, place + 0.2, color="#efe3d3", zorder=0
    )
    seaborn.move_legend(
        grid, "upper center", bbox_to_anchor=(0.45, 1.03), ncols=len(COLOURS), title=None
    )
    pyplot.close(grid.figure)  # saved, not shown
    return grid.figure


def draw_behind(means: Any) -> Any:
    """Draw the learners' distance to the planner on the same seeds, per row, with intervals."""
    rows = []
    for levels, own in means.groupby(list(FACTORS), sort=False):
        summary = Evaluation(own, "planned", 0.95).summary()
        for name in SCHOOLS:
            apart, low, high = summary.loc[
                name, ["difference", "difference_low", "difference_high"]
            ]
            rows.append((*levels, name, apart, f"{apart:+.0f} ({low:+.0f} to {high:+.0f})"))
    behind = DataFrame(rows, columns=[*FACTORS, "contender", "apart", "said"])
    figure = new_figure(9.5, 4.2)
    for axes, name in zip(figure.subplots(1, len(SCHOOLS), sharey=True), SCHOOLS, strict=True):
        cells = behind[behind.contender == name].pivot(
            index=["climate", "exchange"], columns="plants"
        )
        cells = cells.reindex(
            list(dict.fromkeys(zip(behind.climate, behind.exchange, strict=True)))
        )
        names = [", ".join(pair) for pair in cells.index]
        seaborn.heatmap(
            cells["apart"], annot=cells["said"], fmt="", vmin=-60, vmax=0, cmap="YlOrBr_r",
            linewidths=1.5, ax=axes, annot_kws={"fontsize": 8}, yticklabels=names, cbar=False,
        )  # fmt: skip
        axes.set_title(f"{name}, less planned", fontsize=10)
        axes.set_ylabel("")
        axes.tick_params(left=False, bottom=False, labelrotation=0)
    return figure


def draw_factors(means: Any) -> Any:
    """Draw each factor's effect on each contender: means over the other factors, seed by seed."""
    figure = new_figure(9.5, 3.2)
    for axes, factor in zip(figure.subplots(1, len(FACTORS), sharey=True), FACTORS, strict=True):
        by_seed = means.groupby([factor, "contender", "seed"], sort=False, as_index=False)[
            "return"
        ].mean()
        seaborn.pointplot(
            by_seed, x=factor, y="return", hue="contender", palette=COLOURS, markersize=5,
            linewidth=1.6, err_kws={"linewidth": 1.2}, seed=0, legend=False, ax=axes,
        )  # fmt: skip
        axes.grid(axis="y", color="#e6e6e6", linewidth=0.7)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(
        [Line2D([], [], color=colour, marker="o", markersize=5) for colour in COLOURS.values()],
        list(COLOURS), loc="outside upper center", ncols=len(COLOURS), frameon=False,
    )  # fmt: skip
    return figure


def show(table: Any, folder: Path) -> None:
    """Write all figures and tables to a folder, and print the tables.

    Args:
        table: The table that ``matrix.run`` returns.
        folder: The folder to write to; created if it is missing.
    """
    means = averaged(table)
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "compared": compared(means),
        "moved": moved(means),
        "shares": shares(means),
        "learners": learners(table),
    }
    for name, text in texts.items():
        (folder / f"matrix-{name}.md").write_text(text, encoding="utf-8")
        print(text)
    drawn = {
        "returns": draw_returns(means, table),
        "behind": draw_behind(means),
        "factors": draw_factors(means),
    }
    for name, figure in drawn.items():
        figure.savefig(folder / f"matrix-{name}.png", dpi=110, bbox_inches="tight")
