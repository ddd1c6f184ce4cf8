"""The arguments of mappings: the simulation on request, and a chosen answer among choices."""

import gc
import pickle
import weakref

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    SimulationInterface,
    aec_env,
    difference,
    joint_env,
    make_step,
    parallel_env,
    simulate,
    simulate_many,
    single_env,
    vector_env,
)
from simenv_marl.data import collect_episodes
from tests.worlds.models import begun, play

DEAL = f"{__name__}.Dealer.deal"
LEAVE = f"{__name__}.Dealer.leave"


class Dealer:
    """Has no way to what it belongs to."""

    def __init__(self, number):
        self.number = number

    def deal(self, offers):
        return ("rule", offers[0])

    def leave(self):
        """Deal no more."""


class Market(SimulationInterface):
    """Two dealers, who deal once a day."""

    days = 3

    def __init__(self, name="market"):
        self.name = name

    def reset(self, seed=None):
        self.seed, self.day, self.dealers, self.log = seed, 0, [Dealer(0), Dealer(1)], []

    def run(self):
        for day in range(self.days):
            self.day = day
            for dealer in list(self.dealers):
                self.log.append(dealer.deal(["low", "high"]))
        self.dealers.pop().leave()

    def expected_calls(self, point):
        return [(dealer, ["low", "high"]) for dealer in self.dealers]


def watch(dealer, offers, *, _simulation):
    return [_simulation.day, _simulation.seed]


def pay(dealer, offers, *, _simulation):
    return len(_simulation.log)


def offer(dealer, offers, *, _simulation):
    return offers if _simulation.day else offers[:1]


def take(offered, dealer, offers, *, _simulation):
    return (_simulation.name, offered)


def name(dealer, offers=(), *, _simulation):
    return f"{_simulation.name}_{dealer.number}"


def points(**changes):
    given = {
        "observation_space": spaces.Box(0, 1e6, (2,), np.float64),
        "observation_space_mapping": watch,
        "action_space": spaces.Discrete(2),
        "choices": offer,
        "apply": take,
        "reward_mapping": pay,
        "agent": name,
        "removed_by": {LEAVE: name},
    }
    return {DEAL: make_step(**given | changes)}


def last_choice(agent, env):
    """The last action that is legal for an agent."""
    return int(env.infos[agent]["action_mask"].sum()) - 1


@pytest.mark.parametrize(
    ("title", "pay", "earned"),
    [("here", pay, [0, 2, 4, 6]), ("there", difference(pay), [0, 2, 2, 2])],
)
def test_observation_and_reward_mappings_can_take_the_simulation(title, pay, earned):
    other = begun(aec_env(Market("elsewhere"), points()))
    env = aec_env(Market(title), points(reward_mapping=pay))
    turns = play(env, last_choice, seed=5)
    assert [turn.agent for turn in turns] == [f"{title}_0", f"{title}_1"] * 3 + [
        f"{title}_1",
        f"{title}_0",
    ]
    mine = [
        (turn.observation.tolist(), turn.reward) for turn in turns if turn.agent == f"{title}_0"
    ]
    assert mine == list(zip([[0, 5], [1, 5], [2, 5], [2, 5]], earned, strict=True))
    assert [turn.terminated for turn in turns] == [False] * 6 + [True] * 2
    assert env.simulation.log == [(title, "low")] * 2 + [(title, "high")] * 4
    other.step(0)
    assert other.simulation.log == [("elsewhere", "low")]


def test_action_mask_goal_and_rule_mappings_can_take_the_simulation():
    changes = {
        "choices": None,
        "apply": None,
        "action_space_mapping": lambda action, *, _simulation: (_simulation.name, int(action)),
        "action_mask_mapping": lambda dealer, offers, *, _simulation: [1, min(_simulation.day, 1)],
        "rule_action_mapping": lambda decision, *, _simulation: _simulation.day and 1,
        "goal_space": spaces.Box(0, 9, (1,), np.float64),
        "achieved_goal_mapping": lambda dealer, offers, *, _simulation: [_simulation.day],
        "desired_goal_mapping": lambda dealer, offers: [2],
        "compute_reward": lambda achieved, desired, info: 0.0,
    }
    env = single_env(Market, points(**changes), agent="market_0")
    _, info = env.reset(seed=4)
    assert info["action_mask"].tolist() == [1, 0]
    observation, *_ = env.step(0)
    assert {key: value.tolist() for key, value in observation.items()} == {
        "observation": [1, 4],
        "achieved_goal": [1],
        "desired_goal": [2],
    }
    *_, info = env.step(RULE)
    assert info["rule_action"] == 1
    env.step(1)
    rule = ("rule", "low")
    assert env.simulation.log == [("market", 0), rule, rule, rule, ("market", 1), rule]


def test_mappings_can_take_the_simulation_in_every_env_and_in_simulate():
    roster = {"possible_agents": ["market_0", "market_1"]}
    parallel = parallel_env(Market, points(), **roster)
    assert parallel.reset(seed=2)[0]["market_1"].tolist() == [0, 2]
    assert parallel.step({"market_0": 0, "market_1": 0})[1] == {"market_0": 2.0, "market_1": 2.0}
    assert joint_env(Market, points()).reset(seed=2)[0]["market_1"].tolist() == [0, 2]
    vector = vector_env(Market, points(), agent="market_1", num_envs=2)
    assert vector.reset(seed=2)[0].tolist() == [[0, 2], [0, 3]]
    assert vector.step(np.zeros(2, np.int64))[0].tolist() == [[1, 2], [1, 3]]
    vector.close()
    first = {DEAL: lambda observation: 0}
    assert simulate(Market, first, points=points(), seed=1).log == [("market", "low")] * 6
    batched = {DEAL: lambda observations: np.zeros(len(observations), np.int64)}
    days = simulate_many(
        Market, batched, seeds=range(3), points=points(), collect=lambda market: market.log
    )
    assert days == [[("market", "low")] * 6] * 3
    made = collect_episodes(Market, batched, seeds=range(3), points=points())[DEAL]
    assert made.names == ("market_0", "market_1")
    assert made.observations[:, 1].tolist() == [0] * 6 + [1] * 6 + [2] * 6


def test_mappings_of_a_copied_env_get_the_copys_simulation():
    env = begun(aec_env(Market, points()))
    env.close()
    again = pickle.loads(pickle.dumps(env))
    assert str(play(again, last_choice, seed=5)) == str(play(env, last_choice, seed=5))


@pytest.mark.parametrize("episodes", [0, 1, 2])
def test_mappings_do_not_keep_a_dropped_envs_simulation_alive(episodes):
    env = aec_env(Market, points())
    for _ in range(episodes):
        env.reset(seed=1)
    simulation = weakref.ref(env.simulation)
    env.close()
    del env
    gc.collect()
    assert simulation() is None
