"""Section 3 of the contract: calls that hold many decisions, and the rule inside of ``apply``."""

import asyncio
import random

import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    aec_env,
    branch,
    joint_env,
    parallel_env,
    simulate,
    simulate_many,
    single_env,
)
from simenv_marl.errors import DefinitionError
from tests.worlds.models import begun, decisions, define, follow_the_rule, play


class Station:
    def __init__(self, name):
        self.name, self.load = name, 0


class Grid:
    """Allots power to its stations, in one call."""

    def __init__(self):
        self.stations, self.rules = [Station(f"s_{number}") for number in range(3)], 0

    def allot(self, wanted, most=2):
        self.rules += 1
        return {
            station.name: min(number, most)
            for station, number in zip(self.stations, wanted, strict=True)
        }


class Day:
    def reset(self, seed=None):
        self.grid, self.chance, self.log = Grid(), random.Random(seed), []

    def run(self):
        for _ in range(4):
            allotted = self.grid.allot([self.chance.randrange(5) for _ in self.grid.stations])
            for station in self.grid.stations:
                station.load += allotted[station.name]
            self.log.append((*allotted.values(),))

    def expected_calls(self, point):
        return [(self.grid, [0, 0, 0])]


def points(**changes):
    given = {
        "observation_space_mapping": lambda station, grid, wanted, most: [station.load, most],
        "reward_mapping": lambda station, *call: float(station.load),
        "agent": lambda station, *call: station.name,
        "split": lambda grid, wanted, most: iter(grid.stations),
        "gather": lambda items, found, *call: {
            item.name: one for item, one in zip(items, found, strict=True)
        },
        "part": lambda result, station, *call: result[station.name],
    }
    return {Grid.allot: define(**given | changes)}


PLAIN = Day()
PLAIN.reset(5)
PLAIN.run()


def test_split_items_decide_in_order_or_get_a_part_of_the_rules_result():
    env = aec_env(Day, points())
    day = follow_the_rule(env, seed=5)
    assert (day.log, day.grid.rules) == (PLAIN.log, 4)  # the rule runs once for a call
    assert (
        decisions(play(env, {"s_0": 7, "s_1": RULE, "s_2": 7}, seed=5)) == ["s_0", "s_1", "s_2"] * 4
    )
    assert env.simulation.log == [(7, number, 7) for _, number, _ in PLAIN.log]
    assert env.simulation.grid.rules == 4


def rule_actions(env, answers, seed=None):
    """Play an episode; return the action of the rule in each info, by agent."""
    turns = play(env, answers, seed=seed)
    return [(turn.agent, turn.info.get("rule_action")) for turn in turns]


def test_info_has_rule_actions_only_of_split_items_that_the_rule_answered():
    env = aec_env(Day, points(rule_action_mapping=int))
    seen = rule_actions(env, {"s_0": RULE, "s_1": 7, "s_2": RULE}, seed=5)
    numbers = [(first, None, last) for first, _, last in PLAIN.log]
    agents = ("s_0", "s_1", "s_2")
    assert seen[:3] == [(agent, None) for agent in agents]
    for place, agent in enumerate(agents):
        assert [number for name, number in seen[3:] if name == agent] == [
            call[place] for call in numbers
        ]


class Ward:
    """Gives beds. The rule of a call calls for another ward first; processes call in turns."""

    def __init__(self, names, inner=None):
        self.names = names
        self.inner = inner

    def assign(self, number):
        if self.inner is not None:
            self.inner.assign(number + 5)
        return [number] * len(self.names)

    def assign_later(self, number):
        yield
        return [number] * len(self.names)


class Nested:
    def reset(self):
        self.ward = Ward("abc", Ward("xy"))

    def run(self):
        for number in range(3):
            self.ward.assign(number)


class Overlapping:
    def reset(self):
        self.wards = [Ward("abc"), Ward("xy")]

    def run(self):
        calls = [ward.assign_later(number) for number, ward in enumerate(self.wards, 1)]
        for _ in range(2):
            for call in calls:
                next(call, None)
        self.wards[0].names = []
        for ward in self.wards:
            for _ in ward.assign_later(7):
                pass


def beds(function):
    return {
        function: define(
            split=lambda ward, number: ward.names,
            agent=lambda name: name,
            rule_action_mapping=int,
        )
    }


@pytest.mark.parametrize("by_policy", ["", "b", "bx", "ay"])
def test_nested_and_overlapping_split_calls_keep_their_own_rule_actions(by_policy):
    answers = {name: 9 if name in by_policy else RULE for name in "abcxy"}

    def told(env):
        seen = rule_actions(env, answers)
        return {
            name: {number for agent, number in seen if agent == name} - {None} for name in answers
        }

    expected = {"a": {0, 1, 2}, "b": {0, 1, 2}, "c": {0, 1, 2}, "x": {5, 6, 7}, "y": {5, 6, 7}}
    assert told(aec_env(Nested, beds(Ward.assign))) == {
        name: set() if name in by_policy else actions for name, actions in expected.items()
    }
    expected = {"a": {1}, "b": {1}, "c": {1}, "x": {2, 7}, "y": {2, 7}}
    assert told(aec_env(Overlapping, beds(Ward.assign_later))) == {
        name: set() if name in by_policy else actions for name, actions in expected.items()
    }


class Hospital:
    """Three patients wish for one of two beds, in one call."""

    def __init__(self):
        self.given = []

    def reset(self):
        self.day = 0

    def give(self, patients):
        return [0 for _ in patients]

    def run(self):
        for self.day in range(2):
            self.given.append(self.give("abc"))

    def expected_calls(self, point):
        return [(self, "abc")]


def free(name, hospital, patients, *, _answers):
    return [1, *(int(bed not in _answers) for bed in (1, 2))]


SEQUENCE = {
    "split": lambda hospital, patients: patients,
    "agent": lambda name: name,
    "action_space": spaces.Discrete(3),
    "observation_space": spaces.Box(0, 9, (2,)),
    "observation_space_mapping": lambda name, *, _answers: [len(_answers), sum(_answers, 0)],
}


def test_split_items_observe_the_answers_to_earlier_items():
    env = begun(aec_env(Hospital, {Hospital.give: define(**SEQUENCE, action_mask_mapping=free)}))
    seen = []
    for agent in env.agent_iter(6):
        observation, *_, info = env.last()
        seen.append((agent, *observation.tolist(), info["action_mask"].tolist()))
        legal = info["action_mask"].nonzero()[0]
        env.step(int(legal[-1]))
    day = [("a", 0, 0, [1, 1, 1]), ("b", 1, 2, [1, 1, 0]), ("c", 2, 3, [1, 0, 0])]
    assert seen == day * 2
    assert env.simulation.given == [[2, 1, 0]] * 2


def test_split_item_mappings_get_earlier_answers_as_values_not_actions():
    got = []

    def note(name, *, _answers):
        got.append((name, *_answers))
        return [0, 0]

    given = SEQUENCE | {"observation_space_mapping": note}
    del given["action_space"]
    for changes in (
        {"action_space": spaces.Discrete(3), "choices": lambda name, *, _answers: ["p", "q", "r"]},
        {"action_space": spaces.Discrete(3), "apply": lambda action, name: f"bed {action}"},
    ):
        got.clear()
        env = begun(aec_env(Hospital, {Hospital.give: define(**given, **changes)}))
        for action in (1, RULE, 2):
            env.step(action)
        first = "q" if "choices" in changes else 1
        assert got[:3] == [("a",), ("b",), ("c",)]  # when the episode begins
        assert got[3:5] == [("b", first), ("c", first, RULE)]


def test_parallel_env_observes_split_items_at_the_reset():
    env = parallel_env(Hospital, {Hospital.give: define(**SEQUENCE)})
    observations, _ = env.reset()
    assert [seen.tolist() for seen in observations.values()] == [[0, 0]] * 3
    env.step({"a": 2, "b": 1, "c": 0})
    assert env.simulation.given == [[2, 1, 0]]


def test_make_step_refuses_an_answers_parameter_without_split():
    mapping = {"observation_space_mapping": lambda hospital, *, _answers: [0, 0]}
    with pytest.raises(DefinitionError, match="_answers"):
        aec_env(Hospital, {Hospital.give: define(**mapping)})


def test_split_items_can_be_answered_in_every_env_and_by_policies():
    env = begun(parallel_env(Day, points()), 5)
    rewards = env.step({"s_0": 3, "s_1": 4, "s_2": 5})[1]
    assert (env.simulation.log, rewards) == ([(3, 4, 5)], {"s_0": 3.0, "s_1": 4.0, "s_2": 5.0})
    joint = begun(joint_env(Day, points()), 5)
    assert joint.step({"s_0": 3, "s_1": 4, "s_2": 5})[1] == 12.0
    one = begun(single_env(Day, points(), agent="s_1"), 5)
    one.step(8)
    assert one.simulation.log == [(first, 8, last) for first, _, last in PLAIN.log[:1]]
    assert (
        simulate(Day, {Grid.allot: lambda seen: 6}, points=points(), seed=5).log == [(6, 6, 6)] * 4
    )
    days = simulate_many(
        Day, {Grid.allot: lambda seen: (6 for _ in seen)}, points=points(), seeds=[1, 2]
    )
    assert [day.log for day in days] == [[(6, 6, 6)] * 4] * 2


def test_branches_and_resets_within_a_split_call_keep_the_model_exact():
    env = begun(aec_env(Day, points()), 5)
    env.step(7)
    assert (
        branch(
            env, lambda twin, number: (twin.step(1), twin.agent_selection)[1], 2, method="replay"
        )
        == ["s_2"] * 2
    )
    env.close()
    assert follow_the_rule(env, seed=5).log == PLAIN.log


def test_apply_runs_for_each_split_item_and_gather_needs_split():
    env = aec_env(Day, points(apply=lambda action, station, *call: -action))
    play(env, 2)
    assert env.simulation.log == [(-2, -2, -2)] * 4
    with pytest.raises(DefinitionError, match="gather and part need split"):
        points(split=None)


class Shop:
    """Decides by a generator and by a coroutine."""

    def reset(self):
        self.log = []

    def choose(self):
        yield
        return [0, 1]

    async def decide(self):
        await asyncio.sleep(0)
        return [0, 1]

    def run(self):
        assert list(self.work()) == [None]
        self.log.append(asyncio.run(self.decide()))

    def work(self):
        self.log.append((yield from self.choose()))


def test_split_works_for_generator_and_coroutine_functions():
    chosen, decided = (
        define(agent=lambda item, shop, name=name: f"{name}_{item}", split=lambda shop: [0, 1])
        for name in ("chosen", "decided")
    )
    env = aec_env(Shop, {Shop.choose: chosen, Shop.decide: decided})
    play(env, {"chosen_0": 5, "chosen_1": RULE, "decided_0": 6, "decided_1": RULE})
    assert env.simulation.log == [[5, 1], [6, 1]]


class Clinic:
    factor = 2

    def reset(self):
        self.log = []

    def stay(self, days):
        return days * self.factor

    def run(self):
        self.log = [self.stay(days) for days in range(3)]


def under_another_factor(action, clinic, days, *, _rule):
    clinic.factor = action
    try:
        # its own function, which would ask again
        return _rule(clinic, days + 1) + clinic.stay(days)
    finally:
        clinic.factor = 2


def test_apply_can_call_the_models_rule_without_another_decision():
    env = begun(
        single_env(
            Clinic,
            {Clinic.stay: define(action_space=spaces.Discrete(9), apply=under_another_factor)},
        )
    )
    for action in (3, RULE, 4):
        env.step(action)
    assert env.simulation.log == [3, 2, 20]
