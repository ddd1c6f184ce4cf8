"""Event-driven models: factories with one generator or one per machine, queues, a hospital."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, Final

import numpy as np
import simpy
from gymnasium import spaces

from simenv_marl import Streams, difference, make_step

JOBS: Final = 16
"""The number of jobs, and of decisions, of an episode. It ends when all are done."""

MEANS: Final = (0.9, 1.8, 3.6)
"""The mean processing times of the machines, the fastest first.

Jobs arrive once in a unit of time in the mean.
"""

STATIONS: Final = (0.8, 0.9)
"""The mean service times of the two stations."""

REFUSAL: Final = 6.0
"""The costs of a job that is refused."""

DOCTORS: Final = (1.6, 2.4)
"""The mean times of a treatment, by doctor."""

COSTS: Final = (1, 4)
"""The costs of a patient in a unit of time: of others, and of urgent ones."""

URGENT: Final = 0.3
"""The probability that a patient is urgent."""

MOST: Final = 10
"""The network's rule admits a job as long as there are fewer jobs than this."""


class Work:
    """A SimPy model in which jobs arrive. The costs are the times that all jobs are there."""

    separate = True
    """Whether arrivals and each server have a random generator for themselves.

    Else all have the same one.
    """

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode."""
        self.streams = Streams(seed)
        self.sim = simpy.Environment()
        self.costs, self.there, self.counted = 0.0, 0, 0.0

    def reseed(self, seed: int) -> None:
        """Draw what lies ahead anew."""
        self.streams.reseed(seed)

    def time(self) -> float:
        """Return the time."""
        return float(self.sim.now)

    def draw(self, source: str, mean: float) -> float:
        """Draw a time from the generator of a source of chance."""
        return float(self.streams[source if self.separate else "all"].exponential(mean))

    def change(self, number: int) -> None:
        """Add jobs, after the costs so far are counted."""
        self.costs += self.there * (self.sim.now - self.counted)
        self.counted = self.sim.now
        self.there += number

    def costs_now(self) -> float:
        """Return the costs up to now."""
        return self.costs + self.there * (self.sim.now - self.counted)

    def run(self) -> None:
        """Run until all jobs are done."""
        self.sim.process(self.arrivals())
        self.sim.run()

    def arrivals(self) -> Generator[Any, Any, None]:
        """Let jobs arrive."""
        for _ in range(JOBS):
            yield self.sim.timeout(self.draw("arrivals", 1.0))
            self.change(0)
            self.arrive()

    def arrive(self) -> None:
        """Treat a job that has arrived."""
        raise NotImplementedError


class Factory(Work):
    """Three machines of unequal speed, each with a queue.

    The rule sends each job to the shortest queue.
    """

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode."""
        super().reset(seed)
        self.machines = [simpy.Resource(self.sim) for _ in MEANS]

    def queues(self) -> list[int]:
        """Return the number of jobs at each machine."""
        return [len(machine.queue) + machine.count for machine in self.machines]

    def arrive(self) -> None:
        """Treat a job that has arrived."""
        self.change(1)
        self.sim.process(self.job(self.dispatch()))

    @make_step(
        observation_space=spaces.Box(0, JOBS, (len(MEANS),), np.float32),
        observation_space_mapping=lambda factory: factory.queues(),
        action_space=spaces.Discrete(len(MEANS)),
        action_space_mapping=int,
        reward_mapping=difference(lambda factory: -factory.costs_now()),
        agent="dispatcher",
    )
    def dispatch(self) -> int:
        """Choose a machine."""
        return int(np.argmin(self.queues()))

    def job(self, place: int) -> Generator[Any, Any, None]:
        """Process a job on a machine."""
        with self.machines[place].request() as turn:
            yield turn
            yield self.sim.timeout(self.draw(f"machine {place}", MEANS[place]))
        self.change(-1)


class SharedFactory(Factory):
    """The factory with one generator for everything."""

    separate = False


class Network(Work):
    """Two stations in series.

    The rule admits each job, unless very many are there; a job that is refused costs.
    """

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode."""
        super().reset(seed)
        self.stations = [simpy.Resource(self.sim) for _ in STATIONS]

    def arrive(self) -> None:
        """Treat a job that has arrived."""
        if self.admit():
            self.change(1)
            self.sim.process(self.job())
        else:
            self.costs += REFUSAL

    @make_step(
        observation_space=spaces.Box(0, JOBS, (1,), np.float32),
        observation_space_mapping=lambda network: [network.there],
        action_space=spaces.Discrete(2),
        action_space_mapping=bool,
        reward_mapping=difference(lambda network: -network.costs_now()),
        agent="porter",
    )
    def admit(self) -> bool:
        """Decide whether a job is admitted."""
        return self.there < MOST

    def job(self) -> Generator[Any, Any, None]:
        """Process a job at both stations."""
        for place, station in enumerate(self.stations):
            with station.request() as turn:
                yield turn
                yield self.sim.timeout(self.draw(f"station {place}", STATIONS[place]))
        self.change(-1)


class Hospital(Work):
    """Two doctors, and patients of whom some are urgent: their time there costs more.

    The rule treats those first who came first.
    """

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode."""
        super().reset(seed)
        self.waiting: list[int] = []
        self.free = len(DOCTORS) * [True]

    def arrive(self) -> None:
        """Treat a patient who has arrived."""
        is_urgent = self.streams["patients"].random() < URGENT
        self.waiting.append(COSTS[is_urgent])
        self.change(self.waiting[-1])
        for doctor, is_free in enumerate(self.free):
            if is_free and self.waiting:
                self.sim.process(self.treat(doctor))

    @make_step(
        observation_space=spaces.Box(0, JOBS, (len(COSTS),), np.float32),
        observation_space_mapping=lambda hospital: [hospital.waiting.count(cost) for cost in COSTS],
        action_space=spaces.Discrete(len(COSTS)),
        action_space_mapping=lambda kind: COSTS[kind],
        reward_mapping=difference(lambda hospital: -hospital.costs_now()),
        agent="nurse",
    )
    def call(self) -> int:
        """Choose the kind of the next patient, where patients of both kinds wait."""
        return self.waiting[0]

    def treat(self, doctor: int) -> Generator[Any, Any, None]:
        """Treat patients as long as some wait."""
        self.free[doctor] = False
        while self.waiting:
            kind = self.call() if len(set(self.waiting)) > 1 else self.waiting[0]
            self.waiting.remove(kind)
            yield self.sim.timeout(self.draw(f"doctor {doctor}", DOCTORS[doctor]))
            self.change(-kind)
        self.free[doctor] = True


MODELS: Final[dict[str, tuple[type[Work], Any]]] = {
    "factory, one generator": (SharedFactory, Factory.dispatch),
    "factory, streams": (Factory, Factory.dispatch),
    "queue network, streams": (Network, Network.admit),
    "hospital, streams": (Hospital, Hospital.call),
}
