"""The overhead of an experiment, and the speed-up by workers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from tempfile import TemporaryDirectory

from benchmarks.measure import Contender, Group, Row, now, two_cores
from benchmarks.noop import Model, work
from simenv_marl.experiments import design, run_experiment

ROWS, FEW = 10_000, 2_000


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
    """The same after ten milliseconds of work."""

    def run(self) -> None:
        work(10e-3)
        self.model.left()


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with at most as many runs as there are decisions in a round."""
    one_turn, name = (
        experiment(Turn, min(ROWS, number), now),
        f"a run beside its model, of {ROWS:,}",
    )
    yield Group([Row(name, one_turn, None, 1.0, 0.3, unit="ms")], most=1)
    with two_cores():
        few = min(FEW, number // 10)
        two, one = (experiment(SlowTurn, few, time.perf_counter, workers) for workers in (2, 0))
        row = Row(
            "runs of 10 ms: two workers beside one process",
            two,
            one,
            1.8,
            1.95,
            faster=True,
            unit="ms",
        )
        yield Group([row], most=1)


def experiment(make: type, rows: int, clock: Callable[[], float], workers: int = 0) -> Contender:
    """Make a contender of a whole experiment: the milliseconds of each run."""
    table = design({"x": (0.0, 1.0), "n": (1, 1000)}, "halton", rows)

    def run() -> float:
        with TemporaryDirectory() as folder:
            start = clock()
            run_experiment(
                make, table, seeds=[0], store=folder, metric=lambda turn: turn.x, workers=workers
            )
            return (clock() - start) / rows * 1e3

    return run
