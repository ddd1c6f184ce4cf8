"""What an environment keeps alive of a model, where the model can see who is alive."""

import gc
import random
import weakref
from collections import deque, namedtuple
from functools import partial
from weakref import WeakSet

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    SimulationInterface,
    aec_env,
    joint_env,
    parallel_env,
    simulate,
    single_env,
)
from tests.worlds.copied import Walk
from tests.worlds.models import begun, define, follow_the_rule, play

PREY = f"{__name__}.Animal.eat"


class Animal:
    """Eats a neighbour now and then. Weak sets and scheduled events see who is alive."""

    def __init__(self, meadow, number):
        self.meadow = meadow
        self.number = number

    def eat(self, neighbours, *, nearest=None):
        """Decide which of the neighbours to eat; None of them in three of four cases."""
        return self.meadow.rng.randrange(4 * len(neighbours)) if neighbours else None

    def act(self):
        others = [other for other in self.meadow.living() if other is not self]
        neighbours = self.meadow.kind(others)
        place = self.eat(neighbours, nearest=others[0] if others else None)
        del neighbours
        if place is not None and place < len(others):
            victim = others.pop(place)
            self.meadow.held.remove(victim)
            self.meadow.log.append(f"{self.number} eats {victim.number}")


class Meadow(SimulationInterface):
    """Steps all animals that a weak set holds, by events that hold them weakly."""

    kind = list

    def reset(self, seed=None):
        self.rng = random.Random(seed)
        self.log = []
        self.held = [Animal(self, number) for number in range(8)]
        self.alive = WeakSet(self.held)
        for animal in self.held:
            weakref.finalize(animal, self.log.append, f"{animal.number} is gone")

    def living(self):
        return sorted(self.alive, key=lambda animal: animal.number)

    def run(self):
        for _ in range(6):
            events = [weakref.ref(animal) for animal in self.living()]
            while events:
                animal = events.pop(0)()
                if animal is not None:
                    animal.act()
                del animal
            self.log.append([animal.number for animal in self.living()])

    def expected_calls(self, point):
        return [(animal, self.kind(self.living())) for animal in self.living()]


def as_dict(animals):
    return {animal: animal.number for animal in animals}


class Pair(namedtuple("Pair", "first rest")):
    """A named tuple that contains a list."""


def as_pair(animals):
    return Pair(animals[0], animals[1:]) if animals else []


KINDS = {
    "list": list,
    "tuple": tuple,
    "set": set,
    "deque": deque,
    "dict": as_dict,
    "nested": lambda animals: [[animal] for animal in animals],
    "named tuple": as_pair,
}


def meadow_of(kind):
    return type("Meadow", (Meadow,), {"kind": staticmethod(KINDS[kind])})


def definition(**changes):
    return define(
        action_space=spaces.Discrete(100),
        observation_space=spaces.Box(0, 100, (2,), np.float64),
        observation_space_mapping=lambda animal, neighbours, *, nearest: [
            len(neighbours), -1 if nearest is None else nearest.number + 1
        ],
        reward_mapping=lambda animal, neighbours: float(len(neighbours)),
        **changes,
    )  # fmt: skip


def plain_log(source, seed):
    simulation = begun(source(), seed)
    simulation.run()
    return simulation.log[:]


def by_number(animal):
    return f"animal_{animal.number}"


def rule_log(view, source, seed, agent=by_number):
    options = {"possible_agents": [f"animal_{number}" for number in range(8)]}
    if agent != by_number or view is aec_env:
        options = {}
    env = view(source, {PREY: definition(agent=agent)}, **options)
    log = follow_the_rule(env, seed).log[:]
    env.close()
    return log


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("view", [aec_env, parallel_env, joint_env])
@pytest.mark.filterwarnings("ignore:actions that no decision used")
def test_env_with_rule_actions_runs_weak_set_models_like_without_env(view, kind):
    source = meadow_of(kind)
    for seed in range(4):
        expected = plain_log(source, seed)
        assert any(" eats " in str(entry) for entry in expected)
        assert rule_log(view, source, seed) == expected


@pytest.mark.parametrize("kind", KINDS)
def test_env_with_rule_actions_runs_a_one_agent_model_like_without_env(kind):
    source = meadow_of(kind)
    for seed in range(4):
        for view in (aec_env, single_env, parallel_env):
            assert rule_log(view, source, seed, agent="animals") == plain_log(source, seed)


def test_simulate_with_policies_answering_rule_runs_like_without_policies():
    source = meadow_of("list")
    for seed in range(4):
        point = {PREY: definition(agent=by_number)}
        simulation = simulate(source, {PREY: lambda observation: RULE}, points=point, seed=seed)
        assert simulation.log == plain_log(source, seed)


# -- choices and splits ---------------------------------------------------------------------------


class Item:
    """An object that can be referenced weakly."""

    def __init__(self, number):
        self.number = number


class Bag(SimulationInterface):
    """Chooses one of some items and frees the others, or decides for each of them."""

    def reset(self, seed=None):
        self.log = []

    def choose(self, items):
        return items[0]

    def mark(self, items):
        return [item.number for item in items]

    def run(self):
        for decide in (lambda items: self.choose(items).number, self.mark) * 3:
            items = [Item(number) for number in range(3)]
            references = [weakref.ref(item) for item in items]
            self.log.append(decide(items))
            del items
            self.log.append([reference() is None for reference in references])


BAG = {
    f"{__name__}.Bag.choose": define(agent="chooser", choices=lambda bag, items: items),
    f"{__name__}.Bag.mark": define(
        agent=lambda item: f"item_{item.number}", split=lambda bag, items: items
    ),
}


@pytest.mark.parametrize("action", [RULE, 2])
def test_aec_env_frees_split_items_and_choices_after_their_call(action):
    env = aec_env(Bag, BAG)
    play(env, action, seed=1)
    log = env.simulation.log
    assert log[1::2] == [[True] * 3] * 6
    assert log[2::4] == [[0, 1, 2] if action is RULE else [2, 2, 2]] * 3


# -- what stays, and what the last values are -----------------------------------------------------

FREED = f"{__name__}.Cell.split"


class Cell:
    def split(self, size, food):
        return size


class Dish(SimulationInterface):
    """Frees its cell before the end."""

    def reset(self, seed=None):
        self.food = [1.0, 2.0]

    def run(self):
        cell = Cell()
        for size in (3.0, 4.0):
            cell.split(size, self.food)
            self.food[0] += size
        reference = weakref.ref(cell)
        del cell
        self.is_freed = reference() is None


def dish(**changes):
    given = {
        "observation_space": spaces.Box(0, 100, (1,), np.float64),
        "action_space": spaces.Discrete(10),
        "agent": "cell",
    }
    env = begun(single_env(Dish, {FREED: define(**given | changes)}), 1)
    env.step(RULE)
    return env


def test_last_reward_is_zero_if_the_model_has_freed_the_entity():
    env = dish(observation_space_mapping=lambda cell: [5.0], reward_mapping=lambda cell, size: size)
    with pytest.warns(UserWarning, match=r"has freed self .*the reward is 0\.0.*removed_by"):
        observation, reward, terminated, _, _ = env.step(RULE)
    assert env.simulation.is_freed
    assert (list(observation), reward, terminated) == ([5.0], 0.0, True)


def test_last_observation_and_reward_use_arguments_that_still_exist():
    env = dish(
        observation_space_mapping=lambda *, food: food[:1], reward_mapping=lambda *, size: size
    )
    observation, reward, terminated, _, _ = env.step(RULE)
    assert env.simulation.is_freed
    assert (list(observation), reward, terminated) == ([8.0], 4.0, True)


def test_agent_keeps_its_last_observation_if_the_model_frees_its_entity():
    env = dish(
        observation_space_mapping=lambda cell, size: [size], reward_mapping=lambda *, size: size
    )
    with pytest.warns(UserWarning, match="has freed self .*the last observation stays"):
        observation, reward, terminated, _, _ = env.step(RULE)
    assert (list(observation), reward, terminated) == ([4.0], 4.0, True)


@pytest.mark.parametrize("make_env", [aec_env, single_env])
def test_env_is_garbage_collected_even_if_its_mapping_refers_to_it(make_env):
    def observe(holder, walk):
        return [walk.place, len(holder)]

    def used():
        holder = []
        mapping = partial(observe, holder)
        env = make_env(Walk, {Walk.choose: define(observation_space_mapping=mapping)})
        holder.append(env)
        env.reset(seed=1)
        env.step(1)
        env.close()
        return weakref.ref(env.unwrapped.session)

    session = used()
    gc.collect()
    assert session() is None


def test_env_drops_freed_objects_from_containers_among_arguments():
    from simenv_marl.core.episodes.arguments import GONE, restore, weaken

    living, freed = Item(1), Item(2)
    Row = namedtuple("Row", "item number")
    given = {
        "list": [living, freed, 3],
        "nested": {"a": [living], "b": [freed], "c": (freed, living)},
        "keys": {living: 1, freed: 2},
        "row": Row(living, 1),
        "freed row": Row(freed, 1),
        "set": {living, freed},
        "deque": deque([freed, living]),
        "plain": [1, "two", np.zeros(3)],
        "method": living.__init__,
    }
    plain = given["plain"]
    held = {name: weaken(value) for name, value in given.items()}
    given.clear()
    del freed
    gc.collect()
    assert {name: restore(value) for name, value in held.items()} == {
        "list": [living, 3],
        "nested": {"a": [living], "b": [], "c": (living,)},
        "keys": {living: 1},
        "row": Row(living, 1),
        "freed row": GONE,
        "set": {living},
        "deque": deque([living]),
        "plain": plain,
        "method": living.__init__,
    }
    assert restore(held["plain"]) is plain
    assert type(restore(held["row"])) is Row


class Field(SimulationInterface):
    """Its entities decide over an array."""

    def reset(self, seed=None):
        self.cells = [Item(number) for number in range(2)]

    def choose(self, cell, field):
        return 0

    def run(self):
        for size in (1.0, 2.0):
            for cell in self.cells:
                self.choose(cell, np.full(3, size))


def test_observation_shows_array_arguments_with_their_current_values():
    given = define(
        observation_space=spaces.Box(0, 9, (3,)),
        observation_space_mapping=lambda model, cell, field: field,
        agent=lambda model, cell: f"cell_{cell.number}",
    )
    env = begun(parallel_env(Field, {f"{__name__}.Field.choose": given}), 1)
    observations, *_ = env.step({"cell_0": 0})
    assert observations["cell_0"].tolist() == [1.0] * 3


def pick(items):
    return items[0]


def test_env_does_not_keep_objects_alive_that_a_list_argument_contains():
    class Picker(SimulationInterface):
        def reset(self, seed=None):
            self.freed = []

        def run(self):
            for _ in range(2):
                items = [Item(1)]
                reference = weakref.ref(items[0])
                pick(items)
                del items
                self.freed.append(reference() is None)

    points = {f"{__name__}.pick": define(observation_space_mapping=lambda: [0.0, 0.0])}
    simulation = begun(single_env(Picker, points), 1)
    simulation.step(RULE)
    simulation.step(RULE)
    assert simulation.unwrapped.simulation.freed == [True, True]


def test_last_observation_shows_later_changes_of_a_set_argument():
    from simenv_marl.core.episodes.arguments import restore, weaken

    held = {Item(1)}
    weak = weaken(held)
    held.add(2)
    assert restore(weak) is held


@pytest.mark.parametrize("kind", [list, set, dict.fromkeys])
def test_last_observation_stays_if_the_model_empties_a_list_argument(kind):
    class Shop(SimulationInterface):
        def reset(self, seed=None):
            self.jobs = kind(["mill", "drill"])

        def serve(self, jobs):
            return 0

        def run(self):
            self.serve(self.jobs)
            self.jobs.clear()

    seen = []

    def observe(shop, jobs):
        seen.append(len(jobs))
        return [len(jobs), 0.0]

    paid = []
    changes = {
        "observation_space_mapping": observe,
        "reward_mapping": lambda shop, jobs: float(paid.append(len(jobs)) or len(paid)),
    }
    env = begun(single_env(Shop, {Shop.serve: define(**changes)}), 1)
    observation, reward, terminated, _, _ = env.step(0)
    assert (observation.tolist(), reward, terminated) == ([2.0, 0.0], 2.0, True)
    assert (seen, paid) == ([2], [2, 0])
