"""The cost of a branch beside the minimum for the same task, and the speed-up by two cores.

Times are wall-clock times, as branches are processes. On one core, they run one after another.
"""

from __future__ import annotations

import os
import pickle
import random
import time
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks.measure import Contender, Group, Row, timer, two_cores
from benchmarks.noop import Alone, Busy, Model
from simenv_marl import branch, reseed_generators, single_env

BRANCHES, STEPS = 20, 10
MANY = 64
"""The number of branches that are spread over two cores."""


class Chancy(Alone):
    """One agent, whose simulation has a generator."""

    def reset(self, seed: int | None = None) -> None:
        super().reset()
        self.random = random.Random(seed)

    def reseed(self, seed: int) -> None:
        reseed_generators(self, seed)


class Slow(Busy):
    """A simulation that takes 10 milliseconds per decision."""

    seconds = 10e-3


def groups(number: int) -> Iterator[Group]:
    """Yield the rows; the number of decisions does not matter, but a smoke test has few branches."""
    count, many = min(BRANCHES, number // 40), min(MANY, number // 40)
    env = single_env(Chancy, Model.left)
    env.reset(seed=0)
    least = milliseconds(lambda: [by_hand(env, number) for number in range(count)], count)
    ours = milliseconds(lambda: branch(env, some_steps, count, method="fork"), count)
    with_seeds = milliseconds(lambda: branch(env, some_steps, count, method="fork", seeds=range(count)), count)
    replay = milliseconds(lambda: branch(env, some_steps, count, method="replay"), count)
    what, hand = "a branch of ten steps", "os.fork and a pipe by hand"
    yield Group(
        [
            Row(f"{what} / {hand}", ours, least, 1.6, 1.3, unit="ms"),
            Row(f"{what}, with seeds / {hand}", with_seeds, least, unit="ms"),
            Row(f"{what}, replayed / {hand}", replay, least, unit="ms"),
        ]
    )
    env.close()
    env = single_env(Slow, Model.left)
    env.reset(seed=0)
    with two_cores():
        two = milliseconds(lambda: branch(env, one_step, many, method="fork"), many)

        def one() -> float:
            both = os.sched_getaffinity(0)
            os.sched_setaffinity(0, {min(both)})
            try:
                return two()
            finally:
                os.sched_setaffinity(0, both)

        yield Group(
            [Row("branches of 10 ms: two cores beside one", two, one, 1.7, 1.9, faster=True, unit="ms")], most=9
        )
    env.close()


def some_steps(env: Any, number: int) -> float:
    """Take the steps of a branch."""
    step, total = env.step, 0.0
    for _ in range(STEPS):
        total += step(0)[1]
    return total


def one_step(env: Any, number: int) -> float:
    """Take one step."""
    return float(env.step(0)[1])


def milliseconds(run: Callable[[], Any], number: int) -> Contender:
    """Make a contender of a number of branches: the milliseconds of each."""
    microseconds = timer(lambda number: run(), number, time.perf_counter)
    return lambda: microseconds() / 1e3


def by_hand(env: Any, number: int) -> Any:
    """Do the same in a process that is forked by hand and answers through a pipe."""
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        os.write(writing, pickle.dumps(some_steps(env, number)))
        os._exit(0)
    os.close(writing)
    answer = b""
    while chunk := os.read(reading, 1 << 16):
        answer += chunk
    os.close(reading)
    os.waitpid(process, 0)
    return pickle.loads(answer)
