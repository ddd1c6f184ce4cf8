"""Section 3 of the contract: calls that hold many decisions, and the rule inside of ``apply``."""

import asyncio
import random

import numpy as np
import pytest
import simpy
from gymnasium import spaces

from simenv_marl import RULE, aec_env, branch, joint_env, make_step, parallel_env, simulate, simulate_many, single_env
from simenv_marl.errors import DefinitionError

BOX = spaces.Box(-99, 99, (2,), np.float32)


class Station:
    def __init__(self, name):
        self.name, self.load = name, 0


class Grid:
    """Allots power to its stations, in one call."""

    def __init__(self):
        self.stations, self.rules = [Station(f"s_{number}") for number in range(3)], 0

    def allot(self, wanted, most=2):
        self.rules += 1
        return {station.name: min(number, most) for station, number in zip(self.stations, wanted, strict=True)}


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
    return {
        Grid.allot: make_step(**{
            "observation_space": BOX,
            "observation_space_mapping": lambda station, grid, wanted, most: [station.load, most],
            "action_space": spaces.Discrete(9),
            "action_space_mapping": lambda action: action,
            "reward_mapping": lambda station, *call: float(station.load),
            "agent": lambda station, *call: station.name,
            "split": lambda grid, wanted, most: iter(grid.stations),
            "gather": lambda items, found, *call: {item.name: one for item, one in zip(items, found, strict=True)},
            "part": lambda result, station, *call: result[station.name],
        } | changes)
    }  # fmt: skip


def plain(seed):
    day = Day()
    day.reset(seed)
    day.run()
    return day


def played(env, answers):
    env.reset(seed=5)
    while env.agents:
        *_, terminated, truncated, _ = env.last()
        env.step(None if terminated or truncated else answers(env.agent_selection))
    return env.unwrapped.simulation


def test_with_rule_throughout_the_run_is_the_plain_one_and_the_rule_runs_once_for_a_call():
    day = played(aec_env(Day, points()), lambda agent: RULE)
    assert (day.log, day.grid.rules) == (plain(5).log, 4)


def test_items_decide_in_order_and_those_that_are_answered_by_the_rule_get_their_part_of_its_result():
    order = []
    day = played(aec_env(Day, points()), lambda agent: order.append(agent) or (RULE if agent == "s_1" else 7))
    assert order == ["s_0", "s_1", "s_2"] * 4
    assert (day.log, day.grid.rules) == ([(7, number, 7) for _, number, _ in plain(5).log], 4)


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
    assert one.simulation.log == [(first, 8, last) for first, _, last in plain(5).log[:1]]
    assert simulate(Day, {Grid.allot: lambda seen: 6}, points=points(), seed=5).log == [(6, 6, 6)] * 4
    days = simulate_many(Day, {Grid.allot: lambda seen: (6 for _ in seen)}, points=points(), seeds=[1, 2])
    assert [day.log for day in days] == [[(6, 6, 6)] * 4] * 2


def test_branches_and_ends_amid_a_call_are_exact_and_leave_nothing():
    env = aec_env(Day, points())
    env.reset(seed=5)
    env.step(7)
    assert branch(env, lambda twin, number: (twin.step(1), twin.agent_selection)[1], 2, method="replay") == ["s_2"] * 2
    env.close()
    assert played(env, lambda agent: RULE).log == plain(5).log


def test_apply_runs_for_each_item_and_gather_needs_split():
    day = played(
        aec_env(Day, points(action_space_mapping=None, apply=lambda action, station, *call: -action)), lambda agent: 2
    )
    assert day.log == [(-2, -2, -2)] * 4
    with pytest.raises(DefinitionError, match="gather and part need split"):
        points(split=None)


@pytest.mark.parametrize("kind", ["generator", "coroutine"])
def test_functions_that_wait_decide_for_items_too(kind):
    class Shop:
        def reset(self, seed=None):
            self.log = []

        def choose(self):
            yield self.world.timeout(1)
            return [0, 1]

        async def decide(self):
            await asyncio.sleep(0)
            return [0, 1]

        def run(self):
            self.world = simpy.Environment()
            if kind == "coroutine":
                self.log.append(asyncio.run(self.decide()))
            else:
                self.world.run(self.world.process(self.work()))

        def work(self):
            self.log.append((yield from self.choose()))

    definition = make_step(
        observation_space=BOX, observation_space_mapping=lambda item, shop: [item, 0], action_space=spaces.Discrete(9),
        action_space_mapping=lambda action: action, reward_mapping=lambda item, shop: 0.0,
        agent=lambda item, shop: f"part_{item}", split=lambda shop: [0, 1],
    )  # fmt: skip
    env = aec_env(Shop, {Shop.choose if kind == "generator" else Shop.decide: definition})
    env.reset()
    env.step(5)
    env.step(RULE)
    assert env.unwrapped.simulation.log == [[5, 1]]


class Clinic:
    factor = 2

    def reset(self, seed=None):
        self.log = []

    def stay(self, days):
        return days * self.factor

    def run(self):
        self.log = [self.stay(days) for days in range(3)]


def under_another_factor(action, clinic, days, *, _rule):
    clinic.factor = action
    try:
        return _rule(clinic, days + 1) + clinic.stay(days)  # its own function, which would ask again
    finally:
        clinic.factor = 2


def test_apply_runs_the_rule_under_other_parameters_and_its_own_calls_do_not_ask_again():
    definition = make_step(
        observation_space=BOX, observation_space_mapping=lambda clinic, days: [days, 0],
        action_space=spaces.Discrete(9), apply=under_another_factor, reward_mapping=lambda clinic, days: 0.0,
    )  # fmt: skip
    env = single_env(Clinic, {Clinic.stay: definition})
    env.reset()
    for action in (3, RULE, 4):
        env.step(action)
    assert env.simulation.log == [3, 2, 20]
