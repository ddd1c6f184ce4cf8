"""Plays what the option "play" names; probe.cpp plays the same in C++, and Probe.java in Java.

Python 3.8 runs it.
"""

import os
import sys
import threading
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "clients" / "python"))
from simenv_marl_client import Client, Stop

client = Client(["a", "b"], report_rules="NESTED" not in os.environ)
seeds = []
client.on_reseed(seeds.append)


@client.decision("a", lambda name, level: name, 2.0, lambda name, level: {"level": level})
def decorated(name, level):
    return level + 1


class Array:
    """What NumPy's arrays and numbers have."""

    def tolist(self):
        return [1, 0.5, float("nan")]


def count():
    total = 0
    try:
        for _ in range(5):
            try:
                total += client.decide("a", "x", rule=lambda: 1, sum=total)
            except Exception:
                print("swallowed", file=sys.stderr)
    finally:
        try:
            last = f"rule {client.decide('b', 'last', rule=lambda: 7)}"
        except Stop:
            last = "Stop"
        client.update("b", "last", i=1)
        client.remove("b", "last")
        print("unwound by", last, file=sys.stderr)
    return total


def deaf():
    while True:
        with suppress(Stop):
            client.decide("a", "x", rule=lambda: 0)


def careless():
    with suppress(ZeroDivisionError):
        client.decide("a", "x", rule=lambda: 1 // 0)
    return client.decide("a", "x", rule=lambda: 1)


def fail():
    try:
        raise KeyError("the cause")
    except KeyError as cause:
        raise RuntimeError("the pump is broken") from cause


def threaded():
    """Decide in a thread that hides errors, as a library's callbacks do; never end by itself."""

    def callback():
        try:
            client.decide("a", "x", rule=lambda: 1)
        except RuntimeError:
            done.set()

    done = threading.Event()
    threading.Thread(target=callback, name="callbacks").start()
    done.wait()
    client.update("a", "x", level=1)
    return "nobody hears of that"


def reports():
    client.update("a", 12, time=1.5, level=0.5)
    client.remove("a", 12)
    client.remove("a", '"b"')
    client.update("a", level=1)
    client.expect("a", 12, time=1.5, level=0.5)
    client.expect("b")


def model(episode):
    def decide(rule, value=None):
        return client.decide("a", "x", rule=rule, value=value)

    value = episode.options.get("value")
    plays = {
        "echo": lambda: client.decide("a", "ä", time=0.25, value=value, rule=lambda: value),
        "arguments": lambda: client.decide(
            "a", rule=lambda: 0, value=[(1, 2), Array(), float("inf"), {"x": 0.5}]
        ),
        "nested": lambda: client.decide(
            "a", "x", rule=lambda: 10 * client.decide("b", "y", rule=lambda: 1)
        ),
        "reseed": lambda: decide(lambda: seeds[-1]),
        "bad arguments": lambda: decide(lambda: 0, object()),
        "bad result": object,
        "reserved": lambda: client.decision("a", arguments=lambda: {"time": 3})(lambda: 0)(),
        "huge": lambda: decide(lambda: 0, "x" * (16 << 20)),
        "truncated": lambda: client.end({"reached": 3}, truncated=True),
        "leave": lambda: sys.exit(episode.options["status"]),
        "shell": lambda: os.system(episode.options["command"]),
        "seed": lambda: episode.seed,
        "decorated": lambda: decorated("x", 3),
        "count": count,
        "deaf": deaf,
        "careless": careless,
        "fail": fail,
        "reports": reports,
        "threaded": threaded,
    }
    return plays.get(episode.options.get("play", "echo"), lambda: None)()


if __name__ == "__main__":
    result = client.run(model, 7, {"play": sys.argv[1]} if len(sys.argv) > 1 else {})
    if not client.connected:
        print(result)
