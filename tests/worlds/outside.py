"""Models outside Python: simulators in processes of their own, which speak the wire.

``python outside.py [EPISODES] [tells]`` plays reservoirs, which are filled, leak, are given up and
return, to an environment; with ``tells`` it says what its rule decides. ``python outside.py SEED``
plays them by their own rule. ``python outside.py bare POINT ...`` sends only required frames.
``python outside.py faulty WHAT`` does something wrong in mid-episode, one of ``FAULTS``.

This file needs nothing but Python, as a simulator in another language would. ``tests/outside``
has the same model in the process of the tests.
"""

import json
import os
import random
import subprocess
import sys
import time
from math import inf
from typing import Any


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


def _grandchild(wire):
    """Exit, but leave a process that holds the pipes open."""
    subprocess.Popen(["sleep", "600"], pass_fds=(wire.writing, wire.lines.fileno()))
    os._exit(5)


def _close(wire):
    os.close(wire.writing)
    time.sleep(600)


def _flood(wire):
    os.write(2, b"a last word\n")
    os.abort()


UPDATE = {"update": "a", "point": "reservoir.inflow", "args": {}}

FAULTS = {
    "garbage": lambda wire: wire.raw(b"hello?\n"),
    "half a line": lambda wire: (wire.raw(b'{"decide": 4'), os._exit(0)),
    "drop by drop": lambda wire: [(wire.raw(b"{"), time.sleep(0.05)) for _ in range(12_000)],
    "silence": lambda wire: time.sleep(600),
    "exit": lambda wire: os._exit(3),
    "crash": _flood,
    "closed": _close,
    "grandchild": _grandchild,
    "updates": lambda wire: [wire.send(UPDATE) for _ in range(10**6)],
    "slow updates": lambda wire: [(wire.send(UPDATE), time.sleep(0.01)) for _ in range(60_000)],
    "gigabyte": lambda wire: [wire.raw(bytes(1 << 20)) for _ in range(1 << 10)],
    "error": lambda wire: wire.send(
        {"error": {"type": "Flood", "text": "a dam broke", "trace": "dam.cpp:12"}}
    ),
}
"""Faults in mid-episode, after three decisions."""


class Faulty:
    """A model that makes one of the faults."""

    wire: Any
    what: str

    def __init__(self, seed, options):
        self.options = options

    def run(self, decide, *_):
        """Decide three times, then make the fault."""
        try:
            for _ in range(3):
                decide(
                    "reservoir.inflow", "a", None, {"level": 1.0, "queue-length": 0}, lambda: 1.0
                )
        except Stopped:
            if self.what == "end after stop":
                self.wire.send({"end": {}})
            raise
        if not self.options.get("well"):
            FAULTS[self.what](self.wire)
            self.wire.receive()

    def result(self):
        """Nothing came of it."""


def bare(*points):
    """Play episodes of six decisions: each third one at the last point, others at the first."""
    reading, writing = map(int, os.environ["SIMENV_MARL_FDS"].split(","))
    with open(reading) as lines, open(writing, "w", buffering=1) as out:
        out.write(json.dumps({"hello": 1, "points": points, "written in": "Python"}) + "\n")
        for _ in lines:
            values = []
            for number in range(1, 7):
                point = points[-1 if number % 3 == 0 else 0]
                out.write(json.dumps({"decide": number, "point": point, "aside": [number]}) + "\n")
                answer = json.loads(next(lines))
                if "stop" in answer:
                    break
                values.append(answer.get("value"))
            else:
                out.write(json.dumps({"end": {"result": values}}) + "\n")


def main():
    """Play to an environment, or by the model's rule, with the result on the standard output."""
    kind, *words = sys.argv[1:] or [None]
    numbers = [int(word) for word in sys.argv[1:] if word.isdecimal()]
    if kind == "bare":
        bare(*words)
    elif kind == "faulty":
        Faulty.wire, Faulty.what = Wire(), *words
        print("there are many words", file=sys.stderr)
        Faulty.wire.play(Faulty, POINTS)
    elif "SIMENV_MARL_FDS" in os.environ:
        Wire().play(Reservoirs, POINTS, *numbers)
    else:
        print(json.dumps(Reservoirs(numbers[0], {}).by_its_rule()))


if __name__ == "__main__":
    main()
