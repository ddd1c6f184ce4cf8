"""Train all learners, and compare their costs with the rule's and with the exact optimum.

``python -m examples.serial_supply.table`` trains each learner five times, and evaluates all on the
same 200 seeds. It writes ``out/table.csv`` and ``out/gains.csv`` beside this file, and
``docs/figures/serial-supply.png``. Policies and finished episodes stay in ``out``: run again, it
does what is missing. It needs the extra ``clients``, and an hour and a half on one core.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cloudpickle
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from scipy import stats

from simenv_marl.experiments import run_experiment

from .command import SEEDS, Policies
from .env import OPTIMUM, OPTIONS, PERIODS, SerialSupply, base_stocks, profit

OUT: Final = Path(__file__).parent / "out"
FIGURE: Final = Path(__file__).parents[2] / "docs" / "figures" / "serial-supply.png"

LEARNERS: Final = {
    "selfish": "selfish",
    "independent": "independent",
    "central": "torchrl_mappo",
    "turn": "sb3_turn",
}
"""The module of each learner, in this folder."""

COMPARED: Final = (
    ("selfish", "independent", "the team's reward, with independent learners"),
    ("selfish", "central", "the team's reward and a central critic"),
    ("independent", "central", "a central critic"),
    ("central", "turn", "one policy that decides in turn"),
)
"""Pairs of learners, and what the second one adds."""


def trained(name: str, seed: int, folder: Path, steps: int | None = None) -> Policies:
    """Return the policies of a training. Train only if the folder does not have them."""
    path = folder / f"{name}-{seed}.pkl"
    if not path.exists():
        recipe = importlib.import_module(f".{LEARNERS[name]}", __package__)
        begun = cpu_seconds()
        policies = recipe.train(seed, recipe.STEPS if steps is None else steps)
        spent = round(cpu_seconds() - begun)
        path.with_suffix(".json").write_text(json.dumps({"cpu seconds": spent}))
        unfinished = path.with_suffix(".unfinished")
        unfinished.write_bytes(cloudpickle.dumps(policies))
        unfinished.replace(path)
    return cloudpickle.loads(path.read_bytes())


def cpu_seconds() -> float:
    """Return the processor time of this process and of those that it has started and ended."""
    return sum(os.times()[:4])


def costs_of(contenders: dict[str, Policies], seeds: Sequence[int], store: Path) -> pd.DataFrame:
    """Return the mean cost of a period, a row for each seed and a column for each contender."""
    found = run_experiment(
        SerialSupply,
        [{}],
        contenders=contenders,
        seeds=seeds,
        metric={"cost": lambda chain: chain.cost / PERIODS},
        batched=True,
        batch_size=50,
        store=store,
        team_reward=profit,
        **OPTIONS,
    )
    rows = found[found.agent == "team"]
    return rows.pivot(index="seed", columns="contender", values="cost")


def interval(values: Any) -> tuple[float, float]:
    """Return the bounds of the mean, by Student's t, with a confidence of 95 %."""
    if len(values) < 2:
        return (np.nan, np.nan)
    half = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    return (float(np.mean(values) - half), float(np.mean(values) + half))


def summary(costs: pd.DataFrame, trainings: int, folder: Path) -> pd.DataFrame:
    """Return a row for each way to decide.

    The intervals of learners are those of the mean over trainings, those of the rule and the
    optimal base stocks of the mean over seeds.
    """
    rows = []
    for name in ("rule", *LEARNERS, "optimum"):
        if name in LEARNERS:
            runs = [f"{name}-{seed}" for seed in range(trainings)]
            values = costs[runs].mean().to_numpy()
            spent = [
                json.loads((folder / f"{run}.json").read_text())["cpu seconds"] for run in runs
            ]
        else:
            values, spent = costs[name].to_numpy(), [0]
        low, high = interval(values)
        middle = float(np.median(values) if name in LEARNERS else np.mean(values))
        rows.append(
            {
                "name": name,
                "cost": middle,
                "mean": float(np.mean(values)),
                "low": low,
                "high": high,
                "above optimum, %": 100 * (middle / OPTIMUM - 1),
                "cpu seconds": max(spent),
            }
        )
    return pd.DataFrame(rows).set_index("name")


def gains(costs: pd.DataFrame, trainings: int) -> pd.DataFrame:
    """Return what each change is worth: the cost per period that it saves, paired by seeds."""
    rows = []
    for before, after, change in COMPARED:
        saved = [
            float((costs[f"{before}-{seed}"] - costs[f"{after}-{seed}"]).mean())
            for seed in range(trainings)
        ]
        low, high = interval(saved)
        rows.append({"change": change, "saves": float(np.mean(saved)), "low": low, "high": high})
    return pd.DataFrame(rows).set_index("change")


def draw(costs: pd.DataFrame, trainings: int, path: Path) -> None:
    """Draw each training as a dot, and the rule and the optimum as lines."""
    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.add_subplot()
    for row, name in enumerate(LEARNERS):
        values = costs[[f"{name}-{seed}" for seed in range(trainings)]].mean()
        axes.plot(values, np.full(len(values), row), "o", color="#1b6f5f", alpha=0.6)
    for cost, color, text in (
        (costs["rule"].mean(), "#4d4d4d", "rule"),
        (OPTIMUM, "#d1812c", "exact optimum"),
    ):
        axes.axvline(cost, color=color, linestyle="--", label=text)
    axes.set_xscale("log")
    axes.set_yticks(range(len(LEARNERS)), list(LEARNERS))
    axes.set_xlabel("cost of a period")
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, evaluate, and write the table and the figure."""
    parser = argparse.ArgumentParser(description="Compare all learners with the optimum.")
    parser.add_argument("--trainings", type=int, default=5, help="default: %(default)s")
    parser.add_argument("--runs", type=int, default=len(SEEDS), help="default: %(default)s")
    parser.add_argument("--steps", type=int, help="steps of each training (default: the recipe's)")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--figure", type=Path, default=FIGURE)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    contenders: dict[str, Policies] = {"rule": {}, "optimum": base_stocks()}
    for seed in range(options.trainings):
        for name in LEARNERS:
            contenders[f"{name}-{seed}"] = trained(name, seed, options.out, options.steps)
    costs = costs_of(contenders, SEEDS[: options.runs], options.out / "episodes")
    costs.to_csv(options.out / "costs.csv")
    table = summary(costs, options.trainings, options.out)
    saved = gains(costs, options.trainings)
    table.to_csv(options.out / "table.csv", float_format="%.3f")
    saved.to_csv(options.out / "gains.csv", float_format="%.3f")
    draw(costs, options.trainings, options.figure)
    print(table.round(2).to_string(), saved.round(2).to_string(), sep="\n\n")


if __name__ == "__main__":
    main()
