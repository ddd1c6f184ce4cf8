"""The speed of Mesa's unmodified wolf-sheep model in environments, relative to the plain run.

All actions are ``RULE``, so every run ends with the same animals in the same places and the same
state of the generator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import numpy as np
from greenlet import getcurrent, greenlet
from gymnasium import spaces
from mesa.examples.advanced.wolf_sheep import model as wolf_sheep
from mesa.examples.advanced.wolf_sheep.agents import Sheep, Wolf
from numpy.typing import NDArray

from benchmarks.measure import Group, Row
from benchmarks.noop import aec_by_rule, parallel_by_rule, whole
from simenv_marl import TRUNCATED, Definition, SimulationInterface, aec_env, make_step, parallel_env

SEED = 5
TICKS = 25
KINDS: dict[str, Any] = {"wolf": Wolf, "sheep": Sheep}

Run = tuple[Callable[[], Any], Callable[[], Any]]


class Meadow(SimulationInterface):
    """The model over ``TICKS`` ticks."""

    def reset(self, seed: int | None = None) -> None:
        self.model, self.clock = wolves_and_sheep(seed)

    def run(self) -> Any:
        for _ in range(TICKS):
            self.clock.run_for(1)
        return TRUNCATED

    def expected_calls(self, point: str) -> list[tuple[Any]]:
        return [
            (animal,)
            for kind in KINDS.values()
            if point == name_of(kind)
            for animal in self.animals(kind)
        ]

    def animals(self, kind: type) -> Any:
        """Return all animals of a kind that are alive."""
        return self.model.agents_by_type.get(kind, ())

    def outcome(self) -> Any:
        """Return the state at the end of a run."""
        animals = [animal for kind in KINDS.values() for animal in self.animals(kind)]
        states = [(animal.unique_id, animal.energy, animal.cell.coordinate) for animal in animals]
        return states, self.model.random.getstate()


def wolves_and_sheep(seed: int | None) -> tuple[Any, Any]:
    """Make the model and the runner of its ticks: the model itself, before Mesa 3.5 a simulator."""
    if hasattr(wolf_sheep, "WolfSheepScenario"):
        model = wolf_sheep.WolfSheep(wolf_sheep.WolfSheepScenario(rng=seed))
        return model, model
    from mesa.experimental.devs import ABMSimulator

    simulator = ABMSimulator()
    return wolf_sheep.WolfSheep(simulator=simulator, seed=seed), simulator


def name_of(kind: type) -> str:
    """Return the name of a kind's decision point."""
    return f"{kind.__module__}.{kind.__qualname__}.move"


def observe(animal: Any) -> NDArray[np.float32]:
    return np.array((animal.energy, animal.p_reproduce), np.float32)


def reward(animal: Any) -> float:
    return float(animal.energy)


def move(action: int, animal: Any) -> None:
    cells = list(animal.cell.neighborhood)
    animal.cell = cells[action % len(cells)]


def definition(word: str) -> Definition:
    return make_step(
        observation_space=spaces.Box(-np.inf, np.inf, (2,), np.float32),
        observation_space_mapping=observe,
        action_space=spaces.Discrete(4),
        apply=move,
        reward_mapping=reward,
        agent=lambda animal: f"{word}_{animal.unique_id}",
        removed_by="mesa.agent.Agent.remove",
    )


POINTS = {name_of(kind): definition(word) for word, kind in KINDS.items()}


def groups(number: int) -> Iterator[Group]:
    """Yield the rows. Each contender runs one episode in a round; ``number`` has no effect."""
    run, outcome = plain()
    run()
    expected = outcome()
    env: Any = aec_env(Meadow, POINTS)
    env.reset(seed=SEED)
    decisions = aec_by_rule(env)
    model, least, turns, rounds = (
        whole(run, decisions, expected) for run in (plain, crossing, aec, parallel)
    )
    yield Group(
        [
            Row("AEC beside the plain model", turns, model, 0.68, 0.8, faster=True),
            Row(
                "parallel with expected_calls beside the plain model",
                rounds,
                model,
                0.65,
                0.75,
                faster=True,
            ),
            Row("bare crossing beside the plain model", least, model, faster=True),
            Row("AEC beside bare crossing", turns, least, faster=True),
            Row("parallel beside bare crossing", rounds, least, faster=True),
        ]
    )


def plain() -> Run:
    """Run the model without an environment."""
    simulation = Meadow()
    simulation.reset(SEED)
    return simulation.run, simulation.outcome


def aec() -> Run:
    """Run an AEC environment, in the loop of PettingZoo's documentation."""
    env: Any = aec_env(Meadow, POINTS)
    env.reset(seed=SEED)
    return lambda: aec_by_rule(env), lambda: env.simulation.outcome()


def parallel() -> Run:
    """Run a parallel environment, with all actions at once."""
    env: Any = parallel_env(Meadow, POINTS)
    env.reset(seed=SEED)
    return lambda: parallel_by_rule(env), lambda: env.simulation.outcome()


def crossing() -> Run:
    """Run without an environment: suspend and resume each decision, and call the mappings."""
    simulation = Meadow()
    simulation.reset(SEED)
    out = getcurrent().switch

    def suspend(rule: Callable[[Any], None], word: str) -> Callable[[Any], None]:
        def decide(animal: Any) -> None:
            out((word, animal))
            rule(animal)

        return decide

    def run() -> None:
        with ExitStack() as patches:
            for word, kind in KINDS.items():
                patches.enter_context(patch.object(kind, "move", suspend(kind.move, word)))
            inside = greenlet(simulation.run)
            event = inside.switch()
            while event is not TRUNCATED:
                word, animal = event
                f"{word}_{animal.unique_id}"
                reward(animal)
                observe(animal)
                event = inside.switch()

    return run, simulation.outcome
