"""Three queues in a row, each with arrivals of its own and a porter that admits them."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, Final

import numpy as np
import simpy
from gymnasium import spaces

from simenv_marl import TRUNCATED, make_step

from ..event_planning.model import Work

PLACES: Final = 3
"""The number of queues."""

ARRIVALS: Final = (2.0, 4.0, 4.0)
"""The mean times between the arrivals at each queue."""

SERVICES: Final = (1.5, 1.2, 0.9)
"""The mean service times."""

REFUSAL: Final = 8.0
"""The costs of a job that is refused."""

MOST: Final = 10
"""The rule admits a job as long as fewer jobs than this are at its queue."""

END: Final = 200.0
"""The length of an episode."""


class Queues(Work):
    """The queues. A job goes through all that follow. The costs are those of all queues."""

    def reset(self, seed: int | None = None) -> None:
        """Begin with empty queues."""
        super().reset(seed)
        self.servers = [simpy.Resource(self.sim) for _ in range(PLACES)]

    def run(self) -> Any:
        """Run SimPy's loop to the end of the episode."""
        for place in range(PLACES):
            self.sim.process(self.enter(place))
        self.sim.run(until=END)
        return TRUNCATED

    def at(self, place: int) -> int:
        """Return the number of jobs at a queue."""
        server = self.servers[place]
        return len(server.queue) + server.count

    def enter(self, place: int) -> Generator[Any, Any, None]:
        """Let jobs arrive at a queue."""
        while True:
            yield self.sim.timeout(self.draw(f"arrivals {place}", ARRIVALS[place]))
            if self.admit(place):
                self.change(1)
                self.sim.process(self.job(place))
            else:
                self.costs += REFUSAL

    @make_step(
        observation_space=spaces.Box(0, np.inf, (PLACES,), np.float32),
        observation_space_mapping=lambda queues: [queues.at(place) for place in range(PLACES)],
        action_space=spaces.Discrete(2),
        action_space_mapping=bool,
        reward_mapping=lambda: 0.0,
        agent=lambda queues, place: f"porter {place}",
    )
    def admit(self, place: int) -> bool:
        """Decide whether a job is admitted."""
        return self.at(place) < MOST

    def job(self, first: int) -> Generator[Any, Any, None]:
        """Serve a job at a queue and at those that follow."""
        for place in range(first, PLACES):
            with self.servers[place].request() as turn:
                yield turn
                yield self.sim.timeout(self.draw(f"services {place}", SERVICES[place]))
        self.change(-1)
