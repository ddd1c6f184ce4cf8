"""The cost of a branch beside the minimum for the same task, and the speed-up by two cores.

Run it with ``make benchmark``, or alone with ``python -m benchmarks.core --only branches``. Times are wall-clock times,
as branches are processes. They run one after another on one core, except for those on two cores, which are measured in
a separate process.
"""

from __future__ import annotations

import json
import os
import pickle
import random
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.measure import Contender, Section, alone, ratio, side_by_side
from benchmarks.noop import Alone, Busy, Model
from simenv_marl import branch, reseed_generators, single_env

BRANCHES, STEPS = 20, 10

MANY, MILLISECONDS = 64, 10.0
"""The number of branches that are spread over two cores, and the milliseconds of each."""


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds."""
    section = Section("Branches", f"milliseconds per branch of {STEPS} steps")
    rounds = max(3, rounds)
    env = single_env(Chancy, Model.left)
    env.reset(seed=0)
    contenders: dict[str, Contender] = {
        "branch": timed_branches(lambda: branch(env, some_steps, BRANCHES, method="fork")),
        "a bare fork and a pipe": timed_branches(lambda: [bare(env, number) for number in range(BRANCHES)]),
        "branch, another future": timed_branches(
            lambda: branch(env, some_steps, BRANCHES, method="fork", seeds=range(BRANCHES))
        ),
        "branch, beside open files": timed_branches(lambda: beside_open_files(env)),
        "replay": timed_branches(lambda: branch(env, some_steps, BRANCHES, method="replay")),
    }
    with on({min(os.sched_getaffinity(0))}):
        times = side_by_side(contenders, rounds)
    least = "a bare fork and a pipe"
    ours = "a branch / a bare os.fork, a pipe and the steps themselves"
    section.ratio(ours, ratio(times, "branch", least), bar=1.6, aim=1.3)
    section.ratio("the same with seeds, another future in each", ratio(times, "branch, another future", least))
    section.ratio("the same with three files of 100 KiB open", ratio(times, "branch, beside open files", least))
    section.times(times)
    env.close()
    speedup, one, two = alone("branches", str(min(rounds, 9)), cores="0,1")
    section.ratio(
        f"{MANY} branches of {MILLISECONDS:g} ms of model each: one after the other / on two cores",
        speedup,
        bar=1.7,
        aim=1.9,
        at_least=True,
    )
    section.time(f"one after the other, {MILLISECONDS:g} ms each", one)
    section.time(f"on two cores, {MILLISECONDS:g} ms each", two)
    section.remarks.append("Branches on two cores are measured in a process that may use two, all else on one.")
    return section


class Chancy(Alone):
    """One agent, whose simulation has a generator."""

    def reset(self, seed: int | None = None) -> None:
        super().reset()
        self.random = random.Random(seed)

    def reseed(self, seed: int) -> None:
        reseed_generators(self, seed)


def some_steps(env: Any, number: int) -> float:
    """Take the steps of a branch."""
    step, total = env.step, 0.0
    for _ in range(STEPS):
        total += step(0)[1]
    return total


@contextmanager
def on(cores: set[int]) -> Iterator[None]:
    """Pin the process to some cores, which also sets the number of parallel branches."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def beside_open_files(env: Any) -> None:
    """Run branches while three files are open: for reading, for appending, and for reading and writing."""
    with TemporaryDirectory() as folder, ExitStack() as files:
        for mode in ("r", "a", "r+"):
            path = Path(folder, mode)
            path.write_bytes(bytes(100 << 10))
            files.enter_context(path.open(mode))
        branch(env, some_steps, BRANCHES, method="fork")


def timed_branches(run: Callable[[], Any], number: int = BRANCHES) -> Contender:
    """Make a contender of a number of branches."""

    def timed() -> float:
        start = time.perf_counter()
        run()
        return (time.perf_counter() - start) / number * 1e3

    return timed


def bare(env: Any, number: int) -> Any:
    """Do the same in a process that is forked by hand and answers through a pipe."""
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        os.write(writing, pickle.dumps(some_steps(env, number)))
        os._exit(0)
    os.close(writing)
    received = b""
    while chunk := os.read(reading, 1 << 16):
        received += chunk
    os.close(reading)
    os.waitpid(process, 0)
    return pickle.loads(received)


# -- in a separate process ------------------------------------------------------------------------


class Slow(Busy):
    """A simulation that takes ``MILLISECONDS`` per decision."""

    nanoseconds = int(MILLISECONDS * 1e6)


def cores(rounds: int) -> tuple[float, float, float]:
    """Measure the speed-up of branches by two cores, and the milliseconds on one and on two."""
    env = single_env(Slow, Model.left)
    env.reset(seed=0)
    both = os.sched_getaffinity(0)

    def run(cores: set[int]) -> None:
        with on(cores):
            branch(env, lambda twin, number: twin.step(0)[1], MANY, method="fork")

    contenders = {"one": timed_branches(lambda: run({min(both)}), MANY), "two": timed_branches(lambda: run(both), MANY)}
    times = side_by_side(contenders, rounds)
    return ratio(times, "one", "two"), *(sorted(values)[len(values) // 2] for values in times.values())


if __name__ == "__main__":
    print(json.dumps(cores(int(sys.argv[1]))))
