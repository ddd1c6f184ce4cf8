"""A model that fails, ends or interrupts at any place: in its code, mappings, policies or handlers.

``farm_env`` makes an environment of a ``Farm`` in any view; ``farm.let(happen, place)`` chooses the
fault and its place. Faults of a simulator in another process are in ``outside.py``.
"""

import json
import random
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from pettingzoo import AECEnv, ParallelEnv

from simenv_marl import RULE, joint_env, single_env, vector_env
from tests.worlds.models import define, play


class Beast:
    """One of those that decide one by one."""

    def __init__(self, farm, number):
        self.farm, self.number, self.come_by = farm, number, farm.come_by

    def move(self):
        self.come_by("rule")
        return self.farm.random.randrange(5)


class Farm:
    """Something may happen in it once it has come by a place often enough."""

    render_modes = ("human",)
    rounds = 3
    place = None
    happen: Callable[[], Any]

    def come_by(self, place):
        if place == self.place:
            self.left -= 1
            if self.left == 0:
                self.happen()

    def let(self, happen, place, time=1):
        """Let something happen at a place, when it is come by for the given time from now."""
        self.happen, self.place, self.left = happen, place, time

    def reset(self, seed=None):
        self.seed, self.now, self.log, self.caught = seed, 0, [], False
        self.come_by("reset")
        self.random = random.Random(seed)
        self.herd = [Beast(self, number) for number in range(3)]

    def run(self):
        try:
            for _ in range(self.rounds):
                self.come_by("run")
                self.log.append(self.plan())
                self.now += 1
                for beast in list(self.herd):
                    self.log.append(beast.move())
                self.log.append(self.pick())
                self.log.append(self.work())
                if self.now == self.rounds - 1:
                    self.remove(self.herd[0])
        except Exception:
            self.caught = True
            raise
        finally:
            self.come_by("finally")

    def plan(self):
        self.come_by("rule")
        return self.random.randrange(10)

    def pick(self):
        self.come_by("rule")
        return 0

    def work(self):
        self.come_by("rule")
        return self.random.randrange(3)

    def remove(self, beast):
        self.herd.remove(beast)

    def stop(self):
        self.come_by("stop")

    def close(self):
        self.come_by("close")

    def time(self):
        self.come_by("time")
        return float(self.now)

    def expected_calls(self, point):
        self.come_by("expected_calls")
        return [(beast,) for beast in self.herd] if point.endswith("move") else []

    def render(self, mode):
        self.come_by("render")


class Small(Farm):
    """One that is soon over, for those who play it very often."""

    rounds = 1


def at(place, value):
    """A mapping or handler at which something may happen, with that value."""

    def mapping(*args, **_):
        args[-1].come_by(place)
        return value(*args) if callable(value) else value

    return mapping


def mapped(action, *, _simulation):
    _simulation.come_by("action")
    return action


PLAN, PICK, WORK = (f"{__name__}.Farm.{name}" for name in ("plan", "pick", "work"))
MOVE = f"{__name__}.Beast.move"
PLANNER = define(
    agent="planner",
    observation_space_mapping=at("observation", [0, 0]),
    reward_mapping=at("reward", 1.0),
    action_mask_mapping=at("mask", [1] * 10),
    apply=at("apply", lambda action, farm: action + farm.random.randrange(3)),
)
MAPPED_PLANNER = replace(PLANNER, apply=None, action_space_mapping=mapped)
POINTS = {
    PLAN: PLANNER,
    MOVE: define(
        agent=at("agent", lambda beast: f"beast_{beast.number}"),
        observation_space_mapping=at("observation", [0, 0]),
        reward_mapping=at("reward", 1.0),
        removed_by={
            f"{__name__}.Farm.remove": at("removed_by", lambda farm, beast: f"beast_{beast.number}")
        },
    ),
    PICK: define(
        agent="picker",
        choices=at("choices", lambda farm: list(range(farm.now + 1))),
        action_space=spaces.Discrete(5),
    ),
    WORK: define(agent="worker", observation_space_mapping=at("observation", [0, 0])),
}


def vector(*args, **options):
    return vector_env(*args, num_envs=2, **options)


def vector_of_joint(*args, **options):
    return vector_env(*args, num_envs=2, view="joint", **options)


OF_ONE = (single_env, vector)
"""Views of one agent, which is the planner."""
IN_THE_MODEL = ("run", "rule", "apply", "before", "after", "instead")
PLACES = (
    *IN_THE_MODEL, "reset", "finally", "stop", "close", "observation", "reward", "mask", "agent",
    "removed_by", "choices", "action", "policy", "time", "expected_calls", "render",
)  # fmt: skip
ONCE = ("reset", "finally", "stop", "close", "removed_by", "apply", "action")
"""What an episode does not come by three times."""


def comes_by(view, place):
    """Whether an episode of the view comes by the place."""
    return view not in OF_ONE or place not in ("agent", "removed_by", "choices", "expected_calls")


def farm_env(view, place=None, **options):
    """An environment of a farm that comes by ``place``, and its farm (a vector's first one)."""

    def policy(observation):
        farms[0].come_by("policy")
        return 2

    farms = []
    points = POINTS | {PLAN: MAPPED_PLANNER if place == "action" else PLANNER}
    options["policies"] = {WORK: policy if place == "policy" else RULE}
    if place in ("before", "after", "instead"):
        options["plugins"] = [(at(place, 0), WORK, place)]
    if place == "render":
        options["render_mode"] = "human"
    if view in OF_ONE:
        points = {point: points[point] for point in (PLAN, WORK)}
    elif view in (joint_env, vector_of_joint):
        options["possible_agents"] = {MOVE: [f"beast_{number}" for number in range(3)]}
    env = view(Farm, points, **options)
    farms += (
        env.get_attr("simulation") if isinstance(env, VectorEnv) else [env.unwrapped.simulation]
    )
    return env, farms[0]


def take(env, action):
    """Have all who act take that action, in any view; return what the environment tells."""
    if isinstance(env, AECEnv):
        return env.step(action)
    if isinstance(env, ParallelEnv):
        return env.step(dict.fromkeys(env.agents, action))
    if isinstance(env, VectorEnv):
        action = np.zeros(2, np.int64)
    elif action is RULE:
        return env.step(RULE)
    return env.step(
        dict.fromkeys(env.action_space, action)
        if isinstance(env.action_space, spaces.Dict)
        else action
    )


dumps = partial(json.dumps, default=lambda told: [told.dtype.name, told.tolist()])


def run(env, seed=11):
    """Play an episode in any view, every third decision by its rule; return what it was like."""
    answers = (RULE if number % 3 == 0 else 0 for number in count())
    if isinstance(env, AECEnv):
        return dumps([turn[:6] for turn in play(env, lambda agent, env: next(answers), seed=seed)])
    told = [env.reset(seed=seed)]
    while env.agents if isinstance(env, ParallelEnv) else not np.any(told[-1][2:4]):
        told.append(take(env, next(answers)))
    return dumps(told)


def cut_short(env):
    """Begin an episode, take a step, and close the environment, or reset a vector."""
    env.reset(seed=11)
    take(env, RULE)
    env.reset() if isinstance(env, VectorEnv) else env.close()
