"""Mesa's model of wolves, sheep and grass, as it stands in the package: where a sheep goes becomes its decision.

Nothing in the model is changed or decorated; ``Sheep.move`` is named as a decision point from here, and each sheep is
an agent, from its birth to its death. The wolves, and all else about the sheep, follow the model.

- ``Meadow``: the simulation, some ticks of the model with Mesa's default parameters.
- ``sheep_points``: the decision point, for sheep that see so and so far.
- ``numbers``: how many sheep, wolves and grown patches of grass there were after each tick.

**What a sheep decides.** It has to go to one of the four cells beside its own, as by the model's rule. (By the rule it
stays where it is if there are wolves on all four; a sheep that is sent cannot.)

**What it sees.** Its energy, and of each cell up to ``sight`` steps away, its own included: whether the grass is
grown, how many wolves stand there, and how many other sheep. The rule looks one step far. But wolves move after all
sheep have, to a cell beside theirs: whether a sheep is eaten depends on the wolves that are beside it once it has
moved, and those may be two steps away before.

**What it is rewarded for.** Each turn that it has lived to see is worth 1, the last included. That is all there is to
its success in this model: in each tick that it survives it has the same chance of a lamb, so who lives longest has
most offspring. Energy is not rewarded, being only a means: a lamb, which takes half of it, would be a punishment. As
the reward never varies, everything depends on how a trajectory ends. One that death has ended is worth nothing any
more; one that the last tick cuts off would have gone on, and has to be valued by what the sheep then sees.

The reward is each sheep's own. Whether the herd fares well if each of them looks after itself is not said thereby: what
one has eaten, the others lack.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box, Discrete
from mesa.examples.advanced.wolf_sheep import model as wolf_sheep
from mesa.examples.advanced.wolf_sheep.agents import GrassPatch, Sheep, Wolf
from numpy.typing import NDArray

from simenv_marl import TRUNCATED, Definition, SimulationInterface, make_step, reseed_generators

TICKS: Final = 200
"""After how many ticks an episode is truncated."""

SIGHT: Final = 2
"""How many steps a sheep can see."""

DIRECTIONS: Final = ((-1, 0), (0, 1), (1, 0), (0, -1))
"""Where each action leads."""

MOVE: Final = "mesa.examples.advanced.wolf_sheep.agents.Sheep.move"
"""The decision point."""

# -- what is observed, decided and rewarded -------------------------------------------------------


@cache
def ways(sight: int) -> tuple[tuple[int, tuple[int, int]], ...]:
    """The ways to the cells that are seen: for each but the own one, the number of the cell before it, and a step."""
    found = [(0, 0)]
    steps = []
    for number, (row, column) in enumerate(found):  # which grows meanwhile: the nearest are found first
        for direction in DIRECTIONS:
            cell = (row + direction[0], column + direction[1])
            if abs(cell[0]) + abs(cell[1]) <= sight and cell not in found:
                found.append(cell)
                steps.append((number, direction))
    return tuple(steps)


@cache
def cells(sight: int) -> tuple[tuple[int, int], ...]:
    """Where the cells lie that are seen, in the order in which they are observed: the own cell, then by distance."""
    found = [(0, 0)]
    for number, direction in ways(sight):
        found.append((found[number][0] + direction[0], found[number][1] + direction[1]))
    return tuple(found)


def look(sheep: Any, sight: int = SIGHT) -> NDArray[np.float32]:
    """Observe its energy; for each of its ``cells`` the grass, for each the wolves, for each the other sheep."""
    around = [sheep.cell]
    for number, direction in ways(sight):
        around.append(around[number].connections[direction])
    seen = len(around)
    observed = [0.0] * (1 + 3 * seen)
    observed[0] = sheep.energy
    for place, cell in enumerate(around, 1):
        for other in cell.agents:
            if isinstance(other, GrassPatch):
                observed[place] = float(other.fully_grown)
            elif isinstance(other, Wolf):
                observed[place + seen] += 1
            elif other is not sheep:
                observed[place + 2 * seen] += 1
    return np.array(observed, np.float32)


def go(action: Any, sheep: Any) -> None:
    """Go one step in the direction of the action."""
    sheep.cell = sheep.cell.connections[DIRECTIONS[action]]


def sheep_moves(sight: int = SIGHT) -> Definition:
    """Define the decision of sheep that see ``sight`` steps far."""
    return make_step(
        observation_space=Box(-1.0, np.inf, (1 + 3 * len(cells(sight)),), np.float32),
        observation_space_mapping=lambda sheep: look(sheep, sight),
        action_space=Discrete(len(DIRECTIONS)),
        apply=go,
        reward_mapping=lambda sheep: 1.0,
        agent=lambda sheep: f"sheep_{sheep.unique_id}",
        removed_by="mesa.agent.Agent.remove",  # called for sheep that starve or are eaten
    )


def sheep_points(sight: int = SIGHT) -> dict[Any, Definition]:
    """The decision point of sheep that see so and so far, for ``points=``."""
    return {MOVE: sheep_moves(sight)}


# -- the simulation -------------------------------------------------------------------------------


class Meadow(SimulationInterface):
    """Some ticks of wolves and sheep.

    Attributes:
        model: Mesa's model, of the present episode.
        ticks: For how long it runs.
        only_with_sheep: Whether it ends when there are no sheep any more.
        parameters: What is to be different from Mesa's defaults.
    """

    points = sheep_points()

    def __init__(self, ticks: int = TICKS, *, only_with_sheep: bool = False, **parameters: Any) -> None:
        """Say what meadow it is.

        Args:
            ticks: For how long it runs.
            only_with_sheep: Whether it is to end when there are no sheep any more: there is nothing left to learn, but
                the wolves would take their time to starve.
            **parameters: Of Mesa's model: ``initial_wolves``, ``grass_regrowth_time`` and so on.
        """
        self.ticks = ticks
        self.only_with_sheep = only_with_sheep
        self.parameters = parameters
        self.model: Any = None
        self._runner: Any = None

    def reset(self, seed: int | None = None) -> None:
        """Let other animals loose on another meadow."""
        if hasattr(wolf_sheep, "WolfSheepScenario"):  # from Mesa 3.5 on
            self.model = wolf_sheep.WolfSheep(wolf_sheep.WolfSheepScenario(rng=seed, **self.parameters))
            self._runner = self.model
            return
        from mesa.experimental.devs import ABMSimulator  # before

        self._runner = ABMSimulator()
        self.model = wolf_sheep.WolfSheep(simulator=self._runner, seed=seed, **self.parameters)

    def run(self) -> Any:
        """Let the ticks go by.

        Returns:
            ``TRUNCATED`` at the last tick: by itself, the model would go on for ever.
        """
        for _ in range(self.ticks):
            if self.only_with_sheep and not self.sheep:
                return None
            self._runner.run_for(1)
        return TRUNCATED

    def reseed(self, seed: int) -> None:
        """Draw anew what the animals leave to chance: all of them, and the grass, draw from the model's generators."""
        reseed_generators(self, seed)

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Whose decisions will be called for: those of all sheep that are alive."""
        return [(sheep,) for sheep in self.sheep]

    @property
    def sheep(self) -> Any:
        """All sheep that are alive."""
        return self.model.agents_by_type.get(Sheep, ())


def numbers(simulation: Meadow) -> dict[str, NDArray[np.int64]]:
    """What the model has counted, before the first tick and after each.

    Returns:
        By kind, "sheep", "wolves" and "grass", ``(ticks + 1,)``.
    """
    counted = simulation.model.datacollector.model_vars
    return {kind.lower(): np.array(counts, np.int64) for kind, counts in counted.items()}
