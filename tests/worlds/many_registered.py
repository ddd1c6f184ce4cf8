"""A module that registers its simulation when it is imported, as users' modules do."""

import random

import numpy as np
from gymnasium import spaces

from simenv_marl import make_step, register_simulation

PLACE = spaces.Box(-10, 10, (2,), np.float32)
PUSH = spaces.Box(-1, 1, (1,), np.float32)


def choice(agent):
    return make_step(
        observation_space=PLACE,
        observation_space_mapping=lambda boat: [boat.place, boat.course],
        action_space=PUSH,
        action_space_mapping=lambda action: float(np.ravel(action)[0]),
        reward_mapping=lambda boat: boat.place,
        agent=agent,
    )


class Boat:
    """Two of its crew decide where it goes."""

    def __init__(self, seed):
        self.random = random.Random(seed)
        self.place, self.course = 0.0, 1.0

    @choice("helm_0")
    def steer_boat(self):
        return 0.5

    @choice("sail_0")
    def set_sail(self):
        return -0.5


class Voyage:
    """A simulation of a boat."""

    points = (Boat.steer_boat, Boat.set_sail)

    def reset(self, seed=None):
        self.boat = Boat(seed)

    def run(self):
        boat = self.boat
        for _ in range(12):
            boat.course = boat.steer_boat()
            boat.place += boat.set_sail() * boat.course + boat.random.uniform(-0.1, 0.1)

    def render(self, mode):
        pictures = {"ansi": f"at {self.boat.place:.2f}", "rgb_array": np.zeros((8, 8, 3), np.uint8)}
        return pictures.get(mode)


IDS = register_simulation(Voyage, name="manyregistered")
