"""MyModel: rabbits in Mesa are born, starve, and share a policy. Replace the model with yours.

``python -m simenv_marl.testing.templates.mesa`` trains the policy and compares it with the model's
own rule.
"""

import sys
from typing import Any, ClassVar

import mesa
import numpy as np
from gymnasium.spaces import Box, Discrete
from mesa.discrete_space import Cell, CellAgent, OrthogonalVonNeumannGrid
from numpy.typing import NDArray

from simenv_marl import (
    SteppedSimulation,
    Streams,
    aec_env,
    difference,
    evaluate,
    make_step,
    reseed_generators,
)
from simenv_marl.envs import SimulationAECEnv

# -- 1. The model: Mesa's agents, and their own rule ----------------------------------------------


class Rabbit(CellAgent):
    """Moves, eats, has young, and starves."""

    def __init__(self, model: "MyModel", cell: Cell, energy: float) -> None:
        super().__init__(model)
        self.cell = cell
        self.energy = energy
        self.eaten = 0.0
        # Its own generator, so that other rabbits do not change its draws.
        self.chance = model.streams[f"rabbit_{self.unique_id}"]

    def places(self) -> list[Cell]:
        """Return the cells that it can reach: its own, and its four neighbours."""
        return [self.cell, *self.cell.connections.values()]

    def choose_cell(self) -> Cell:
        """The rule: stay while there is something to eat, then go anywhere."""
        if self.model.grass[self.cell.coordinate] > 0.5:
            return self.cell
        places = self.places()
        return places[self.chance.integers(len(places))]

    def step(self) -> None:
        """Live for a day."""
        self.cell = self.choose_cell()
        bite = self.model.grass[self.cell.coordinate]
        self.model.grass[self.cell.coordinate] = 0.0
        self.eaten += bite
        self.energy += bite - 0.25
        if self.energy <= 0:
            self.remove()  # death
        elif self.energy > 4:
            self.energy /= 2
            Rabbit(self.model, self.cell, self.energy)  # birth


class MyModel(mesa.Model):
    """A meadow with growing grass and rabbits."""

    def __init__(self, rng: int | None = None) -> None:
        super().__init__(rng=rng)  # Mesa's generators, so that a seed repeats a run
        self.streams = Streams(rng)
        self.grid = OrthogonalVonNeumannGrid((12, 12), torus=True, random=self.random)
        self.grass = self.rng.random((12, 12))
        for cell in self.random.sample(list(self.grid.all_cells), 12):
            Rabbit(self, cell, 2.0)

    def step(self) -> None:
        """Let one day go by."""
        self.grass = np.minimum(self.grass + 0.03, 1.0)
        self.agents.shuffle_do("step")
        self.running = len(self.agents) > 0


# -- 2. The decision: each agent's observation, actions and reward --------------------------------


def observe(rabbit: Rabbit) -> list[float]:
    """Return two numbers for each cell in reach: the grass and the other rabbits there."""
    numbers = []
    for place in rabbit.places():
        others = len(place.agents) - (place is rabbit.cell)
        numbers += [rabbit.model.grass[place.coordinate], min(others, 5)]
    return numbers


def name_places(rabbit: Rabbit) -> list[str]:
    """Return the position of each cell in reach, its grass and the other rabbits there."""
    numbers = observe(rabbit)
    parts = zip(rabbit.places(), numbers[::2], numbers[1::2], strict=True)
    return [
        f"{place.coordinate}: grass {grass:.2f}, other rabbits {others:g}"
        for place, grass, others in parts
    ]


move = make_step(
    observation_space=Box(0, 5, (10,), np.float32),
    observation_space_mapping=observe,  # gets the arguments of the decision call
    action_space=Discrete(5),
    choices=Rabbit.places,  # the action is an index
    reward_mapping=difference(lambda rabbit: rabbit.eaten),  # since its last decision
    agent=lambda rabbit: f"rabbit_{rabbit.unique_id}",  # from its birth ...
    removed_by="mesa.agent.Agent.remove",  # ... to its death
    # For people and language models:
    question="Where does the rabbit go?",
    action_labels=name_places,
    observation_labels=[
        f"{place}: {part}"
        for place in ("here", "cell 1", "cell 2", "cell 3", "cell 4")
        for part in ("grass", "other rabbits")
    ],
    display_mapping=lambda rabbit: {
        "energy": f"{rabbit.energy:.2f}",
        "grass here": f"{rabbit.model.grass[rabbit.cell.coordinate]:.2f}",
    },
)

# -- 3. The simulation: an episode ----------------------------------------------------------------


class MySimulation(SteppedSimulation):
    """Fifty days: each reset makes a model with its seed, and run steps it."""

    points: ClassVar = {Rabbit.choose_cell: move}  # the classes of the model do not change

    def __init__(self) -> None:
        super().__init__(MyModel, 50)

    def reseed(self, seed: int) -> None:
        """Draw another future, for planning."""
        reseed_generators(self, seed)


# -- 4. The environment, the training, and its value ----------------------------------------------


def env() -> SimulationAECEnv:
    """Make the environment, a ``pettingzoo.AECEnv``."""
    return aec_env(MySimulation)


def score_places(weights: Any) -> Any:
    """Make a policy for one observation or many: it takes the place with the highest score."""

    def choose(observations: NDArray[np.float32]) -> Any:
        rows = observations.reshape(*observations.shape[:-1], 5, 2)
        return (rows @ weights).argmax(-1)

    return choose


def train(candidates: int, meadows: int) -> Any:
    """Train a policy for all rabbits by random search: candidates meet the same meadows."""
    weights = np.random.default_rng(1).normal(size=(candidates, 2))
    contenders = {str(n): {Rabbit.choose_cell: score_places(w)} for n, w in enumerate(weights)}
    evaluation = evaluate(MySimulation, contenders, seeds=range(meadows), batched=True)
    return contenders[evaluation.summary()["mean"].idxmax()][Rabbit.choose_cell]


if __name__ == "__main__":
    quick = "--quick" in sys.argv  # to try whether everything runs
    policy = train(5, 1) if quick else train(20, 2)
    policies = {"rule": {}, "trained": {Rabbit.choose_cell: policy}}
    seeds = range(100_000, 100_005 if quick else 100_030)  # other meadows than in training
    evaluation = evaluate(MySimulation, policies, seeds=seeds, baseline="rule", batched=True)
    print("What all rabbits have eaten, on the same meadows:")
    print(evaluation)
    if mesa.__version__ == "3.3.1":
        print("Mesa 3.3.1 keeps each model in memory; newer ones (Python 3.12) do not.")
