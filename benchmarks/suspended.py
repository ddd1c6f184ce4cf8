"""Simulations suspended side by side, beside one thread or process for each.

Their memory; the speed-up by workers.

``python -m benchmarks.suspended memory`` prints the KiB of each of 10,000 suspended simulations.
"""

from __future__ import annotations

import gc
import json
import os
import queue
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv

from benchmarks.hand_written import TemplateEnv
from benchmarks.measure import Group, Row, alone, two_cores
from benchmarks.noop import Alone, Busy, Model, vector
from simenv_marl import vector_env

SIZE, FEW = 64, 4


class Slow(Busy):
    """A simulation that takes 100 microseconds per decision."""

    seconds = 100e-6


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with a number of decisions of each contender."""
    threads, here = Threads(SIZE), vector_env(Alone, Model.left, num_envs=SIZE)
    ours, theirs = vector(here, SIZE, number), vector(threads, SIZE, number // 10)
    yield Group(
        [Row(f"{SIZE} simulations beside a thread for each", ours, theirs, 11, 20, faster=True)],
        most=10,
    )
    threads.close()
    here.close()

    clock = time.perf_counter
    processes, workers = (
        AsyncVectorEnv([TemplateEnv] * FEW),
        vector_env(Alone, Model.left, num_envs=FEW, workers=2),
    )
    ours, theirs = (vector(env, FEW, number // 20, clock) for env in (workers, processes))
    yield Group(
        [Row(f"{FEW} simulations in two workers / AsyncVectorEnv of template", ours, theirs)],
        most=10,
    )
    processes.close()
    workers.close()

    memory = partial(alone, "suspended", "memory", str(min(10_000, number)))
    yield Group(
        [Row("memory of each of 10,000 simulations", memory, None, 10, 9, unit="KiB")], most=1
    )
    with two_cores():
        envs = [vector_env(Slow, Model.left, num_envs=SIZE, workers=workers) for workers in (0, 2)]
        one, two = (vector(env, SIZE, min(SIZE * 20, number), clock) for env in envs)
        row = Row(
            "100 µs per decision: two workers beside one process", two, one, 1.7, 1.9, faster=True
        )
        yield Group([row], most=9)
        for env in envs:
            env.close()


class Threads:
    """One thread per simulation, which alternates with its user as in RLlib's ExternalEnv.

    Each thread has a queue for observations and one for actions. All threads share a condition,
    which they notify after each observation.
    """

    def __init__(self, number: int) -> None:
        self.arrival = threading.Condition()
        self.queues: list[Any] = [(queue.Queue(), queue.Queue()) for _ in range(number)]
        self.threads = [
            threading.Thread(target=self._run, args=pair, daemon=True) for pair in self.queues
        ]

    def _run(self, observations: queue.Queue[Any], actions: queue.Queue[Any]) -> None:
        model, reward = Model(), 0.0
        while True:
            with self.arrival:
                observations.put_nowait((model.observe(), reward, False, False, {}))
                self.arrival.notify()
            if actions.get(timeout=60.0) is None:
                return
            reward = 1.0

    def reset(self, seed: int) -> None:
        for thread in self.threads:
            thread.start()
        self._observe()

    def _observe(self) -> Any:
        rows: dict[int, Any] = {}
        while len(rows) < len(self.queues):
            with self.arrival:
                while not (
                    ready := [
                        n
                        for n, (observations, _) in enumerate(self.queues)
                        if not observations.empty()
                    ]
                ):
                    self.arrival.wait()
                for number in ready:
                    rows[number] = self.queues[number][0].get_nowait()
        in_order = [rows[number] for number in range(len(rows))]
        return np.stack([row[0] for row in in_order]), np.array([row[1] for row in in_order])

    def step(self, actions: Any) -> Any:
        for (_, pending), action in zip(self.queues, actions.tolist(), strict=True):
            pending.put(action)
        return self._observe()

    def close(self) -> None:
        for _, actions in self.queues:
            actions.put(None)
        for thread in self.threads:
            thread.join()


def memory(number: int = 10_000) -> float:
    """Measure the resident memory of each of many suspended simulations, in KiB."""
    warm = vector_env(Alone, Model.left, num_envs=100)
    warm.reset(seed=0)
    gc.collect()
    before = _resident()
    env = vector_env(Alone, Model.left, num_envs=number)
    env.reset(seed=0)
    env.step(np.ones(number, np.int64))
    gc.collect()
    return (_resident() - before) / number


def _resident() -> float:
    fields = Path("/proc/self/statm").read_text(encoding="ascii").split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE") / 1024


if __name__ == "__main__":
    print(json.dumps({"memory": memory}[sys.argv[1]](*map(int, sys.argv[2:]))))
