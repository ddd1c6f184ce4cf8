"""Models whose agents are entities that are born, decide and are removed.

``life`` plays a line of text: use it where a test needs one certain order of events. ``Colony``
draws births and deaths: use it for properties of any order. ``AnsweredColony`` is the same
without the library, and notes the decisions and rewards that a view must report.
"""

import random
from collections import Counter
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces
from hypothesis import strategies as st

from simenv_marl import RULE, TRUNCATED, SimulationInterface, difference
from tests.worlds.models import define

HERE = __name__


class Being:
    """An entity that decides by ``act`` and goes by ``leave``."""

    def __init__(self, number):
        self.number, self.health, self.whole = number, 0, True

    def act(self):
        return "rule"

    def leave(self):
        self.whole = False


class Other:
    """An entity of another kind."""

    def __init__(self, number):
        self.number = number

    def act(self):
        return "other rule"

    def leave(self):
        pass


def banish(place, being):
    """End a being by a function whose first argument is another object."""
    being.whole = False


def being_of(being):
    """The agent of a being."""
    return f"being_{being.number}"


def other_of(other):
    """The agent of another."""
    return f"other_{other.number}"


def watch(being):
    """Observe the number and the health of a being; fail if it has left."""
    assert being.whole, "observed after its end"
    return [being.number, being.health]


def pay(being):
    """Reward a being by its health; fail if it has left."""
    assert being.whole, "rewarded after its end"
    return being.health


def beings(**changes):
    """The point of beings, which ``leave`` ends, but for what is changed."""
    given = {"agent": being_of, "observation_space_mapping": watch, "reward_mapping": pay}
    return {Being.act: define(**given | {"removed_by": f"{HERE}.Being.leave"} | changes)}


def others(**changes):
    """The point of the others."""
    return {Other.act: define(**{"agent": other_of, "removed_by": f"{HERE}.Other.leave"} | changes)}


@dataclass(frozen=True)
class ColonyDesign:
    """What a colony is like.

    Attributes:
        initial, most: How many creatures there are first, and may be in all.
        ticks: How long it runs.
        overseen: Whether the colony itself decides in each tick, and when: before or after the
            creatures.
        truncates: Whether the end is a limit of time.
    """

    initial: int
    most: int
    ticks: int
    overseen: str = ""
    truncates: bool = False


MOST = 10
ROSTER = [f"creature_{number}" for number in range(MOST)]

colony_designs = st.builds(
    ColonyDesign,
    initial=st.integers(1, 5),
    most=st.integers(5, MOST),
    ticks=st.integers(1, 6),
    overseen=st.sampled_from(["", "before", "after"]),
    truncates=st.booleans(),
)

seeds = st.integers(0, 2**31 - 1)


def answer(seed, agent, number):
    """What an agent answers at its decision of that number, whoever asks."""
    return random.Random(f"{seed} {agent} {number}").choice([0, 1, 2, 3, 4, 4, RULE])


class Creature:
    """Decides a number, on which depends who is born and who dies."""

    def __init__(self, colony, number):
        self.colony, self.number, self.decided = colony, number, 0

    @property
    def name(self):
        return f"creature_{self.number}"

    def act(self):
        return self.colony.random.randrange(5)

    def die(self):
        self.colony.creatures.remove(self)
        self.colony.trace.append((self.name, "died"))


class Colony:
    """A simulation of creatures."""

    creature = Creature

    def __init__(self, design):
        self.design = design

    def reset(self, seed=None):
        self.seed = seed
        self.random = random.Random(seed)
        self.trace = []
        self.fortune = self.born = self.overseen = 0
        self.creatures = []
        self.queue = []
        for _ in range(self.design.initial):
            self.bear()

    def bear(self):
        if self.born < self.design.most:
            self.creatures.append(self.creature(self, self.born))
            self.born += 1

    def run(self):
        for _ in range(self.design.ticks):
            self.queue = self.random.sample(self.creatures, len(self.creatures))
            if self.design.overseen == "before":
                self.decide_itself()
            while self.queue:
                creature = self.queue.pop(0)
                if creature in self.creatures:
                    self.decide(creature)
                del creature  # whoever has died is to be held by nobody
            if self.design.overseen == "after":
                self.decide_itself()
            self.trace.append("tick")
        return TRUNCATED if self.design.truncates else None

    def oversee(self):
        return self.random.randrange(5)

    def decide_itself(self):
        value = self.oversee()
        self.overseen += 1
        self.note("overseer_0", value)

    def note(self, agent, value):
        self.fortune = (self.fortune * 3 + value + self.random.randrange(4)) % 997
        self.trace.append((agent, value, self.fortune))

    def decide(self, creature, *, again=True):
        value = creature.act()
        creature.decided += 1
        self.note(creature.name, value)
        event = (value + self.random.randrange(4)) % 9
        if event in (1, 4):
            self.bear()
        if event in (2, 4):
            creature.die()
        elif event == 3 and again:
            self.decide(creature, again=False)
        elif event == 5:
            for victim in self.random.sample(self.creatures, min(2, len(self.creatures))):
                victim.die()


class AnnouncingColony(Colony):
    """A colony that knows who is going to decide."""

    def expected_calls(self, point):
        return (
            [(creature,) for creature in self.creatures]
            if point.endswith("Creature.act")
            else [(self,)]
        )


class AnsweredColony(Colony):
    """A colony without an environment, in which everybody answers as ``answer`` says.

    It keeps who has decided, in their order, and by agent the fortune at its first decision and at
    its end.
    """

    def __init__(self, design, seed=None, answers=answer):
        super().__init__(design)
        reference = self

        class AnsweredCreature(Creature):
            def act(self):
                return reference.asked(self.name, super().act)

            def die(self):
                reference.ends(self.name)
                super().die()

        self.creature = AnsweredCreature
        self.answers = answers
        self.decisions = []
        self.first = {}
        self.last = {}
        self.reset(seed)
        self.ended = self.run()
        for agent in self.first:
            self.ends(agent)

    def oversee(self):
        return self.asked("overseer_0", super().oversee)

    def asked(self, agent, rule):
        self.first.setdefault(agent, self.fortune)
        value = self.answers(self.seed, agent, self.decisions.count(agent))
        self.decisions.append(agent)
        return rule() if value is RULE else value

    def ends(self, agent):
        self.last.setdefault(agent, self.fortune)

    @property
    def totals(self):
        """The return of each agent that has decided: the change of the fortune in its life."""
        return {agent: float(self.last[agent] - self.first[agent]) for agent in self.first}


def colony_points(*, overseen):
    """The points of a colony, at which the change of its fortune is paid."""
    space = {"observation_space": spaces.Box(-1, 1e4, (3,), np.float64)}
    points = {
        Creature.act: define(
            agent=lambda creature: creature.name,
            observation_space_mapping=lambda c: [c.number, c.decided, c.colony.fortune],
            reward_mapping=difference(lambda creature: creature.colony.fortune),
            removed_by=f"{HERE}.Creature.die",
            **space,
        )
    }
    if overseen:
        points[Colony.oversee] = define(
            agent="overseer_0",
            observation_space_mapping=lambda colony: [-1, colony.overseen, colony.fortune],
            reward_mapping=difference(lambda colony: colony.fortune),
            **space,
        )
    return points


_made = {}


def colony(make, design, simulation=Colony, *, roster=False):
    """An environment of a colony, also one made before.

    ``roster``: whether all possible agents are declared.
    """
    key = make, bool(design.overseen), simulation, roster
    if key not in _made:
        names = {f"{HERE}.Creature.act": ROSTER} if roster else None
        points = colony_points(overseen=bool(design.overseen))
        _made[key] = make(lambda: simulation(design), points, possible_agents=names)
    _made[key].unwrapped.simulation.design = design
    return _made[key]


def colony_policy(observation, seed):
    """The answer of whoever makes that observation."""
    number, decided = int(observation[0]), int(observation[1])
    return answer(seed, f"creature_{number}" if number >= 0 else "overseer_0", decided)


def play_colony(env, seed, look=lambda agent: None):
    """Play a colony; check PettingZoo's books at every step, and look at each decision.

    Returns who decided, the totals and the ends.
    """
    env.reset(seed=seed)
    decided, totals, ends = [], Counter(), {}
    booked = Counter(env.rewards)
    for agent in env.agent_iter():
        assert agent not in ends
        assert agent in env.agents
        assert len(set(env.agents)) == len(env.agents)
        for book in (env.rewards, env.terminations, env.truncations, env.infos):
            assert set(book) == set(env.agents)
        observation, reward, terminated, truncated, _ = env.last()
        assert observation in env.observation_space(agent)
        totals[agent] += reward
        assert type(reward) is float
        assert type(terminated) is type(truncated) is bool
        if terminated or truncated:
            ends[agent] = (terminated, truncated)
            env.step(None)
        else:
            look(agent)
            env.step(answer(seed, agent, decided.count(agent)))
            decided.append(agent)
        booked.update(env.rewards)
    assert {a: t for a, t in booked.items() if t} == {a: t for a, t in totals.items() if t}
    return decided, totals, ends


class Life(SimulationInterface):
    """A simulation of ten beings, whose time is ``now`` if it is timed."""

    def __init__(self, program, announced, ends, kind):
        self.program, self.announced, self.ends, self.kind = program, announced, ends, kind

    def reset(self, seed=None):
        self.seed, self.now = seed, 0.0
        self.log = []
        self.asked = []
        self.beings = {number: self.kind(number) for number in range(10)}

    def run(self):
        for number, what, *value in map(str.split, self.program.split(", ")):
            if what == "o'clock":
                self.now = float(number)
            else:
                self.happens(int(number), what, *map(int, value))
        return self.ends

    def happens(self, number, what, *value):
        """Do one thing to a being; any other word is an attribute, which gets the value."""
        if what == "acts":
            self.log.append(self.beings[number].act())
        elif what == "leaves":
            self.beings[number].leave()
        elif what == "banished":
            banish("nowhere", self.beings[number])
        elif what == "ends":  # without any call that could be named
            self.end_agent(None)  # nobody
            self.end_agent(being_of(self.beings[number]))
        elif what == "forgotten":
            del self.beings[number]
        elif what == "fails":
            raise ZeroDivisionError
        else:
            setattr(self.beings[number], what, *value)


class AnnouncingLife(Life):
    """A life that announces decisions."""

    def expected_calls(self, point):
        self.asked.append(point)
        return [(self.beings[number],) for number in self.announced or ()]


def life(program, *, announced=None, timed=False, ends=None, kind=Being):
    """A factory of lives, as ``life("0 acts, 0 health 5, 0 leaves, 1 acts")``."""
    base = Life if announced is None else AnnouncingLife
    if timed:
        base = type("Timed", (base,), {"time": lambda self: self.now})
    return lambda: base(program, announced, ends, kind)


def story(turns):
    """Who decides, is removed and is truncated, in the order of turns."""
    words = []
    for turn in turns:
        words.append(
            turn.agent.removeprefix("being_") + "+" * turn.terminated + "~" * turn.truncated
        )
    return " ".join(words)
