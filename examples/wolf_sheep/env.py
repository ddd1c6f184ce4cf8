"""Environments made from Mesa's wolves, sheep and grass: each sheep decides where to go.

The model is unchanged and undecorated. This module names ``Sheep.move`` as a decision point, and
each sheep is an agent from its birth to its death. The wolves, and the rest of the sheep's
behaviour, follow the model.

- ``Meadow``: the simulation: the model over a number of ticks, with Mesa's default parameters.
- ``sheep_points``: the decision point, for sheep with a given range of sight.
- ``numbers``: the numbers of sheep, wolves and grown patches of grass after each tick.

**Actions.** A sheep goes to one of the four neighbouring cells, as by the model's rule. (By the
rule it stays where it is if there are wolves on all four; the actions do not include staying.)

**Observations.** A sheep sees its energy, and for each cell up to ``sight`` steps away, its own
included: whether the grass is grown, the number of wolves, and the number of other sheep. The rule
looks one step ahead. But wolves move after all sheep, to a neighbouring cell: the danger comes from
wolves next to a sheep after its move, which may be two steps away before it.

**Rewards.** Each turn of a sheep's life brings a reward of 1, the last turn included. This measures
success in this model: a sheep has the same chance of a lamb in each tick that it survives, so the
longest lives bring the most offspring. Energy is only a means and brings no reward: otherwise a
lamb, which takes half of it, would be a punishment. As the reward is constant, everything depends
on how a trajectory ends. After a death (termination), the value is zero. After the last tick
(truncation), the sheep would have lived on, so its last observation determines the value
(bootstrapping).

The reward is individual. It does not imply that the herd does well if each sheep maximises its own
reward: what one sheep eats, the others cannot.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box, Discrete
from mesa.examples.advanced.wolf_sheep import model as wolf_sheep
from mesa.examples.advanced.wolf_sheep.agents import GrassPatch, Sheep, Wolf
from numpy.typing import NDArray

from simenv_marl import TRUNCATED, Definition, SimulationInterface, make_step, reseed_generators

TICKS: Final = 200
"""The number of ticks after which an episode is truncated."""

SIGHT: Final = 2
"""The range of a sheep's sight, in steps."""

DIRECTIONS: Final = ((-1, 0), (0, 1), (1, 0), (0, -1))
"""The step of each action."""

STEPS: Final = ("up", "right", "down", "left")
"""The labels of the actions."""

MOVE: Final = "mesa.examples.advanced.wolf_sheep.agents.Sheep.move"
"""The decision point."""

# -- observations, actions, rewards ---------------------------------------------------------------


@cache
def ways(sight: int) -> tuple[tuple[int, tuple[int, int]], ...]:
    """List the paths to the visible cells, without the own cell.

    A path is the index of the previous cell, and a step.
    """
    found = [(0, 0)]
    steps = []
    # the list grows in the loop: a breadth-first search
    for number, (row, column) in enumerate(found):
        for direction in DIRECTIONS:
            cell = (row + direction[0], column + direction[1])
            if abs(cell[0]) + abs(cell[1]) <= sight and cell not in found:
                found.append(cell)
                steps.append((number, direction))
    return tuple(steps)


@cache
def cells(sight: int) -> tuple[tuple[int, int], ...]:
    """List the visible cells as offsets, in the order of the observation.

    The own cell comes first; the others follow by distance.
    """
    found = [(0, 0)]
    for number, direction in ways(sight):
        found.append((found[number][0] + direction[0], found[number][1] + direction[1]))
    return tuple(found)


def look(sheep: Any, sight: int = SIGHT) -> NDArray[np.float32]:
    """Observe the sheep's energy, then the grass, wolves and other sheep of all ``cells``."""
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


def display(sheep: Any) -> dict[str, str | float]:
    """Return what people and language models read in place of the observation."""
    shown: dict[str, str | float] = {"your energy": float(sheep.energy)}
    around = {"here": sheep.cell}
    around |= {
        label: sheep.cell.connections[direction]
        for label, direction in zip(STEPS, DIRECTIONS, strict=True)
    }
    for label, cell in around.items():
        wolves = sum(isinstance(other, Wolf) for other in cell.agents)
        others = sum(isinstance(other, Sheep) and other is not sheep for other in cell.agents)
        grass = any(isinstance(other, GrassPatch) and other.fully_grown for other in cell.agents)
        shown[label] = f"{'grass' if grass else 'no grass'}, {wolves} wolves, {others} sheep"
    return shown


def turn(sheep: Any) -> float:
    """Reward each turn of a life."""
    return 1.0


def name(sheep: Any) -> str:
    """Name a sheep's agent."""
    return f"sheep_{sheep.unique_id}"


def sheep_moves(sight: int = SIGHT) -> Definition:
    """Define the decision of sheep that see ``sight`` steps far."""
    return make_step(
        observation_space=Box(-1.0, np.inf, (1 + 3 * len(cells(sight)),), np.float32),
        observation_space_mapping=partial(look, sight=sight),
        action_space=Discrete(len(DIRECTIONS)),
        apply=go,
        reward_mapping=turn,
        agent=name,
        question="Where does the sheep go? Wolves move after it, one step.",
        display_mapping=display,
        action_labels=STEPS,
        observation_labels=[
            "energy",
            *(
                f"{what} at {cell}"
                for what in ("grass", "wolves", "other sheep")
                for cell in cells(sight)
            ),
        ],
        removed_by="mesa.agent.Agent.remove",  # called for sheep that starve or are eaten
    )


def sheep_points(sight: int = SIGHT) -> dict[Any, Definition]:
    """Return the decision point of sheep with a given range of sight, for ``points=``."""
    return {MOVE: sheep_moves(sight)}


# -- the simulation -------------------------------------------------------------------------------


class Meadow(SimulationInterface):
    """The wolf-sheep model over a number of ticks.

    Attributes:
        model: Mesa's model in the current episode.
        ticks: The number of ticks after which an episode is truncated.
        only_with_sheep: Whether an episode ends when the last sheep dies.
        parameters: The parameters that differ from Mesa's defaults.
    """

    points = sheep_points()

    def __init__(
        self, ticks: int = TICKS, *, only_with_sheep: bool = False, **parameters: Any
    ) -> None:
        """Make a simulation.

        Args:
            ticks: The number of ticks after which an episode is truncated.
            only_with_sheep: Whether an episode ends when the last sheep dies. After that there is
                nothing to learn, but it takes the wolves many ticks to starve.
            **parameters: Parameters of Mesa's model: ``initial_wolves``, ``grass_regrowth_time``
                and so on.
        """
        self.ticks = ticks
        self.only_with_sheep = only_with_sheep
        self.parameters = parameters
        self.model: Any = None
        self._runner: Any = None

    def reset(self, seed: int | None = None) -> None:
        """Create a new model."""
        if hasattr(wolf_sheep, "WolfSheepScenario"):  # from Mesa 3.5 on
            self.model = wolf_sheep.WolfSheep(
                wolf_sheep.WolfSheepScenario(rng=seed, **self.parameters)
            )
            self._runner = self.model
            return
        from mesa.experimental.devs import ABMSimulator  # before Mesa 3.5

        self._runner = ABMSimulator()
        self.model = wolf_sheep.WolfSheep(simulator=self._runner, seed=seed, **self.parameters)

    def run(self) -> Any:
        """Run the ticks.

        Returns:
            ``TRUNCATED`` after the last tick, because the model itself has no end; None without
            sheep.
        """
        for _ in range(self.ticks):
            if self.only_with_sheep and not self.sheep:
                return None
            self._runner.run_for(1)
        return TRUNCATED

    def reseed(self, seed: int) -> None:
        """Draw another future: all animals and the grass draw from the model's generators."""
        reseed_generators(self, seed)

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Return the calls to come: one for each living sheep."""
        return [(sheep,) for sheep in self.sheep]

    @property
    def sheep(self) -> Any:
        """All living sheep."""
        return self.model.agents_by_type.get(Sheep, ())


def numbers(simulation: Meadow) -> dict[str, NDArray[np.int64]]:
    """Return the model's counts before the first tick and after each tick.

    Returns:
        An array of shape ``(ticks + 1,)`` for each kind: "sheep", "wolves" and "grass".
    """
    counted = simulation.model.datacollector.model_vars
    return {kind.lower(): np.array(counts, np.int64) for kind, counts in counted.items()}
