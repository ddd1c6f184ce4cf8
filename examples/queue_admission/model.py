"""A queue in SimPy: jobs of two kinds arrive at random, wait for one server, and pay when done.

``python -m examples.queue_admission.model`` runs the model without any environment.
"""

from collections.abc import Generator
from dataclasses import dataclass
from itertools import count
from math import exp
from typing import Any, Final

import simpy
from numpy.random import SeedSequence, default_rng


@dataclass(frozen=True)
class Kind:
    """A kind of jobs: the rates of arrivals and services per unit of time, and a job's pay."""

    name: str
    arrivals: float
    services: float
    reward: float


KINDS: Final = (Kind("A", 0.4, 1.0, 1.0), Kind("B", 0.8, 0.1, 6.0))
"""The kinds by priority: A is quick; B pays more but holds the server ten times as long."""

PLACES: Final = 2
"""How many jobs can wait."""

HOLDING_COST: Final = 0.1
"""The cost of each job in the system, the one in service included, per unit of time."""

INTEREST: Final = 0.1
"""The rate of continuous discounting, per unit of time."""


class Queue:
    """A server, with two places to wait in. A before B; a service is never interrupted.

    Attributes:
        clock: SimPy's environment.
        server: The server, with the requests of waiting jobs.
        generators: The random generator of each kind.
    """

    def __init__(self, seed: int | None = None, clock: Any = None) -> None:
        self.clock = clock or simpy.Environment()
        self.server = simpy.PriorityResource(self.clock)
        self._jobs, self._earned, self._booked = 0, 0.0, 0.0
        self.generators = [default_rng(stream) for stream in SeedSequence(seed).spawn(len(KINDS))]
        for kind, generator in enumerate(self.generators):
            self.clock.process(self._arrive(kind, generator))

    def admit(self, kind: int) -> bool:
        """Decide whether an arriving job comes in; only asked if there is room.

        The rule admits all.
        """
        return True

    def waiting(self, kind: int) -> int:
        """Return the number of waiting jobs of a kind."""
        requests: Any = self.server.queue
        return sum(request.priority == kind for request in requests)

    def serving(self) -> int | None:
        """Return the kind of the job in service; None if the server is idle."""
        users: Any = self.server.users
        return users[0].priority if users else None

    def present_value(self) -> float:
        """Return the rewards minus the holding costs so far, discounted to the run's beginning."""
        cost = HOLDING_COST * self._jobs / INTEREST
        return self._earned - cost * (
            exp(-INTEREST * self._booked) - exp(-INTEREST * self.clock.now)
        )

    def take(self, kind: int, work: float) -> None:
        """Let a job arrive, which comes in if there is room and it is admitted."""
        if len(self.server.queue) < PLACES and self.admit(kind):
            self.clock.process(self._serve(kind, work))

    def _arrive(self, kind: int, generator: Any) -> Generator[Any, Any, Any]:
        """Let jobs of a kind arrive.

        A job has the same work in each run of a seed, whichever jobs are admitted.
        """
        for _ in count():
            yield self.clock.timeout(generator.exponential(1 / KINDS[kind].arrivals))
            work = generator.exponential(1 / KINDS[kind].services)
            self.take(kind, work)

    def _serve(self, kind: int, work: float) -> Generator[Any, Any, Any]:
        """Wait for the server, work, and pay."""
        self._book(jobs=1)
        with self.server.request(priority=kind) as request:
            yield request
            yield self.clock.timeout(work)
            self._book(jobs=-1, reward=KINDS[kind].reward)

    def _book(self, jobs: int, reward: float = 0.0) -> None:
        """Book the holding costs so far and a reward, and change the number of jobs."""
        self._earned = self.present_value() + reward * exp(-INTEREST * self.clock.now)
        self._jobs, self._booked = self._jobs + jobs, self.clock.now


if __name__ == "__main__":
    queue = Queue(1)
    queue.clock.run(until=100)
    print(f"present value of 100 units of time, all jobs admitted: {queue.present_value():.2f}")
