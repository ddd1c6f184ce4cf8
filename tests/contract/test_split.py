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
from tests.worlds.models import decisions, define, follow_the_rule, play


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


def test_items_decide_in_order_and_those_that_are_answered_by_the_rule_get_their_part_of_its_result():  # noqa: E501
    env = aec_env(Day, points())
    day = follow_the_rule(env, seed=5)
    assert (day.log, day.grid.rules) == (PLAIN.log, 4)  # the rule runs once for a call
    assert (
        decisions(play(env, {"s_0": 7, "s_1": RULE, "s_2": 7}, seed=5)) == ["s_0", "s_1", "s_2"] * 4
    )
    assert env.simulation.log == [(7, number, 7) for _, number, _ in PLAIN.log]
    assert env.simulation.grid.rules == 4


def test_infos_have_the_part_of_each_item_in_what_the_rule_decided():
    env = aec_env(Day, points(rule_action_mapping=int))
    env.reset(seed=5)
    seen = []
    for _ in range(6):
        seen.append(env.last()[4].get("rule_action"))
        env.step(RULE)
    assert seen == [None, None, None, *PLAIN.log[0]]


def test_all_views_and_policies_answer_items():
    env = parallel_env(Day, points())
    env.reset(seed=5)
    rewards = env.step({"s_0": 3, "s_1": 4, "s_2": 5})[1]
    assert (env.simulation.log, rewards) == ([(3, 4, 5)], {"s_0": 3.0, "s_1": 4.0, "s_2": 5.0})
    joint = joint_env(Day, points())
    joint.reset(seed=5)
    assert joint.step({"s_0": 3, "s_1": 4, "s_2": 5})[1] == 12.0
    one = single_env(Day, points(), agent="s_1")
    one.reset(seed=5)
    one.step(8)
    assert one.simulation.log == [(first, 8, last) for first, _, last in PLAIN.log[:1]]
    assert (
        simulate(Day, {Grid.allot: lambda seen: 6}, points=points(), seed=5).log == [(6, 6, 6)] * 4
    )
    days = simulate_many(
        Day, {Grid.allot: lambda seen: (6 for _ in seen)}, points=points(), seeds=[1, 2]
    )
    assert [day.log for day in days] == [[(6, 6, 6)] * 4] * 2


def test_branches_and_ends_amid_a_call_are_exact_and_leave_nothing():
    env = aec_env(Day, points())
    env.reset(seed=5)
    env.step(7)
    assert (
        branch(
            env, lambda twin, number: (twin.step(1), twin.agent_selection)[1], 2, method="replay"
        )
        == ["s_2"] * 2
    )
    env.close()
    assert follow_the_rule(env, seed=5).log == PLAIN.log


def test_apply_runs_for_each_item_and_gather_needs_split():
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


def test_functions_that_wait_decide_for_items_too():
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


def test_apply_runs_the_rule_under_other_parameters_and_its_own_calls_do_not_ask_again():
    env = single_env(
        Clinic, {Clinic.stay: define(action_space=spaces.Discrete(9), apply=under_another_factor)}
    )
    env.reset()
    for action in (3, RULE, 4):
        env.step(action)
    assert env.simulation.log == [3, 2, 20]
