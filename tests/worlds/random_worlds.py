"""Random models for tests by Hypothesis.

``World`` calls decision points of all kinds in one random order; ``Reference`` predicts, without
the library, what a view reports of it. ``Yard`` has SimPy processes, births and deaths: use it
where stacks and resources matter. ``Fair`` has split decisions, masks and forced moves.
"""

import random
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import simpy
from gymnasium import spaces
from hypothesis import strategies as st

from simenv_marl import RULE, TRUNCATED, difference, make_step
from tests.worlds.models import define

HERE = __name__
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
class WorldDesign:
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
def world_designs(draw):
    """Any design in which at least one decision is the user's."""
    number = draw(st.integers(1, 4))
    kinds = tuple(draw(st.sampled_from(KINDS)) for _ in range(number))
    calls = st.tuples(st.integers(0, number - 1), st.integers(0, 2))
    first = draw(st.integers(0, number - 1))
    others = [point for point in range(number) if point != first]
    answered = draw(st.sets(st.sampled_from(others), max_size=2)) if others else set()
    policies = {point for point in answered if draw(st.booleans())}
    return WorldDesign(
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
    """The name of the agent that decides a call."""
    if kind == "sometimes" and entity == 0:
        return None
    return f"point_{point}_{entity}" if kind in ("entity", "sometimes") else f"point_{point}"


def watched(level, calls):
    """The observation of every agent."""
    return [level, calls]


def paid(level, point):
    """The reward of an agent at a point."""
    return (level * (point + 2) % 23 - 9) / 8


def offered(level):
    """The choices at a level."""
    return [level % 5 + number for number in range(1 + level % 3)]


def world_policy(observation, info):
    """What a policy answers: the level that it observes, made legal."""
    return legal(int(observation[0]), info)


def legal(answer, info):
    """An answer among those that a mask allows: the first ones, or any of ten."""
    return answer if answer is RULE else answer % (int(info["action_mask"].sum()) if info else 10)


class Entity:
    """An entity of the model, for which some points decide."""

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


def world_policies(design, points):
    """The policies of a design by point: some answer, others leave it to the rule."""
    policies = {points[point]: world_policy for point in design.policies}
    return policies | {points[point]: RULE for point in design.rules} or None


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
        """Note the turn of the agent that decides, and use its answer."""
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


MOST_MACHINES = 6
YARD_ROSTER = {
    f"{HERE}.Machine.{name}": [f"{name}_{number}" for number in range(MOST_MACHINES)]
    for name in ("load", "pace")
}


@dataclass(frozen=True)
class YardDesign:
    """A yard: initial machines, jobs of each, and ``cranes``, the machines that may load at once.

    It decides itself every ``plans`` units of time. One of ``luck`` cases brings a birth or a
    death.
    """

    machines: int
    jobs: int
    cranes: int
    plans: int
    luck: int
    until: int | None


yard_designs = st.builds(
    YardDesign,
    machines=st.integers(1, 4),
    jobs=st.integers(1, 3),
    cranes=st.integers(1, 3),
    plans=st.integers(1, 5),
    luck=st.integers(2, 6),
    until=st.none() | st.integers(3, 15),
)


class Machine:
    """Decides how much to load, by a method, and how fast to go, by a generator."""

    def __init__(self, yard, number):
        self.yard, self.number, self.decided = yard, number, 0

    def load(self):
        return self.yard.random.randrange(1, 5)

    def pace(self):
        yield self.yard.clock.timeout(self.yard.random.randrange(2))
        return self.yard.random.randrange(1, 4)

    def work(self):
        yard = self.yard
        for _ in range(yard.design.jobs):
            yield yard.clock.timeout(yard.random.randrange(3))
            with yard.cranes.request() as request:
                yield request
                load = self.load()
                self.decided += 1
                yield yard.clock.timeout(load)
            pace = yield from self.pace()
            self.decided += 1
            yard.note(self.number, load, pace)
            event = yard.random.randrange(yard.design.luck * 2)
            if event == 0:
                yard.build()
            elif event == 1:
                yard.scrap(self)
                return


class Yard:
    """A simulation of machines."""

    render_modes = ("ansi",)

    def __init__(self, design):
        self.design = design

    def reset(self, seed=None):
        self.seed, self.random = seed, random.Random(seed)
        self.trace = []
        self.fortune = self.built = self.planned = 0
        self.machines = []
        self.retired = []  # held, for a reward of whom nobody holds any more is lost
        self.clock = simpy.Environment()
        self.cranes = simpy.Resource(self.clock, self.design.cranes)
        for _ in range(self.design.machines):
            self.build()

    def run(self):
        self.clock.process(self.manage())
        self.clock.run(self.design.until)
        return TRUNCATED if self.design.until else None

    def build(self):
        if self.built < MOST_MACHINES:
            machine = Machine(self, self.built)
            self.built += 1
            self.machines.append(machine)
            self.clock.process(self.working(machine))

    def working(self, machine):
        yield from machine.work()
        if machine in self.machines:
            self.machines.remove(machine)
            self.retired.append(machine)

    def scrap(self, machine):
        self.machines.remove(machine)
        self.trace.append(("scrapped", machine.number))

    def manage(self):
        while self.machines:
            self.note("plan", self.plan(), self.clock.now)
            self.planned += 1
            yield self.clock.timeout(self.design.plans)

    def plan(self):
        return self.random.randrange(5)

    def note(self, *what):
        self.fortune = (self.fortune * 3 + what[1] + self.random.randrange(4)) % 997
        self.trace.append((self.clock.now, *what, self.fortune))

    def state(self):
        return [self.fortune, self.clock.now]

    def time(self):
        return float(self.clock.now)

    def render(self, mode):
        return str(self.trace[-1:])


SPACE = {"observation_space": spaces.Box(-1, 1e4, (4,), np.float64)}
SCRAPPED = f"{HERE}.Yard.scrap"
YARD_POINTS = {
    f"{HERE}.Yard.plan": define(
        agent="planner",
        observation_space_mapping=lambda yard: [-1, yard.planned, yard.fortune, yard.seed % 997],
        reward_mapping=difference(lambda yard: yard.fortune),
        **SPACE,
    ),
} | {
    f"{HERE}.Machine.{name}": define(
        agent=lambda machine, name=name: f"{name}_{machine.number}",
        observation_space_mapping=lambda machine: [
            machine.number, machine.decided, machine.yard.fortune, machine.yard.seed % 997
        ],
        reward_mapping=difference(lambda machine: machine.yard.fortune),
        removed_by={SCRAPPED: lambda yard, machine, name=name: f"{name}_{machine.number}"},
        **SPACE,
    )
    for name in ("load", "pace")
}  # fmt: skip
"""The decision points of yards, by name: the model knows of none."""

YARD_PLAN = {f"{HERE}.Yard.plan": YARD_POINTS[f"{HERE}.Yard.plan"]}


def yard_policy(observation):
    """The answer to an observation of a machine or of the yard: an action, or the rule."""
    number, decided, _, seed = (int(value) for value in observation)
    return random.Random(f"{seed} {number} {decided}").choice([1, 2, 3, 4, RULE])


def plain_yard(design, seed):
    """A yard that has run on its own."""
    yard = Yard(design)
    yard.reset(seed)
    yard.run()
    return yard


def yard_outcome(yard):
    """All that has come of a yard."""
    return yard.trace, yard.fortune, yard.built, yard.clock.now, yard.random.getstate()


MOST_STALLS = 6


class Stall:
    """A stall, which sells at its price."""

    def __init__(self, number):
        self.number, self.earned = number, 0


class Fair:
    """A fair of some days: it prices all stalls in one call, and then lets one more in or not."""

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.day = self.built = 0
        self.level = self.random.randrange(50)
        self.days = self.random.randrange(2, 5)
        self.stalls = []
        for _ in range(self.random.randrange(1, 3)):
            self.build()

    def run(self):
        while self.stalls and self.day < self.days:
            for stall, price in zip(list(self.stalls), self.prices(), strict=True):
                stall.earned += price * (self.level % 3) - price**2 / 4
                self.level = (self.level * 3 + price + self.random.randrange(4)) % 101
                if self.level % 7 == 0:
                    self.shut(stall)
            self.level += self.enlarge()
            if self.level % 3 == 0:
                self.build()
            self.day += 1

    def build(self):
        if self.built < MOST_STALLS:
            self.stalls.append(Stall(self.built))
            self.built += 1

    def shut(self, stall):
        self.stalls.remove(stall)

    def prices(self):
        return [self.random.randrange(4) for _ in self.stalls]

    def enlarge(self):
        return self.random.choice(self.sizes())

    def sizes(self):
        return [number + self.level % 2 for number in range(1 + self.level % 4)]

    def time(self):
        return float(self.day)

    def reseed(self, seed):
        self.random.seed(seed)

    @property
    def fortune(self):
        return float(self.level + sum(stall.earned for stall in self.stalls))


def affordable(stall, fair, *, _answers):
    """The mask of prices: at most two stalls a day have the same one."""
    return np.array([_answers.count(price) < 2 for price in range(4)], np.int8)


SEEN = spaces.Box(-1e6, 1e6, (3,), np.float64)

FAIR_POINTS = {
    f"{HERE}.Fair.prices": make_step(
        split=lambda fair: list(fair.stalls),
        agent=lambda stall: f"stall_{stall.number}",
        observation_space=SEEN,
        observation_space_mapping=lambda stall, fair: [stall.number, fair.level, fair.day],
        action_space=spaces.Discrete(4),
        action_space_mapping={price: price for price in range(4)},
        action_mask_mapping=affordable,
        reward_mapping=lambda stall, fair: stall.earned / 3 + fair.level / 7,
        removed_by={f"{HERE}.Fair.shut": lambda fair, stall: f"stall_{stall.number}"},
        action_labels=["free", "cheap", "fair", "dear"],
    ),
    f"{HERE}.Fair.enlarge": make_step(
        agent="warden_0",
        observation_space=SEEN,
        observation_space_mapping=lambda fair: [-1, fair.level, len(fair.stalls)],
        action_space=spaces.Discrete(4),
        choices=Fair.sizes,
        reward_mapping=difference(lambda fair: fair.level / 3),
    ),
}


def fair_policy(observation, info):
    """An answer by the observation alone: a legal action, or the rule."""
    legal = np.flatnonzero(info["action_mask"]).tolist()
    return random.Random(str(observation.tolist())).choice([*legal, RULE])


def boldest(observation, info):
    """The last legal action."""
    return int(np.flatnonzero(info["action_mask"])[-1])


FAIR_POLICIES = dict.fromkeys(FAIR_POINTS, fair_policy)
