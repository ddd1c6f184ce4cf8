"""MyModel: rabbits in Mesa that are born and starve, and one policy, shared by all of them, that learns where to go.

``python -m simenv_marl.testing.templates.mesa`` trains the policy and compares it with the model's own rule. It needs
``pip install "simenv-marl[experiments]" mesa``. ``--quick`` only shows that everything runs.

Replace the model by yours, section by section. Section 1 knows nothing of reinforcement learning and stays that way.
"""

import sys
from typing import Any

import mesa
import numpy as np
from gymnasium.spaces import Box, Discrete
from mesa.discrete_space import CellAgent, OrthogonalVonNeumannGrid

from simenv_marl import SteppedSimulation, aec_env, difference, evaluate, make_step
from simenv_marl.data import collect_episodes

# -- 1. The model: Mesa's agents, and a rule of their own -----------------------------------------


class Rabbit(CellAgent):
    """Goes, eats, has young, and starves."""

    def __init__(self, model: Any, cell: Any, energy: float) -> None:
        super().__init__(model)
        self.cell, self.energy, self.eaten = cell, energy, 0.0

    def places(self) -> list[Any]:
        """List the cells that it can be in next: its own, and the four beside it."""
        return [self.cell, *self.cell.connections.values()]

    def choose_cell(self) -> Any:
        """The rule: stay while there is something to eat, then go anywhere."""
        return self.cell if self.model.grass[self.cell.coordinate] > 0.5 else self.random.choice(self.places())

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

    def __init__(self, width: int = 16, rabbits: int = 20, rng: int | None = None) -> None:
        super().__init__(rng=rng)  # the model's own generators: the same seed brings the same run
        self.grid = OrthogonalVonNeumannGrid((width, width), torus=True, random=self.random)
        self.grass = self.rng.random((width, width))
        for cell in self.random.sample(list(self.grid.all_cells), rabbits):
            Rabbit(self, cell, 2.0)

    def step(self) -> None:
        """Let one day go by."""
        self.grass = np.minimum(self.grass + 0.03, 1.0)
        self.agents.shuffle_do("step")
        self.running = len(self.agents) > 0


# -- 2. The decision: what each agent sees, what it can do, and what it is rewarded for -----------


def observe(rabbit: Rabbit) -> list[float]:
    """See its energy; of each place the grass, and the other rabbits there."""
    places = rabbit.places()
    others = [min(len(place.agents) - (place is rabbit.cell), 5) for place in places]
    return [rabbit.energy / 4, *(rabbit.model.grass[place.coordinate] for place in places), *others]


move = make_step(
    observation_space=Box(-1, 5, (11,), np.float32),
    observation_space_mapping=observe,  # gets the arguments of the decision call
    action_space=Discrete(5),
    choices=lambda rabbit: rabbit.places(),  # the action is an index
    reward_mapping=difference(lambda rabbit: rabbit.eaten),  # since its last decision
    agent=lambda rabbit: f"rabbit_{rabbit.unique_id}",  # from its birth ...
    removed_by="mesa.agent.Agent.remove",  # ... to its death
)

# -- 3. The simulation: what an episode is --------------------------------------------------------


class MySimulation(SteppedSimulation):
    """A hundred days: each reset makes a model with its seed, and run steps it."""

    points = {Rabbit.choose_cell: move}  # the model's classes stay as they are

    def __init__(self, days: int = 100, **parameters: Any) -> None:
        super().__init__(MyModel, days, **parameters)

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Say who is going to decide: all rabbits there are. So a round of the parallel view is a day."""
        return [(rabbit,) for rabbit in self.model.agents]


# -- 4. The environment, training, and what it is worth -------------------------------------------


def env(**options: Any) -> Any:
    """Make the environment: a ``pettingzoo.AECEnv``; use ``parallel_env`` for learners that act in rounds."""
    return aec_env(MySimulation, **options)


def odds(weights: np.ndarray[Any, Any], seen: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Work out how likely each place is, for one observation or for many: a softmax over linear scores."""
    scores = seen @ weights[:-1] + weights[-1]
    scores = np.exp(scores - scores.max(axis=-1, keepdims=True))
    return np.asarray(scores / scores.sum(axis=-1, keepdims=True))


def train(updates: int, meadows: int) -> Any:
    """Train one policy for all rabbits by policy gradients, and return it: a callable of one observation or many."""
    generator, weights = np.random.default_rng(1), np.zeros((12, 5))

    def explore(seen: np.ndarray[Any, Any]) -> Any:  # is asked for all rabbits of all meadows that wait for it
        chances = odds(weights, seen)
        drawn = (chances.cumsum(axis=1) < generator.random((len(seen), 1))).sum(axis=1).clip(max=4)
        return drawn, {"chances": chances}

    for update in range(updates):
        seeds = range(update * meadows, (update + 1) * meadows)
        found = collect_episodes(MySimulation, {Rabbit.choose_cell: explore}, seeds=seeds)[Rabbit.choose_cell]
        returns, ended = found.rewards.copy(), found.terminations | found.truncations
        for row in range(len(returns) - 2, -1, -1):  # each life is a trajectory; they stand one after the other
            returns[row] += 0.0 if ended[row] else 0.8 * returns[row + 1]
        advantages = (returns - returns.mean()) / returns.std()
        slopes = (np.eye(5)[found.actions] - found.extras["chances"]) * advantages[:, None]
        inputs = np.column_stack([found.observations, np.ones(len(returns))])
        weights += 1.0 * inputs.T @ slopes / len(returns)
    return lambda seen: odds(weights, seen).argmax(axis=-1)


if __name__ == "__main__":
    quick = "--quick" in sys.argv
    trained = train(*(2, 2) if quick else (12, 4))
    policies: dict[str, Any] = {"rule": {}, "trained": {Rabbit.choose_cell: trained}}  # {}: the model as it is
    seeds = range(100_000, 100_005 if quick else 100_030)  # meadows that it was not trained on
    metric = {"alive": lambda simulation: len(simulation.model.agents)}
    found = evaluate(MySimulation, policies, seeds=seeds, baseline="rule", metric=metric, batched=True)
    for of, title in (("return", "What all rabbits have eaten"), ("alive", "Rabbits alive at the end")):
        print(f"{title}; differences are paired by seed, with 95 % intervals:")
        print(found.summary(of).round(1).to_string())
    print("Next: put your model into section 1, and run pytest. For a full report:")
    print("python -m simenv_marl check simenv_marl.testing.templates.mesa:MySimulation")
