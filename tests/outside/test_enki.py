"""Robots in Enki, which come and leave in mid-episode: a model in C++, by the client's header."""

import numpy as np
import pytest
from examples.enki_robots import env as robots

from simenv_marl import RULE, evaluate
from simenv_marl.remote.check import check_wire

pytestmark = [
    pytest.mark.skipif(bool(robots.missing()), reason=robots.missing()),
    # what PettingZoo says where no roster is declared
    pytest.mark.filterwarnings("ignore::UserWarning"),
]


def test_enki_robots_join_in_pairs_and_leave_one_by_one(make_env):
    env = make_env(robots.parallel_env)
    env.reset(seed=7)
    born, gone, truncated, rounds = dict.fromkeys(env.agents, 0), set(), set(), 0
    while env.agents:
        _, _, terminations, truncations, _ = env.step(dict.fromkeys(env.agents, RULE))
        rounds += 1
        born = {**dict.fromkeys(terminations, rounds), **born}
        gone |= {agent for agent, over in terminations.items() if over}
        truncated |= {agent for agent, over in truncations.items() if over}
    assert born == {f"robot_{number}": 40 * (number // 2) for number in range(12)}
    assert len(gone) > 4
    assert gone | truncated == born.keys()
    assert not gone & truncated
    assert rounds == 240, "one for each half second"


def test_enki_robots_of_a_pair_each_get_the_team_reward(make_env):
    env = make_env(robots.parallel_env)
    env.reset(seed=7, options={"seconds": 20.0})
    paid = {agent: [] for agent in env.agents}
    while env.agents:
        _, rewards, *_ = env.step(dict.fromkeys(env.agents, RULE))
        for agent, reward in rewards.items():
            paid[agent].append(reward)
    assert paid["robot_0"] == paid["robot_1"]
    assert sum(paid["robot_0"]) == env.simulation.result["swept"]


@pytest.mark.greenlet("the driver makes no difference to policies")
def test_enki_robots_by_the_rule_sweep_more_than_robots_going_straight():
    contenders = {"rule": {}, "straight": {"robot.turn": lambda _: np.zeros(1, np.float32)}}
    swept = evaluate(
        robots.robots,
        contenders,
        seeds=range(4),
        metric=lambda simulation: simulation.result["swept"],
    ).values("metric")
    assert (swept["rule"] > 1.2 * swept["straight"]).all()


@pytest.mark.greenlet("nothing runs here")
def test_enki_simulator_passes_wire_check():
    report = check_wire([str(robots.program())])
    assert {finding.verdict for finding in report.findings} == {"ok"}, str(report)
