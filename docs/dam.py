"""A dam that uses the wire protocol, in few lines. It represents a simulator in any language."""

import json
import os
import random
import sys


class Stopped(BaseException):
    """The environment has abandoned this episode."""


def run(decide, seed, days):
    """Run the model: every day, it decides how much water to let out."""
    weather, level = random.Random(seed), 50.0
    for day in range(days):
        level += weather.uniform(0, 10)
        seen = {"level": round(level, 2)}
        outlet = decide("dam.outlet", "north", day, seen, rule=lambda level=level: level / 10)
        level = max(0.0, level - outlet)
    return {"level": round(level, 2)}


def plain_rule(point, entity, time, args, rule):
    """Decide by the model's own rule."""
    return rule()


def speak(reading, writing):
    """Run one episode after the other for an environment."""

    def send(frame):
        writing.write(json.dumps(frame) + "\n")
        writing.flush()

    def receive():
        line = reading.readline()
        if not line:
            sys.exit()  # the environment has closed the pipe
        return json.loads(line)

    send({"hello": 1, "points": ["dam.outlet"]})
    while True:
        start, number = receive()["start"], 0

        def decide(point, entity, time, args, rule):
            nonlocal number
            number += 1
            send({"decide": number, "point": point, "entity": entity, "time": time, "args": args})
            answer = receive()
            if "stop" in answer:
                raise Stopped
            assert answer["act"] == number, answer
            return rule() if answer.get("rule") else answer["value"]

        try:
            result = run(decide, start["seed"], start["options"].get("days", 5))
        except Stopped:
            continue
        send({"end": {"truncated": False, "result": result}})


if __name__ == "__main__":
    if "SIMENV_MARL_FDS" in os.environ:
        numbers = os.environ["SIMENV_MARL_FDS"].split(",")
        with open(int(numbers[0])) as reading, open(int(numbers[1]), "w") as writing:
            speak(reading, writing)
    else:
        print(run(plain_rule, seed=1, days=5))
