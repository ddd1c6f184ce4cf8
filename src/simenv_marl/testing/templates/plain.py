"""MyModel: a home battery, and an agent that learns when to charge it. Replace the model by yours, section by section.

``python -m simenv_marl.testing.templates.plain`` trains the agent and compares it with the model's
own rule.
"""

import math
import random
import sys
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from simenv_marl import TRUNCATED, SimulationInterface, difference, evaluate, make_step, single_env

# -- 1. The model: plain Python, with a main loop and a rule of its own ---------------------------


class MyModel:
    """A house with solar panels and a battery.

    Each hour, the rule decides how much flows into the battery.
    """

    capacity, power, losses = 10.0, 3.0, 0.1  # kWh, kWh in an hour, share of what is charged

    def __init__(self, seed: int | None = None) -> None:
        # the model's own generator: the same seed brings the same run
        self.random = random.Random(seed)
        self.hour, self.charge, self.cost = 0, 5.0, 0.0
        self.begin_hour()

    def begin_hour(self) -> None:
        """Draw what the sun brings, what the house uses, and what a kWh costs in this hour."""
        clock = self.hour % 24
        daylight = max(0.0, math.sin((clock - 6) / 12 * math.pi))
        self.sun = 3.5 * daylight * self.random.uniform(0.2, 1.0)
        self.use = (1.8 if 17 <= clock < 22 else 0.7) * self.random.uniform(0.7, 1.3)
        self.price = (
            0.45 if 17 <= clock < 22 else 0.12 if clock < 6 else 0.28
        ) * self.random.uniform(0.9, 1.1)

    def choose_flow(self) -> float:
        """The rule, as sold with most batteries: store what the sun leaves over, and give what the house lacks."""
        return self.sun - self.use

    def end_hour(self) -> None:
        """Let one hour go by."""
        flow = min(
            max(self.choose_flow(), -self.power, -self.charge),
            self.power,
            self.capacity - self.charge,
        )
        self.charge += flow * (1 - self.losses) if flow > 0 else flow
        bought = self.use - self.sun + flow
        # what is fed into the grid earns little
        self.cost += bought * (self.price if bought > 0 else 0.05)
        self.hour += 1
        self.begin_hour()


# -- 2. The decision: what the agent sees, what it can do, and what it is rewarded for ------------


def observe(model: MyModel) -> list[float]:
    """See the time of day on a circle, and the hour's numbers, each of them between -1 and 1 or so."""
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
)

# -- 3. The simulation: what an episode is --------------------------------------------------------


class MySimulation(SimulationInterface):
    """A week."""

    points = {MyModel.choose_flow: flow}  # the model's class stays as it is

    def reset(self, seed: int | None = None) -> None:
        """Begin a week."""
        self.model = MyModel(seed)

    def run(self) -> Any:
        """Run the model's own loop.

        It is suspended at each decision; nothing here has to be stepped.
        """
        while self.model.hour < 7 * 24:
            self.model.end_hour()
        return TRUNCATED  # time is up, but the house goes on: no end of the task


# -- 4. The environment, training, and what it is worth -------------------------------------------


def env() -> Any:
    """Make the environment: a ``gymnasium.Env``."""
    return single_env(MySimulation)


def train(steps: int) -> Any:
    """Train by PPO, and return a policy: a callable of the observation that returns an action."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    learner = PPO("MlpPolicy", make_vec_env(env, n_envs=8, seed=1), n_steps=168, batch_size=168, n_epochs=5,
        gamma=0.97, learning_rate=2e-3, seed=1, device="cpu")  # fmt: skip
    learner.learn(steps)
    return lambda observation: int(learner.predict(observation, deterministic=True)[0])


if __name__ == "__main__":
    quick = "--quick" in sys.argv  # only to see that everything runs
    policies: dict[str, Any] = {
        "rule": {},
        "trained": {"battery_0": train(1500 if quick else 100_000)},
    }
    seeds = range(100_000, 100_005 if quick else 100_030)  # weeks that it was not trained on
    print("Minus the costs of a week; differences are paired by seed, with 95 % intervals:")
    print(
        evaluate(MySimulation, policies, seeds=seeds, baseline="rule")
        .summary()
        .round(2)
        .to_string()
    )
