"""Figures and tables of the pension study, from its tables of runs and its trained policies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import seaborn
from examples.fin_base.env import INDEXATIONS, MIXES, OBSERVED, OF_A_CLIENT, SURCHARGES
from examples.fin_base.law import INDEXING, MINIMUM, REQUIRED
from examples.fin_base.train import HELD_OUT, USUAL, Policies
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from pandas import DataFrame

from simenv_marl import simulate
from simenv_marl.experiments import Evaluation, effects

from ..report import markdown, new_figure
from .study import CLIENTS, FACTORS, HOME, INDEXER, LARGE, MANAGER, POINTS, PREMIUM

COLOURS: Final = {
    "rule": "#8c8c8c",
    "constant pair": "#d1812c",
    "constant premium": "#e3b778",
    "trained pair": "#1b6f5f",
    "trained premiums": "#7fb3d3",
    "both trained": "#2b4c7e",
    "planned": "#9c4f96",
}

DRAWN: Final = 64
"""The number of funds in the figures over years."""


# -- tables ---------------------------------------------------------------------------------------


def compared(table: Any) -> str:
    """Tabulate contenders' welfare in one world, their gain on the rule, the funds' outcomes."""
    summary = _against_rule(table).summary("welfare")
    others = table.groupby("contender")[["right", "coverage", "premium", "short", "cuts"]].mean()
    rows = []
    for name, found in summary.iterrows():
        own = others.loc[name]
        better = "" if name == "rule" else _difference(found, "+.1f")
        told = (
            f"{own.right:.1%}",
            f"{own.coverage:.0%}",
            f"{own.premium:.1%}",
            f"{own.short:.1f}",
            f"{own.cuts:.1f}",
        )
        rows.append((name, f"{found['mean']:.0f}", better, *told))
    outcomes = ("purchasing power", "coverage", "premium", "years short", "years with cuts")
    return markdown(("policy", "welfare", "gain over the rule", *outcomes), rows)


def in_worlds(table: Any) -> dict[str, Any]:
    """Summarise the welfare of the contenders in each world, compared with the rule."""
    worlds = table.groupby(list(FACTORS), sort=False)
    return {", ".join(levels): _against_rule(own).summary("welfare") for levels, own in worlds}


def everywhere(worlds: Mapping[str, Any]) -> str:
    """Tabulate how much better than the rule each contender is, in each world of ``in_worlds``."""
    rows = []
    for levels, summary in worlds.items():
        differences = [
            _difference(found, "+.0f") for name, found in summary.iterrows() if name != "rule"
        ]
        rows.append((levels, f"{summary.loc['rule', 'mean']:.0f}", *differences))
    names = next(iter(worlds.values())).index.drop("rule")
    return markdown((", ".join(FACTORS), "rule", *names), rows)


def moved(table: Any) -> str:
    """Tabulate the effect of each factor on the mean welfare of each contender."""
    rows = []
    for name in dict.fromkeys(table.contender):
        found = (
            effects(table, metric="welfare", contender=name)
            .main["mean"]
            .groupby("factor", sort=False)
        )
        rows.append((name, *(f"{own.iloc[1] - own.iloc[0]:+.0f}" for _, own in found)))
    return markdown(
        ("policy", *(f"{factor}: {levels[1]}" for factor, levels in FACTORS.items())), rows
    )


def sizes(at_home: Any, large: Any) -> str:
    """Tabulate the contenders' gain on the rule in small and large funds, on the same seeds."""
    few = at_home[at_home.seed.isin(set(large.seed)) & at_home.contender.isin(set(large.contender))]
    small, big = (_against_rule(own).summary("welfare") for own in (few, large))
    rows = [
        (name, *(_difference(own.loc[name], "+.0f") for own in (small, big)))
        for name in big.index[1:]
    ]
    return markdown(
        (f"{len(set(large.seed))} seeds", f"{CLIENTS} clients", f"{LARGE:,} clients"), rows
    )


def _against_rule(table: Any) -> Evaluation:
    order = {name: number for number, name in enumerate(COLOURS)}
    return Evaluation(
        table.sort_values("contender", key=lambda names: names.map(order), kind="stable"),
        "rule",
        0.95,
    )


def _difference(found: Any, form: str) -> str:
    low, high = found["difference_low"], found["difference_high"]
    return f"{found['difference']:{form}} ({low:{form}} to {high:{form}})"


# -- figures --------------------------------------------------------------------------------------


def draw_worlds(worlds: Mapping[str, Any]) -> Figure:
    """Draw each contender's gain on the rule in each world of ``in_worlds``, with intervals."""
    without_rule = {levels: summary.drop("rule") for levels, summary in worlds.items()}
    better = DataFrame({levels: own["difference"] for levels, own in without_rule.items()}).T
    told = DataFrame(
        {
            levels: own.apply(_difference, axis=1, form="+.0f")
            for levels, own in without_rule.items()
        }
    ).T
    figure = new_figure(11, 4.2)
    axes = figure.subplots()
    most = float(np.nanmax(abs(better.to_numpy())))
    seaborn.heatmap(
        better, annot=told, fmt="", vmin=-most, vmax=most, cmap="BrBG", linewidths=1.5, ax=axes,
        cbar=False, annot_kws={"fontsize": 8},
    )  # fmt: skip
    axes.set(
        xlabel="",
        ylabel=", ".join(FACTORS),
        title="gain over the rule, in per cent of a year's income",
    )
    axes.tick_params(left=False, bottom=False, labelrotation=0)
    return figure


def draw_learned(found: Mapping[str, Policies]) -> Figure:
    """Draw the trained policies' decisions and the rules', with other observations typical."""
    figure = new_figure(11, 3.4)
    mix, by, premium = figure.subplots(1, 3)
    coverage = np.linspace(0.8, 1.8, 101)
    pair, shared = found["trained pair"], found["trained premiums"][PREMIUM]
    observed = np.tile(USUAL[: len(OBSERVED)], (len(coverage), 1))
    observed[:, 0] = observed[:, 1] = coverage
    for axes, who, levels, rule in (
        (mix, MANAGER, MIXES, np.where(coverage >= 1, 0.4, 0.3)),
        (by, INDEXER, INDEXATIONS, np.clip((coverage - INDEXING) / 0.2, 0, 1)),
    ):
        chosen = [levels[round(pair[who].share(own) * (len(levels) - 1))] for own in observed]
        axes.plot(coverage, rule, color=COLOURS["rule"], label="rule")
        axes.plot(coverage, chosen, color=COLOURS["trained pair"], label="trained pair")
        axes.xaxis.set_major_formatter(PercentFormatter(1))
        axes.yaxis.set_major_formatter(PercentFormatter(1))
        axes.set(xlabel="coverage", ylim=(-0.03, 1.03))
    mix.axvspan(0.8, MINIMUM, color="#f3e3e3", lw=0)
    by.axvspan(0.8, INDEXING, color="#f3e3e3", lw=0)
    mix.set_title("share of equities (red: no increase allowed)", fontsize=9)
    by.set_title("share of full indexation (red: none allowed)", fontsize=9)
    ages = np.arange(25, 67)
    for of, style in ((1.0, ":"), (1.2, "-"), (1.5, "--")):
        asked = [_surcharge(shared, int(age), of) for age in ages]
        premium.plot(
            ages, asked, style, color=COLOURS["trained premiums"], label=f"coverage {of:.0%}"
        )
    premium.axhline(1.05, color=COLOURS["rule"])
    premium.set_title("premium, divided by the cost of the accrual", fontsize=9)
    premium.set(xlabel="age")
    mix.legend(fontsize=8, frameon=False)
    premium.legend(fontsize=8, frameon=False, loc=(0.3, 0.1))
    for axes in (mix, by, premium):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _surcharge(policy: Any, age: int, coverage: float) -> float:
    """Compute the surcharge of a policy for a client of an age who is otherwise typical."""
    observed = USUAL.copy()
    names = (*OBSERVED, *OF_A_CLIENT)
    observed[0] = observed[1] = coverage
    observed[names.index("age / 100 years")] = age / 100
    observed[names.index("rights / wage")] = 0.0175 * (age - 25)
    # the cost of an accrual is discounted by the years until retirement, at 2.5 % a year; from 67
    # on it is 14 pensions
    observed[names.index("cost of the standard accrual / wage")] = 0.0175 * 14 * 1.025 ** (age - 67)
    lowest = SURCHARGES[0] if coverage >= REQUIRED else 1.0
    return max(SURCHARGES[round(policy.share(observed) * (len(SURCHARGES) - 1))], lowest)


def draw_years(found: Mapping[str, Policies], home: Callable[[], Any], seeds: int) -> Figure:
    """Draw rights and coverage over the years: the median, and the 10 % to 90 % quantiles."""
    figure = new_figure(9.5, 3.4)
    rights, coverages = figure.subplots(1, 2)
    for name, policies in (("rule", {}), ("trained pair", found["trained pair"])):
        funds = [
            simulate(home(), policies, seed=HELD_OUT + seed, points=POINTS) for seed in range(seeds)
        ]
        for axes, of in ((rights, "right"), (coverages, "coverage")):
            # a fund that could not pay all pensions ended early; its later years count as 0
            values = np.zeros((seeds, funds[0].years))
            for row, fund in zip(values, funds, strict=True):
                row[: len(fund.account.years)] = [getattr(year, of) for year in fund.account.years]
            low, middle, high = np.quantile(values, (0.1, 0.5, 0.9), axis=0)
            years = range(1, len(middle) + 1)
            axes.fill_between(years, low, high, color=COLOURS[name], alpha=0.2, lw=0)
            axes.plot(years, middle, color=COLOURS[name], label=name)
    rights.set_title("purchasing power of a right from the first month", fontsize=9)
    coverages.set_title("coverage", fontsize=9)
    for axes in (rights, coverages):
        axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        axes.set_xlabel("year")
        axes.set_xticks(range(0, funds[0].years + 1, 5))
        axes.grid(axis="y", color="#e6e6e6", linewidth=0.7)
        axes.spines[["top", "right"]].set_visible(False)
    rights.legend(fontsize=8, frameon=False)
    return figure


def show(
    table: Any, large: Any, found: Mapping[str, Policies], home: Callable[[], Any], folder: Path
) -> None:
    """Write all figures and tables to a folder, and print the tables.

    Args:
        table: The table of runs in all worlds.
        large: The table of runs with 10,000 clients, or None.
        found: The constant and trained policies, by name.
        home: Makes a fund of the world in which policies learn.
        folder: The folder to write to; created if it is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    at_home = table[(table[list(HOME)] == list(HOME.values())).all(axis=1)]
    worlds = in_worlds(table)
    texts = {"compared": compared(at_home), "worlds": everywhere(worlds), "moved": moved(table)}
    if large is not None:
        texts["sizes"] = sizes(at_home, large)
    for name, text in texts.items():
        (folder / f"pension-{name}.md").write_text(text, encoding="utf-8")
        print(text)
    few = len(at_home[at_home.contender == "rule"]) < 16
    drawn = {
        "worlds": draw_worlds(worlds),
        "learned": draw_learned(found),
        "years": draw_years(found, home, 4 if few else DRAWN),
    }
    for name, figure in drawn.items():
        figure.savefig(folder / f"pension-{name}.png", dpi=110, bbox_inches="tight")
