"""The speed-up by policies that answer many simulations at once, and by two worker processes."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.hand_written import ACTION_SPACE, OBSERVATION_SPACE
from benchmarks.measure import Contender, Group, MissingError, Row, timer, two_cores
from benchmarks.noop import Model, Turns, work
from simenv_marl import simulate, simulate_many

SIMULATIONS, DECISIONS = 1_000, 100
FEW = 128
"""A number of simulations that fit into the processor's cache."""


class Asking(Turns):
    """A simulation that only makes decisions, so that only the overhead remains."""

    def run(self) -> None:
        for _ in range(DECISIONS):
            self.model.left()


class Slow(Turns):
    """Fewer decisions, with 100 microseconds of work after each."""

    def run(self) -> None:
        for _ in range(DECISIONS // 10):
            self.model.left()
            work(100e-6)


async def wait(observation: Any) -> int:
    """Answer like a service that takes its time."""
    await asyncio.sleep(0.05)
    return 0


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with one simulation for 20 decisions in a round, at most a thousand."""
    number = min(SIMULATIONS, number // 20)
    network = {Model.left: network_policy()}
    waiting = at_once(
        Slow,
        {Model.left: wait},
        min(200, number),
        DECISIONS // 10,
        time.perf_counter,
        concurrency=50,
    )
    least = 50e3 / 50  # microseconds for each decision
    yield Group(
        [Row("coroutines of 50 ms, 50 at once / their time", waiting, lambda: least, 1.3, 1.2)],
        most=1,
    )

    def simulate_each(number: int) -> None:
        for seed in range(number):
            simulate(Asking, network, seed=seed)

    one_by_one = per_decision(simulate_each, max(number // 10, 1), DECISIONS)
    all_at_once, few_at_once = (
        at_once(Asking, network, number, batch_size=size) for size in (SIMULATIONS, FEW)
    )
    beside = "at once beside one by one, MLP 64x64 in NumPy"
    yield Group(
        [
            Row(f"{SIMULATIONS:,} {beside}", all_at_once, one_by_one, 3.5, 4.5, faster=True),
            Row(f"{FEW} {beside}", few_at_once, one_by_one, faster=True),
        ],
        most=7,
    )
    try:
        import joblib  # noqa: F401
    except ImportError:
        raise MissingError("joblib") from None
    with two_cores():
        zeros = {Model.left: lambda observations: np.zeros(len(observations), np.int64)}
        few, clock = DECISIONS // 10, time.perf_counter
        two, one = (at_once(Slow, zeros, number, few, clock, workers=workers) for workers in (2, 0))
        row = Row(
            "100 µs per decision: two workers beside one process", two, one, 1.7, 1.9, faster=True
        )
        yield Group([row], most=7)


def network_policy() -> Callable[[Any], Any]:
    """Draw a network with two hidden layers of 64, which decides for one observation or a batch."""
    generator = np.random.default_rng(0)
    sizes = (OBSERVATION_SPACE.shape[0], 64, 64, int(ACTION_SPACE.n))
    weights = [generator.normal(0, n**-0.5, (n, m)).astype(np.float32) for n, m in pairwise(sizes)]

    def policy(observations: Any) -> Any:
        hidden = np.tanh(observations @ weights[0])
        return (np.tanh(hidden @ weights[1]) @ weights[2]).argmax(-1)

    return policy


def at_once(
    make: type, policies: Any, number: int, decisions: int = DECISIONS, *clock: Any, **options: Any
) -> Contender:
    """Make a contender of ``simulate_many``, which keeps nothing of the simulations."""

    def run(number: int) -> None:
        simulate_many(make, policies, seeds=range(number), collect=_nothing, **options)

    return per_decision(run, number, decisions, *clock)


def per_decision(run: Callable[[int], None], number: int, decisions: int, *clock: Any) -> Contender:
    """Make a contender of a number of simulations: the time of each decision."""
    per_simulation = timer(run, number, *clock)
    return lambda: per_simulation() / decisions


def _nothing(simulation: Any) -> None:
    """Return nothing of a simulation; a function that workers can import."""
