"""Random simulations, and what must come of them, computed without the library.

A world has a level, which every decision changes, and a program: the calls of its decision points
in their order. ``Reference`` is a world that goes through its program by itself, and tells who
decides when, what it observes, what it is paid and what the model comes to. It knows of no
environment, stack or greenlet.
"""

import random
from contextlib import suppress
from dataclasses import dataclass

from gymnasium import spaces
from hypothesis import strategies as st

from simenv_marl import RULE, TRUNCATED, difference
from tests.worlds.models import define

KINDS = (
    "method",
    "function",
    "keyword",
    "entity",
    "sometimes",
    "nested",
    "generator",
    "choices",
    "apply",
)


@dataclass(frozen=True)
class Design:
    """What a world is like.

    Attributes:
        kinds: Of what kind each decision point is.
        program: The calls: of which point, for which of three entities.
        policies, rules: The points that a policy answers, and those that only their rule answers.
        differences: The points that are paid by how much the level has changed.
        truncates, max_steps: Whether the end is a limit of time; the environment's limit.
    """

    kinds: tuple[str, ...]
    program: tuple[tuple[int, int], ...]
    policies: frozenset[int] = frozenset()
    rules: frozenset[int] = frozenset()
    differences: frozenset[int] = frozenset()
    truncates: bool = False
    max_steps: int | None = None

    @property
    def active(self):
        """The points that the environment's user answers."""
        return [
            point for point in range(len(self.kinds)) if point not in self.policies | self.rules
        ]


@st.composite
def designs(draw):
    """Any design in which at least one decision is the user's."""
    number = draw(st.integers(1, 4))
    kinds = tuple(draw(st.sampled_from(KINDS)) for _ in range(number))
    calls = st.tuples(st.integers(0, number - 1), st.integers(0, 2))
    first = draw(st.integers(0, number - 1))
    others = [point for point in range(number) if point != first]
    answered = draw(st.sets(st.sampled_from(others), max_size=2)) if others else set()
    policies = {point for point in answered if draw(st.booleans())}
    return Design(
        kinds=kinds,
        program=((first, 1), *draw(st.lists(calls, max_size=14))),
        policies=frozenset(policies),
        rules=frozenset(answered - policies),
        differences=frozenset(draw(st.sets(st.integers(0, number - 1)))),
        truncates=draw(st.booleans()),
        max_steps=draw(st.none() | st.integers(1, 12)),
    )


seeds = st.integers(0, 2**31 - 1)

answers = seeds.map(
    lambda seed: random.Random(seed).choices([*range(10), RULE], [1] * 10 + [3], k=80)
)
"""Answers in the order of the decisions; an integer becomes legal by its remainder.

There are enough of them.
"""


def agent_of(kind, point, entity):
    """Who decides a call."""
    if kind == "sometimes" and entity == 0:
        return None
    return f"point_{point}_{entity}" if kind in ("entity", "sometimes") else f"point_{point}"


def watched(level, calls):
    """What everybody observes."""
    return [level, calls]


def paid(level, point):
    """What whoever decides at a point is paid."""
    return (level * (point + 2) % 23 - 9) / 8


def offered(level):
    """The choices at a level."""
    return [level % 5 + number for number in range(1 + level % 3)]


def advised(observation, info):
    """What a policy answers: the level that it observes, made legal."""
    return legal(int(observation[0]), info)


def legal(answer, info):
    """An answer among those that a mask allows: the first ones, or any of ten."""
    return answer if answer is RULE else answer % (int(info["action_mask"].sum()) if info else 10)


class Entity:
    """What some of the points are decided for."""

    def __init__(self, world, number):
        self.world, self.number = world, number


class World:
    """A simulation of a design."""

    def __init__(self, design, points):
        self.design, self.points = design, points

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.level, self.calls, self.trace = self.random.randrange(50), 0, []
        self.entities = [Entity(self, number) for number in range(3)]

    def run(self):
        for point, entity in self.design.program:
            value = self.call(point, entity)
            self.calls += 1
            self.level = (self.level * 3 + value + self.random.randrange(4)) % 101
            self.trace.append((point, value, self.level))
        return TRUNCATED if self.design.truncates else None

    def call(self, point, entity):
        kind, function = self.design.kinds[point], self.points[point]
        if kind == "keyword":
            return function(self, number=entity)
        if kind in ("entity", "sometimes"):
            return function(self.entities[entity])
        if kind == "generator":
            return next(iter_value(function(self)))
        return function(self)

    def rule(self, point):
        value = self.random.randrange(7)
        if self.design.kinds[point] == "nested" and point > 0:
            value += self.call(point - 1, value % 3)
        return value


def iter_value(generator):
    """The one value of a generator, as an iterator."""
    value = yield from generator
    yield value


def points_of(design):
    """Decision functions of a design, whose rules are those of the world."""
    return [
        _point(kind, number, number in design.differences)
        for number, kind in enumerate(design.kinds)
    ]


def _point(kind, point, by_difference):
    def world_of(thing):
        return thing.world if isinstance(thing, Entity) else thing

    changes = {
        "agent": f"point_{point}",
        "observation_space_mapping": lambda thing, **_: watched(
            world_of(thing).level, world_of(thing).calls
        ),
        "reward_mapping": lambda thing, **_: paid(world_of(thing).level, point),
    }
    if by_difference:
        changes["reward_mapping"] = difference(lambda thing, **_: world_of(thing).level / 4)

    class Rules:
        def of_world(self):
            return self.rule(point)

        def keyword(self, *, number):
            return self.rule(point)

        def generator(self):
            if point < 0:
                yield
            return self.rule(point)

        def of_entity(self):
            return self.world.rule(point)

    def function(world):
        return world.rule(point)

    rule = Rules.of_world
    if kind == "function":
        rule = function
    elif kind in ("entity", "sometimes"):
        rule = Rules.of_entity
        changes["agent"] = lambda entity: agent_of(kind, point, entity.number)
    elif kind in ("keyword", "generator"):
        rule = vars(Rules)[kind]
    if kind == "choices":
        changes |= {
            "choices": lambda world: offered(world_of(world).level),
            "action_space": spaces.Discrete(4),
        }
    if kind == "apply":
        changes["apply"] = lambda action, world: action + world.random.randrange(3)
    return define(**changes)(rule)


@dataclass
class Told:
    """What an agent is told when it decides or ends."""

    agent: str
    observation: list[int]
    reward: float


class _PendingError(Exception):
    pass


class Reference(World):
    """What must come of a design, a seed and the answers that were given so far.

    Attributes:
        turns: The decisions that have arisen, in their order; the last one waits unless the episode
            is over.
        ends: What the agents are told at the end; None where the episode is not over.
        truncated: Whether it was truncated.
        trace: What the model has noted.
    """

    def __init__(self, design, seed, answers):
        super().__init__(design, [])
        self.turns = []
        self.ends = None
        self.truncated = False
        self._decided = {}
        self._remembered = {}
        self._given, self._steps = iter(answers), 0
        self.reset(seed)
        with suppress(_PendingError):
            self._end(truncated=self.run() is TRUNCATED)

    def _end(self, *, truncated):
        self.truncated = truncated
        self.ends = {
            agent: Told(agent, watched(self.level, self.calls), self._paid(agent, point))
            for agent, point in self._decided.items()
        }

    def _paid(self, agent, point):
        if point not in self.design.differences:
            return paid(self.level, point)
        before, self._remembered[agent] = self._remembered.get(agent, self.level), self.level
        return (self.level - before) / 4

    def call(self, point, entity):
        """Who decides is told so, and does what was answered."""
        kind = self.design.kinds[point]
        agent = agent_of(kind, point, entity)
        if agent is None or point in self.design.rules:
            return self.rule(point)
        if point in self.design.policies:
            return self._value(kind, self.level)
        if self._steps == self.design.max_steps:
            self._end(truncated=True)
            raise _PendingError
        reward = self._paid(agent, point)
        if agent not in self._decided:
            reward = 0.0  # nothing was done yet
        self._decided[agent] = point
        self.turns.append(Told(agent, watched(self.level, self.calls), reward))
        answer = next(self._given, None)
        if answer is None:
            raise _PendingError
        self._steps += 1
        return self.rule(point) if answer is RULE else self._value(kind, answer)

    def _value(self, kind, answer):
        if kind == "choices":
            choices = offered(self.level)
            return choices[answer % len(choices)]
        action = answer % 10
        return action + self.random.randrange(3) if kind == "apply" else action
