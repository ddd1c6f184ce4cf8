"""A sweep of Mesa's wealth model, with Mesa's ``batch_run`` and with ``run_experiment``: lines of code, and seconds.

The sweep measures the final inequality, depending on the number of people and on the space: a mean with its interval
for each combination. The same seeds give the same numbers. A user would write the functions ``by_...``, whose lines are
counted. Two processes are measured only if this is not pinned to one core: ``python -m benchmarks.core --only
batch_run``.
"""

from __future__ import annotations

import gc
import inspect
import json
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from joblib import cpu_count  # type: ignore[import-untyped]
from mesa.agent import Agent
from mesa.batchrunner import batch_run
from mesa.examples.basic.boltzmann_wealth_model.model import BoltzmannWealth
from pandas import DataFrame

from benchmarks.measure import Contender, Section, alone, now, ratio, side_by_side
from simenv_marl import SteppedSimulation
from simenv_marl.experiments import design, run_experiment

FACTORS = {"n": [50, 100, 200], "width": [5, 10, 20]}
SEEDS = range(8)
STEPS = 100

ABLE = "n" in inspect.signature(BoltzmannWealth).parameters
"""Whether ``batch_run`` can run this model: it cannot in Mesa 3.5, where the model takes a scenario."""

ROUNDS = 11


def interval(values: Any) -> Any:
    """Return half the width of a mean's interval."""
    return 1.96 * values.sem()


def by_batch_run(processes: int = 1) -> Any:
    parameters = {**FACTORS, "seed": SEEDS}
    runs = batch_run(BoltzmannWealth, parameters, processes, max_steps=STEPS, display_progress=False)
    table = DataFrame(runs).drop_duplicates("RunId")  # there is a row for each agent
    return table.groupby(["n", "width"])["Gini"].agg(["mean", interval])


def by_run_experiment(store: Path, workers: int = 0) -> Any:
    make, gini = partial(SteppedSimulation, BoltzmannWealth, STEPS), lambda wealth: wealth.model.compute_gini()
    table = run_experiment(make, design(FACTORS), seeds=SEEDS, metric={"Gini": gini}, store=store, workers=workers)
    return table.groupby(["n", "width"])["Gini"].agg(["mean", interval])


def by_batch_run_resumed(store: Path) -> Any:
    store.touch()
    runs = [json.loads(line) for line in store.read_text().splitlines()]
    known = {(run["n"], run["width"], run["seed"]) for run in runs}
    with store.open("a") as file:
        for n, width, seed in product(*FACTORS.values(), SEEDS):
            if (n, width, seed) not in known:
                parameters = {"n": n, "width": width, "seed": seed}
                runs.append(batch_run(BoltzmannWealth, parameters, max_steps=STEPS, display_progress=False)[0])
                print(json.dumps(runs[-1]), file=file, flush=True)
    return DataFrame(runs).groupby(["n", "width"])["Gini"].agg(["mean", interval])


# -- lines and seconds ----------------------------------------------------------------------------


def lines(*written: Any) -> int:
    """Count the lines of functions, without empty ones."""
    return sum(bool(line.strip()) for thing in written for line in inspect.getsource(thing).splitlines())


def stored(processes: int = 1) -> Any:
    """Run the sweep with ``run_experiment``, in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        return by_run_experiment(Path(folder), 0 if processes == 1 else processes)


WAYS: dict[str, Callable[[int], Any]] = {"batch_run": by_batch_run, "run_experiment": stored}


def taken(way: Callable[[int], Any], processes: int) -> Contender:
    """Make a contender: the seconds of a sweep, of the processor for one process, else of the wall clock."""
    clock = now if processes == 1 else time.perf_counter

    def run() -> float:
        Agent._ids.clear()  # where Mesa's agents keep all earlier models alive
        gc.collect()
        start = clock()
        way(processes)
        return clock() - start

    return run


def in_a_new_process(name: str) -> Contender:
    """Make a contender: the seconds of two workers, started from a new process."""
    return lambda: float(alone("batch_run", name))


def measure(rounds: int, number: int) -> Section:
    """Compare both ways.

    Args:
        rounds: The maximum number of rounds.
        number: Not used.
    """
    section, rounds = Section("A sweep of Mesa's model of wealth", "seconds"), min(rounds, ROUNDS)
    ours, theirs = lines(by_run_experiment), lines(by_batch_run)
    section.ratio("lines: run_experiment / batch_run", ours / theirs, 1.0)
    section.ratio("lines, where a kill loses one run", ours / lines(by_batch_run_resumed), 1.0)
    if not ABLE:
        section.remarks.append("A sweep: this version of Mesa's batch_run cannot run its model of wealth.")
        return section
    kinds = {"one process": {name: taken(way, 1) for name, way in WAYS.items()}}
    if cpu_count() > 1:
        kinds["two processes, the first sweep of a script"] = {name: in_a_new_process(name) for name in WAYS}
        kinds["two processes, the next"] = {name: taken(way, 2) for name, way in WAYS.items()}
    for title, contenders in kinds.items():
        times = side_by_side(contenders, rounds)
        section.ratio(f"seconds, {title}: run_experiment / batch_run", ratio(times, "run_experiment", "batch_run"), 1.0)
        section.times({f"{name}, {title}": found for name, found in times.items()})
    return section


def main() -> None:
    """Run one way in two processes, and print its seconds."""
    print(taken(WAYS[sys.argv[1]], 2)())


if __name__ == "__main__":
    main()
