"""Models whose values and returns a test can compute without the library.

``Duel`` is for planning: ``worth`` is the value of an action in one future. ``Shop`` is for
experiments, evaluations and worker processes: its returns are known in advance.
"""

import random
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from gymnasium import spaces

from simenv_marl import difference, make_step
from tests.worlds.models import define


class Duel:
    """Two who move a value: the one up, the other down, as far as chance has it.

    Who is on the left may retire.
    """

    turns = 6
    ceiling = 1e9

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.value = self.clock = 0.0
        self.turn = 0
        self.retired = False

    def reseed(self, seed):
        self.random.seed(seed)

    def time(self):
        return self.clock

    def run(self):
        for turn in range(self.turns):
            self.turn = turn
            if not self.retired:
                self.value += self.left() * (1 + self.random.random())
            self.clock += 0.5 + self.turn
            if self.value >= self.ceiling and not self.retired:
                self.retire()
                self.retired = True
            self.value -= self.right() * self.random.random()

    def expected_calls(self, point):
        return [] if self.retired and point == LEFT else [(self,)]

    def retire(self):
        """The one on the left is not asked any more."""

    def left(self):
        return 1

    def right(self):
        return 1


class Unseeded(Duel):
    """The same, but for a future that cannot be drawn anew."""

    reseed = None  # type: ignore[assignment]


LEFT = f"{__name__}.Duel.left"
RIGHT = f"{__name__}.Duel.right"
SPACE = spaces.Box(-1e9, 1e9, (2,), np.float64)


def observe(duel):
    return [duel.turn, duel.value]


def points(**changes):
    """Both decision points; for the one on the left something may be different."""
    alike = {
        "observation_space": SPACE,
        "observation_space_mapping": observe,
        "action_space": spaces.Discrete(3),
    }
    left = {
        "agent": "left",
        "reward_mapping": difference(lambda duel: duel.value),
        "removed_by": {f"{__name__}.Duel.retire": lambda duel: "left"},
    }
    right = {"agent": "right", "reward_mapping": difference(lambda duel: -3 * duel.value)}
    return {LEFT: define(**alike | left | changes), RIGHT: define(**alike | right)}


Base = Callable[[list[float]], int]


def rule(seen):
    return 1


class Told(Duel):
    """A duel that is told what is decided, and notes what an agent is rewarded for."""

    def __init__(self, agent, at, action, future, bases):
        self.agent, self.at, self.action, self.future, self.bases = agent, at, action, future, bases
        self.asked = 0
        # time and value at each decision of the agent from then on
        self.marks = []
        self.over = False

    def _decide(self, agent):
        number, self.asked = self.asked, self.asked + 1
        if number < self.at:
            return 1
        if agent == self.agent:
            self.marks.append((self.clock, self.value))
        if number == self.at:
            assert agent == self.agent
            if self.future is not None:
                self.reseed(self.future)
            return self.action
        return self.bases.get(agent, rule)(observe(self))

    def left(self):
        return self._decide("left")

    def right(self):
        return self._decide("right")

    def retire(self):
        if self.agent == "left" and not self.over:
            self.over = True
            self.marks.append((self.clock, self.value))


def worth(
    agent,
    action,
    future,
    *,
    at=0,
    seed=5,
    model=Duel,
    bases=None,
    horizon=None,
    timed_horizon=False,
    discount=1.0,
    timed=False,
    terminal=None,
    both=False,
):
    """What an action of an agent is worth in a future, at the decision of that number."""
    told = Told(agent, at, action, future, bases or {})
    told.turns, told.ceiling = model.turns, model.ceiling
    told.reset(seed)
    told.run()
    sign = -2.0 if both else 1.0 if agent == "left" else -3.0
    marks = told.marks if told.over else [*told.marks, (told.clock, told.value)]
    total, start = 0.0, marks[0][0]
    for number in range(len(marks) - 1):
        (began, before), (ended, after) = marks[number : number + 2]
        total += discount ** (began - start if timed else number) * sign * (after - before)
        reached = number + 1 if not timed_horizon else ended - start
        if number < len(marks) - 2 and horizon is not None and reached >= horizon:
            if terminal is not None:
                total += discount ** (ended - start if timed else number + 1) * terminal(after)
            break
    return total


class Shop:
    """Each day the keeper orders, and then the helper sells."""

    def __init__(self, days=3, price=1.0, kind="plain"):
        self.days, self.price, self.kind = days, price, kind

    def reset(self, seed):
        self.generator, self.level, self.seed = np.random.default_rng(seed), 0.0, seed

    def reseed(self, seed):
        self.generator = np.random.default_rng(seed)

    def run(self):
        for _ in range(self.days):
            self.level += self.order() * self.price
            self.level -= self.sell()
            self.level += float(self.generator.normal())
        if self.kind == "faulty" and self.seed % 2:
            raise ZeroDivisionError("no change")
        if self.kind == "slow":
            time.sleep(0.02)

    def order(self):
        return 2

    def sell(self):
        return 1


def level(shop):
    return shop.level


DECIDED = {
    "observation_space": spaces.Box(-1e9, 1e9, (1,), np.float64),
    "observation_space_mapping": lambda shop: [shop.level],
    "action_space": spaces.Discrete(10),
    "action_space_mapping": lambda action: action,
}
POINTS = {
    Shop.order: make_step(**DECIDED, reward_mapping=level, agent="keeper"),
    Shop.sell: make_step(**DECIDED, reward_mapping=lambda shop: 1.0, agent="helper"),
}
NEAR = {
    point: replace(definition, reward_mapping=lambda shop: -abs(shop.level))
    for point, definition in POINTS.items()
}
"""Points at which both should keep the level near zero, so that chance matters to planners."""


def much(observation):
    return 5


def much_of_many(observations):
    return [5] * len(observations)


def some(observation):
    return int(abs(observation[0]) % 7)


def some_of_many(observations):
    return (np.abs(observations[:, 0]) % 7).astype(int)
