"""Models for vector environments, and what it means that two of these tell the same."""

import multiprocessing
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from simenv_marl import RULE, TRUNCATED, joint_env, make_step, single_env, vector_env
from tests.worlds.worlds import World, advised, agent_of, points_of

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


class Timed(Counter):
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
    "timed": (Timed, definition()),
    "masked": (Timed, definition(action_mask_mapping=lambda self: [1, self.count % 2, 1])),
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
    policies = {points[point]: advised for point in design.policies} | {
        points[point]: RULE for point in design.rules
    }
    entities = [
        point
        for point in design.active
        if agent_of(design.kinds[point], point, 0) != f"point_{point}"
    ]
    options |= {"policies": policies or None, "max_steps": design.max_steps}
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
