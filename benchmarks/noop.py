"""No-op simulations, which leave only the overhead, and contenders that run their environments."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.hand_written import ACTION_SPACE, OBSERVATION_SPACE, State
from benchmarks.measure import Contender, now, timer
from simenv_marl import RULE, make_step

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


class AloneBy(Turns):
    """The same, with an argument."""

    def run(self) -> None:
        model = self.model
        while True:
            model.left_by(1.0)


class Busy(Alone):
    """One agent, whose simulation takes processor time."""

    seconds = 0.0

    def run(self) -> None:
        while True:
            work(self.seconds)
            self.model.left()


def work(seconds: float) -> None:
    """Take processor time."""
    clock = time.thread_time
    until = clock() + seconds
    while clock() < until:
        pass


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


class Dispatched(Crowd):
    """The same without an end, in one call for all of them."""

    @make_step(**BY, agent=lambda entity, crowd: entity.name, split=lambda crowd: crowd.entities)
    def dispatch(self) -> list[int]:
        return [0] * self.size

    def run(self) -> None:
        while True:
            self.dispatch()


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


# -- contenders: environments that do not end -----------------------------------------------------


def aec(env: Any, number: int, clock: Callable[[], float] = now) -> Contender:
    """Make a contender of ``last`` and ``step`` of an AEC environment."""
    env.reset(seed=0)

    def loop(number: int) -> None:
        last, step = env.last, env.step
        for _ in range(number):
            last()
            step(1)

    return timer(loop, number, clock)


def single(env: Any, number: int) -> Contender:
    """Make a contender of ``step`` of a Gymnasium environment."""
    env.reset(seed=0)
    return steps(env, 1, number)


def parallel(env: Any, agents: int, number: int) -> Contender:
    """Make a contender of parallel steps with actions of all agents: the time per agent."""
    env.reset(seed=0)
    if len(env.agents) < agents:  # some agents have not appeared yet
        for _ in range(agents):
            env.step(dict.fromkeys(env.agents, 1))
    assert len(env.agents) == agents
    run = steps(env, dict.fromkeys(env.agents, 1), max(number // agents, 1))
    return lambda: run() / agents


def vector(env: Any, size: int, number: int, clock: Callable[[], float] = now) -> Contender:
    """Make a contender of steps of a vector environment: the time of each simulation."""
    env.reset(seed=0)
    run = steps(env, np.ones(size, np.int64), max(number // size, 1), clock)
    return lambda: run() / size


def steps(env: Any, action: Any, number: int, clock: Callable[[], float] = now) -> Contender:
    """Make a contender of ``step`` with the same action."""

    def loop(number: int) -> None:
        step = env.step
        for _ in range(number):
            step(action)

    return timer(loop, number, clock)


# -- contenders: whole runs of models, which the rule decides -------------------------------------


def whole(
    prepare: Callable[[], tuple[Callable[[], Any], Callable[[], Any]]], number: int, outcome: Any
) -> Contender:
    """Make a contender of whole runs: the time of each of a number of decisions.

    Args:
        prepare: Returns a function that runs once, and one that returns the outcome.
        number: The number of decisions of a run.
        outcome: What each run must end with.
    """

    def run() -> float:
        play, end = prepare()
        start = now()
        play()
        microseconds = (now() - start) * 1e6
        assert end() == outcome
        gc.collect()  # the model's reference cycles, as automatic collection is off
        return microseconds / number

    return run


def aec_by_rule(env: Any) -> int:
    """Play the rest of an AEC episode, and count the decisions."""
    decisions = 0
    last, step = env.last, env.step
    for _ in env.agent_iter():
        _, _, terminated, truncated, _ = last()
        over = terminated or truncated
        step(None if over else RULE)
        decisions += not over
    env.close()
    return decisions


def parallel_by_rule(env: Any) -> None:
    """Play the rest of a parallel episode."""
    while env.agents:
        env.step(dict.fromkeys(env.agents, RULE))
    env.close()
