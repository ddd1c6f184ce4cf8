"""Models that are cloned, pickled, registered, or imported by other processes.

``Trip`` has all state that a clone must continue, in all views; its processes share a diary file.
``Walk`` is for copies and pickles of environments, ``NamedWalk`` and its subclasses for hash seeds.
``Voyage`` is registered when this module is imported, as in users' modules.
"""

import os
import random
from functools import partial

import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import aec_to_parallel, parallel_to_aec
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from simenv_marl import (
    RULE,
    aec_env,
    difference,
    generate_env,
    joint_env,
    make_step,
    parallel_env,
    register_simulation,
    single_env,
)
from simenv_marl.envs import pad_agents
from tests.worlds.models import define


class Trip:
    render_modes = ("ansi",)
    free = False  # whether all actions are always legal

    def __init__(self, diary=os.devnull):
        self.diary = diary

    def reset(self, seed=None):
        self.seed, self.random, self.day, self.place, self.steps = (
            seed,
            random.Random(seed),
            0,
            0.0,
            [],
        )
        self.held = (step for step in self.steps)  # which cannot be pickled
        self.note("reset")

    def reseed(self, seed):
        self.random.seed(seed)

    def run(self):
        try:
            while self.day < 5:
                self.steps.append(self.walk())
                self.steps.append(
                    self.lead([1.5, -1.5, 3.0][: 3 if self.free else self.random.randrange(1, 4)])
                )
                self.place += sum(self.steps[-2:]) + self.luck()
                self.day += 1
        finally:
            self.note("unwound")

    def close(self):
        self.note("closed")

    def note(self, what):
        with open(self.diary, "a", encoding="utf-8") as file:
            file.write(f"{what} {self.seed}\n")

    def walk(self):
        return self.random.choice([-1, 1])

    def lead(self, ways):
        return self.random.choice(ways)

    def luck(self):
        return self.random.random()

    def time(self):
        return self.day * 1.5

    def state(self):
        return [self.place, self.day]

    def render(self, mode):
        return f"day {self.day} at {self.place}"


Free = type("Free", (Trip,), {"free": True})


class Lucky(Trip):
    def luck(self):
        return random.random() + float(np.random.standard_normal())


PLACE = {
    "observation_space": spaces.Box(-99, 99, (2,), np.float32),
    "action_space": spaces.Discrete(3),
}
POINTS = {
    f"{__name__}.Trip.walk": define(
        agent="walker_0", observation_space_mapping=Trip.state,
        action_space_mapping=lambda action: action - 1,
        action_mask_mapping=lambda trip: [1, 1, trip.free or trip.day % 2],
        reward_mapping=difference(lambda trip: trip.place), goal_space=PLACE["observation_space"],
        achieved_goal_mapping=lambda trip: [trip.day, trip.place],
        desired_goal_mapping=lambda trip: [trip.place, 1],
        compute_reward=lambda achieved, desired, info: achieved[0], **PLACE,
    ),
    f"{__name__}.Trip.lead": define(
        agent="guide_0", observation_space_mapping=lambda trip, ways: [trip.place, len(ways)],
        choices=lambda trip, ways: ways, reward_mapping=lambda trip, ways: trip.place, **PLACE,
    ),
}  # fmt: skip

single, limited = partial(single_env, agent="walker_0"), partial(TimeLimit, max_episode_steps=4)
VIEWS = {
    "aec": (aec_env, None), "aec, ordered": (aec_env, OrderEnforcingWrapper),
    "aec, padded": (aec_env, pad_agents),
    "parallel": (parallel_env, None), "parallel, padded": (parallel_env, pad_agents),
    "parallel to aec": (parallel_env, parallel_to_aec),
    "parallel to aec to parallel": (
        parallel_env, lambda env: aec_to_parallel(parallel_to_aec(env))
    ),
    "single": (single, None), "single, limited": (single, limited),
    "joint": (joint_env, None), "joint, limited": (joint_env, limited),
}  # fmt: skip


def trip(view="single", simulation=Trip, *, taken=1, seed=3, **options):
    """An environment of a trip on which some steps were taken."""
    make, wrap = VIEWS[view]
    env = (wrap or (lambda made: made))(make(simulation, POINTS, **options))
    env.reset(seed=seed)
    for _ in range(taken):
        move(env)
    return env


def move(env):
    """Take a step that the spaces' generators draw, in any view; return its results and the end."""
    view = env.unwrapped

    def drawn(name, space):
        mask = view.episode.agent(name).info.get("action_mask")
        return RULE if space.np_random.random() < 0.2 else space.sample(mask)

    if isinstance(env, AECEnv):
        last, name, seen = (
            env.last(),
            env.agent_selection,
            [env.observe(agent) for agent in env.agents],
        )
        told = repr((name, last, seen, env.rewards, env.terminations, env.truncations, env.infos))
        env.step(None if last[2] or last[3] else drawn(name, env.action_space(name)))
    elif isinstance(env, ParallelEnv):
        told = env.step({name: drawn(name, env.action_space(name)) for name in env.agents})
    elif isinstance(env.action_space, spaces.Dict):
        told = env.step({name: drawn(name, space) for name, space in env.action_space.items()})
    else:
        told = (
            *env.step(drawn("walker_0", env.action_space)),
            view.action_masks(),
            view.compute_reward([2.5], 0, {}),
        )
    over = not env.agents if hasattr(view, "agents") else told[2] or told[3]
    return repr((told, view.state(), env.render() if view.render_mode else None)), over


def outcome(env):
    """What has come of a trip, as its own process knows it."""
    model = env.unwrapped.simulation
    return model.seed, model.day, model.place, [*model.steps], model.random.getstate()


def future(env, outcome=outcome):
    """All that comes of an environment, and what its generators and the next episode draw."""
    found, over = [], False
    while not over:
        told, over = move(env)
        found.append(told)
    found += [env.unwrapped.call(outcome), env.unwrapped.provenance()["seed"]]
    env.reset()
    return [*found, move(env), env.unwrapped.call(outcome), env.unwrapped.np_random.random()]


def observe_walk(walk):
    return [walk.place]


def reward_of_walk(walk):
    return -abs(walk.place)


def to_step(action):
    return action - 1


def define_walk(**changes):
    given = {
        "observation_space": spaces.Box(-1e9, 1e9, (1,), np.float64),
        "observation_space_mapping": observe_walk,
        "action_space": spaces.Discrete(3),
        "action_space_mapping": to_step,
        "reward_mapping": reward_of_walk,
    }
    return make_step(**given | changes)


class Walk:
    """A walk that decides where to go."""

    def __init__(self, length=5):
        self.length = length

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.place, self.steps = 0.0, []
        self.held = (step for step in self.steps)  # which cannot be pickled

    def run(self):
        for _ in range(self.length):
            self.steps.append(self.choose())
            self.place += self.steps[-1] + self.drift() + self.random.random()

    @define_walk(agent="walker_0")
    def choose(self):
        return self.random.choice([-1, 1])

    def drift(self):
        return 0.0


def blow(walk):
    return 0.25


WalkEnv = generate_env(Walk, Walk.choose)
WalkEnv.__qualname__ = WalkEnv.__name__ = "WalkEnv"


NAMES = ("ant", "bee", "cat", "dog")


class NamedWalk:
    """A walk in the order of its names."""

    names = NAMES

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.place = 0.0
        self.notes = []

    def run(self):
        for number, name in enumerate(self.names):
            self.place += self.choose() + self.random.uniform(-0.5, 0.5)
            self.place += number * (name == "ant")

    def choose(self):
        return self.random.choice([-1, 0, 1])


class UnorderedWalk(NamedWalk):
    names = frozenset(NAMES)


class NotedWalk(NamedWalk):
    """It only notes the order of a set."""

    def run(self):
        super().run()
        self.notes = [*{*NAMES}]


class HashedWalk(NamedWalk):
    def choose(self):
        return hash("walker") % 1000


class OrderedWalk(NamedWalk):
    """It sorts a set, and holds values that differ in each process."""

    names = sorted({*NAMES})

    def run(self):
        super().run()
        self.notes = [{*NAMES}, os.getpid()]


def walk_points(simulation, **changes):
    """The one decision point of a walk."""
    return {simulation.choose: define_walk(agent="walker_0", **changes)}


BOAT_PLACE = spaces.Box(-10, 10, (2,), np.float32)
BOAT_PUSH = spaces.Box(-1, 1, (1,), np.float32)


def define_boat(agent):
    return make_step(
        observation_space=BOAT_PLACE,
        observation_space_mapping=lambda boat: [boat.place, boat.course],
        action_space=BOAT_PUSH,
        action_space_mapping=lambda action: float(np.ravel(action)[0]),
        reward_mapping=lambda boat: boat.place,
        agent=agent,
    )


class Boat:
    """Two of its crew decide where it goes."""

    def __init__(self, seed):
        self.random = random.Random(seed)
        self.place, self.course = 0.0, 1.0

    @define_boat("helm_0")
    def steer_boat(self):
        return 0.5

    @define_boat("sail_0")
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
