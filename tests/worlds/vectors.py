"""Models for vector environments, spaces of all kinds, and wrappers.

``Counter`` has one agent; ``VARIETY`` defines its decision with each kind of space. ``agree``
compares our vector environments with Gymnasium's. ``DialSim`` and ``DialEnv`` are one model with a
picture, as a simulation and written by hand: use them to compare wrappers.
"""

import multiprocessing
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from simenv_marl import TRUNCATED, joint_env, make_step, single_env, vector_env
from tests.worlds.models import define
from tests.worlds.random_worlds import World, agent_of, points_of, world_policies

MODES = list(AutoresetMode)

FORK = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
"""The quickest way to start a worker; which one it is makes no difference once it runs."""

FORKS = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
"""That numpy has threads does not matter here: they have nothing to do when a worker is forked."""


def definition(**changes):
    """A definition for ``Counter.decide``."""
    return make_step(
        **{
            "observation_space": spaces.Box(-100, 100, (2,), np.float32),
            "observation_space_mapping": lambda self: [self.count, self.goal],
            "action_space": spaces.Discrete(3, start=1),
            "action_space_mapping": int,
            "reward_mapping": lambda self: self.count / 4,
            **changes,
        }
    )


class Counter:
    """Counts to a number that its seed gives; every decision says by how much."""

    render_modes = ("ansi",)
    failing = False

    def reset(self, seed=None, options=None):
        self.seed, self.options = seed, options
        self.random = np.random.default_rng(seed)
        self.count, self.goal = 0, int(self.random.integers(3, 12))

    def run(self):
        try:
            while self.count < self.goal:
                self.count += self.decide()
                if self.failing:
                    raise ZeroDivisionError
        finally:
            self.unwound = True
        return TRUNCATED if self.goal % 2 else None

    def render(self, mode):
        return f"{mode} {self.count}"

    @definition()
    def decide(self):
        return 1


POINT = f"{__name__}.Counter.decide"


class TimedCounter(Counter):
    """The same with a clock."""

    def time(self):
        return 1.5 * self.count


NESTED = spaces.Dict(
    {
        "count": spaces.Discrete(1000),
        "both": spaces.Tuple([spaces.Box(-1, 1, (), np.float64), spaces.MultiDiscrete([100, 100])]),
        "word": spaces.Text(5, charset="abc"),
        "image": spaces.Box(0, 255, (2, 3, 1), np.uint8),
    }
)

VARIETY = {
    "plain": (Counter, definition()),
    "timed": (TimedCounter, definition()),
    "masked": (TimedCounter, definition(action_mask_mapping=lambda self: [1, self.count % 2, 1])),
    "choices": (Counter, definition(
        action_space=spaces.Discrete(4),
        action_space_mapping=None,
        choices=lambda self: list(range(1, 2 + self.count % 4)),
    )),
    "rows": (Counter, definition(
        observation_space=spaces.Box(-100, 100, (2, 3), np.float64),
        # A new array with a column-major layout.
        observation_space_mapping=lambda self: np.full(
            (2, 3), [self.count, self.goal, 7.0], order="F"
        ),
    )),
    "box": (Counter, definition(
        action_space=spaces.Box(0, 3, (2,), np.float32),
        action_space_mapping=lambda a: 1 + int(a.sum()),
    )),
    "dict action": (Counter, definition(
        action_space=spaces.Dict(
            {"a": spaces.Discrete(3), "b": spaces.Box(0, 1, (2,), np.float64)}
        ),
        action_space_mapping=lambda action: 1 + int(action["a"]),
    )),
    "multi": (Counter, definition(
        action_space=spaces.MultiDiscrete([2, 3]), action_space_mapping=lambda a: 1 + int(a.sum())
    )),
    "nested": (Counter, definition(
        observation_space=NESTED,
        observation_space_mapping=lambda self: {
            "count": self.count,
            "both": (self.count / 100, [self.count, self.goal]),
            "word": "abc"[: 1 + self.count % 3],
            "image": np.full((2, 3, 1), self.count),
        },
    )),
    "number": (Counter, definition(
        observation_space=spaces.Discrete(100), observation_space_mapping=lambda self: self.count
    )),
    "image": (Counter, definition(
        observation_space=spaces.Box(0, 255, (4, 2), np.uint8),
        observation_space_mapping=lambda self: np.full((4, 2), self.count),
    )),
    "goal": (Counter, definition(
        goal_space=spaces.Box(0, 100, (1,), np.float64),
        achieved_goal_mapping=lambda self: [self.count],
        desired_goal_mapping=lambda self: [self.goal],
        compute_reward=lambda achieved, desired, info: -np.abs(achieved - desired).sum(-1),
    )),
}  # fmt: skip


same = partial(data_equivalence, exact=True)
"""Whether two results are equal to the dtype."""


def alike(one, other):
    """The same, but for how long it has taken; tensors are compared as arrays."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(
            alike(one[key], other[key]) for key in one if key != "t"
        )
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(alike, one, other))
    if type(one).__module__ == "torch":
        one, other = one.numpy(), other.numpy()
    return same(one, other)


def legal_actions(envs, infos, rng):
    """A batch of actions out of the action space that the masks allow."""
    envs.action_space.seed(int(rng.integers(1000)))
    actions = envs.action_space.sample()
    masks = infos.get("action_mask")
    if isinstance(masks, np.ndarray):
        start = envs.single_action_space.start
        actions = np.array(
            [start + rng.choice(np.flatnonzero(m)) if m.any() else start for m in masks]
        )
    return actions


def agree(ours, theirs, steps, rng):
    """Two vector environments tell the same, whatever happens."""
    disabled = ours.metadata["autoreset_mode"] == AutoresetMode.DISABLED
    told = ours.reset(seed=5), theirs.reset(seed=5)
    assert same(*told)
    for _ in range(steps):
        actions = legal_actions(ours, told[0][-1], rng)
        told = ours.step(actions), theirs.step(actions)
        assert same(*told)
        assert told[0][1].dtype == np.float64
        over = told[0][2] | told[0][3]
        if disabled and over.any():
            told = tuple(envs.reset(options={"reset_mask": over.copy()}) for envs in (ours, theirs))
            assert same(*told)
            infos = told[0][-1]
            if "action_mask" in infos:  # of those that were not reset it is not told again
                told = ours.reset(seed=3), theirs.reset(seed=3)
                assert same(*told)


def made(design, number, mode, *, sync=False, **options):
    """A vector environment of worlds of a design, ours or Gymnasium's; None if it is impossible."""
    points = points_of(design)
    entities = [
        point
        for point in design.active
        if agent_of(design.kinds[point], point, 0) != f"point_{point}"
    ]
    options |= {"policies": world_policies(design, points), "max_steps": design.max_steps}
    if entities:
        names = {p: [agent_of(design.kinds[p], p, entity) for entity in range(3)] for p in entities}
        options["possible_agents"] = {points[p]: list(filter(None, names[p])) for p in entities}
    single = len(design.active) == 1 and not entities
    if not single and any(design.kinds[point] == "choices" for point in design.active):
        return None  # what is legal for one may be illegal by its turn

    def source():
        return World(design, points)

    if not sync:
        return vector_env(source, points, num_envs=number, autoreset_mode=mode, **options)
    make = single_env if single else joint_env
    return SyncVectorEnv([lambda: make(source, points, **options)] * number, autoreset_mode=mode)


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
"""Kinds of observations of a dial, each with its space and its mapping."""


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


def dial_points(seen):
    """The decision point of dials with observations of that kind."""
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
    return single_env(DialSim, dial_points(seen), **options)
