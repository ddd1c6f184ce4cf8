"""A simulation for planning, and the values of its futures, computed without the library."""

import random
from collections.abc import Callable

import numpy as np
from gymnasium import spaces

from simenv_marl import difference
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
