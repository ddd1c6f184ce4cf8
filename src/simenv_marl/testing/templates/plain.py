"""MyModel: a home battery, and an agent that learns to charge it. Replace the model with yours.

``python -m simenv_marl.testing.templates.plain`` trains the agent and compares it with the model's
own rule.
"""

import math
import random
import sys
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box, Discrete

from simenv_marl import TRUNCATED, SimulationInterface, difference, evaluate, make_step, single_env
from simenv_marl.envs import SimulationEnv

# -- 1. The model: plain Python, with its own main loop and rule ----------------------------------


class MyModel:
    """A house with solar panels and a battery.

    Each hour, the rule decides how much flows into the battery.
    """

    capacity = 10.0  # kWh
    power = 3.0  # kWh in an hour
    losses = 0.1  # share of the charge
    # By hour of the day: the price of a kWh, and the average use of the house in kWh.
    prices = [0.12] * 6 + [0.28] * 11 + [0.45] * 5 + [0.28] * 2
    uses = [0.7] * 17 + [1.8] * 5 + [0.7] * 2

    def __init__(self, seed: int | None = None) -> None:
        self.random = random.Random(seed)  # its own generator, so that a seed repeats a run
        self.hour = 0
        self.charge = 5.0
        self.cost = 0.0
        self.begin_hour()

    def begin_hour(self) -> None:
        """Draw the solar power, the use of the house and the price of a kWh in this hour."""
        clock = self.hour % 24
        daylight = max(0.0, math.sin((clock - 6) / 12 * math.pi))
        self.sun = 3.5 * daylight * self.random.uniform(0.2, 1.0)
        self.use = self.uses[clock] * self.random.uniform(0.7, 1.3)
        self.price = self.prices[clock] * self.random.uniform(0.9, 1.1)

    def choose_flow(self) -> float:
        """The rule of most batteries: store the surplus of the sun, and cover the lack."""
        return self.sun - self.use

    def end_hour(self) -> None:
        """Let one hour go by."""
        flow = max(self.choose_flow(), -self.power, -self.charge)
        flow = min(flow, self.power, self.capacity - self.charge)
        self.charge += flow * (1 - self.losses) if flow > 0 else flow
        bought = self.use - self.sun + flow
        self.cost += bought * (self.price if bought > 0 else 0.05)  # the grid pays little
        self.hour += 1
        self.begin_hour()


# -- 2. The decision: the agent's observation, its actions and its reward -------------------------


def observe(model: MyModel) -> list[float]:
    """Return the time of day on a circle, and the numbers of the hour, all near -1 to 1."""
    angle = model.hour % 24 / 24 * 2 * math.pi
    return [
        math.sin(angle),
        math.cos(angle),
        model.charge / 10,
        model.sun / 4,
        model.use / 4,
        model.price,
    ]


flow = make_step(
    observation_space=Box(-1, 1, (6,), np.float32),
    observation_space_mapping=observe,  # gets the arguments of the decision call
    action_space=Discrete(3),
    # As the rule, nothing, or as much as the battery takes:
    apply=lambda action, model: (model.sun - model.use, 0.0, model.power)[action],
    reward_mapping=difference(lambda model: -model.cost),  # since the last decision
    agent="battery_0",
    # For people and language models:
    question="What does the battery do in this hour?",
    action_labels=["store the surplus, cover the lack", "nothing", "take as much as it can"],
    observation_labels=["time of day (sine)", "(cosine)", "charge", "sun", "use", "price"],
    display_mapping=lambda model: {
        "hour": f"{model.hour % 24}:00",
        "charge": f"{model.charge:.1f} of {model.capacity:g} kWh",
        "sun": f"{model.sun:.1f} kWh",
        "use of the house": f"{model.use:.1f} kWh",
        "price": f"{model.price:.2f} for a kWh",
    },
)

# -- 3. The simulation: an episode ----------------------------------------------------------------


class MySimulation(SimulationInterface):
    """A week."""

    points: ClassVar = {MyModel.choose_flow: flow}  # the class of the model does not change

    def reset(self, seed: int | None = None) -> None:
        """Begin a week."""
        self.model = MyModel(seed)

    def run(self) -> object:
        """Run the model's own loop, which is suspended at each decision."""
        while self.model.hour < 7 * 24:
            self.model.end_hour()
        return TRUNCATED  # a time limit, not an end of the task: the house remains


# -- 4. The environment, the training, and its value ----------------------------------------------


def env() -> SimulationEnv:
    """Make the environment, a ``gymnasium.Env``."""
    return single_env(MySimulation)


def train(steps: int) -> Any:
    """Train by PPO; return the policy, a function from observation to action."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    torch.set_num_threads(1)  # several would wait for each other
    learner = PPO(
        "MlpPolicy",
        make_vec_env(env, n_envs=8, seed=1),
        n_steps=168,
        batch_size=168,
        n_epochs=5,
        gamma=0.97,
        learning_rate=2e-3,
        seed=1,
        device="cpu",
    )
    learner.learn(steps)
    return lambda observation: int(learner.predict(observation, deterministic=True)[0])


if __name__ == "__main__":
    quick = "--quick" in sys.argv  # to try whether everything runs
    policies = {
        "rule": {},
        "trained": {"battery_0": train(1500 if quick else 100_000)},
    }
    seeds = range(100_000, 100_005 if quick else 100_030)  # other weeks than in training
    evaluation = evaluate(MySimulation, policies, seeds=seeds, baseline="rule")
    print("Minus the costs of a week, of the same weeks:")
    print(evaluation)
