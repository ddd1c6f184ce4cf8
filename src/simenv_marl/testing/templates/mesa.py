"""MyModel: rabbits in Mesa that are born and starve, and one policy, shared by all of them. Replace the model by yours.

``python -m simenv_marl.testing.templates.mesa`` trains the policy and compares it with the model's
own rule.
"""

import sys
from typing import Any

import mesa
import numpy as np
from gymnasium.spaces import Box, Discrete
from mesa.discrete_space import CellAgent, OrthogonalVonNeumannGrid

from simenv_marl import (
    SteppedSimulation,
    Streams,
    aec_env,
    difference,
    evaluate,
    make_step,
    reseed_generators,
)

# -- 1. The model: Mesa's agents, and a rule of their own -----------------------------------------


class Rabbit(CellAgent):
    """Goes, eats, has young, and starves."""

    def __init__(self, model: Any, cell: Any, energy: float) -> None:
        super().__init__(model)
        self.cell, self.energy, self.eaten = cell, energy, 0.0
        # its own, which no other rabbit changes
        self.chance = model.streams[f"rabbit_{self.unique_id}"]

    def places(self) -> list[Any]:
        """List the cells that it can be in next: its own, and the four beside it."""
        return [self.cell, *self.cell.connections.values()]

    def anywhere(self) -> Any:
        """Choose one of the places at random."""
        return self.places()[self.chance.integers(len(self.places()))]

    def choose_cell(self) -> Any:
        """The rule: stay while there is something to eat, then go anywhere."""
        return self.cell if self.model.grass[self.cell.coordinate] > 0.5 else self.anywhere()

    def step(self) -> None:
        """Do what a rabbit does in a day."""
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
    """A meadow on which grass grows, and rabbits."""

    def __init__(self, rng: int | None = None) -> None:
        super().__init__(rng=rng)  # the model's own generators: the same seed brings the same run
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


# -- 2. The decision: what each agent sees, what it can do, and what it is rewarded for -----------


def observe(rabbit: Rabbit) -> list[list[float]]:
    """See a row for each place that it can be in next: the grass, and the other rabbits there."""
    places = rabbit.places()
    others = [min(len(place.agents) - (place is rabbit.cell), 5) for place in places]
    return [
        [rabbit.model.grass[place.coordinate], number]
        for place, number in zip(places, others, strict=True)
    ]


move = make_step(
    observation_space=Box(0, 5, (5, 2), np.float32),
    observation_space_mapping=observe,  # gets the arguments of the decision call
    action_space=Discrete(5),
    choices=lambda rabbit: rabbit.places(),  # the action is an index
    reward_mapping=difference(lambda rabbit: rabbit.eaten),  # since its last decision
    agent=lambda rabbit: f"rabbit_{rabbit.unique_id}",  # from its birth ...
    removed_by="mesa.agent.Agent.remove",  # ... to its death
)

# -- 3. The simulation: what an episode is --------------------------------------------------------


class MySimulation(SteppedSimulation):
    """Fifty days: each reset makes a model with its seed, and run steps it."""

    points = {Rabbit.choose_cell: move}  # the model's classes stay as they are

    def __init__(self) -> None:
        super().__init__(MyModel, 50)

    def reseed(self, seed: int) -> None:
        """Draw another future, for planning."""
        reseed_generators(self, seed)


# -- 4. The environment, training, and what it is worth -------------------------------------------


def env() -> Any:
    """Make the environment: a ``pettingzoo.AECEnv``."""
    return aec_env(MySimulation)


def policy_of(weights: Any) -> Any:
    """Make a policy that gives points to each place, and takes the place with the most.

    For one rabbit or many.
    """
    return lambda seen: (seen @ np.asarray(weights)).argmax(-1)


def train(candidates: int, meadows: int) -> Any:
    """Train one policy for all rabbits by random search: all candidates meet the same meadows, and the best wins."""
    policies = [
        policy_of(weights) for weights in np.random.default_rng(1).normal(size=(candidates, 2))
    ]
    contenders: dict[str, Any] = {
        str(number): {Rabbit.choose_cell: policy} for number, policy in enumerate(policies)
    }
    found = evaluate(MySimulation, contenders, seeds=range(meadows), batched=True)
    return policies[int(found.summary()["mean"].idxmax())]


if __name__ == "__main__":
    quick = "--quick" in sys.argv  # only to see that everything runs
    policies: dict[str, Any] = {
        "rule": {},
        "trained": {Rabbit.choose_cell: train(*(5, 1) if quick else (20, 2))},
    }
    seeds = range(100_000, 100_005 if quick else 100_030)  # meadows that it was not trained on
    print("What all rabbits have eaten; differences are paired by seed, with 95 % intervals:")
    print(
        evaluate(MySimulation, policies, seeds=seeds, baseline="rule", batched=True)
        .summary()
        .round(1)
        .to_string()
    )
