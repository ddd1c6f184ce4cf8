"""The overhead of an experiment, the speed-up by workers, and the benefit of paired seeds.

Two workers are measured in a process pinned to two cores, if there are two.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from typing import Any

import numpy as np
from examples.greenhouse_coop.env import GreenhouseSim
from examples.greenhouse_coop.experiment.questions import BEST_CONSTANTS, FINAL
from examples.greenhouse_coop.train import VENTILATOR, Crew, learn
from tqdm import tqdm  # type: ignore[import-untyped]

from benchmarks.measure import Section, alone, now
from benchmarks.noop import Model
from simenv_marl import evaluate
from simenv_marl.experiments import design, run_experiment

ROWS = 10_000
WORK = 10e-3
"""The seconds of a run of the slow model."""

GENERATIONS = 15
"""The generations of training of the pair: half a minute."""


class Turn:
    """A simulation with a single decision, so that only the overhead remains."""

    points = (f"{Model.__module__}.Model.left",)

    def __init__(self, x: float = 0.0, n: int = 0) -> None:
        self.x, self.n = x, n

    def reset(self, seed: int) -> None:
        self.model = Model()

    def run(self) -> None:
        self.model.left()


class SlowTurn(Turn):
    """The same after some processor time of work."""

    def run(self) -> None:
        end = time.thread_time() + WORK
        while time.thread_time() < end:
            pass
        self.model.left()


def experiment(make: type, rows: int, workers: int) -> float:
    """Measure the seconds of a whole experiment: processor time for one process, else wall-clock time."""
    table = design({"x": (0.0, 1.0), "n": (1, 1000)}, "sobol", rows)
    clock = time.perf_counter if workers else now
    with tempfile.TemporaryDirectory() as folder:
        start = clock()
        run_experiment(make, table, seeds=[0], store=folder, metric=lambda turn: turn.x, workers=workers)
        return clock() - start


def wall(rows: int, workers: int) -> float:
    """Measure the same for the slow model, in wall-clock time."""
    table = design({"x": (0.0, 1.0), "n": (1, 1000)}, "sobol", rows)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        run_experiment(SlowTurn, table, seeds=[0], store=folder, workers=workers)
        return time.perf_counter() - start


def widths(generations: int) -> tuple[float, float]:
    """Measure the width of the interval of a difference, with paired and unpaired seeds."""
    with tqdm(disable=True) as bar, Crew(1, bar) as crew:
        trained = learn(crew.rate, BEST_CONSTANTS, generations, np.random.default_rng(0))
    contenders: dict[str, Any] = {"constants": BEST_CONSTANTS, "trained": trained}
    found = evaluate(
        GreenhouseSim, contenders, seeds=FINAL, baseline="constants", team=lambda returns: returns[VENTILATOR]
    )
    values = found.values()
    paired = found.summary().loc["trained", ["difference_low", "difference_high"]]
    generator, number = np.random.default_rng(0), len(values)
    draws = generator.integers(number, size=(2, 5000, number))
    apart = values["trained"].to_numpy()[draws[0]].mean(1) - values["constants"].to_numpy()[draws[1]].mean(1)
    low, high = np.quantile(apart, (0.025, 0.975))
    return float(paired.iloc[1] - paired.iloc[0]), float(high - low)


def measure(rounds: int, number: int) -> Section:
    """Measure experiments.

    Args:
        rounds: Not used, as the many rows of one round suffice.
        number: The maximum number of rows; a smoke test has few.
    """
    rows = min(ROWS, number)
    section = Section("Experiments", "milliseconds per run, seconds")
    experiment(Turn, min(rows, 200), 0)  # warm-up of imports and caches
    overhead = experiment(Turn, rows, 0) / rows * 1e3
    section.ratio(f"milliseconds per run beside the model, {rows:,} rows, one process", overhead, 1.0, 0.3, 3)
    section.time("a run beside its model, milliseconds", overhead)
    if (os.cpu_count() or 1) > 1:
        few = min(rows, 2000)
        one, two = alone("experiments", str(few), cores="0,1")
        section.ratio("a model of 10 ms: one process / two workers", one / two, 1.8, 1.95, at_least=True)
        section.time(f"{few} runs of 10 ms, one process, seconds", one)
        section.time(f"{few} runs of 10 ms, two workers, seconds", two)
    paired, unpaired = widths(GENERATIONS if rows == ROWS else 1)
    section.ratio("width of the interval of a difference, paired / unpaired, 32 seeds", paired / unpaired, 0.5, 0.33)
    return section


def main(rows: int) -> None:
    """Print the seconds of one process, and of two workers once they have started."""
    wall(16, 2)
    print(json.dumps([wall(rows, 0), wall(rows, 2)]))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
