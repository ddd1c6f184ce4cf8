"""How many branches of random worlds differ from the run of which they are branches; there are to be none.

Run with ``python -m tests.worlds.exactness 10000``.
"""

from __future__ import annotations

import random
import sys
import warnings
from typing import Any

from simenv_marl import aec_env, branch, single_env
from tests.worlds import filing
from tests.worlds.filing import Archive
from tests.worlds.random_worlds import POINTS, Design, Yard, advised, outcome


def advance(env: Any, decisions: int) -> None:
    """Let a yard go on for some decisions, or to the last one."""
    for agent in env.agent_iter(decisions):
        observation, _, terminated, truncated, _ = env.last()
        assert agent == env.agent_selection
        env.step(None if terminated or truncated else advised(observation))


def is_over(env: Any) -> bool:
    """Whether nothing is left to be decided."""
    return all(env.terminations[agent] or env.truncations[agent] for agent in env.agents)


def rest_of_yard(env: Any, number: int = 0) -> Any:
    """All that comes of a yard, and what its agents are told."""
    told = []
    while env.agents:
        told.append((env.agent_selection, repr(env.last()[:4])))
        advance(env, 1)
    return told, outcome(env.simulation)


def of_archive(chance: random.Random) -> list[bool]:
    """Which of some branches of an archive are what it would have been: files, and global generators."""
    env = single_env(Archive, filing.choose)
    env.reset(seed=chance.randrange(2**31))
    for _ in range(chance.randrange(12)):
        env.step(3)
    found = branch(env, filing.left, 3, method="fork")
    own = filing.left(env)
    return [each == own for each in found]


def of_yard(chance: random.Random) -> list[bool]:
    """Which of some branches of a yard are what it would have been: births, deaths, stacks in stacks."""
    design = Design(
        machines=chance.randint(1, 4),
        jobs=chance.randint(1, 3),
        cranes=chance.randint(1, 3),
        plans=chance.randint(1, 5),
        luck=chance.randint(2, 6),
        until=chance.choice([None, *range(3, 16)]),
    )
    driver = chance.choice(["greenlet", "thread"])
    env = aec_env(lambda: Yard(design), POINTS, driver=driver)
    env.reset(seed=chance.randrange(2**31))
    advance(env, chance.randrange(15))
    found = []
    if not is_over(env):
        for method in ("replay", "fork") if driver == "greenlet" else ("replay",):
            found += branch(env, rest_of_yard, 2, method=method)
    own = rest_of_yard(env)
    env.close()
    return [each == own for each in found]


def differing(number: int, seed: int = 0) -> tuple[int, int]:
    """How many of at least so many branches differ, and of how many."""
    chance, alike = random.Random(seed), list[bool]()
    while len(alike) < number:
        alike += chance.choice([of_archive, of_yard])(chance)
    return alike.count(False), len(alike)


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # an archive draws from the global generators
    print("{} of {:,} branches differ".format(*differing(*map(int, sys.argv[1:]))))
