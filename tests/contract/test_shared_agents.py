"""One entity with two kinds of decisions as one agent, and rosters of agents that are born."""

import warnings

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, clone, parallel_env, simulate, single_env, turn_env
from simenv_marl.errors import AgentError, NoDecisionError
from tests.worlds.models import calling, decision, define, play, script


class Nurse:
    """Decides by two functions."""

    def __init__(self, name):
        self.name = name

    def walk(self):
        return 0

    def treat(self):
        return 0


class Ward:
    """Nurses that walk and treat in turns. Nurses leave."""

    def reset(self, seed=None):
        self.log = []
        self.nurses = [Nurse("ann"), Nurse("bob")]

    def run(self):
        for day in range(3):
            for nurse in list(self.nurses):
                self.log.append((nurse.name, "walk", nurse.walk()))
                self.log.append((nurse.name, "treat", nurse.treat()))
            if day == 1:
                self.leave(self.nurses[0])

    def leave(self, nurse):
        self.nurses.remove(nurse)


def points(**changes):
    """The points of nurses, each of whom is one agent."""
    shared = {
        "agent": lambda nurse: nurse.name,
        "reward_mapping": lambda nurse: 1.0,
        "removed_by": {Ward.leave: lambda ward, nurse: nurse.name},
    }
    return {
        f"{__name__}.Nurse.walk": define(observation_space_mapping=lambda nurse: [0, 0], **shared),
        f"{__name__}.Nurse.treat": define(
            **{"observation_space_mapping": lambda nurse: [1, 1], **shared, **changes}
        ),
    }


NUMBERS = {
    "action_space": spaces.Box(0, 9, (1,), np.float32),
    "action_space_mapping": lambda action: round(float(action[0])),
}
EXPECTED = [
    (name, kind, 0 if kind == "walk" else 1)
    for names in (["ann", "bob"], ["ann", "bob"], ["bob"])
    for name in names
    for kind in ("walk", "treat")
]


def test_entity_with_two_kinds_of_decisions_is_one_agent():
    env = aec_env(Ward, points())
    turns = play(env, lambda agent, env: int(env.last()[0][0]))
    assert env.simulation.log == EXPECTED
    lasts = [turn.agent for turn in turns if turn.terminated]
    assert sorted(lasts) == ["ann", "bob"]
    assert sum(turn.reward for turn in turns if turn.agent == "ann") == 4.0
    assert sum(turn.reward for turn in turns if turn.agent == "bob") == 6.0


class Announcing(Ward):
    """Announces both decisions of all nurses."""

    def expected_calls(self, point):
        return [(nurse,) for nurse in self.nurses]


def test_agent_of_expected_calls_can_decide_at_another_decision_point():
    shifted = points(action_space_mapping=lambda action: action + 1)
    env = aec_env(Announcing, shifted)
    play(env, 0)
    assert env.simulation.log == EXPECTED
    env = parallel_env(Announcing, shifted)
    env.reset()
    while env.agents:
        env.step(dict.fromkeys(env.agents, 0))
    assert env.simulation.log == EXPECTED


def test_decision_points_of_one_agent_name_share_an_agent():
    ant, other = decision(agent="ant_0"), decision(agent="ant_0")
    for make in (aec_env, parallel_env):
        env = make(calling(ant, other, ant), [ant, other])
        assert env.possible_agents == ["ant_0"]
    single = single_env(calling(ant, other, ant), [ant, other])
    single.reset()
    for action in (1, 2, 3):
        single.step(action)
    assert single.simulation.log == [1, 2, 3]
    simulation = simulate(
        calling(ant, other), {"ant_0": lambda observation: 4}, points=[ant, other]
    )
    assert simulation.log == [4, 4]


def test_agent_with_two_kinds_of_spaces_needs_turn_env():
    ant, other = decision(agent="ant_0"), decision(agent="ant_0", **NUMBERS)
    with pytest.raises(AgentError, match="have the same agent 'ant_0', but their spaces differ"):
        aec_env(calling(ant, other), [ant, other])
    env = aec_env(Ward, points(**NUMBERS))
    env.reset()
    with pytest.raises(AgentError, match="use turn_env, which unites spaces"):
        env.step(1)
    turn = turn_env(Ward, points(**NUMBERS))
    observation, _ = turn.reset()
    total, ended = 0.0, False
    while not ended:
        action = np.full(11, -1, np.float32)
        action[0] = 1
        action[10] = -7 / 9  # 1 in [0, 9]
        twin = clone(turn) if len(turn.simulation.log) == 3 else None
        observation, reward, terminated, truncated, _ = turn.step(action)
        if twin is not None:
            seen, paid, *_ = twin.step(action)
            assert (seen["kind"], paid) == (observation["kind"], reward)
            assert twin.step(action)[0]["kind"] != observation["kind"]
            twin.close()
        total += reward
        ended = terminated or truncated
    assert turn.simulation.log == EXPECTED
    assert total == 10.0


def test_env_state_has_one_part_per_agent_with_two_kinds_of_observations():
    make = points(observation_space=spaces.Discrete(3), observation_space_mapping=lambda nurse: 2)
    names = {point: ["ann", "bob"] for point in make}
    given = {"possible_agents": names, "state_space": "observations", "state_in_info": True}
    env = turn_env(Ward, make, **given)
    _, info = env.reset()
    states = [info["state"].tolist(), *(env.step(RULE)[-1]["state"].tolist() for _ in range(3))]
    assert env.state_space.shape == (6,)
    assert states == [
        [0, 0, 0, 0, 0, 0],
        [0, 0, 1, 0, 0, 0],
        [0, 0, 1, 0, 0, 0],
        [0, 0, 1, 0, 0, 1],
    ]


# -- births ---------------------------------------------------------------------------------------


def births(most):
    """A simulation with one ant more in each round."""

    def main(simulation):
        for ants in range(1, most + 1):
            for number in range(ants):
                simulation.log.append((number, choose(number)))

    choose = define(
        agent=lambda number: f"ant_{number}", observation_space_mapping=lambda n: [n, 0]
    )(lambda number: 0)
    return script(main), choose


def test_possible_agents_may_list_more_agents_than_are_born():
    make, choose = births(3)
    names = [f"ant_{number}" for number in range(5)]
    env = aec_env(make, choose, possible_agents=names)
    with warnings.catch_warnings(action="error"):
        play(env, 1)
    make, choose = births(1)
    with pytest.warns(UserWarning, match="did not appear in the episode"):
        play(aec_env(make, choose, possible_agents=names), 1)


class Colony:
    """A second ant is born in one of four episodes."""

    def reset(self, seed=None):
        self.seed = seed
        self.has_two = np.random.default_rng(seed).random() < 0.25
        self.log = []

    def run(self):
        for number in range(1 + self.has_two):
            self.log.append(self.decide(number))

    def decide(self, number):
        return 0


ANTS = {f"{__name__}.Colony.decide": define(agent=lambda colony, number: f"ant_{number}")}


def test_single_env_resets_until_its_agent_appears():
    env = single_env(Colony, ANTS, agent="ant_1")
    seeds = []
    for seed in range(8):
        env.reset(seed=seed)
        assert env.simulation.has_two
        seeds.append(env.simulation.seed)
        assert env.np_random_seed == seed
    assert len(set(seeds)) == 8
    again = single_env(Colony, ANTS, agent="ant_1")
    again.reset(seed=3)
    assert again.simulation.seed == seeds[3]
    never = single_env(Colony, ANTS, agent="ant_2")
    with pytest.raises(NoDecisionError, match="ant_0"):
        never.reset(seed=0)


def test_single_env_resets_a_deterministic_simulation_only_once(monkeypatch):
    monkeypatch.setattr(Colony, "deterministic", True, raising=False)
    env = single_env(Colony, ANTS, agent="ant_1")
    with pytest.raises(NoDecisionError):
        env.reset(seed=0)
