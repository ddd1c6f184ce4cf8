"""No-op simulations, so that only the overhead remains, and loops over their environments."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from benchmarks.hand_written import ACTION_SPACE, OBSERVATION_SPACE, State
from benchmarks.measure import Contender, timed
from simenv_marl import make_step

DEFINITION: dict[str, Any] = {
    "observation_space": OBSERVATION_SPACE,
    "observation_space_mapping": lambda entity: entity.observe(),
    "action_space": ACTION_SPACE,
    "action_space_mapping": lambda action: action,
    "reward_mapping": lambda entity: 1.0,
}

BY: dict[str, Any] = DEFINITION | {
    "observation_space_mapping": lambda entity, amount: entity.observe(),
    "reward_mapping": lambda entity, amount: 1.0,
}
"""The same for decisions whose calls have an argument besides ``self``."""


class Model(State):
    """Decisions that change nothing."""

    @make_step(**DEFINITION, agent="agent_0")
    def left(self) -> int:
        return 0

    @make_step(**DEFINITION, agent="agent_1")
    def right(self) -> int:
        return 0

    @make_step(**BY, agent="agent_0")
    def left_by(self, amount: float) -> int:
        return 0

    @make_step(**BY, agent="agent_1")
    def right_by(self, amount: float) -> int:
        return 0


class Turns:
    """Two agents, turn by turn, without an end."""

    def reset(self) -> None:
        self.model = Model()

    def run(self) -> None:
        model = self.model
        while True:
            model.left()
            model.right()


class TurnsBy(Turns):
    """The same, with an argument."""

    def run(self) -> None:
        model = self.model
        while True:
            model.left_by(1.0)
            model.right_by(1.0)


class Alone(Turns):
    """One agent, without an end."""

    def run(self) -> None:
        model = self.model
        while True:
            model.left()


class Busy(Alone):
    """One agent, whose simulation takes processor time."""

    nanoseconds = 0

    def run(self) -> None:
        model, clock = self.model, time.thread_time_ns
        while True:
            until = clock() + self.nanoseconds
            while clock() < until:
                pass
            model.left()


class AloneBy(Turns):
    """The same, with an argument."""

    def run(self) -> None:
        model = self.model
        while True:
            model.left_by(1.0)


class Entity(State):
    """One of many entities, each of which is an agent."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.name = f"entity_{number}"

    @make_step(**DEFINITION, agent=lambda entity: entity.name)
    def decide(self) -> int:
        return 0

    @make_step(**BY, agent=lambda entity, amount: entity.name)
    def decide_by(self, amount: float) -> int:
        return 0


class Crowd:
    """Many agents, in rounds; without an end, or for a number of rounds."""

    def __init__(self, size: int, rounds: int | None = None) -> None:
        self.size, self.rounds = size, rounds

    def reset(self) -> None:
        self.entities = [Entity(number) for number in range(self.size)]

    def names(self) -> list[str]:
        """The names of all agents, in the order in which they decide."""
        return [f"entity_{number}" for number in range(self.size)]

    def run(self) -> None:
        done = 0
        while done != self.rounds:
            for entity in self.entities:
                entity.decide()
            done += 1


class CrowdBy(Crowd):
    """The same without an end, and with an argument."""

    def run(self) -> None:
        while True:
            for entity in self.entities:
                entity.decide_by(1.0)


class ForetoldCrowd(Crowd):
    """Many agents, with ``expected_calls``."""

    def expected_calls(self, point: str) -> list[tuple[Entity]]:
        return [(entity,) for entity in self.entities]


# -- contenders -----------------------------------------------------------------------------------


def last_and_step(env: Any) -> Callable[[int], None]:
    """Make a loop of ``last`` and ``step`` of an AEC environment that does not end."""
    env.reset(seed=0)

    def loop(number: int) -> None:
        last, step = env.last, env.step
        for _ in range(number):
            last()
            step(1)

    return loop


def aec(env: Any, number: int) -> Contender:
    """Make a contender of this loop."""
    return timed(last_and_step(env), number)


def single(env: Any, number: int) -> Contender:
    """Make a contender of ``step`` of a Gymnasium environment that does not end."""
    env.reset(seed=0)

    def loop(number: int) -> None:
        step = env.step
        for _ in range(number):
            step(1)

    return timed(loop, number)
