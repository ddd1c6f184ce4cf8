"""Plays what the option "play" names; probe.cpp plays the same in C++, and Probe.java in Java. Python 3.8 runs it."""

import json
import os
import sys
import threading
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "clients" / "python"))
from simenv_marl_client import Client, Stop

client = Client(["a", "b"], report_rules="NESTED" not in os.environ)
seeded = 0


@client.on_reseed
def reseed(seed):
    global seeded
    seeded = seed


@client.decision("a", lambda name, level: name, 2.0, lambda name, level: {"level": level})
def decorated(name, level):
    return level + 1


class Array:
    """What NumPy's arrays and numbers have."""

    def tolist(self):
        return [1, 0.5, float("nan")]


def types():
    def decide(value):
        return client.decide("a", rule=lambda: value)

    return [decide(0.5), decide(3), decide(True), decide("rule"), decide([1.0, 2.0]), decide(None)]


def count(times):
    total = 0
    try:
        for _ in range(times):
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


def deaf(times):
    heard = 0
    while True:
        try:
            client.decide("a", "x", rule=lambda: 0)
        except Stop:
            heard += 1
            if heard == times:
                raise


def careless():
    try:
        client.decide("a", "x", rule=lambda: 1 // 0)
    except ZeroDivisionError:
        print("swallowed", file=sys.stderr)
    return client.decide("a", "x", rule=lambda: 1)


def fail():
    try:
        raise KeyError("the cause")
    except KeyError as cause:
        raise RuntimeError("the pump is broken") from cause


def threaded():
    """Decide in a thread whose errors nobody sees, as in callbacks that a library catches; never end by itself."""

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
    play, options = episode.options.get("play", "echo"), episode.options
    times = options.get("times", 5)
    value = options.get("value")
    if play == "echo":
        return client.decide("a", "ä", time=0.25, value=value, rule=lambda: value)
    if play == "arguments":
        return client.decide("a", rule=lambda: 0, value=[(1, 2), Array(), float("inf"), {"x": 0.5}])
    if play == "nested":
        return client.decide("a", "x", rule=lambda: 10 * client.decide("b", "y", rule=lambda: 1))
    if play == "reseed":
        return client.decide("a", "x", rule=lambda: seeded)
    if play == "decorated":
        return decorated("x", 3)
    if play in ("bad arguments", "bad result"):
        return client.decide("a", "x", rule=lambda: 0, value=object()) if play == "bad arguments" else object()
    if play == "reserved":
        return client.decision("a", arguments=lambda: {"time": 3})(lambda: 0)()
    if play == "huge":
        return client.decide("a", "x", rule=lambda: 0, value="x" * (16 << 20))
    if play == "truncated":
        client.end({"reached": 3}, truncated=True)
    if play == "leave":
        sys.exit(options.get("status"))
    if play == "shell":
        return os.system(options["command"])
    plays = {"types": types, "careless": careless, "fail": fail, "reports": reports, "seed": lambda: episode.seed}
    plays.update(count=lambda: count(times), deaf=lambda: deaf(times), threaded=threaded)
    return plays.get(play, lambda: None)()


if __name__ == "__main__":
    options = {"play": sys.argv[1]} if len(sys.argv) > 1 else {}
    if len(sys.argv) > 2:
        options["value"] = json.loads(sys.argv[2])
    result = client.run(model, 7, options)
    if not client.connected:
        print(json.dumps(result, separators=(",", ":"), ensure_ascii=False))
