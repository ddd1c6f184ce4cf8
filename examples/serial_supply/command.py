"""The command line that all recipes share."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from simenv_marl import simulate_many

from .env import OPTIMUM, OPTIONS, PERIODS, SerialSupply

Policies = Any
"""What ``simulate`` takes: a policy for each stage, or one for all."""

SEEDS = range(1_000_000, 1_000_200)
"""The seeds of evaluations. No training uses them."""


def cost(policies: Policies, seeds: range = SEEDS, **options: Any) -> float:
    """Return the mean cost of a period."""
    costs = simulate_many(
        SerialSupply, policies, seeds=seeds, collect=lambda chain: chain.cost, **OPTIONS, **options
    )
    return float(np.mean(costs)) / PERIODS


def command(train: Callable[[int, int], Policies], steps: int) -> None:
    """Train as the command line says, and print the cost of a period."""
    parser = argparse.ArgumentParser(description="Train, and print the cost of a period.")
    parser.add_argument("--seed", type=int, default=0, help="seed of the training")
    parser.add_argument("--steps", type=int, default=steps, help="default: %(default)s")
    parser.add_argument("--runs", type=int, default=50, help="number of evaluated episodes")
    options = parser.parse_args()
    torch.set_num_threads(1)
    begun = time.monotonic()
    policies = train(options.seed, options.steps)
    seconds = time.monotonic() - begun
    found = cost(policies, SEEDS[: options.runs])
    print(f"cost of a period: {found:.3f}, optimum: {OPTIMUM}, trained for {seconds:.0f} s")


if __name__ == "__main__":
    print(f"rule: {cost({}):.3f}")
