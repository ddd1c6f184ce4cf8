"""How many branches and clones of random worlds differ from the run that they continue; there are to be none.

Run with ``python -m tests.worlds.exactness 10000``.
"""

from __future__ import annotations

import random
import sys
import warnings
from collections.abc import Callable
from typing import Any

from simenv_marl import aec_env, branch, clone, single_env
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


def an_archive(chance: random.Random) -> Any:
    """An archive at its first decision."""
    env = single_env(Archive, filing.choose)
    env.reset(seed=chance.randrange(2**31))
    return env


def a_yard(chance: random.Random) -> Any:
    """A yard at its first decision: births, deaths, stacks in stacks."""
    design = Design(
        machines=chance.randint(1, 4),
        jobs=chance.randint(1, 3),
        cranes=chance.randint(1, 3),
        plans=chance.randint(1, 5),
        luck=chance.randint(2, 6),
        until=chance.choice([None, *range(3, 16)]),
    )
    env = aec_env(lambda: Yard(design), POINTS, driver=chance.choice(["greenlet", "thread"]))
    env.reset(seed=chance.randrange(2**31))
    return env


def methods_of(env: Any) -> list[str]:
    """The methods by which a yard can be branched or cloned."""
    return ["replay", "fork"] if env.unwrapped.driver == "greenlet" else ["replay"]


def of_archive(chance: random.Random) -> list[bool]:
    """Which of some branches of an archive are what it would have been: files, and global generators."""
    env = an_archive(chance)
    for _ in range(chance.randrange(12)):
        env.step(3)
    found = branch(env, filing.left, 3, method="fork")
    own = filing.left(env)
    return [each == own for each in found]


def of_yard(chance: random.Random) -> list[bool]:
    """Which of some branches of a yard are what it would have been."""
    env = a_yard(chance)
    advance(env, chance.randrange(15))
    found = []
    if not is_over(env):
        for method in methods_of(env):
            found += branch(env, rest_of_yard, 2, method=method)
    own = rest_of_yard(env)
    env.close()
    return [each == own for each in found]


def tree_of_archive(chance: random.Random) -> list[bool]:
    """Which clones in a tree become what their archive becomes."""

    def step(env: Any) -> tuple[Any, bool]:
        told = env.step(3)
        return repr(told), told[2]

    return of_tree(chance, an_archive(chance), step, lambda env: env.unwrapped.simulation.log, ["fork"])


def tree_of_yard(chance: random.Random) -> list[bool]:
    """Which clones in a tree become what their yard becomes."""

    def step(env: Any) -> tuple[Any, bool]:
        told = list[Any]()
        while not told or (env.agents and is_over(env)):
            told.append((*env.agents, env.agent_selection, repr(env.last())))
            advance(env, 1)
        return told, not env.agents

    env = a_yard(chance)
    return of_tree(chance, env, step, lambda env: outcome(env.unwrapped.simulation), methods_of(env))


def of_tree(
    chance: random.Random, env: Any, step: Callable[[Any], tuple[Any, bool]], come: Any, methods: list[str]
) -> list[bool]:
    """Which clones of an environment, and of its clones, become what it becomes. All move in a random order.

    A ``step`` returns what is told, and whether it was the last one. ``come`` returns what has come of a simulation.
    """
    nodes: list[tuple[Any, list[Any]]] = [(env, [])]
    for _ in range(chance.randrange(20, 60)):
        one, told = chance.choice(nodes)
        if told and told[-1][1]:
            continue
        if chance.random() < 0.3:
            nodes.append((clone(one, method=chance.choice(methods)), [*told]))
        else:
            told.append(step(one))
    ends = {}
    for one, told in chance.sample(nodes, len(nodes)):  # some outlive what they were cloned from
        while not (told and told[-1][1]):
            told.append(step(one))
        ends[one] = told, one.unwrapped.call(come)
        if one is not env:
            one.close()
    own = ends.pop(env)
    env.close()
    return [each == own for each in ends.values()]


BRANCHES, CLONES = (of_archive, of_yard), (tree_of_archive, tree_of_yard)


def differing(number: int, seed: int = 0, kinds: Any = (*BRANCHES, *CLONES)) -> tuple[int, int]:
    """How many of at least so many branches and clones differ, and of how many."""
    chance, alike = random.Random(seed), list[bool]()
    while len(alike) < number:
        alike += chance.choice(kinds)(chance)
    return alike.count(False), len(alike)


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # an archive draws from the global generators
    for what, kinds in (("branches", BRANCHES), ("clones", CLONES)):
        differ, of = differing(int(sys.argv[1]), kinds=kinds)
        print(f"{differ} of {of:,} {what} differ", flush=True)
