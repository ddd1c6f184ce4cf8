"""A model with a picture, as a simulation and as an environment that was written by hand."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from simenv_marl import TRUNCATED, single_env
from tests.worlds.models import define


class Dial:
    """Is turned a few times, with another start in each episode."""

    def __init__(self, episode):
        self.place, self.turns = 1.0 + episode / 4, 0

    @property
    def ended(self):
        return self.turns == 5

    @property
    def truncated(self):
        return self.place > 1.5

    def choose(self):
        return 0.5

    def turn(self, by):
        self.place, self.turns = self.place + by, self.turns + 1

    def picture(self):
        return (np.arange(72).reshape(6, 4, 3) * (self.turns + 1) + int(self.place * 10)).astype(
            np.uint8
        )


def turned_by(action):
    return float(action[0] - action[1] / 2)


ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
SEEN = {
    "numbers": (
        spaces.Box(-10, 10, (4,), np.float32),
        lambda dial: np.array([dial.place, dial.turns, dial.place**2 / 10, 1], np.float32),
    ),
    "picture": (spaces.Box(0, 255, (6, 4, 3), np.uint8), Dial.picture),
    "parts": (
        spaces.Dict({"place": spaces.Box(-10, 10, (1,), np.float64), "turns": spaces.Discrete(9)}),
        lambda dial: {"place": np.array([dial.place]), "turns": np.int64(dial.turns)},
    ),
}
"""What may be seen of a dial: in which space, and what."""


class DialSim:
    """Turns dials."""

    render_modes = ("rgb_array",)
    render_fps = 200
    episodes = 0

    def reset(self):
        self.episodes += 1
        self.dial = Dial(self.episodes)

    def run(self):
        while not self.dial.ended:
            self.dial.turn(self.dial.choose())
        return TRUNCATED if self.dial.truncated else None

    def time(self):
        return float(self.dial.turns)

    def render(self, mode):
        return self.dial.picture()


class DialEnv(gymnasium.Env[Any, Any]):
    """The same, written by hand."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 200}  # noqa: RUF012 - Gymnasium's way
    action_space = ACTIONS
    episodes = 0

    def __init__(self, seen="numbers", *, render_mode=None):
        self.observation_space, self.look = SEEN[seen]
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episodes += 1
        self.dial = Dial(self.episodes)
        return self.look(self.dial), {"time": 0.0, "elapsed": 0.0}

    def step(self, action):
        self.dial.turn(turned_by(action))
        ended, truncated = self.dial.ended, self.dial.truncated
        info = {"time": float(self.dial.turns), "elapsed": 1.0}
        return (
            self.look(self.dial),
            self.dial.place,
            ended and not truncated,
            ended and truncated,
            info,
        )

    def render(self):
        return self.dial.picture()


def points(seen):
    """The decision point of dials of which that is seen."""
    space, look = SEEN[seen]
    definition = define(
        agent="hand_0",
        observation_space=space,
        observation_space_mapping=look,
        action_space=ACTIONS,
        action_space_mapping=turned_by,
        reward_mapping=lambda dial: dial.place,
    )
    return {Dial.choose: definition}


def dial_env(seen="numbers", **options):
    """The single view of a simulation of dials."""
    return single_env(DialSim, points(seen), **options)
