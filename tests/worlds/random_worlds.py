"""Random models of continuous-time processes: machines decide while they hold shared resources.

A ``Yard`` is made of SimPy processes, nested generators, births and deaths. What comes of it is all
in its ``trace`` and its generator, and depends on every decision and on their order.
"""

import random
from dataclasses import dataclass

import numpy as np
import simpy
from gymnasium import spaces
from hypothesis import strategies as st

from simenv_marl import RULE, TRUNCATED, difference
from tests.worlds.models import define

HERE = __name__
MOST = 6
ROSTER = {
    f"{HERE}.Machine.{name}": [f"{name}_{number}" for number in range(MOST)]
    for name in ("load", "pace")
}


@dataclass(frozen=True)
class Design:
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


designs = st.builds(
    Design,
    machines=st.integers(1, 4),
    jobs=st.integers(1, 3),
    cranes=st.integers(1, 3),
    plans=st.integers(1, 5),
    luck=st.integers(2, 6),
    until=st.none() | st.integers(3, 15),
)

seeds = st.integers(0, 2**31 - 1)


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
        if self.built < MOST:
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
POINTS = {
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

PLAN = {f"{HERE}.Yard.plan": POINTS[f"{HERE}.Yard.plan"]}


def advised(observation):
    """The answer to an observation of a machine or of the yard: an action, or the rule."""
    number, decided, _, seed = (int(value) for value in observation)
    return random.Random(f"{seed} {number} {decided}").choice([1, 2, 3, 4, RULE])


def plain(design, seed):
    """A yard that has run on its own."""
    yard = Yard(design)
    yard.reset(seed)
    yard.run()
    return yard


def outcome(yard):
    """All that has come of a yard."""
    return yard.trace, yard.fortune, yard.built, yard.clock.now, yard.random.getstate()
