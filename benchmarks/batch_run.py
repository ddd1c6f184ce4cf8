"""A sweep of Mesa's wealth model with ``batch_run`` and ``run_experiment``: statements and seconds.

The sweep measures the final inequality, depending on the number of people and on the space: a mean
with its interval for each combination. The same seeds give the same numbers. A user would write the
functions ``by_...``, whose statements are counted.
"""

from __future__ import annotations

import ast
import gc
import inspect
import json
import sys
import time
from collections.abc import Iterator
from functools import partial
from itertools import chain, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

from joblib.externals.loky import get_reusable_executor
from mesa.agent import Agent
from mesa.batchrunner import batch_run
from mesa.examples.basic.boltzmann_wealth_model.model import BoltzmannWealth
from pandas import DataFrame

from benchmarks.measure import Contender, Group, MissingError, Row, now, two_cores
from simenv_marl import SteppedSimulation
from simenv_marl.experiments import design, run_experiment

FACTORS = {"n": [50, 100, 200], "width": [5, 10, 20]}
SEEDS = range(8)
STEPS = 100

ABLE = "n" in inspect.signature(BoltzmannWealth).parameters
"""Whether ``batch_run`` can run this model. It cannot in Mesa 3.5: the model takes a scenario."""


def interval(values: Any) -> Any:
    """Return half the width of a mean's interval."""
    return 1.96 * values.sem()


def by_batch_run(processes: int = 1) -> Any:
    parameters = {**FACTORS, "seed": SEEDS}
    runs = batch_run(
        BoltzmannWealth, parameters, processes, max_steps=STEPS, display_progress=False
    )
    table = DataFrame(runs).drop_duplicates("RunId")  # there is a row for each agent
    return table.groupby(["n", "width"])["Gini"].agg(["mean", interval])


def by_run_experiment(store: Path, workers: int = 0) -> Any:
    make = partial(SteppedSimulation, BoltzmannWealth, STEPS)
    metric = {"Gini": lambda wealth: wealth.model.compute_gini()}
    table = run_experiment(
        make, design(FACTORS), seeds=SEEDS, metric=metric, store=store, workers=workers
    )
    return table.groupby(["n", "width"])["Gini"].agg(["mean", interval])


def by_batch_run_resumed(store: Path) -> Any:
    store.touch()
    runs = [json.loads(line) for line in store.read_text().splitlines()]
    known = {(run["n"], run["width"], run["seed"]) for run in runs}
    with store.open("a") as file:
        for n, width, seed in product(*FACTORS.values(), SEEDS):
            if (n, width, seed) not in known:
                parameters = {"n": n, "width": width, "seed": seed}
                runs.append(
                    batch_run(BoltzmannWealth, parameters, max_steps=STEPS, display_progress=False)[
                        0
                    ]
                )
                print(json.dumps(runs[-1]), file=file, flush=True)
    return DataFrame(runs).groupby(["n", "width"])["Gini"].agg(["mean", interval])


# -- lines and seconds ----------------------------------------------------------------------------


def lines(*functions: Any) -> int:
    """Count the statements of functions, one a line however long they are, without docstrings."""
    parts = chain.from_iterable(
        ast.walk(ast.parse(inspect.getsource(function))) for function in functions
    )
    statements = [part for part in parts if isinstance(part, ast.stmt)]
    return sum(
        not (isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant))
        for part in statements
    )


def sweep(name: str, processes: int, *, start: bool = False) -> Contender:
    """Make a contender that measures the seconds of a sweep.

    The seconds are processor time for one process, and wall-clock time for several. With ``start``,
    joblib's workers of earlier sweeps are ended before, so that new ones have to start.
    """
    clock = now if processes == 1 else time.perf_counter

    def run() -> float:
        Agent._ids.clear()  # where Mesa's agents keep all earlier models alive
        gc.collect()
        if start:
            get_reusable_executor().shutdown(wait=True)
        with TemporaryDirectory() as folder:
            begin = clock()
            if name == "batch_run":
                by_batch_run(processes)
            else:
                by_run_experiment(Path(folder), 0 if processes == 1 else processes)
            return clock() - begin

    return run


def groups(number: int) -> Iterator[Group]:
    """Yield the rows; the number of decisions does not matter, but a smoke test has one seed."""
    ours, theirs, resumable = map(lines, (by_run_experiment, by_batch_run, by_batch_run_resumed))
    what = "run_experiment / batch_run"
    yield Group(
        [
            Row(f"{what}, lines", lambda: ours, lambda: theirs, 1.0, unit="lines"),
            Row(
                f"{what}, lines, where a kill loses one run",
                lambda: ours,
                lambda: resumable,
                1.0,
                unit="lines",
            ),
        ],
        most=1,
    )
    if not ABLE:
        raise MissingError("a version of Mesa whose batch_run can run its model of wealth")

    def seconds(title: str, processes: int, *, start: bool = False) -> Group:
        ours, theirs = (
            sweep(name, processes, start=start) for name in ("run_experiment", "batch_run")
        )
        return Group([Row(f"{what}, {title}", ours, theirs, 1.0, unit="s")], most=11)

    with patch.object(sys.modules[__name__], "SEEDS", SEEDS[: number // 200]):
        yield seconds("one process", 1)
        with two_cores():
            yield seconds("two processes, first sweep", 2, start=True)
            yield seconds("two processes, next sweep", 2)
