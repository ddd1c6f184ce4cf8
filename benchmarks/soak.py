"""A soak test: very many episodes that are cut short at random must not leak resources.

Run it with ``python -m benchmarks.soak``; ``make soak`` does so with both drivers. It fails if
threads, greenlets, file descriptors, objects or memory leak.
"""

from __future__ import annotations

import argparse
import gc
import os
import random
import resource
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from greenlet import greenlet
from gymnasium import spaces

from simenv_marl import RULE, aec_env, joint_env, make_step, parallel_env, single_env

DRIVERS = ("greenlet", "thread")
WARM = 0.1
"""The share of episodes after which no figure may grow."""
GROWTH = {"objects": 100, "KiB": 8 * 1024}
"""The allowed growth of some figures: allocators keep memory for later."""


class Failed(Exception):
    """An error that the model raises now and then."""


class Animal:
    """An animal, which makes decisions."""

    def __init__(self, model: Model, number: int) -> None:
        self.model, self.number, self.load = model, number, bytearray(2000)

    def move(self) -> int:
        """Decide how far to go."""
        if self.model.random.random() < 0.002:
            raise Failed
        return self.model.random.randrange(4)


class Model:
    """A model of animals that are born and die, and of a keeper who decides inside a generator."""

    def reset(self, seed: int | None = None) -> None:
        self.random = random.Random(seed)
        self.animals = [Animal(self, number) for number in range(4)]
        self.born, self.moved = 4, 0

    def run(self) -> None:
        self.days = self.live()
        for _ in self.days:
            for animal in list(self.animals):
                self.moved += animal.move()

    def live(self) -> Iterator[None]:
        try:
            for _ in range(20):
                if self.keep():
                    self.animals.append(Animal(self, self.born))
                    self.born += 1
                elif len(self.animals) > 1:
                    self.remove(self.animals[0])
                yield
        finally:
            self.animals.clear()

    def keep(self) -> int:
        """Decide whether to add another animal."""
        return self.random.randrange(2)

    def remove(self, animal: Animal) -> None:
        self.animals.remove(animal)

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Return the next calls."""
        return [(animal,) for animal in self.animals] if point.endswith("move") else [(self,)]


NAME = f"{Model.__module__}.Model"
NAMED = f"{Animal.__module__}.Animal.move"
COMMON: dict[str, Any] = {
    "observation_space": spaces.Box(-1e6, 1e6, (2,), np.float64),
    "action_space_mapping": int,
    "reward_mapping": lambda thing: 1.0,
}
KEEP = make_step(
    **COMMON,
    action_space=spaces.Discrete(2),
    observation_space_mapping=lambda model: [model.moved, model.born],
    agent="keeper",
)
MOVE = make_step(
    **COMMON,
    action_space=spaces.Discrete(4),
    observation_space_mapping=lambda animal: [animal.number, 0],
    agent=lambda animal: f"animal_{animal.number}",
    removed_by={f"{NAME}.remove": lambda model, animal: f"animal_{animal.number}"},
)


def environments(driver: str) -> list[Callable[[], Any]]:
    """Return functions that make an environment of each view."""
    both = {f"{NAME}.keep": KEEP, NAMED: MOVE}
    roster = {NAMED: [f"animal_{number}" for number in range(30)]}
    return [
        lambda: aec_env(Model, both, driver=driver),
        lambda: parallel_env(Model, both, driver=driver),
        lambda: joint_env(Model, both, possible_agents=roster, driver=driver),
        lambda: single_env(Model, {f"{NAME}.keep": KEEP}, driver=driver),
    ]


def episode(env: Any, draw: random.Random) -> None:
    """Play a part of an episode."""
    env.reset(seed=draw.randrange(2**31))
    for _ in range(draw.randrange(12)):
        if hasattr(env, "agent_selection"):
            env.step(None if env.terminations[env.agent_selection] else draw.choice([0, 1, RULE]))
        elif hasattr(env, "agents"):
            env.step(
                {agent: draw.choice([0, 1, RULE]) for agent in env.agents if draw.random() < 0.9}
            )
        else:
            env.step(RULE if hasattr(env.action_space, "spaces") else draw.choice([0, 1, RULE]))


def play(driver: str, number: int, draw: random.Random) -> None:
    """Play a number of episodes, and end each in a random way."""
    makers = environments(driver)
    kept = [make() for make in makers]
    for _ in range(number):
        at = draw.randrange(len(kept))
        try:
            episode(kept[at], draw)
        except Failed:
            continue
        end = draw.random()
        if end < 0.3:
            kept[at].close()
        elif end < 0.4:
            kept[at] = makers[at]()  # the previous environment is abandoned
    for env in kept:
        env.close()


def figures() -> dict[str, int]:
    """Count the resources of this process."""
    gc.collect()
    things = gc.get_objects()
    with open("/proc/self/statm") as statm:
        resident = int(statm.read().split()[1]) * resource.getpagesize()
    return {
        "threads": threading.active_count(),
        # a thread's own greenlet, which has no parent, is freed a moment after the thread has ended
        "greenlets": sum(
            isinstance(thing, greenlet) and thing.parent is not None for thing in things
        ),
        "descriptors": len(os.listdir("/proc/self/fd")),
        "objects": len(things),
        "KiB": resident // 1024,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--driver", choices=DRIVERS, default=DRIVERS[0])
    parser.add_argument("--episodes", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    draw = random.Random(chosen.seed)
    warm = int(chosen.episodes * WARM)
    play(chosen.driver, warm, draw)
    before = figures()
    play(chosen.driver, chosen.episodes - warm, draw)
    after = figures()
    print(f"{chosen.driver}: {chosen.episodes} episodes")
    for name, value in after.items():
        print(f"  {name:12} {before[name]:>9} after {warm}, {value:>9} after all")
    grown = [name for name, value in after.items() if value > before[name] + GROWTH.get(name, 0)]
    if grown:
        print(f"  left behind: {', '.join(grown)}")
    return bool(grown)


if __name__ == "__main__":
    sys.exit(main())
