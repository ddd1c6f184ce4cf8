"""A process of its own that speaks the wire: reservoirs are filled, leak, are given up, and return.

``python outside.py [EPISODES] [tells]`` plays it to an environment, which it tells or not what its
rule decides. ``python outside.py SEED`` plays it by its own rule. It needs nothing but Python, and
nothing of the library, as a simulator in another language would not have it. The tests run the same
model in their own process, too.
"""

import json
import os
import random
import sys
from math import inf


class Stopped(BaseException):
    """The environment has broken off the episode."""


class Reservoirs:
    """Some reservoirs.

    Whoever operates one says how much is let in; a broker, now and then, sets the price.
    """

    def __init__(self, seed, options):
        self.random = random.Random(seed)
        self.hours, self.words = options.get("hours", 12), options.get("words", 0)
        self.levels = {"a": 4.0, "b": 6.0}
        self.price, self.time, self.born, self.log = 1.0, 0.0, 0, []

    def run(self, decide, remove, update):
        """The main loop: decisions by ``decide``, removals by ``remove``, changes by ``update``."""
        for hour in range(self.hours):
            if self.words:
                print("hm" * self.words, file=sys.stderr)
            self.time = hour / 4
            for name in sorted(self.levels):
                if name not in self.levels:
                    continue
                level = self.levels[name]
                inflow = decide(
                    "reservoir.inflow",
                    name,
                    self.time,
                    {"level": level, "queue-length": hour, "price": self.price},
                    lambda level=level: round(max(0.0, 5.0 - level), 3),
                )
                self.levels[name] = level + inflow - self.random.uniform(0.2, 5.5)
                self.log.append([hour, name, self.levels[name]])
                if not 0 < self.levels[name] < 9:
                    level = self.levels.pop(name)
                    update(
                        "reservoir.inflow",
                        name,
                        {"level": level, "queue-length": hour, "price": self.price},
                    )
                    remove("reservoir.inflow", name)
                    self.born += 1
                    self.levels[f"new{self.born}"] = self.random.uniform(2, 6)
            if hour % 3 == 2:
                self.price = decide(
                    "broker.price",
                    None,
                    self.time,
                    {"total": sum(self.levels.values())},
                    lambda: self.price * 1.1,
                )

    def result(self):
        """What came of it."""
        return {"levels": self.levels, "price": self.price, "log": self.log}

    def by_its_rule(self):
        """What comes of it by its own rule."""
        self.run(
            lambda point, entity, time, arguments, rule: rule(),
            lambda *named: None,
            lambda *named: None,
        )
        return self.result()


class Wire:
    """The simulator's end."""

    def __init__(self):
        reading, writing = map(int, os.environ["SIMENV_MARL_FDS"].split(","))
        self.lines = open(reading, encoding="utf-8")  # noqa: SIM115
        self.writing = writing
        self.number = 0
        self.tells = "tells" in sys.argv  # what the rule decides
        self.model = None

    def send(self, frame):
        """Send a frame."""
        self.raw(json.dumps(frame).encode() + b"\n")

    def raw(self, line):
        """Send any bytes."""
        while line:
            line = line[os.write(self.writing, line) :]

    def receive(self):
        """Wait for a frame; the process ends where none can come any more."""
        line = self.lines.readline()
        if not line:
            sys.exit()
        return json.loads(line)

    def decide(self, point, entity, time, arguments, rule):
        """Have something decided."""
        self.number += 1
        frame = {
            "decide": self.number,
            "point": point,
            "entity": entity,
            "time": time,
            "args": arguments,
        }
        self.send({name: value for name, value in frame.items() if value is not None})
        answer = self.receive()
        if "reseed" in answer:
            self.model.random.seed(answer["reseed"])
            answer = self.receive()
        if "stop" in answer:
            raise Stopped
        assert answer["act"] == self.number
        if not answer.get("rule"):
            return answer["value"]
        value = rule()
        if self.tells:
            self.send({"decided": self.number, "value": value})
        return value

    def remove(self, point, entity):
        """Say that an entity is gone."""
        self.send({"remove": entity, "point": point})

    def update(self, point, entity, arguments):
        """Say what the arguments of an entity would be by now."""
        self.send({"update": entity, "point": point, "args": arguments})

    def play(self, make, points, episodes=inf):
        """Play so many episodes."""
        self.send(
            {"hello": 1, "points": points, "can": ["reseed", *(["decided"] if self.tells else [])]}
        )
        played = 0
        while played < episodes:
            start = self.receive()["start"]
            self.number, self.model = 0, make(start["seed"], start["options"])
            try:
                self.model.run(self.decide, self.remove, self.update)
            except Stopped:
                continue
            played += 1
            truncated = start["options"].get("truncated", False)
            self.send({"end": {"truncated": truncated, "result": self.model.result()}})


POINTS = ["reservoir.inflow", "broker.price"]


def main():
    """Play to an environment, or by the model's rule, with the result on the standard output."""
    numbers = [int(word) for word in sys.argv[1:] if word.isdecimal()]
    if "SIMENV_MARL_FDS" in os.environ:
        Wire().play(Reservoirs, POINTS, *numbers)
    else:
        print(json.dumps(Reservoirs(numbers[0], {}).by_its_rule()))


if __name__ == "__main__":
    main()
