"""A model of a process of its own, on the client for Python: a flock of sheep."""

import random
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "clients" / "python"))
from simenv_marl_client import Client

client = Client(["sheep.graze"])


def graze(episode):
    """Sheep that graze each day; those that were born the night before have not decided yet."""
    chance, options = random.Random(episode.seed), episode.options
    flock, eaten = {}, 0
    for day in range(options.get("days", 2)):
        flock.update({f"{day}.{number}": chance.randrange(5) for number in range(options.get("sheep", 10))})
        if options.get("culled") and day:
            flock.pop("0.0", None)
            client.remove("sheep.graze", "0.0")
        for name, hunger in flock.items() if options.get("expects") else ():
            client.expect("sheep.graze", name, time=day, hunger=hunger)
        for name in flock:
            eaten += client.decide(
                "sheep.graze", name, rule=lambda name=name: flock[name], time=day, hunger=flock[name]
            )
    return eaten


if __name__ == "__main__":
    client.run(graze)
