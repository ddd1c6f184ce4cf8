"""Simulations suspended side by side, beside one thread or process for each; their memory; the speed-up by workers.

Run it with ``make benchmark``, or alone with ``python -m benchmarks.core --only suspended``. Memory and the scaling
over two cores are measured in separate processes, the latter in one pinned to two cores.
"""

from __future__ import annotations

import gc
import json
import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv

from benchmarks.hand_written import TemplateEnv
from benchmarks.measure import Section, alone, ratio, side_by_side
from benchmarks.noop import Busy, Model
from benchmarks.vector import ours, steps
from simenv_marl import vector_env

MICROSECONDS = 100.0
"""The duration of a decision of the simulation that is spread over two cores."""


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, with a number of decisions of each contender."""
    section = Section("Suspended simulations", "microseconds per simulation and step")
    rounds = max(3, rounds // 3)
    _beside_threads(section, rounds, number)
    _beside_processes(section, rounds, number)
    section.ratio("KiB of memory for each of 10,000 suspended simulations", alone("suspended", "memory"), bar=10, aim=9)
    speedup, one, two = alone("suspended", "cores", str(min(rounds, 9)), cores="0,1")
    section.ratio(
        f"two workers on two cores: steps per second / one process, {MICROSECONDS:g} us per decision",
        speedup,
        bar=1.7,
        aim=1.9,
        at_least=True,
    )
    section.time(f"one process, 64 simulations of {MICROSECONDS:g} us", one)
    section.time(f"two workers on two cores, 64 simulations of {MICROSECONDS:g} us", two)
    section.remarks.append(
        "The scaling over two workers is measured in a process pinned to two cores, all else to one."
    )
    return section


def _beside_threads(section: Section, rounds: int, number: int) -> None:
    """Compare our vector environment with one thread per simulation."""
    size = 64
    threads, alone = Threads(size), ours(size)
    contenders = {
        "vector_env, 64, beside threads": steps(alone, size, number),
        "a thread with queues for each, 64": steps(threads, size, number // 10),
    }
    times = side_by_side(contenders, rounds)
    section.ratio(
        "64 simulations: a thread with queues for each / ours",
        ratio(times, *reversed(contenders)),
        bar=11,
        aim=20,
        at_least=True,
    )
    section.times(times)
    threads.close()
    alone.close()


def _beside_processes(section: Section, rounds: int, number: int) -> None:
    """Compare our vector environment with one process per simulation."""
    few = 4
    processes, in_workers, alone = AsyncVectorEnv([TemplateEnv] * few), ours(few, workers=2), ours(few)
    contenders = {
        "vector_env, 4, beside processes": steps(alone, few, number, time.perf_counter),
        "vector_env, 4, in two workers": steps(in_workers, few, number // 20, time.perf_counter),
        "AsyncVectorEnv, by hand, 4": steps(processes, few, number // 20, time.perf_counter),
    }
    times = side_by_side(contenders, rounds)
    section.ratio("4 simulations: ours in two workers / AsyncVectorEnv", ratio(times, *list(contenders)[1:]))
    section.times(times)
    for env in (processes, in_workers, alone):
        env.close()


class Threads:
    """One thread per simulation, which alternates with its user as in RLlib's ExternalEnv.

    Each thread has a queue for observations and one for actions. All threads share a condition, which they notify after
    each observation.
    """

    def __init__(self, number: int) -> None:
        self.told = threading.Condition()
        self.queues: list[Any] = [(queue.Queue(), queue.Queue()) for _ in range(number)]
        self.threads = [threading.Thread(target=self._run, args=pair, daemon=True) for pair in self.queues]

    def _run(self, observed: queue.Queue[Any], decided: queue.Queue[Any]) -> None:
        model, reward = Model(), 0.0
        while True:
            with self.told:
                observed.put_nowait((model.observe(), reward, False, False, {}))
                self.told.notify()
            if decided.get(timeout=60.0) is None:
                return
            reward = 1.0

    def reset(self, seed: int) -> None:
        for thread in self.threads:
            thread.start()
        self._observe()

    def _observe(self) -> Any:
        rows: dict[int, Any] = {}
        while len(rows) < len(self.queues):
            with self.told:
                while not (ready := [n for n, (observed, _) in enumerate(self.queues) if not observed.empty()]):
                    self.told.wait()
                for number in ready:
                    rows[number] = self.queues[number][0].get_nowait()
        told = [rows[number] for number in range(len(rows))]
        return np.stack([row[0] for row in told]), np.array([row[1] for row in told])

    def step(self, actions: Any) -> Any:
        for (_, decided), action in zip(self.queues, actions.tolist(), strict=True):
            decided.put(action)
        return self._observe()

    def close(self) -> None:
        for _, decided in self.queues:
            decided.put(None)
        for thread in self.threads:
            thread.join()


# -- in separate processes ------------------------------------------------------------------------


class Slow(Busy):
    """A simulation that takes ``MICROSECONDS`` per decision."""

    nanoseconds = int(MICROSECONDS * 1000)


def memory(number: int = 10_000) -> float:
    """Measure the resident memory of each of many suspended simulations, in KiB."""
    warm = ours(100)
    warm.reset(seed=0)
    gc.collect()
    before = _resident()
    env = ours(number)
    env.reset(seed=0)
    env.step(np.ones(number, np.int64))
    gc.collect()
    return (_resident() - before) / number


def _resident() -> float:
    fields = Path("/proc/self/statm").read_text(encoding="ascii").split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE") / 1024


def cores(rounds: int, size: int = 64) -> tuple[float, float, float]:
    """Measure the speed-up by two workers, and the microseconds of one process and of two workers."""
    envs = {workers: vector_env(Slow, Model.left, num_envs=size, workers=workers) for workers in (0, 2)}
    times = side_by_side(
        {str(workers): steps(env, size, size * 20, time.perf_counter) for workers, env in envs.items()}, rounds
    )
    for env in envs.values():
        env.close()
    return ratio(times, "0", "2"), median(times["0"]), median(times["2"])


if __name__ == "__main__":
    functions: dict[str, Callable[..., Any]] = {"memory": memory, "cores": cores}
    print(json.dumps(functions[sys.argv[1]](*map(int, sys.argv[2:]))))
