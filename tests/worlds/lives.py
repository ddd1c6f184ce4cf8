"""Simulations of beings that do in turn what a line of text says."""

from simenv_marl import SimulationInterface
from tests.worlds.many_worlds import Being, banish, being_of


class Life(SimulationInterface):
    """A simulation of ten beings; ``now`` is told as its time where it is timed."""

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
        """Let one thing happen to a being; whatever else it is is set."""
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


class Announcing(Life):
    """One that knows who is going to decide."""

    def expected_calls(self, point):
        self.asked.append(point)
        return [(self.beings[number],) for number in self.announced or ()]


def life(
    program,
    *,
    announced=None,
    timed=False,
    ends=None,
    kind=Being,
):
    """A factory of lives, as ``life("0 acts, 0 health 5, 0 leaves, 1 acts")``."""
    base = Life if announced is None else Announcing
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
