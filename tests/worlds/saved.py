"""Episodes in mid-course, and commands that compare thousands of their continuations.

``cases`` draws environments that can be saved: ``Depot`` (one call decides for many), ``Pumps``
(vectors as actions), yards and worlds. ``Archive`` has open files and global generators, for forks.

``python -m tests.worlds.saved 10000`` saves episodes and continues them in another process;
``python -m tests.worlds.saved 10000 branches`` does so with branches and clones. Both print how
many differ from their original: there are to be none.
"""

import json
import os
import pickle
import random
import shutil
import sys
import tempfile
import warnings
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

from simenv_marl import (
    RULE,
    aec_env,
    branch,
    clone,
    joint_env,
    load_episode,
    make_step,
    parallel_env,
    save_episode,
    single_env,
    turn_env,
)
from simenv_marl.core import EpisodeState
from tests.processes import python
from tests.worlds import random_worlds
from tests.worlds.copied import move as move_trip
from tests.worlds.models import decision
from tests.worlds.random_worlds import (
    KINDS,
    YARD_POINTS,
    World,
    WorldDesign,
    Yard,
    YardDesign,
    points_of,
    world_policies,
    yard_outcome,
)

HERE = __name__


def yard(machines, jobs, cranes, plans, luck, until):
    """Make a yard, from arguments that a file has."""
    return Yard(YardDesign(machines, jobs, cranes, plans, luck, until))


YARD = partial(yard, 3, 2, 2, 2, 3, None)


class Depot:
    """A simulation that decides for all its vans in one call, and removes some of them."""

    def reset(self, seed=None):
        self.random = random.Random(seed)
        self.vans = {f"van_{number}": self.random.randrange(5) for number in range(3)}
        self.day, self.trace = 0, []

    def run(self):
        while self.vans and self.day < 8:
            self.day += 1
            if self.random.randrange(3) == 0:
                self.vans[f"van_{self.day + 3}"] = self.day
            for van, load in self.loads(sorted(self.vans)).items():
                self.vans[van] = (self.vans[van] + int(load) + self.random.randrange(2)) % 6
            self.trace.append(dict(self.vans))
            for van in [van for van, load in self.vans.items() if load == 5]:
                self.scrap(van)

    def loads(self, vans):
        return {van: self.random.randrange(3) for van in vans}

    def scrap(self, van):
        del self.vans[van]


def mask_of(van, vans, *, _simulation):
    """Return which loads a van can take."""
    return np.arange(4, dtype=np.int8) <= 4 - _simulation.vans.get(van, 0) // 2


VANS = {
    f"{HERE}.Depot.loads": make_step(
        agent=lambda van: van,
        split=lambda depot, vans: vans,
        gather=lambda vans, loads, *_: dict(zip(vans, loads, strict=True)),
        part=lambda loads, van, *_: loads[van],
        observation_space=spaces.Dict(
            {"load": spaces.Box(0, 9, (2,)), "name": spaces.Text(9, charset="van_0123456789")}
        ),
        observation_space_mapping=lambda van, vans, *, _simulation: {
            "load": [_simulation.vans.get(van, 0), _simulation.day], "name": van
        },
        action_space=spaces.Discrete(4),
        action_space_mapping=lambda action: action,
        action_mask_mapping=mask_of,
        reward_mapping=lambda van, vans, *, _simulation: _simulation.vans.get(van, 0) / 3,
        removed_by={f"{HERE}.Depot.scrap": lambda depot, van: van},
    )
}  # fmt: skip


class Pumps:
    """A simulation of two pumps, each a point with a vector of actions."""

    points = ()

    def reset(self, seed=None, options=None):
        self.random = np.random.default_rng(seed)
        self.level = np.zeros(2) if options is None else np.array(options["level"], float)

    def run(self):
        for _ in range(12):
            self.level += self.push() * 0.3
            self.level -= self.pull() * 0.1
            self.level += self.random.normal(size=2)

    def push(self):
        return self.random.random(2)

    def pull(self):
        return self.random.random(2)


Pumps.points = {
    f"{HERE}.Pumps.{name}": make_step(
        agent=name,
        observation_space=spaces.Box(-99, 99, (2,), np.float32),
        observation_space_mapping=lambda pumps: pumps.level,
        action_space=spaces.Box(-1, 1, (2,), np.float32),
        action_space_mapping=lambda action: action,
        reward_mapping=lambda pumps: -float(abs(pumps.level).sum()),
    )
    for name in ("push", "pull")
}


def steady(observation):
    """Answer with a vector that depends on the observation."""
    return np.clip(observation / 10, -1, 1).astype(np.float32)


def pushing(observation, info):
    """Answer for a van or for a yard, by the mask if there is one."""
    mask = info.get("action_mask")
    return 1 if mask is None else int(np.flatnonzero(mask)[-1])


def define_again():
    """Return a definition that no module holds."""
    plan = YARD_POINTS[f"{random_worlds.HERE}.Yard.plan"]
    return replace(plan, agent="planner")


@dataclass
class Case:
    """An environment to save.

    Attributes:
        make: Makes it.
        arguments: The simulation, the points and the options.
        given: What must be given when it is loaded.
        reset: The options of the reset.
    """

    make: object
    arguments: tuple
    options: dict = field(default_factory=dict)
    given: object = dict
    reset: dict | None = None


def cases(chance):
    """Return a random case."""
    kind = chance.choice(["yard", "depot", "pumps", "world"])
    driver = chance.choice(["greenlet", "greenlet", "thread"])
    if kind == "yard":
        numbers = [chance.randint(1, 4), chance.randint(1, 3), chance.randint(1, 3)]
        numbers += [chance.randint(1, 5), chance.randint(2, 6), chance.choice([None, 5, 15])]
        make, options = chance.choice(
            [
                (aec_env, {}),
                (parallel_env, {}),
                (turn_env, {}),
                (turn_env, {"flatten": True}),
                (joint_env, {"possible_agents": random_worlds.YARD_ROSTER}),
                (single_env, {"agent": "planner"}),
                (
                    aec_env,
                    {"policies": {f"{random_worlds.HERE}.Machine.load": random_worlds.yard_policy}},
                ),
                (parallel_env, {"policies": {"planner": random_worlds.yard_policy}}),
            ]
        )
        return Case(make, (partial(yard, *numbers), YARD_POINTS), {"driver": driver, **options})
    if kind == "depot":
        make, options = chance.choice(
            [
                (aec_env, {}),
                (parallel_env, {}),
                (turn_env, {}),
                (aec_env, {"policies": {"van_1": pushing, "van_2": RULE}}),
                (turn_env, {"skip_forced": True, "policies": {"van_0": pushing}}),
            ]
        )
        return Case(make, (Depot, VANS), {"driver": driver, **options})
    if kind == "pumps":
        make, options = chance.choice(
            [
                (aec_env, {"clip_actions": True}),
                (parallel_env, {}),
                (joint_env, {}),
                (joint_env, {"flatten": True}),
                (turn_env, {}),
                (single_env, {"agent": "push", "policies": {"pull": steady}}),
                (aec_env, {"max_steps": 9}),
            ]
        )
        reset = chance.choice([None, {"level": [1, 2.5]}])
        return Case(make, (Pumps,), {"driver": driver, **options}, reset=reset)
    return Case(aec_env, (), {"driver": driver}, partial(program, chance.randrange(2**31)))


def program(seed):
    """Return the arguments of a random program, whose functions have no names."""
    chance = random.Random(seed)
    number = chance.randint(1, 4)
    design = WorldDesign(
        tuple(chance.choices(KINDS, k=number)),
        ((0, 1), *((chance.randrange(number), chance.randrange(3)) for _ in range(14))),
        policies=frozenset({1} if number > 2 else ()),
    )
    points = points_of(design)
    return {
        "simulation": partial(World, design, points),
        "points": points,
        "policies": world_policies(design, points),
    }


def move(env, chance):
    """Take a random step in any view; return the results, and whether it was the last one."""
    view = env.unwrapped
    episode: EpisodeState = view.episode

    def drawn(name, space):
        agent = episode.agent(name)
        mask = None if agent is None or agent is not episode.pending else agent.mask
        space.seed(chance.randrange(2**31))
        return RULE if chance.random() < 0.2 else space.sample(mask)

    if isinstance(env, AECEnv):
        *_, terminated, truncated, _ = env.last()
        name = env.agent_selection
        env.step(None if terminated or truncated else drawn(name, env.action_space(name)))
        last = env.last() if env.agents else None
        return repr((name, last, env.agents, env.rewards, env.infos)), not env.agents
    if isinstance(env, ParallelEnv):
        pending = episode.pending.name
        names = [name for name in env.agents if name == pending or chance.random() < 0.7]
        results = env.step({name: drawn(name, env.action_space(name)) for name in names})
        return repr((results, env.agents)), not env.agents
    space = env.action_space
    space.seed(chance.randrange(2**31))
    action = space.sample()
    if view.kind in ("single", "turn"):
        mask = view.latest[-1].get("action_mask")
        action = space.sample(mask) if isinstance(space, spaces.Discrete) else action
        action = RULE if chance.random() < 0.2 else action
    results = env.step(action)
    return repr(results), results[2] or results[3]


def mid_episode(make=aec_env, simulation=YARD, points=YARD_POINTS, *, taken=6, seed=7, **options):
    """Return an environment after some steps."""
    env = make(simulation, points, **options)
    env.reset(seed=seed)
    chance = random.Random(1)
    for _ in range(taken):
        move(env, chance)
    return env


def future(env, seed, most=10_000):
    """Return all that comes of an environment that a seed's answers continue, up to a length."""
    chance = random.Random(seed)
    view = env.unwrapped
    found = [repr(view.latest) if view.kind != "aec" or env.agents else "over"]
    over = not env.agents if hasattr(env, "agents") else view.session.episode.over
    while not over and len(found) < most:
        told, over = move(env, chance)
        found.append(told)
    return found


def save(case, seed, path):
    """Save an environment after some decisions. Return its future."""
    chance = random.Random(seed)
    given = case.given()
    arguments = [*case.arguments, *(given[name] for name in ("simulation", "points") if given)]
    options = case.options | ({"policies": given["policies"]} if given else {})
    env = case.make(*arguments, **options)
    with suppress(AttributeError):
        env.action_space.seed(0)
    env.reset(seed=chance.randrange(2**31), options=case.reset)
    over = False
    for _ in range(chance.randrange(30)):
        over = over or move(env, chance)[1]
    source = env
    if not over and env.unwrapped.episode.pending is not None and chance.random() < 0.3:
        source = clone(env, method=chance.choice([None, "replay"]))
    save_episode(source, path, unnamed=bool(given))
    found = future(env, seed)
    if source is not env:
        source.close()
    env.close()
    return found


def load_all(folder):
    """Load all files of a folder, and write the future of each beside it."""
    for path in sorted(Path(folder).glob("*.jsonl")):
        given, seed = pickle.loads(path.with_suffix(".pickle").read_bytes())
        env = load_episode(path, **given())
        path.with_suffix(".future").write_text(json.dumps(future(env, seed)))
        env.close()


def differing(number, first=0):
    """Return the seeds whose environments continue differently in another process, of so many."""
    with tempfile.TemporaryDirectory() as folder:
        expected = {}
        for seed in range(first, first + number):
            case = cases(random.Random(seed))
            path = Path(folder, f"{seed}.jsonl")
            expected[seed] = save(case, seed, path)
            path.with_suffix(".pickle").write_bytes(pickle.dumps((case.given, seed)))
        code = f"import warnings; warnings.simplefilter('ignore'); from {HERE} import load_all"
        python("-c", f"{code}; load_all({folder!r})", timeout=600)
        found = {seed: json.loads(Path(folder, f"{seed}.future").read_text()) for seed in expected}
    return [seed for seed in expected if found[seed] != expected[seed]]


choose = decision()


class Archive:
    """Does something random with a file between decisions; its log holds all that it reads."""

    def __init__(self, days=12):
        self.days = days

    def reset(self, seed=None):
        self.seed, self.log = seed, []
        self.chance = random.Random(seed)
        random.seed(seed)
        np.random.seed(seed)
        self.files = []
        self.numbers = []
        self.folder = tempfile.mkdtemp()

    def close(self):
        """Branches do not come here, and so leave the folder to the environment."""
        shutil.rmtree(self.folder)

    def run(self):
        with tempfile.NamedTemporaryFile("w+", dir=self.folder, delete=False) as self.named:
            Path(self.folder, "0").write_text(
                "".join(f"{line} " * 3 + "\n" for line in range(3000))
            )
            try:
                # opened by name here only, because all branches share the named files
                for _ in range(self.chance.randrange(6)):
                    self.open()
                self.numbers.append(os.open(Path(self.folder, "0"), os.O_RDWR))
                for day in range(self.days):
                    self.log.append(
                        (day, choose(), random.random(), random.gauss(0, 1), np.random.random())
                    )
                    for _ in range(self.chance.randrange(4)):
                        self.chance.choice(DEEDS)(self)
                self.look()
            finally:
                while self.files:
                    self.files.pop().close()
                while self.numbers:
                    os.close(self.numbers.pop())

    def open(self):
        path = Path(self.folder, str(self.chance.randrange(3)))
        mode = self.chance.choice(["r+", "a+", "w+", "a", "r"])
        self.files.append(open(path, mode if path.exists() else "w+"))  # noqa: SIM115 - closed later

    def open_nameless(self):
        self.files.append(tempfile.TemporaryFile("w+"))  # noqa: SIM115

    def write(self):
        file = self.any_file()
        if file.writable():
            file.write(f"{self.log[-1]}\n" * self.chance.randrange(1, 400))
        if self.chance.random() < 0.5:
            file.flush()

    def read(self):
        file = self.any_file()
        if file.readable():
            self.log.append((file.read(self.chance.randrange(9000)), file.tell()))

    def seek(self):
        file = self.any_file()
        file.seek(0 if self.chance.random() < 0.5 else self.chance.randrange(2000))

    def duplicate(self):
        self.numbers.append(os.dup(self.chance.choice(self.numbers)))

    def use_numbers(self):
        for number in self.numbers:
            self.log.append(os.read(number, self.chance.randrange(50)))
            if self.chance.random() < 0.3:
                os.write(number, repr(self.log[0]).encode())

    def forget(self):
        if self.files:
            self.files.pop(self.chance.randrange(len(self.files))).close()

    def look(self):
        self.log.append((sorted(os.listdir(self.folder)), Path(self.named.name).exists()))

    def any_file(self):
        return self.chance.choice([*self.files, self.named])


DEEDS = [
    Archive.open_nameless, Archive.write, Archive.write, Archive.read, Archive.read, Archive.seek,
    Archive.duplicate, Archive.use_numbers, Archive.forget,
]  # fmt: skip


def rest_of_archive(env, number=0):
    """Play what is left of an episode. Returns its log."""
    over = False
    while not over:
        over = env.step(3)[2]
    return env.unwrapped.simulation.log


def tree_of_archive(chance):
    """Whether branches and clones in a tree have their archive's outcome: files, generators."""

    def step(env):
        told = env.step(3)
        return repr(told), told[2]

    env = single_env(Archive, choose)
    return of_tree(chance, env, step, lambda env: env.unwrapped.simulation.log, ["fork"])


def tree_of_yard(chance):
    """Whether branches and clones in a tree have their yard's outcome: births, deaths, stacks."""
    design = YardDesign(
        machines=chance.randint(1, 4),
        jobs=chance.randint(1, 3),
        cranes=chance.randint(1, 3),
        plans=chance.randint(1, 5),
        luck=chance.randint(2, 6),
        until=chance.choice([None, *range(3, 16)]),
    )
    make, driver = chance.choice([aec_env, parallel_env]), chance.choice(["greenlet", "thread"])
    env = make(lambda: Yard(design), YARD_POINTS, driver=driver)
    methods = ["replay", "fork"] if driver == "greenlet" else ["replay"]
    return of_tree(
        chance, env, move_trip, lambda env: yard_outcome(env.unwrapped.simulation), methods
    )


def of_tree(chance, env, step, come, methods):
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


def differing_branches(number, seed=0):
    """Return how many branches and clones differ, and how many there are: at least ``number``."""
    chance, alike = random.Random(seed), []
    while len(alike) < number:
        alike += chance.choice([tree_of_archive, tree_of_yard])(chance)
    return alike.count(False), len(alike)


def main(number, kind="saved"):
    """Print how many of so many continuations differ from their original."""
    warnings.simplefilter("ignore")  # an archive draws from the global generators
    if kind == "branches":
        differ, number = differing_branches(number)
        print(f"{differ} of {number:,} differ")
        return
    differ = []
    for first in range(0, number, 200):
        differ += differing(min(200, number - first), first)
    print(f"{len(differ)} of {number:,} differ {differ[:20]}")


if __name__ == "__main__":
    from tests.worlds.saved import main as main_of  # its functions are of a module then

    main_of(int(sys.argv[1]), *sys.argv[2:])
