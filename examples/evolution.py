"""Evolution (CMA-ES) for several examples: it needs only the returns of a policy's weights."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Weights = NDArray[np.float64]


def evolve(
    rate: Callable[[Sequence[Weights]], NDArray[np.float64]],
    first: Weights,
    generations: int,
    rng: np.random.Generator,
    population: int,
    spread: float = 0.3,
) -> Weights:
    """Find weights with high returns.

    Args:
        rate: Returns the mean return of each candidate of a generation. It should play the same
            seeds for all of them, so that no candidate is chosen for its luck.
        first: ``(weights,)``: the initial weights.
        generations: The number of generations.
        rng: The source of all random numbers; ``rate`` may draw its seeds from it.
        population: The number of candidates per generation.
        spread: The standard deviation of the weights of the first generation.

    Returns:
        ``(weights,)``: the mean of the best weights found so far, over the last quarter of the
        generations. The best of a single generation varies with the seeds of that generation; this
        mean hardly does.
    """
    import cma  # imported here, because a process with many imports forks slowly

    options: dict[str, Any] = {"popsize": population, "verbose": -9, "verb_log": 0}
    # without these two options, CMA-ES would seed and use NumPy's global generator
    options |= {"seed": math.nan, "randn": lambda *shape: rng.standard_normal(shape)}
    evolution = cma.CMAEvolutionStrategy(first, spread, options)
    best = []
    for _ in range(generations):
        candidates = evolution.ask()
        evolution.tell(candidates, (-rate(candidates)).tolist())
        best.append(evolution.result.xfavorite)
    mean: Weights = np.mean(best[-max(1, generations // 4) :], axis=0)
    return mean
