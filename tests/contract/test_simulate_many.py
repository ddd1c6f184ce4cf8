"""Many simulations at once: ``simulate_many``, in this process."""

import gc
import sys
import weakref
from collections import Counter
from typing import ClassVar

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from simenv_marl import RULE, simulate, simulate_many
from simenv_marl.errors import (
    InvalidActionError,
    MissingExtraError,
    OptionValueError,
    UnknownOptionError,
    UnknownPointError,
)
from simenv_marl.experiments import Variant
from tests.worlds import worlds
from tests.worlds.many_worlds import Colony, Creature, colony_points, designs
from tests.worlds.models import Script, calling, decision, define, notes, plainly, script, stacks

some_seeds = st.lists(st.integers(0, 2**31 - 1), max_size=12)
sizes = st.integers(1, 14)

PAIRS = {"observation_space": spaces.Box(-9, 9, (2,), np.float32), "observation_space_mapping": lambda *args: [1, 2]}


def by_row(policy):
    """The policy of many that answers each row as another one answers it alone."""

    def of_many(observations, infos):
        return [policy(observation, info) for observation, info in zip(observations, infos, strict=True)]

    return of_many


def ones(observations):
    return np.ones(len(observations), np.int64)


class Going:
    """Goes on until its number is up; which is its seed, so that all end at different times."""

    def reset(self, seed):
        self.seed, self.log = seed, []

    def run(self):
        for _ in range(self.seed):
            self.log.append(self.decide())

    def decide(self):
        return "rule"


going = {Going.decide: define(agent="going_0")}


# -- it is what simulate does ---------------------------------------------------------------------


@given(designs, some_seeds, sizes)
@settings(max_examples=40)
def test_colonies_are_what_they_are_one_by_one(design, seeds, size):
    points = colony_points(overseen=bool(design.overseen))

    def answered(observation):
        number = int(observation.sum()) % 6
        return RULE if number == 5 else number

    many = {Creature.act: lambda observations: [answered(observation) for observation in observations]}
    one = {Creature.act: answered}
    if design.overseen:
        many["overseer_0"], one["overseer_0"] = many[Creature.act], answered
    found = simulate_many(lambda: Colony(design), many, seeds=seeds, points=points, batch_size=size)
    for seed, simulation in zip(seeds, found, strict=True):
        alone = simulate(lambda: Colony(design), one, seed=seed, points=points)
        assert simulation.trace == alone.trace
        assert simulation.random.getstate() == alone.random.getstate()


@given(designs, some_seeds, sizes)
@settings(max_examples=20)
def test_some_agents_by_their_own_policies_and_the_rest_by_their_points(design, seeds, size):
    points = {Creature.act: colony_points(overseen=False)[Creature.act]}
    policies = {
        Creature.act: lambda observation, info: int(observation[2]) % 5,
        "creature_0": lambda observation, info: 3,
        "creature_2": RULE,
    }
    many = {key: RULE if policy is RULE else by_row(policy) for key, policy in policies.items()}
    found = simulate_many(
        lambda: Colony(design), many, seeds=seeds, points=points, batch_size=size, collect=lambda s: s.trace
    )
    assert found == [
        simulate(lambda: Colony(design), policies, seed=seed, points=points).trace for seed in seeds
    ]  # fmt: skip


@given(worlds.designs(), some_seeds, sizes)
@settings(max_examples=60)
def test_worlds_are_what_they_are_one_by_one(design, seeds, size):
    """Whatever the decision points are like: nested, generators, with choices, of entities, named now and then."""
    points = worlds.points_of(design)
    policies = {points[number]: worlds.advised for number in range(len(points)) if number not in design.rules}

    def simulation():
        return worlds.World(design, points)

    many = {point: by_row(policy) for point, policy in policies.items()}
    found = simulate_many(simulation, many, seeds=seeds, points=points, batch_size=size)
    for seed, one in zip(seeds, found, strict=True):
        alone = simulate(simulation, policies, seed=seed, points=points)
        assert one.trace == alone.trace
        assert one.random.getstate() == alone.random.getstate()


def test_without_policies_they_are_plain_runs():
    ant = decision(agent="ant_0")
    assert [s.log for s in simulate_many(calling(ant, ant), seeds=range(3))] == [["rule", "rule"]] * 3
    assert [s.log for s in simulate_many(calling(ant), {ant: RULE}, seeds=[5], points=ant)] == [["rule"]]
    assert simulate_many(calling(ant), {ant: ones}, seeds=[]) == []


def test_each_seed_has_a_simulation_of_its_own_and_its_results_stand_in_their_order():
    found = simulate_many(Going, {Going.decide: ones}, points=going, seeds=iter([4, 0, 2, 4]), batch_size=2)
    assert [simulation.seed for simulation in found] == [4, 0, 2, 4]
    assert [simulation.log for simulation in found] == [[1] * 4, [], [1, 1], [1] * 4]
    assert len({id(simulation) for simulation in found}) == 4
    given_simulation = Going()
    (found,) = simulate_many(given_simulation, {Going.decide: ones}, points=going, seeds=[1])
    assert found is not given_simulation  # it is copied
    assert not hasattr(given_simulation, "log")


# -- what policies are asked ----------------------------------------------------------------------


def test_policies_see_stacked_observations():
    seen = []

    def policy(observations):
        seen.append(observations)
        return ones(observations)

    def main(simulation):
        simulation.log.append(ant())

    ant = decision(agent="ant_0", **PAIRS)
    simulate_many(script(main), {ant: policy}, seeds=range(3))
    (observations,) = seen
    assert observations.dtype == np.float32
    assert observations.tolist() == [[1, 2]] * 3


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (spaces.Discrete(5), 3),
        (spaces.Box(0, 9, (), np.float64), 3.0),
        (spaces.Box(0, 9, (2, 3), np.uint8), np.arange(6, dtype=np.uint8).reshape(2, 3)),
        (spaces.Box(0, 9, (0,), np.float64), []),
        (spaces.MultiDiscrete([3, 4]), [1, 2]),
        (spaces.MultiBinary(3), [1, 0, 1]),
    ],
)
def test_stacks_of_all_kinds_of_spaces(space, value):
    ant = decision(agent="ant_0", observation_space=space, observation_space_mapping=lambda: value)
    seen = []
    simulate_many(calling(ant), {ant: lambda observations: seen.append(observations) or [1] * 4}, seeds=range(4))
    assert seen[0].dtype == space.dtype
    assert seen[0].shape == (4, *space.shape)
    assert all(np.array_equal(row, value) for row in seen[0])


def test_stacks_of_composite_spaces():
    space = spaces.Dict(near=spaces.Tuple([spaces.Discrete(3), spaces.Box(0, 9, (2,))]), word=spaces.Text(4))
    ant = decision(
        agent="ant_0",
        observation_space=space,
        observation_space_mapping=lambda: {"near": (2, [1, 2]), "word": "ant"},
    )
    seen = []
    simulate_many(calling(ant), {ant: lambda observations: seen.append(observations) or [1, 1]}, seeds=range(2))
    assert list(seen[0]) == ["near", "word"]
    assert seen[0]["near"][0].tolist() == [2, 2]
    assert seen[0]["near"][1].tolist() == [[1, 2], [1, 2]]
    assert seen[0]["word"].tolist() == ["ant", "ant"]


def test_what_policies_are_given_is_theirs():
    ant = decision(agent="ant_0", **PAIRS)

    def policy(observations, infos):
        assert observations.tolist() == [[1, 2]] * 3
        assert infos == [{}] * 3
        observations[:] = 7
        for info in infos:
            info["seen"] = True
        return ones(observations)

    found = simulate_many(calling(ant, ant, ant), {ant: policy}, seeds=range(3))
    assert [simulation.log for simulation in found] == [[1, 1, 1]] * 3


def test_policies_get_the_infos_if_they_take_them():
    class Timed(Script):
        def time(self):
            return len(self.log)

    def main(simulation):
        simulation.log += [ant(), ant()]

    ant = decision(agent="ant_0", action_mask_mapping=lambda: [0, 1] + [0] * 8)
    seen = []

    def policy(observations, infos):
        seen.extend((info["time"], info["elapsed"], info["action_mask"].tolist()) for info in infos)
        return [1] * len(infos)

    simulate_many(lambda: Timed(main), {ant: policy}, seeds=range(2))
    assert seen == [(0.0, 0.0, [0, 1] + [0] * 8)] * 4


def test_policies_that_are_the_same_are_asked_together():
    ant, bee = decision(agent="ant_0", **PAIRS), decision(agent="bee_0", **PAIRS)
    asked = []

    def policy(observations):
        asked.append(len(observations))
        return ones(observations)

    def main(simulation):
        simulation.log.append(ant() if simulation.seed % 2 else bee())

    simulate_many(script(main), {ant: policy, bee: policy}, seeds=range(10))
    assert asked == [10]
    cat = decision(agent="cat_0")  # who observes something else
    assert [s.log for s in simulate_many(calling(ant, cat), {ant: policy, cat: policy}, seeds=range(3))] == [[1, 1]] * 3
    assert asked == [10, 3, 3]


def test_batches_are_large():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    asked = Counter()

    def policy(name):
        def of_many(observations):
            asked[name, len(observations)] += 1
            return ones(observations)

        return of_many

    source = calling(ant, bee, bee, ant)
    simulate_many(source, {ant: policy("ant"), bee: policy("bee")}, seeds=range(50), batch_size=50)
    assert asked == {("ant", 50): 2, ("bee", 50): 2}
    asked.clear()
    simulate_many(source, {ant: policy("ant"), bee: policy("bee")}, seeds=range(50), batch_size=25)
    assert asked == {("ant", 25): 4, ("bee", 25): 4}


def test_simulations_that_have_ended_make_room_for_others():
    asked = []

    def policy(observations):
        asked.append(len(observations))
        return ones(observations)

    seeds = [1, 1, 1, 9] * 5
    simulate_many(Going, {Going.decide: policy}, points=going, seeds=seeds, batch_size=4)
    assert max(asked) == 4
    assert len(asked) < 30  # and not 45, which it would be if all of four had to end first


def test_no_more_are_under_way_than_may_be():
    under_way = set()

    class Watched(Going):
        def reset(self, seed):
            super().reset(seed)
            under_way.add(id(self))
            assert len(under_way) <= 3

    def gone(simulation):
        under_way.remove(id(simulation))

    points = {Watched.decide: define(agent="going_0")}
    simulate_many(Watched, {Watched.decide: ones}, points=points, seeds=[5, 2, 7, 1, 0, 3], batch_size=3, collect=gone)
    assert not under_way


def test_simulations_are_collected_as_soon_as_they_end():
    class Mortal(Going):
        pass

    watched, ended = [], []

    def collect(simulation):
        gc.collect()
        assert sum(reference() is not None for reference in watched) == 0  # those before are gone
        watched.append(weakref.ref(simulation))
        ended.append(simulation.seed)
        return simulation.seed * 10

    found = simulate_many(
        Mortal, {Mortal.decide: ones}, points=going, seeds=[3, 1, 2], batch_size=2, collect=collect
    )  # fmt: skip
    assert found == [30, 10, 20]
    assert ended == [1, 3, 2]


# -- what policies answer -------------------------------------------------------------------------


class Tensor:
    """What only becomes an array, as tensors do."""

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype)


@pytest.mark.parametrize(
    "answer",
    [
        [4, 5],
        (4, 5),
        np.array([4, 5]),
        np.array([4, 5], np.int8),
        [np.int64(4), np.array(5)],
        Tensor([4, 5]),
        {4: None, 5: None}.keys(),
        ([4, 5], {"values": [0.5, 0.5]}),
    ],
    ids=lambda answer: type(answer).__name__,
)
def test_actions_come_as_anything_that_has_rows(answer):
    ant = decision(agent="ant_0")
    found = simulate_many(calling(ant), {ant: lambda observations: answer}, seeds=range(2))
    assert [simulation.log for simulation in found] == [[4], [5]]
    assert all(type(action) is int for simulation in found for action in simulation.log)


def test_actions_of_other_spaces():
    box = decision(agent="box_0", action_space=spaces.Box(0, 9, (2,), np.float32))
    both = decision(
        agent="both_0", action_space=spaces.Dict(a=spaces.Discrete(9), b=spaces.Box(0, 9, (2,), np.float64))
    )
    pair = decision(agent="pair_0", action_space=spaces.Tuple([spaces.Discrete(9), spaces.Discrete(9)]))
    policies = {
        box: lambda observations: np.array([[1.0, 2], [3, 4]]),
        both: lambda observations: {"a": np.array([5, 6]), "b": np.array([[1.0, 2], [3, 4]])},
        pair: lambda observations: [(1, 2), (3, 4)],
    }
    one, two = simulate_many(calling(box, both, pair), policies, seeds=range(2))
    assert one.log[0].tolist() == [1, 2]
    assert two.log[0].tolist() == [3, 4]
    assert two.log[0].dtype == np.float32
    assert (one.log[1]["a"], one.log[1]["b"].tolist()) == (5, [1, 2])
    assert (two.log[1]["a"], two.log[1]["b"].tolist()) == (6, [3, 4])
    assert (one.log[2], two.log[2]) == ((1, 2), (3, 4))


def test_rows_and_all_may_be_left_to_the_rule():
    ant = decision(agent="ant_0")
    answers = iter([[3, RULE], RULE, np.array([RULE, 4], object)])
    one, two = simulate_many(calling(ant, ant, ant), {ant: lambda observations: next(answers)}, seeds=range(2))
    assert one.log == [3, "rule", "rule"]
    assert two.log == ["rule", "rule", 4]


@pytest.mark.parametrize(
    "answer",
    [[1], [1, 1, 1], [], np.int64(1), 1, None, "ab", {}, {"a": [1], "b": [1, 2]}, np.ones((3, 2))],
    ids=repr,
)
def test_a_wrong_number_of_actions(answer):
    ant = decision(agent="ant_0")
    with pytest.raises(InvalidActionError, match=r"2 decisions|not in its action space") as caught:
        simulate_many(calling(ant), {ant: lambda observations: answer}, seeds=[3, 4])
    assert "3" in notes(caught.value)


# -- errors ---------------------------------------------------------------------------------------


class Delicate(Going):
    """Notes in ``ended`` what has been unwound or has ended."""

    ended: ClassVar[list] = []

    def run(self):
        try:
            super().run()
            if self.seed == 13:
                raise ZeroDivisionError
        finally:
            self.ended.append(self.seed)


delicate = {Delicate.decide: define(agent="going_0")}


def fails(error, **arguments):
    """Run some simulations of which one fails; return the error. Nothing is left of any."""
    Delicate.ended.clear()
    plain, before = vars(Going)["decide"], stacks()
    given_ = {"policies": {Delicate.decide: ones}, "points": delicate, "seeds": [20, 13, 17, 30], "batch_size": 3}
    with pytest.raises(error) as caught:
        simulate_many(Delicate, **given_ | arguments)
    assert "decide" not in vars(Delicate)
    assert vars(Going)["decide"] is plain
    assert stacks(before) == before
    return caught.value


def test_an_error_in_a_model_unwinds_the_others():
    error = fails(ZeroDivisionError)
    assert "seed 13" in notes(error)
    assert sorted(Delicate.ended) == [13, 17, 20]


@pytest.mark.parametrize("kind", [ZeroDivisionError, KeyboardInterrupt, SystemExit])
def test_an_error_in_a_policy_unwinds_all(kind):
    answered = []

    def policy(observations):
        answered.append(len(observations))
        if len(answered) > 4:
            raise kind
        return ones(observations)

    error = fails(kind, policies={Delicate.decide: policy})
    assert "seeds 20, 13, 17" in notes(error)
    assert "decide" in notes(error)
    assert sorted(Delicate.ended) == [13, 17, 20]


def test_an_interrupt_in_a_model_unwinds_all():
    def interrupting(action):
        if action == 2:
            raise KeyboardInterrupt
        return action

    actions = iter([1, 1, 1, 1, 2, 1])
    fails(
        KeyboardInterrupt,
        points={Delicate.decide: define(agent="going_0", apply=lambda action, simulation: interrupting(action))},
        policies={Delicate.decide: lambda observations: [next(actions) for _ in observations]},
    )
    assert sorted(Delicate.ended) == [13, 17, 20]


def test_an_error_in_a_mapping_says_of_which_seed():
    def observe(simulation):
        return [1, 2] if len(simulation.log) < 5 or simulation.seed != 17 else [1 // 0, 2]

    error = fails(ZeroDivisionError, points={Delicate.decide: define(agent="a", observation_space_mapping=observe)})
    assert "seed 17" in notes(error)
    assert sorted(Delicate.ended) == [13, 17, 20]


def test_an_illegal_action_says_of_whom_and_which_seed():
    error = fails(InvalidActionError, policies={Delicate.decide: lambda observations: [1, 10, 1]})
    assert "seed 13" in notes(error)
    assert "going_0" in notes(error)


def test_an_error_in_what_collects_says_of_which_seed():
    error = fails(ZeroDivisionError, seeds=[5, 3, 9], collect=lambda simulation: 1 // (simulation.seed - 5))
    assert "seed 5" in notes(error)
    assert sorted(Delicate.ended) == [3, 5, 9]


def test_an_error_in_a_reset_or_a_factory_says_of_which_seed():
    class Fussy(Delicate):
        def reset(self, seed):
            super().reset(1 // (seed - 17) or seed)

    with pytest.raises(ZeroDivisionError) as caught:
        simulate_many(Fussy, {Delicate.decide: ones}, points=delicate, seeds=[20, 17])
    assert "seed 17" in notes(caught.value)
    made = []

    def factory():
        made.append(1)
        return Delicate() if len(made) < 3 else 1 // 0

    with pytest.raises(ZeroDivisionError) as caught:
        simulate_many(factory, {Delicate.decide: ones}, points=delicate, seeds=[20, 17, 31])
    assert "seed 31" in notes(caught.value)


def test_what_the_others_raise_when_they_are_unwound_is_noted():
    class Stubborn(Delicate):
        def run(self):
            try:
                super().run()
            except SystemExit:
                raise LookupError("not yet") from None

    with pytest.raises(ZeroDivisionError) as caught:
        simulate_many(Stubborn, {Delicate.decide: ones}, points=delicate, seeds=[13, 99])
    assert "seed 99" in notes(caught.value)
    assert "not yet" in notes(caught.value)


@pytest.mark.parametrize("seeds", [5, None, "12", [1, "a"], [1, None], [1, -1], [True], [0.5]])
def test_seeds_are_integers(seeds):
    with pytest.raises(OptionValueError, match="seed"):
        simulate_many(Going, seeds=seeds)


def test_seeds_may_be_an_array():
    found = simulate_many(Going, seeds=np.arange(3))
    assert [type(simulation.seed) for simulation in found] == [int] * 3


@pytest.mark.parametrize(
    "wrong",
    [
        {"batch_size": 0},
        {"batch_size": -1},
        {"batch_size": 1.5},
        {"batch_size": True},
        {"workers": -2},
        {"workers": -3},
        {"workers": 0.5},
        {"workers": True},
        {"workers": None},
        {"workers": "all"},
        {"collect": 3},
        {"policies": [1]},
        {"policies": {Going.decide: 3}},
        {"policies": {"nobody": ones}},
    ],
    ids=plainly,
)
def test_arguments_that_cannot_be(wrong):
    with pytest.raises((OptionValueError, UnknownPointError), match=rf"{next(iter(wrong))} must be|polic"):
        simulate_many(Going, **{"seeds": range(3), "points": going} | wrong)


def test_unknown_options_are_refused():
    with pytest.raises(UnknownOptionError, match="there is no option"):
        simulate_many(Going, seeds=[1], speed=3)


# -- other things around --------------------------------------------------------------------------


def test_plugins_are_for_these_simulations_alone():
    called = []

    def extended(simulation):
        called.append(simulation.seed)

    options = {"plugins": [(extended, Going.decide, "before")]}
    found = simulate_many(Going, {Going.decide: ones}, points=going, seeds=[2, 1, 3], batch_size=2, **options)
    assert [simulation.log for simulation in found] == [[1, 1], [1], [1, 1, 1]]
    assert sorted(called) == [1, 2, 2, 3, 3, 3]
    simulate_many(Going, {Going.decide: ones}, points=going, seeds=[2])
    assert len(called) == 6


def test_variants_whose_own_policies_are_asked_one_by_one():
    ant, bee = decision(agent="ant_0", **PAIRS), decision(agent="bee_0", **PAIRS)

    def of_one(observation):
        assert observation.shape == (2,)
        return 5

    variant = Variant("own", calling(ant, bee), points=[ant, bee], policies={bee: of_one})
    found = simulate_many(variant, {ant: ones}, seeds=range(3))
    assert [simulation.log for simulation in found] == [[1, 5]] * 3


def test_simulations_within_policies_and_rules():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")

    def look_ahead(observations):
        found = simulate_many(calling(bee, bee), {bee: ones}, seeds=range(len(observations)))
        return [sum(simulation.log) for simulation in found]

    assert [s.log for s in simulate_many(calling(ant, ant), {ant: look_ahead}, seeds=range(3))] == [[2, 2]] * 3

    def main(simulation):
        simulation.log.append([s.log for s in simulate_many(calling(bee), {bee: ones}, seeds=range(2))])
        simulation.log.append(ant())

    assert [s.log for s in simulate_many(script(main), {ant: ones}, seeds=range(2))] == [[[[1], [1]], 1]] * 2


@pytest.mark.parametrize(("missing", "wanted"), [("tqdm.auto", {"progress": True}), ("joblib", {"workers": 2})])
def test_what_is_missing_is_named(monkeypatch, missing, wanted):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(MissingExtraError, match=r"simenv-marl\[many\]"):
        simulate_many(Going, seeds=[1, 2], **wanted)


def test_more_are_under_way_where_a_policy_takes_longer_than_they_do(monkeypatch):
    """Few at first, which stay in the processor's caches; never more than asked for, and the same comes of it."""
    monkeypatch.setattr("simenv_marl.many.batch.CROWD", 4)
    clock = [0.0]  # stands still while simulations run
    monkeypatch.setattr("simenv_marl.many.batch.perf_counter", lambda: clock[0])
    ant = decision(agent="ant_0")
    source = calling(*[ant] * 6)

    def crowds(pause, **options):
        seen = []

        def policy(observations):
            clock[0] += pause
            seen.append(len(observations))
            return [1] * len(observations)

        found = simulate_many(source, {ant: policy}, points=ant, seeds=range(40), **options)
        assert [simulation.log for simulation in found] == [[1] * 6] * 40
        return max(seen)

    assert crowds(0.0) == 4
    assert crowds(1.0) > 8
    assert crowds(1.0, batch_size=6) == 6
    assert crowds(1.0, batch_size=3) == 3


def test_workers_may_be_as_many_as_there_are():
    found = simulate_many(
        Going, {Going.decide: ones}, seeds=range(3), points=going, workers=-1, collect=lambda s: s.log
    )
    assert found == [[1] * seed for seed in range(3)]
