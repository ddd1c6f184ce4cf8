"""Many simulations at once: ``simulate_many``, in this process."""

import gc
import inspect
import sys
import weakref
from typing import ClassVar

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import RULE, evaluate, simulate, simulate_many
from simenv_marl.data import collect_episodes
from simenv_marl.errors import InvalidActionError, MissingExtraError, OptionValueError
from simenv_marl.experiments import run_experiment
from tests.extent import examples
from tests.worlds.models import calling, decision, define, fails, notes, plainly, script, stacks
from tests.worlds.random_worlds import World, points_of, world_designs, world_policy
from tests.worlds.vectors import same

some_seeds = st.lists(st.integers(0, 2**31 - 1), max_size=12)
sizes = st.integers(1, 14)

PAIRS = {
    "observation_space": spaces.Box(-9, 9, (2,), np.float32),
    "observation_space_mapping": lambda *args: [1, 2],
}


def by_row(policy):
    def of_many(observations, infos):
        return [
            policy(observation, info) for observation, info in zip(observations, infos, strict=True)
        ]

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


@given(world_designs(), some_seeds, sizes)
@examples(60)
def test_simulate_many_matches_simulate_one_by_one(design, seeds, size):
    """All kinds of decision points: nested, generators, with choices, of entities, named late."""

    def source():
        return World(design, points)

    points = points_of(design)
    one = {
        points[number]: world_policy for number in range(len(points)) if number not in design.rules
    }
    many = {point: by_row(policy) for point, policy in one.items()}
    found = simulate_many(source, many, seeds=seeds, points=points, batch_size=size)
    for seed, simulation in zip(seeds, found, strict=True):
        alone = simulate(source, one, seed=seed, points=points)
        assert simulation.trace == alone.trace
        assert simulation.random.getstate() == alone.random.getstate()


def test_simulate_many_without_policies_runs_models_unchanged():
    ant = decision(agent="ant_0")
    assert [s.log for s in simulate_many(calling(ant, ant), seeds=range(3))] == [
        ["rule", "rule"]
    ] * 3
    assert [s.log for s in simulate_many(calling(ant), {ant: RULE}, seeds=[5], points=ant)] == [
        ["rule"]
    ]
    assert simulate_many(calling(ant), {ant: ones}, seeds=[]) == []


def test_simulate_many_returns_one_simulation_per_seed_in_order():
    found = simulate_many(
        Going, {Going.decide: ones}, points=going, seeds=iter([4, 0, 2, 4]), batch_size=2
    )
    assert [simulation.seed for simulation in found] == [4, 0, 2, 4]
    assert [simulation.log for simulation in found] == [[1] * 4, [], [1, 1], [1] * 4]
    assert len({id(simulation) for simulation in found}) == 4
    given_simulation = Going()
    (found,) = simulate_many(given_simulation, {Going.decide: ones}, points=going, seeds=[1])
    assert found is not given_simulation  # it is copied
    assert not hasattr(given_simulation, "log")


def test_simulate_many_stacks_observations_of_all_spaces_for_policies():
    kinds = [
        spaces.Box(-9, 9, (2,), np.float32),
        spaces.Discrete(5),
        spaces.Box(0, 9, ()),
        spaces.MultiBinary(3),
    ]
    values = ([1.0, 2.0], 3, 3.0, [1, 0, 1])
    ant = decision(
        agent="ant_0",
        observation_space=spaces.Dict(near=spaces.Tuple(kinds), word=spaces.Text(4)),
        observation_space_mapping=lambda: {"word": "bee", "near": values},
    )

    def policy(observations):
        assert list(observations) == ["near", "word"]
        assert observations["word"].tolist() == ["bee"] * 4
        for space, value, rows in zip(kinds, values, observations["near"], strict=True):
            assert same(rows, np.array([value] * 4, space.dtype))
        return [1] * 4

    found = simulate_many(calling(ant), {ant: policy}, seeds=range(4))
    assert [simulation.log for simulation in found] == [[1]] * 4


def test_simulate_many_policies_own_observations_and_can_take_infos():
    mask = [0, 1] + [0] * 8
    ant = decision(agent="ant_0", action_mask_mapping=lambda: mask, **PAIRS)

    def policy(observations, infos):
        assert observations.tolist() == [[1, 2]] * 3
        assert [{name: value.tolist() for name, value in info.items()} for info in infos] == [
            {"action_mask": mask}
        ] * 3
        observations[:] = 7
        for info in infos:
            info["seen"] = True
        return ones(observations)

    found = simulate_many(calling(ant, ant), {ant: policy}, seeds=range(3))
    assert [simulation.log for simulation in found] == [[1, 1]] * 3


def test_simulate_many_batches_all_decision_points_of_a_policy_together():
    ant, bee = decision(agent="ant_0", **PAIRS), decision(agent="bee_0", **PAIRS)
    cat = decision(agent="cat_0")  # who observes something else
    asked = []

    def policy(observations):
        asked.append(len(observations))
        return ones(observations)

    source = script(
        lambda simulation: simulation.log.append(ant() if simulation.seed % 2 else bee())
    )
    simulate_many(source, {ant: policy, bee: policy}, seeds=range(10))
    assert asked == [10]
    assert [
        s.log for s in simulate_many(calling(ant, cat), {ant: policy, cat: policy}, seeds=range(3))
    ] == [[1, 1]] * 3
    assert asked == [10, 3, 3]


def test_simulate_many_starts_new_simulations_up_to_the_batch_size():
    asked, under_way, ended = [], weakref.WeakSet(), []

    class Watched(Going):
        def reset(self, seed):
            super().reset(seed)
            under_way.add(self)
            gc.collect()
            assert len(under_way) <= 4

    def policy(observations):
        asked.append(len(observations))
        return ones(observations)

    def collect(simulation):
        ended.append(simulation.seed)
        return simulation.seed * 10

    seeds = [1, 1, 2, 9] * 5
    given = {"points": going, "seeds": seeds, "batch_size": 4, "collect": collect}
    assert simulate_many(Watched, {Going.decide: policy}, **given) == [10 * seed for seed in seeds]
    assert ended[:4] == [1, 1, 2, 1]  # as soon as they have
    assert max(asked) == 4
    assert len(asked) < 35  # and not 45, which it would be if all of four had to end first


class Tensor:
    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype)


PAIRED = np.array([[1.0, 2], [3, 4]])
BOTH = spaces.Dict(a=spaces.Discrete(9), b=spaces.Box(0, 9, (2,), np.float64))


@pytest.mark.parametrize(
    ("space", "answer", "expected"),
    [
        *(
            (spaces.Discrete(10), answer, [4, 5])
            for answer in (
                (4, 5),
                np.array([4, 5]),
                Tensor([4, 5]),
                {4: None, 5: None}.keys(),
                ([4, 5], {"value": [1, 2]}),
            )
        ),
        (spaces.Discrete(10), [3, RULE], [3, "rule"]),
        (spaces.Discrete(10), np.array([RULE, 4], object), ["rule", 4]),
        (spaces.Discrete(10), RULE, ["rule", "rule"]),
        (spaces.Box(0, 9, (2,), np.float32), PAIRED, PAIRED.astype(np.float32)),
        (
            BOTH,
            {"a": np.array([5, 6]), "b": PAIRED},
            [{"a": 5, "b": PAIRED[0]}, {"a": 6, "b": PAIRED[1]}],
        ),
        (
            spaces.Tuple([spaces.Discrete(9), spaces.Discrete(9)]),
            [(1, 2), (3, 4)],
            [(1, 2), (3, 4)],
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_simulate_many_accepts_lists_arrays_and_generators_from_policies(space, answer, expected):
    ant = decision(agent="ant_0", action_space=space)
    found = simulate_many(
        calling(ant), {ant: lambda observations: answer}, seeds=range(len(expected))
    )
    assert same([simulation.log for simulation in found], [[action] for action in expected])


@pytest.mark.parametrize(
    "answer",
    [[1], [1, 1, 1], [], np.int64(1), 1, None, "ab", {}, {"a": [1], "b": [1, 2]}, np.ones((3, 2))],
    ids=repr,
)
def test_simulate_many_refuses_a_wrong_number_of_actions(answer):
    ant = decision(agent="ant_0")
    with fails(InvalidActionError, "3", match=r"2 decisions|not in its action space"):
        simulate_many(calling(ant), {ant: lambda observations: answer}, seeds=[3, 4])


class Delicate(Going):
    """Fails in its run by the seed 13, in its reset by 50, and as it unwinds by 99."""

    ended: ClassVar[list] = []

    def reset(self, seed):
        super().reset(seed)
        if seed == 50:
            raise ZeroDivisionError

    def run(self):
        try:
            super().run()
            if self.seed == 13:
                raise ZeroDivisionError
        finally:
            self.ended.append(self.seed)
            if self.seed == 99:
                raise LookupError("not yet")


def delicate(**changes):
    return {Delicate.decide: define(agent="going_0", **changes)}


def raising(kind):
    answered = []

    def policy(observations):
        answered.append(len(observations))
        if len(answered) % 5 == 0:
            raise kind
        return ones(observations)

    return {"policies": {Delicate.decide: policy}}


def observe(simulation):
    return [1, 2] if len(simulation.log) < 5 or simulation.seed != 17 else [1 // 0, 2]


@pytest.mark.parametrize("run", [simulate_many, collect_episodes])
@pytest.mark.parametrize(
    ("error", "arguments", "told"),
    [
        (ZeroDivisionError, {}, ["seed 13"]),
        (ZeroDivisionError, {"seeds": [20, 17, 50]}, ["seed 50"]),
        (ZeroDivisionError, {"seeds": [20, 13, 99]}, ["seed 13", "seed 99", "not yet"]),
        *(
            (kind, raising(kind), ["seeds 20, 13, 17", "decide"])
            for kind in (StopIteration, KeyboardInterrupt)
        ),
        (ZeroDivisionError, {"points": delicate(observation_space_mapping=observe)}, ["seed 17"]),
        (
            InvalidActionError,
            {"policies": {Delicate.decide: lambda seen: [1, 10, 1]}},
            ["seed 13", "going_0"],
        ),
        (
            ZeroDivisionError,
            {"seeds": [20, 17, 18], "collect": lambda model: 1 // (model.seed - 17)},
            ["seed 17"],
        ),
    ],
    ids=[
        "model",
        "reset",
        "unwinding",
        "policy",
        "interrupt",
        "mapping",
        "illegal action",
        "collect",
    ],
)
def test_simulate_many_error_names_the_seed_and_unwinds_all_simulations(
    error, arguments, told, run
):
    Delicate.ended.clear()
    plain, before = vars(Going)["decide"], stacks()
    usual = {
        "policies": {Delicate.decide: ones},
        "points": delicate(),
        "seeds": [20, 13, 17, 30],
        "batch_size": 3,
    }
    usual |= arguments
    with pytest.raises(error) as caught:
        run(Delicate, **usual)
    assert all(words in notes(caught.value) for words in told)
    assert sorted(Delicate.ended) == sorted(set(usual["seeds"][:3]) - {50})
    assert "decide" not in vars(Delicate)
    assert vars(Going)["decide"] is plain
    assert not stacks(before)


def test_simulate_many_error_in_a_factory_names_the_seed():
    models = [Going()]
    with fails(IndexError, "seed 17"):
        simulate_many(lambda: models.pop(), {Going.decide: ones}, points=going, seeds=[20, 17])


@pytest.mark.parametrize(
    "wrong",
    [
        *(
            {"seeds": seeds}
            for seeds in (5, None, "12", [1, "a"], [1, None], [1, -1], [True], [0.5])
        ),
        *({"batch_size": size} for size in (0, -1, 1.5, True)),
        *({"workers": workers} for workers in (-2, -3, 0.5, True, None, "all")),
        {"collect": 3},
        {"policies": [1]},
    ],
    ids=plainly,
)
def test_simulate_many_refuses_invalid_arguments(wrong):
    (name,) = wrong
    with pytest.raises(
        OptionValueError, match={"policies": "polic", "seeds": "seed"}.get(name, f"{name} must be")
    ):
        simulate_many(Going, **{"seeds": range(3), "points": going} | wrong)


def test_simulate_many_takes_an_array_of_seeds_and_workers_minus_one():
    told = lambda simulation: (type(simulation.seed), simulation.log)  # noqa: E731
    given = {"seeds": np.arange(3), "points": going, "workers": -1}
    assert simulate_many(Going, {Going.decide: ones}, **given, collect=told) == [
        (int, [1] * seed) for seed in range(3)
    ]


def test_simulate_many_plugins_act_only_in_its_own_simulations():
    called = []
    plugins = [(lambda simulation: called.append(simulation.seed), Going.decide, "before")]
    given = {"points": going, "batch_size": 2, "plugins": plugins}
    found = simulate_many(Going, {Going.decide: ones}, seeds=[2, 1, 3], **given)
    assert [simulation.log for simulation in found] == [[1, 1], [1], [1, 1, 1]]
    assert sorted(called) == [1, 2, 2, 3, 3, 3]
    simulate_many(Going, {Going.decide: ones}, points=going, seeds=[2])
    assert len(called) == 6


def test_simulate_many_can_be_called_by_policies_and_models():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")

    def look_ahead(observations):
        found = simulate_many(calling(bee, bee), {bee: ones}, seeds=range(len(observations)))
        return [sum(simulation.log) for simulation in found]

    def main(simulation):
        simulation.log.append(
            [s.log for s in simulate_many(calling(bee), {bee: ones}, seeds=range(2))]
        )
        simulation.log.append(ant())

    assert [s.log for s in simulate_many(script(main), {ant: look_ahead}, seeds=range(2))] == [
        [[[1], [1]], 2]
    ] * 2


@pytest.mark.parametrize(
    ("missing", "wanted"), [("tqdm.auto", {"progress": True}), ("joblib", {"workers": 2})]
)
def test_simulate_many_error_names_the_extra_of_a_missing_package(monkeypatch, missing, wanted):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(MissingExtraError, match=r"simenv-marl\[many\]"):
        simulate_many(Going, seeds=[1, 2], **wanted)


def test_simulate_many_runs_more_simulations_at_once_if_policies_are_slow(monkeypatch):
    """Few simulations run at first, for the processor's caches; the results are always the same."""
    monkeypatch.setattr("simenv_marl.many.batch.CROWD", 4)
    clock = [0.0]  # stands still while simulations run
    monkeypatch.setattr("simenv_marl.many.batch.perf_counter", lambda: clock[0])
    ant = decision(agent="ant_0")

    def crowd(pause, **options):
        seen = []

        def policy(observations):
            clock[0] += pause
            seen.append(len(observations))
            return ones(observations)

        found = simulate_many(calling(*[ant] * 6), {ant: policy}, seeds=range(40), **options)
        assert [simulation.log for simulation in found] == [[1] * 6] * 40
        return seen

    assert (max(crowd(0.0)), max(crowd(1.0, batch_size=6)), max(crowd(1.0, batch_size=3))) == (
        4,
        6,
        3,
    )
    assert crowd(1.0)[:4] == [4, 8, 16, 32]


def test_simulate_many_collect_episodes_and_evaluate_share_their_defaults():
    expected = {"batch_size": 1024, "concurrency": 64, "workers": 0, "progress": False}
    for function in (simulate_many, collect_episodes, evaluate, run_experiment):
        parameters = inspect.signature(function).parameters
        assert {
            name: parameters[name].default for name in expected if name in parameters
        }.items() <= expected.items()
        assert {"workers", "concurrency"} <= parameters.keys()
