"""How many branches and clones of random worlds differ from the run that they continue.

There are to be none.

Run with ``python -m tests.worlds.exactness 10000``.
"""

import random
import sys
import warnings
from functools import partial

from simenv_marl import aec_env, branch, clone, parallel_env, single_env
from tests.worlds import filing
from tests.worlds.filing import Archive
from tests.worlds.random_worlds import POINTS, Design, Yard, outcome
from tests.worlds.trips import move


def tree_of_archive(chance):
    """Whether branches and clones in a tree have their archive's outcome: files, generators."""

    def step(env):
        told = env.step(3)
        return repr(told), told[2]

    env = single_env(Archive, filing.choose)
    return of_tree(chance, env, step, lambda env: env.unwrapped.simulation.log, ["fork"])


def tree_of_yard(chance):
    """Whether branches and clones in a tree have their yard's outcome: births, deaths, stacks."""
    design = Design(
        machines=chance.randint(1, 4),
        jobs=chance.randint(1, 3),
        cranes=chance.randint(1, 3),
        plans=chance.randint(1, 5),
        luck=chance.randint(2, 6),
        until=chance.choice([None, *range(3, 16)]),
    )
    make, driver = chance.choice([aec_env, parallel_env]), chance.choice(["greenlet", "thread"])
    env = make(lambda: Yard(design), POINTS, driver=driver)
    methods = ["replay", "fork"] if driver == "greenlet" else ["replay"]
    return of_tree(chance, env, move, lambda env: outcome(env.unwrapped.simulation), methods)


def of_tree(
    chance,
    env,
    step,
    come,
    methods,
):
    """Whether an environment's clones, their clones and all branches have its outcome.

    All move in a random order. A ``step`` returns what is told, and whether it was the last one.
    ``come`` returns what has come of a simulation.
    """

    def rest(env, number, told):
        """All that is told to the end, and what has come."""
        told = [*told]
        while not (told and told[-1][1]):
            told.append(step(env))
        return told, env.unwrapped.call(come)

    env.reset(seed=chance.randrange(2**31))
    nodes = [(env, [])]
    for _ in range(chance.randrange(20, 60)):
        one, told = chance.choice(nodes)
        if told and told[-1][1]:
            continue
        if chance.random() < 0.3 and one.unwrapped.episode.pending is not None:
            nodes.append((clone(one, method=chance.choice(methods)), [*told]))
        else:
            told.append(step(one))
    ends, branched = {}, []
    for one, told in chance.sample(nodes, len(nodes)):  # some outlive what they were cloned from
        if one.unwrapped.episode.pending is not None:
            branched += branch(one, partial(rest, told=told), method=chance.choice(methods))
        ends[one] = rest(one, 0, told)
        if one is not env:
            one.close()
    own = ends.pop(env)
    env.close()
    return [each == own for each in (*ends.values(), *branched)]


def differing(number, seed=0):
    """How many of at least so many branches and clones differ, and of how many."""
    chance, alike = random.Random(seed), []
    while len(alike) < number:
        alike += chance.choice([tree_of_archive, tree_of_yard])(chance)
    return alike.count(False), len(alike)


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # an archive draws from the global generators
    differ, of = differing(int(sys.argv[1]))
    print(f"{differ} of {of:,} differ", flush=True)
