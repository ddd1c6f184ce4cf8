"""``reseed_generators`` finds and seeds a simulation's generators in place, ``Streams`` by name."""

import copy
import datetime
import enum
import functools
import math
import pickle
import random
from collections import deque
from dataclasses import dataclass
from pathlib import PurePosixPath
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import Streams, reseed_generators
from simenv_marl.errors import OptionValueError, SimulationError
from tests.core.test_global_rng import world
from tests.processes import python


class Slotted:
    __slots__ = ("__weakref__", "chance")

    def __init__(self, chance):
        self.chance = chance


class Crowd:
    """Has generators of all kinds, in all places."""

    def __init__(self, seed):
        def wait(generator):
            while True:
                yield generator.random()

        chances = [random.Random(seed + number) for number in range(9)]
        self.chance, self.legacy = chances[0], np.random.RandomState(seed)
        self.number, self.name, self.weights = 3, "crowd", np.zeros(4)
        self.kinds = [
            np.random.Generator(kind(seed))
            for kind in (np.random.PCG64, np.random.MT19937, np.random.SFC64)
        ]
        self.bits = np.random.Philox(seed)
        self.by_name = {"one": Slotted(chances[1]), Slotted(chances[2]): (chances[3],)}
        self.draw, self.normal = chances[4].random, np.random.default_rng(seed + 9).normal
        self.later = functools.partial(chances[5].gauss, 0.0)
        self.queue, self.some = deque([chances[6]]), {Slotted(chances[7])}
        self.waiting = wait(chances[8])
        next(self.waiting)
        self.itself, self.module, self.kind, self.function = (
            self,
            np.random,
            Crowd,
            reseed_generators,
        )
        self.shared = SimpleNamespace(same=self.chance)
        self.all = chances

    def drawn(self):
        many = [chance.random() for chance in self.all]
        many += [
            self.legacy.standard_normal(),
            self.legacy.random(),
            self.bits.random_raw(),
            self.normal(),
        ]
        many += [generator.random() for generator in self.kinds] + [
            self.draw(),
            self.later(1.0),
            next(self.waiting),
        ]
        return [*many, self.shared.same.random()]


@given(st.integers(0, 2**80), st.integers(0, 7))
def test_reseed_generators_gives_the_same_state_after_any_earlier_draws(seed, before):
    one, other = Crowd(1), Crowd(2)
    for _ in range(before):
        other.drawn()
    other.legacy.standard_normal()
    other.chance.gauss(0, 1)
    for crowd in (one, other):
        assert reseed_generators(crowd, seed) == 9 + 1 + 3 + 1 + 1
    drawn = one.drawn()
    assert drawn == other.drawn()
    assert len(set(drawn)) == len(drawn)
    reseed_generators(one, seed + 1)
    assert set(one.drawn()).isdisjoint([*drawn, *Crowd(1).drawn()])


@pytest.mark.parametrize("kind", [np.random.PCG64, np.random.MT19937, np.random.Philox])
def test_reseed_generators_reseeds_spawned_numpy_generators(kind):
    """Where NumPy can put that back into a generator at all."""
    generator = np.random.Generator(kind(1))
    spawned = generator.spawn(1)[0].random()
    generator = np.random.Generator(kind(1))
    reseed_generators(generator, 5)
    if not isinstance(kind(1).__getstate__(), dict):
        assert generator.spawn(1)[0].random() != spawned
    assert generator.bit_generator.random_raw() != kind(1).random_raw()


def test_reseed_generators_differs_from_seeding_generators_directly():
    one, other, legacy = random.Random(), np.random.default_rng(), np.random.RandomState()
    reseed_generators([one, other, legacy], 7)
    drawn = {one.random(), other.random(), legacy.random()}
    sequence = np.random.SeedSequence(7)
    plain = [np.random.default_rng(part).random() for part in (7, *sequence.spawn(4))]
    assert drawn.isdisjoint([random.Random(7).random(), np.random.RandomState(7).random(), *plain])


def test_reseed_generators_refuses_models_with_only_global_generators():
    model = SimpleNamespace(
        random=random, draw=random.random, numpy=np.random.mtrand._rand, function=world
    )
    model.chance, model.kind = random.SystemRandom(), random.Random
    before = world()
    for nothing in (object(), model):
        with pytest.raises(
            SimulationError, match=r"no random generator[\s\S]*attribute[\s\S]*global_rng=True"
        ):
            reseed_generators(nothing, 3)
    model.own = random.Random()
    assert reseed_generators(model, 3) == 1
    assert world() == before


@pytest.mark.parametrize("seed", [-1, True, 1.5, "7"])
def test_reseed_generators_and_streams_refuse_seeds_that_are_no_integers(seed):
    for refused in (
        Streams,
        Streams(1).reseed,
        functools.partial(reseed_generators, random.Random()),
    ):
        with pytest.raises(OptionValueError, match="seed must be a non-negative integer"):
            refused(seed)


# -- streams by name ------------------------------------------------------------------------------


def draws(streams, *names):
    return [streams[name].random() for name in names]


def test_random_stream_depends_only_on_the_seed_and_its_name():
    one, other = Streams(3), Streams(3)
    other["b"].random(100)
    assert draws(one, "a", "a") == draws(other, "a", "a")
    names = ["a", "b", "ab", "ba", "a\0", "", "\0", "\u00e4", *map(str, range(300))]
    assert len(set(draws(Streams(3), *names) + draws(Streams(4), *names))) == 2 * len(names)
    assert draws(Streams(), "a") != draws(Streams(), "a")


class Part(enum.Enum):
    PUMP = "pump"
    VALVE = "valve"


@dataclass(frozen=True)
class Place:
    row: int
    tags: frozenset[str]

    def method(self):
        """Bound to a place, which equals others, it is a name as well."""


@dataclass(eq=False)
class Entity:
    row: int

    def method(self):
        """Bound to an entity, it is no name."""


NAMES = [
    "a",
    3,
    -3,
    10**400,
    2.5,
    math.inf,
    None,
    b"a",
    (),
    ("pump", 2),
    ("pump", (2,)),
    ("pump", "2"),
    "('pump', 2)",
    frozenset(["a", "b", ("c", 1)]),
    Part.PUMP,
    Part.VALVE,
    Place(1, frozenset("abcdef")),
    Place(2, frozenset()),
    Place(2, frozenset()).method,
    Place,
    datetime.date(2026, 1, 2),
    PurePosixPath("/a/b"),
    "3",
    "None",
]


def test_random_streams_are_the_same_in_each_process():
    here = draws(Streams(3), *NAMES)
    assert len(set(here)) == len(here)
    code = "from tests.core.test_reseeding import *; print(draws(Streams(3), *NAMES))"
    for seed in "12":
        text = python("-c", code, env={"PYTHONHASHSEED": seed}).stdout
        assert text.strip() == str(here)


def test_random_stream_draws_the_same_numbers_in_every_version():
    assert draws(Streams(3), "a", "pump 2") == [0.6653036503847838, 0.9648250980937277]


def test_random_streams_with_equal_names_share_one_generator():
    for alike in [(3, 3.0, np.int64(3)), (1, True), (2.5, np.float32(2.5)), ("a", np.str_("a"))]:
        assert len({*draws(Streams(3), alike[0])} | {draws(Streams(3), n)[0] for n in alike}) == 1


@pytest.mark.parametrize(
    "name", [object(), Entity(1), Entity(1).method, ("pump", Entity(1)), lambda: 0, math.nan]
)
def test_random_streams_refuse_names_that_differ_between_processes(name):
    with pytest.raises(OptionValueError, match=r'or a tuple of these, such as \("pump", 2\)'):
        Streams(3)[name]


@pytest.mark.parametrize("name", [[1], ("pump", [1]), {}])
def test_random_streams_refuse_unhashable_names(name):
    with pytest.raises(TypeError, match="unhashable type"):
        Streams(3)[name]


@pytest.mark.parametrize("reseed", [Streams.reseed, reseed_generators])
def test_reseeding_changes_existing_and_later_random_streams(reseed):
    def future(seed, used):
        streams = Streams(3)
        held = streams["a"]
        held.random(used)
        reseed(streams, seed)
        assert streams["a"] is held
        return draws(streams, "a", "later")

    assert future(1, 0) == future(1, 7)
    assert not {*future(1, 0), *future(3, 0)} & {*future(2, 0), *draws(Streams(3), "a", "later")}


def test_reseeding_reaches_random_streams_that_entities_hold():
    model = SimpleNamespace(streams=Streams(3))
    model.entities = [SimpleNamespace(chance=model.streams[name]) for name in "ab"]
    assert reseed_generators(model, 5) == 1
    assert [entity.chance.random() for entity in model.entities] != draws(Streams(3), "a", "b")


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda streams: pickle.loads(pickle.dumps(streams))]
)
def test_copied_random_streams_continue_independently_from_the_same_state(duplicate):
    streams = Streams(3)
    streams["a"].random()
    twin = duplicate(streams)
    assert draws(twin, "a", "b") == draws(streams, "a", "b")
    assert twin["a"] is not streams["a"]
