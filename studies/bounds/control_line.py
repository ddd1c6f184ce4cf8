"""LineFlow's complex line as a simulation, and simple policies for it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from lineflow.examples.complex_line import ComplexLine, make_agent

from simenv_marl import make_step

STATIONS: Final = 3
WORKERS: Final = 9
SCRAP: Final = 1 / STATIONS


class Line:
    """The complex line. One agent sets the source, the switch and the workers at each unit."""

    end = 4000

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode."""
        self.line: Any = ComplexLine(
            WORKERS, STATIONS, alternate=False, scrap_factor=SCRAP, random_state=seed
        )
        self.heuristic = make_agent(
            self.line.state, STATIONS, WORKERS, waiting_time=5, ramp_up_waiting_time=10
        )

    def reseed(self, seed: int) -> None:
        """Draw all times anew."""
        self.line.random.seed(seed)

    def run(self) -> None:
        """Run LineFlow's loop."""
        self.line.run(self.end, agent=lambda state, env: self.control(), show_status=False)

    def time(self) -> float:
        """Return the time."""
        return float(self.line.env.now)

    @property
    def score(self) -> float:
        """The number of parts less a third of that of scrapped ones."""
        parts, scrap = self.line.get_n_parts_produced(), self.line.get_n_scrap_parts()
        return float(parts - SCRAP * scrap)

    def fills(self) -> Any:
        """Return how full the buffers between switch and assemblies are, from 0 to 1."""
        state = self.line.state
        names = [f"Buffer_Switch_to_A{place}" for place in range(STATIONS)]
        return np.array([state[name]["fill"].value for name in names])

    @make_step(
        observation_space=spaces.Box(0, 1, (STATIONS,), np.float32),
        observation_space_mapping=lambda line: line.fills(),
        action_space=spaces.MultiDiscrete([100, STATIONS, *[STATIONS] * WORKERS]),
        action_space_mapping=lambda values: {
            "Source": {"waiting_time": int(values[0])},
            "Switch": {"index_buffer_out": int(values[1])},
            "Pool": {f"W{number}": int(place) for number, place in enumerate(values[2:])},
        },
        reward_mapping=lambda: 0.0,
        agent="control",
    )
    def control(self) -> dict[str, dict[str, int]]:
        """Set the waiting time of the source, the way out of the switch, and the workers."""
        decided: dict[str, dict[str, int]] = self.heuristic(self.line.state, self.line.env)
        return decided


@dataclass(frozen=True)
class Route:
    """A policy: components go to the assembly that has the fewest.

    Attributes:
        waiting: The waiting time of the source, in half units.
        full: The fill of that assembly's buffer from which on the source waits for long.
        workers: The number of workers of each assembly.
    """

    waiting: int = 4
    full: float = 0.5
    workers: tuple[int, ...] = (2, 3, 4)

    def __call__(self, observation: Any) -> list[int]:
        """Return the action."""
        place = int(np.argmin(observation))
        waiting = self.waiting if observation[place] < self.full else 40
        return [waiting, place, *np.repeat(np.arange(STATIONS), self.workers).tolist()]

    def near(self) -> list[Route]:
        """Return policies that differ in one thing."""
        found = [replace(self, waiting=max(0, self.waiting + change)) for change in (-3, -1, 1, 3)]
        found += [replace(self, full=full) for full in (0.25, 0.5, 0.75) if full != self.full]
        for giving in range(STATIONS):
            for taking in range(STATIONS):
                workers = list(self.workers)
                workers[giving] -= 1
                workers[taking] += 1
                if giving != taking and workers[giving] > 0:
                    found.append(replace(self, workers=tuple(workers)))
        return found
