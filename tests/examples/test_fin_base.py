"""The pension fund: money, law and people on their own, its environments, and a training in a small way."""

import pickle

import numpy as np
import pytest
from examples.fin_base import pension, train
from examples.fin_base.env import PREMIUMS, TEAM, FundSim, premium_env, team_env
from examples.fin_base.people import Client, clients_of
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from simenv_marl import RULE, aec_env, joint_env, parallel_env, single_env
from simenv_marl.errors import InvalidActionError
from simenv_marl.testing import check_simulation
from tests.worlds.models import follow_the_rule

SMALL = pension.Parameters(clients=60, coverage=1.0)  # poor enough for plans, cuts and demands
MANAGER = {point: definition for point, definition in TEAM.items() if definition.agent == "manager_0"}


def state(fund):
    """All that there is to know of a fund."""
    company, world = fund.company, fund.world
    slots = {slot for kind in Client.__mro__ for slot in getattr(kind, "__slots__", ())}
    plain = sorted(slots - {"__weakref__", "world", "company", "contract", "may_owe"})
    return (
        world.month,
        {name: entity.cents for name, entity in world.entities.items()},
        [[getattr(client, slot) for slot in plain] for client in clients_of(world)],
        [(number, contract.cents, contract.missed) for number, contract in world.contracts.items()],
        dict(world.ledger.flows),
        dict(world.counts),
        (company.coverage(), company.policy_coverage(), company.measured_short, company.indexed),
        (company.manager.equities, fund.market.inflation, fund.market.bond_yield, fund.market.price_level),
        (fund.people.getstate(), fund.market.random.getstate()),
    )


def small(years=12):
    return FundSim(years, SMALL)


VIEWS = {
    "aec": (aec_env, TEAM | PREMIUMS),
    "parallel team": (parallel_env, TEAM),
    "parallel premiums": (parallel_env, PREMIUMS),
    "joint": (joint_env, TEAM),
    "single": (single_env, MANAGER),
}


@pytest.mark.parametrize("view", VIEWS)
def test_the_rule_through_every_view_is_the_plain_run(view):
    make, points = VIEWS[view]
    simulation = small()
    simulation.reset(4)
    simulation.run()
    environment = pickle.loads(pickle.dumps(make(small(), points)))
    assert state(follow_the_rule(environment, 4).fund) == state(simulation.fund)


def test_no_cent_is_lost_by_random_legal_actions_and_others_are_refused():
    environment = aec_env(small(), TEAM | PREMIUMS)
    refused = 0
    for seed in range(10):
        environment.reset(seed=seed)
        generator = np.random.default_rng(seed)
        for _ in environment.agent_iter():
            _, _, terminated, truncated, info = environment.last()
            mask = info.get("action_mask", np.ones(5))
            if not mask.all():
                refused += 1
                with pytest.raises(InvalidActionError):
                    environment.step(int(np.argmin(mask)))
            action = int(generator.choice(np.flatnonzero(mask)))
            environment.step(None if terminated or truncated else action)
        environment.simulation.fund.world.check()
    assert refused


@pytest.mark.parametrize("points", [TEAM, MANAGER])
def test_rewards_of_the_team_sum_up_to_the_welfare_gained_since_the_first_decision(points):
    environment = aec_env(small(6), points)
    environment.reset(seed=2)
    before, earned, times = None, 0.0, []
    for agent in environment.agent_iter():
        _, reward, terminated, truncated, info = environment.last()
        if agent == "manager_0":
            before = environment.simulation.welfare() if before is None else before
            earned += reward
            times.append(info["time"])
        environment.step(None if terminated or truncated else RULE)
    assert earned == pytest.approx(environment.simulation.welfare() - before)
    assert times[:3] == [0.25, 0.5, 0.75]


@pytest.mark.parametrize(("coverage", "ends"), [(0.02, (True, False)), (1.5, (False, True))])
def test_an_episode_is_terminated_when_pensions_cannot_be_paid_and_truncated_at_its_last_year(coverage, ends):
    environment = single_env(FundSim(4, pension.Parameters(clients=60, coverage=coverage)), MANAGER)
    environment.reset(seed=1)
    over = (False, False)
    while not any(over):
        _, _, *over, _ = environment.step(RULE)
    assert tuple(over) == ends
    assert bool(environment.simulation.fund.company.rations) == ends[0]


def test_pettingzoo_and_gymnasium_accept_the_environments():
    api_test(team_env(small(3)), num_cycles=30)
    seed_test(lambda: team_env(small(3)), num_cycles=10)
    with pytest.warns(UserWarning, match="possible_agents"):  # which clients there will be is not known beforehand
        api_test(premium_env(small(3)), num_cycles=30)
    seed_test(lambda: premium_env(small(3)), num_cycles=10)
    rich = FundSim(3, pension.Parameters(clients=60, coverage=5.0))
    unmasked = {point: definition for point, definition in TEAM.items() if definition.agent != "indexer_0"}
    parallel_api_test(parallel_env(rich, unmasked), num_cycles=30)  # which knows no masks
    parallel_seed_test(lambda: parallel_env(rich, unmasked), num_cycles=10)
    check_env(single_env(rich, MANAGER), skip_render_check=True)


@pytest.mark.parametrize("points", [TEAM, PREMIUMS])
def test_the_librarys_check_finds_nothing(points):
    report = check_simulation(lambda: small(3), points, episodes=2)
    assert not [finding for finding in report.findings if finding.severity != "note"], report


def test_the_model_prints_its_years(capsys):
    pension.main(["--clients", "30", "--years", "2"])
    assert "years a second" in capsys.readouterr().out


def test_training_is_determined_by_its_seed(capsys):
    options = ["--clients", "30", "--years", "3", "--generations", "1", "--seeds", "2", "--workers", "0"]
    train.main(options)
    first = capsys.readouterr().out
    train.main(options)
    assert capsys.readouterr().out == first
    assert "trained pair" in first
