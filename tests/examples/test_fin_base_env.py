"""The pension fund as environments: the same fund by its rules, what may be decided, and who ends when."""

import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pettingzoo
import pytest
from examples.fin_base.env import (
    BOARD,
    COMPANY,
    INDEXATIONS,
    MANAGER,
    MIX_WITH_GOAL,
    MIXES,
    PREMIUMS,
    REGULATOR,
    STATE_SPACE,
    SURCHARGES,
    TEAM,
    FundSim,
    board_env,
    lawful_indexations,
    lawful_mixes,
    lawful_surcharges,
    mix_env,
    premium_env,
    team_env,
)
from examples.fin_base.law import MINIMUM
from examples.fin_base.pension import Parameters
from examples.fin_base.people import Client, clients_of
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from simenv_marl import RULE, aec_env, branch, joint_env, parallel_env, single_env, vector_env
from simenv_marl.__main__ import main
from simenv_marl.errors import InvalidActionError
from simenv_marl.testing import check_simulation
from tests.worlds.models import follow_the_rule

from .test_fin_base import state, with_coverage

SMALL = Parameters(clients=60, coverage=1.0)  # poor enough for plans, cuts and demands


def small(years=12):
    return FundSim(years, SMALL)


def rich():
    """A fund in which nothing but indexation is ever masked."""
    return FundSim(3, Parameters(clients=60, coverage=5.0))


def plain(seed, years=12):
    simulation = small(years)
    simulation.reset(seed)
    simulation.run()
    return simulation.fund


VIEWS = {
    "aec board": (aec_env, BOARD),
    "aec premiums": (aec_env, PREMIUMS),
    "aec all": (aec_env, BOARD | PREMIUMS),
    "parallel board": (parallel_env, BOARD),
    "parallel premiums": (parallel_env, PREMIUMS),
    "joint board": (joint_env, BOARD),
    "single manager": (single_env, MANAGER),
    "single goal": (single_env, MIX_WITH_GOAL),
    "single regulator": (single_env, REGULATOR),
}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("driver", ["greenlet", "thread"])
def test_the_rule_through_every_view_is_the_plain_run(view, driver):
    make, points = VIEWS[view]
    fund, expected = follow_the_rule(make(small(), points, driver=driver), 4).fund, plain(4)
    assert state(fund) == state(expected)
    assert fund.world.counts == expected.world.counts


def test_the_single_view_of_one_client_by_rule_is_the_plain_run():
    fund = plain(4)
    name = next(client.name for client in clients_of(fund.world) if client.works)
    assert state(follow_the_rule(single_env(small(), PREMIUMS, agent=name), 4).fund) == state(fund)


def test_a_vector_whose_managers_act_as_the_rule_earns_what_the_rule_earns():
    def earned(seed):
        environment, rewards, over = single_env(small(), MANAGER), [], False
        environment.reset(seed=seed)
        while not over:
            _, reward, terminated, truncated, _ = environment.step(RULE)
            rewards.append(reward)
            over = terminated or truncated
        return rewards

    expected = np.array([earned(4), earned(5)])
    envs = vector_env(small(), MANAGER, num_envs=2)
    observations, _ = envs.reset(seed=[4, 5])
    for step in range(expected.shape[1]):
        equities = np.where(observations[:, 1] >= 1, 3, 2)
        lawful = np.where(observations[:, 1] < MINIMUM, np.rint(10 * observations[:, 3]).astype(int) - 1, 3)
        observations, rewards, *_ = envs.step(np.minimum(equities, lawful))
        assert rewards == pytest.approx(expected[:, step])
    envs.close()


@pytest.mark.parametrize("points", [PREMIUMS, MANAGER])
def test_the_rule_has_actions_which_do_the_same(points):
    environment = aec_env(small(6), points)
    environment.reset(seed=4)
    told = {}
    for agent in environment.agent_iter():
        _, _, terminated, truncated, info = environment.last()
        if "rule_action" in info:
            told.setdefault(agent, []).append(info["rule_action"])
        environment.step(None if terminated or truncated else RULE)
    assert told
    environment.reset(seed=4)
    for agent in environment.agent_iter():
        _, _, terminated, truncated, _ = environment.last()
        environment.step(None if terminated or truncated else told[agent].pop(0))
    assert state(environment.simulation.fund) == state(plain(4, 6))


# -- what may be decided --------------------------------------------------------------------------


def fund_with(coverage):
    simulation = small()
    simulation.reset(1)
    with_coverage(simulation.fund, coverage)
    return simulation.fund


@pytest.mark.parametrize(
    ("coverage", "discounts", "indexations", "mixes"),
    [(0.95, False, 1, 4), (1.08, False, 1, 6), (1.2, False, 5, 6), (1.3, True, 5, 6)],
)
def test_masks_are_what_the_law_allows(coverage, discounts, indexations, mixes):
    company = fund_with(coverage).company
    client = next(client for client in clients_of(company.world) if client.works)
    allowed = lawful_surcharges(company, client)
    assert [bool(legal) for legal in allowed] == [level >= 1 or discounts for level in SURCHARGES]
    assert sum(lawful_indexations(company)) == indexations
    assert sum(lawful_mixes(company.manager)) == mixes
    lowest, highest = company.lawful_premium(client)
    for level, legal in zip(SURCHARGES, allowed, strict=True):
        assert (lowest - 1e-9 <= level * company.cost_rate(client) <= highest + 1e-9) == bool(legal)


def test_what_is_masked_is_refused():
    environment = premium_env(small())
    environment.reset(seed=1)
    with pytest.raises(InvalidActionError):
        environment.step(0)


def test_actions_are_what_becomes_of_the_fund():
    environment = premium_env(small())
    environment.reset(seed=1)
    client = environment.simulation.fund.world.entities[environment.agent_selection]
    cost = client.company.cost_rate(client) * (1 + client.extra)
    environment.step(5)
    assert client.premium == pytest.approx(1.3 * cost)

    environment = aec_env(small(), MANAGER)
    environment.reset(seed=1)
    environment.step(1)
    assert environment.simulation.fund.company.manager.equities == MIXES[1]

    environment = aec_env(FundSim(4, Parameters(clients=60, coverage=1.6)), COMPANY)
    environment.reset(seed=1)
    company = environment.simulation.fund.company
    assert environment.agent_selection == "indexer_0"
    most = company.lawful_indexation()
    environment.step(2)
    assert company.indexed == pytest.approx(1 + INDEXATIONS[2] * most)


def test_a_plan_that_cuts_too_little_is_denied_and_the_demand_carried_out():
    environment = board_env(FundSim(3, Parameters(clients=60, coverage=0.8)))
    environment.reset(seed=1)
    fund = environment.simulation.fund
    while environment.agent_selection == "manager_0":
        environment.step(RULE)
    assert environment.agent_selection == "regulator_0"
    environment.step(4)
    short = fund.company.shortfall()
    assert environment.agent_selection == "planner_0"
    environment.step(0)
    assert fund.world.counts["RecoveryPlan denied: cuts too little"] == 1
    assert fund.company.indexed == pytest.approx(1 - short)


def test_no_cent_is_lost_by_random_legal_actions():
    environment = aec_env(small(), BOARD | PREMIUMS)
    for seed in range(10):
        environment.reset(seed=seed)
        generator = np.random.default_rng(seed)
        for _ in environment.agent_iter():
            _, _, terminated, truncated, info = environment.last()
            legal = np.flatnonzero(info.get("action_mask", np.ones(5)))
            environment.step(None if terminated or truncated else int(generator.choice(legal)))
        environment.simulation.fund.world.check()


# -- agents, rewards, time ------------------------------------------------------------------------


def test_the_agent_of_a_client_ends_when_the_client_retires_leaves_or_dies(monkeypatch):
    ended, gone = [], []
    for name in ("retire", "vanish"):
        original = getattr(Client, name)

        def noted(client, *rest, original=original):
            if client.status in ("working", "away"):
                gone.append(client.name)
            return original(client, *rest)

        monkeypatch.setattr(Client, name, noted)
    environment = premium_env(small())
    environment.reset(seed=4)
    decided = set()
    for agent in environment.agent_iter():
        _, _, terminated, truncated, _ = environment.last()
        if terminated:
            ended.append(agent)
        decided.add(agent)
        environment.step(None if terminated or truncated else RULE)
    assert len(ended) == len(set(ended)) > 10
    assert set(ended) == set(gone) & decided


def play(environment, seed, until=40):
    """Rewards and infos by agent, with the rule."""
    seen = {}
    environment.reset(seed=seed)
    for agent in environment.agent_iter(until):
        _, reward, terminated, truncated, info = environment.last()
        seen.setdefault(agent, []).append((reward, info))
        environment.step(None if terminated or truncated else RULE)
    return seen


def test_the_boards_rewards_differ_and_a_teams_are_one():
    alone, together = play(board_env(small()), 4), play(team_env(small()), 4)
    assert alone.keys() == together.keys()
    manager = [[reward for reward, _ in seen["manager_0"]] for seen in (alone, together)]
    assert manager[0] != manager[1]
    planner = [[reward for reward, _ in seen["planner_0"]] for seen in (alone, together)]
    assert planner[0] == planner[1]
    definitions = {id(definition.reward_mapping) for definition in TEAM.values()}
    assert len(definitions) == 1


def test_infos_tell_the_time_in_years():
    seen = play(aec_env(small(), BOARD | PREMIUMS), 4, 400)
    assert [info["time"] for _, info in seen["manager_0"]][:5] == [0.25, 0.5, 0.75, 1.0, 1.25]
    assert {info["elapsed"] for _, info in seen["manager_0"][1:]} == {0.25}
    assert any(info["elapsed"] > 0.9 for agent in seen if agent.startswith("client") for _, info in seen[agent])


def test_the_goal_is_a_coverage_and_rewards_can_be_computed_for_another():
    environment = mix_env(small())
    environment.reset(seed=1)
    observation, reward, _, _, info = environment.step(3)
    achieved, desired = observation["achieved_goal"], observation["desired_goal"]
    assert environment.compute_reward(achieved, desired, info) == pytest.approx(reward, abs=1e-6)
    stacked = environment.compute_reward(
        np.stack([achieved] * 3), np.stack([achieved, desired, achieved + 1]), [info] * 3
    )
    assert stacked == pytest.approx([0, reward, -1], abs=1e-6)


def test_a_state_for_critics():
    environment = board_env(small())
    environment.reset(seed=1)
    first = environment.state()
    assert STATE_SPACE.contains(first)
    follow_the_rule(environment, 1)
    assert STATE_SPACE.contains(environment.state())
    assert first[-1] < environment.state()[-1] == 1


def test_what_lies_ahead_can_be_drawn_anew():
    environment = single_env(small(3), MANAGER)
    environment.reset(seed=1)
    environment.step(3)

    def end(copied, number):
        over = False
        while not over:
            _, _, terminated, truncated, _ = copied.step(RULE)
            over = terminated or truncated
        return copied.simulation.fund.company.coverage()

    ends = branch(environment, end, 3, seeds=[1, 1, 2])
    assert ends[0] == ends[1] != ends[2]


@pytest.mark.parametrize("generator", [lambda fund: fund.people, lambda fund: fund.market.random])
def test_market_and_people_are_drawn_anew(generator):
    draws = []
    for seed in (3, 3, 4):
        simulation = small()
        simulation.reset(len(draws))
        simulation.reseed(seed)
        draws.append(generator(simulation.fund).random())
    assert draws[0] == draws[1] != draws[2]


AGENTS = ["indexer_0", "planner_0", "manager_0", "regulator_0"]


@pytest.mark.parametrize("make", [board_env, team_env])
def test_pettingzoos_tests_pass_for_single_agents(make):
    api_test(make(small(3)), num_cycles=30)
    seed_test(lambda: make(small(3)), num_cycles=10)


def test_pettingzoos_tests_pass_for_agents_that_are_born_and_end():
    with pytest.warns(UserWarning, match="possible_agents"):  # which clients there will be is not known beforehand
        api_test(premium_env(small(3)), num_cycles=30)
    seed_test(lambda: premium_env(small(3)), num_cycles=10)


@pytest.mark.parametrize("points", [BOARD, TEAM], ids=["board", "team"])
def test_pettingzoos_tests_pass_for_rounds(points):
    """These tests know no masks."""
    unmasked = {point: definition for point, definition in points.items() if definition.agent != "indexer_0"}
    parallel_api_test(parallel_env(rich(), unmasked), num_cycles=30)
    parallel_seed_test(lambda: parallel_env(rich(), unmasked), num_cycles=10)


@pytest.mark.parametrize(
    ("make", "fund"),
    [(mix_env, rich()), (lambda fund: single_env(fund, REGULATOR), FundSim(3, Parameters(clients=60, coverage=0.9)))],
    ids=["mix", "demand"],
)
def test_gymnasiums_checker_passes(make, fund):
    check_env(make(fund), skip_render_check=True)


# -- registered -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ChooseIndexation", "ChooseCut", "ChooseMix", "ChooseDemand", "Joint"])
def test_gymnasium_makes_the_teams_agents_by_their_ids(name):
    environment = gymnasium.make(f"fin_base/{name}-v0", max_steps=2)
    environment.reset(seed=1)
    assert isinstance(environment.unwrapped.simulation, FundSim)
    _, reward, *_ = environment.unwrapped.step(RULE)
    assert reward != 0
    environment.close()


def test_gymnasium_makes_the_goal_based_environment_by_its_id():
    environment = gymnasium.make("fin_base/MixWithGoal-v0", simulation=rich())
    check_env(environment.unwrapped, skip_render_check=True)
    assert set(environment.observation_space.spaces) == {"observation", "achieved_goal", "desired_goal"}


@pytest.mark.skipif(not hasattr(pettingzoo, "aec_registry"), reason="this PettingZoo has no registry")
@pytest.mark.parametrize(("name", "agents"), [("coop", AGENTS), ("board", AGENTS), ("premium", None)])
def test_pettingzoo_makes_environments_by_their_ids(name, agents):
    environment = pettingzoo.make("aec", f"fin_base/{name}_v0", max_steps=3)
    if agents:
        assert environment.possible_agents == agents
    environment.reset(seed=1)
    assert environment.agent_selection.startswith("manager" if agents else "client")
    for _ in range(3):
        environment.step(RULE)
    assert all(environment.truncations.values())


@pytest.mark.skipif(not hasattr(pettingzoo, "parallel_registry"), reason="this PettingZoo has no registry")
def test_pettingzoo_makes_the_team_in_rounds_by_its_id():
    environment = pettingzoo.make("parallel", "fin_base/coop_v0", max_steps=3)
    assert environment.possible_agents == AGENTS
    environment.reset(seed=1)
    _, rewards, *_ = environment.step(dict.fromkeys(environment.agents, RULE))
    assert set(rewards) <= set(AGENTS)


def test_ids_are_known_in_a_fresh_process_and_may_be_registered_twice():
    code = """
import importlib
import gymnasium
import examples.fin_base.env as module

importlib.reload(module)
for name in ("ChooseMix", "MixWithGoal"):
    environment = gymnasium.make(f"examples.fin_base.env:fin_base/{name}-v0", max_steps=2)
    print(gymnasium.spec(environment.spec.id).id)
"""
    root = Path(__file__).parents[2]
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["fin_base/ChooseMix-v0", "fin_base/MixWithGoal-v0"], done.stderr


# -- the library's own check ----------------------------------------------------------------------


def test_the_command_line_finds_no_errors(capsys):
    assert main(["check", f"{__name__}:small", "--episodes", "1", "--max-steps", "40"]) == 0
    assert "ERROR" not in capsys.readouterr().out


@pytest.mark.parametrize("points", [BOARD, PREMIUMS])
def test_the_librarys_check_finds_nothing(points):
    report = check_simulation(lambda: small(3), points, episodes=2)
    assert not [finding for finding in report.findings if finding.severity != "note"], report


def test_an_episode_is_terminated_when_pensions_cannot_be_paid_and_truncated_at_its_last_year():
    for coverage, ends in ((0.02, (True, False)), (1.5, (False, True))):
        environment = single_env(FundSim(4, Parameters(clients=60, coverage=coverage)), MANAGER)
        environment.reset(seed=1)
        over = (False, False)
        while not any(over):
            _, _, *over, _ = environment.step(RULE)
        assert tuple(over) == ends
        assert bool(environment.simulation.fund.company.rations) == ends[0]
