"""The pension fund: money, law and people on their own, its environments, and a training in a small way."""

import ast
import copy
import math
import pickle
import subprocess
import sys
from pathlib import Path
from random import Random

import gymnasium
import numpy as np
import pettingzoo
import pytest
from examples.fin_base import blocks, company, economy, law, pension, people, train
from examples.fin_base.company import Company, Manager, Regulator
from examples.fin_base.economy import OLDEST, STEP, Climate, Market, Mortality, annuity_factors
from examples.fin_base.env import PREMIUMS, TEAM, FundSim, premium_env, team_env
from examples.fin_base.law import RETIREMENT
from examples.fin_base.pension import Fund, Parameters
from examples.fin_base.people import Client, clients_of
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from simenv_marl import RULE, aec_env, joint_env, parallel_env, single_env
from simenv_marl.errors import InvalidActionError
from simenv_marl.testing import check_simulation
from tests.worlds.models import follow_the_rule

ROOT = Path(__file__).parents[2]
AGENTS = ["indexer_0", "planner_0", "manager_0", "regulator_0"]
SMALL = Parameters(clients=60, coverage=1.0)  # poor enough for plans, cuts and demands
MANAGER = {point: definition for point, definition in TEAM.items() if definition.agent == "manager_0"}
DECISIONS = (
    (Company, "set_premium"),
    (Company, "choose_indexation"),
    (Company, "choose_cut"),
    (Manager, "choose_mix"),
    (Regulator, "choose_demand"),
)


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


def decide_at_random(monkeypatch, seed):
    """Have all decisions taken at random, with values within reason and beyond."""
    draw = Random(seed)
    for kind, name in DECISIONS:
        monkeypatch.setattr(kind, name, lambda *_: draw.choice((-1.0, 0.0, 0.01, 0.3, 0.9, 1.0, 7.0)))
    monkeypatch.setattr(Client, "choose_extra", lambda client: draw.choice(law.EXTRAS))
    monkeypatch.setattr(Client, "choose_to_join", lambda client: draw.random() < 0.8)
    monkeypatch.setattr(Client, "choose_to_leave", lambda client: draw.random() < 0.5)


def small(years=12):
    return FundSim(years, SMALL)


# -- the model ------------------------------------------------------------------------------------


def test_no_cent_is_lost_and_coverage_is_exact_whatever_is_decided(monkeypatch):
    rationed = 0
    for seed in range(150):
        coverage = (0.02, 0.8, 1.0, 1.15, 1.6)[seed % 5]
        with monkeypatch.context() as patch:
            decide_at_random(patch, seed)
            fund = Fund(seed, Parameters(clients=15, coverage=coverage, job_change=0.05, entry=0.2))
            for _ in range(25):
                fund.advance()
                fund.world.check()
                assert fund.company.coverage() == coverage_from_scratch(fund)
        rationed += fund.world.counts["pensions rationed"]
    assert 0 < rationed < 150 * 25  # some ran out of money, and some had enough


def coverage_from_scratch(fund):
    """The coverage as it is by the rights of each client."""
    company = fund.company
    factors = annuity_factors(company.tables, fund.market.yield_steps, RETIREMENT)
    sums = [0] * OLDEST
    for client in clients_of(fund.world):
        sums[OLDEST - 1 - client.age] += client.accrued
    provisions = sum(right * factor for right, factor in zip(sums, factors, strict=True))
    return company.cents / provisions if provisions else 2.0


def test_the_same_seed_is_the_same_run_and_a_copy_goes_on_by_itself():
    def run(seed):
        fund = Fund(seed, Parameters(clients=80))
        fund.run(42)
        return state(fund)

    assert run(3) == run(3) != run(4)
    fund = Fund(3, Parameters(clients=80))
    fund.run(18)
    before = state(fund)
    twin = copy.deepcopy(fund)
    twin.run(24)
    assert state(fund) == before
    assert state(twin) == run(3)


@pytest.mark.parametrize("generator", [lambda fund: fund.people, lambda fund: fund.market.random])
def test_market_and_people_are_drawn_anew(generator):
    draws = []
    for seed in (3, 3, 4):
        simulation = small()
        simulation.reset(len(draws))
        simulation.reseed(seed)
        draws.append(generator(simulation.fund).random())
    assert draws[0] == draws[1] != draws[2]


def test_everything_happens():
    seen = set()
    for seed, coverage in ((1, 1.15), (2, 0.85), (3, 1.0)):
        fund = Fund(seed, Parameters(clients=600, coverage=coverage, climate=Climate(equity_sd=0.25)))
        fund.run(360)
        seen |= {event for event, count in fund.world.counts.items() if count}
        flows = set(fund.world.ledger.flows)
        assert flows >= {"premium", "pension", "wages", "returns", "losses", "transfer", "estate", "spending"}
    assert seen >= {
        *("Admission granted", "Admission denied: too old", "Contribution granted"),
        *("Contribution denied: above the highest premium", "Contribution denied: cannot be afforded"),
        *("Transfer granted", "Transfer denied: coverage is too low"),
        *("RecoveryPlan granted", "RecoveryPlan denied: cuts too little"),
        *("declined", "changed jobs", "came back", "retired", "died", "indexed", "short", "cut"),
    }


def test_lives_and_annuities_are_those_of_the_standard_ultimate_life_table():
    alive, table, monthly = 1.0, {}, Mortality().monthly()
    for age in range(20 * 12, OLDEST):
        table[age / 12] = 100_000 * alive
        alive *= 1 - monthly[age]
    expected = {20: 100_000.0, 65: 94_579.7, 80: 75_657.2, 100: 6_248.2}  # l_x as published with the parameters
    assert {age: round(table[age], 1) for age in expected} == expected
    for age, steps in [(300, 10), (RETIREMENT, 0), (1000, -2), (1439, 32)]:
        value, alive = 0.0, 1.0
        for month in range(age, OLDEST):
            if month >= RETIREMENT:
                value += alive / 12 / (1 + STEP * steps) ** ((month - age) / 12)
            alive *= 1 - monthly[month]
        assert annuity_factors(Mortality(), steps, RETIREMENT)[OLDEST - 1 - age] == pytest.approx(value)


def test_the_market_is_what_its_climate_says_in_the_long_run():
    climate = Climate()
    market = Market(climate, Random(3))
    rows = []
    for _ in range(120_000):
        market.advance()
        rows.append((market.inflation, market.bond_yield, math.log1p(market.equity_return)))
    means, deviations = np.mean(rows, axis=0), np.std(rows, axis=0)
    assert means[:2] == pytest.approx([climate.inflation, climate.bond_yield], rel=0.08)
    assert deviations[:2] == pytest.approx([climate.inflation_sd, climate.yield_sd], rel=0.08)
    assert 12 * means[2] == pytest.approx(climate.bond_yield + climate.equity_premium, abs=0.006)
    assert math.sqrt(12) * deviations[2] == pytest.approx(climate.equity_sd, rel=0.02)
    memory = np.array([climate.inflation_memory, climate.yield_memory, 0.0]) ** (1 / 12)
    shocks = np.corrcoef(np.array(rows[1:]) - memory * rows[:-1], rowvar=False)
    assert shocks[[0, 0, 1], [1, 2, 2]] == pytest.approx(climate.correlations, abs=0.02)


@pytest.mark.parametrize("module", [blocks, company, economy, law, pension, people])
def test_the_model_knows_nothing_of_environments(module):
    imported = set()
    for node in ast.walk(ast.parse(Path(module.__file__).read_text())):
        if isinstance(node, ast.ImportFrom):
            imported.add(node.module)
        elif isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
    own = {"blocks", "company", "economy", "law", "people"}
    assert {name.split(".")[0] for name in imported} <= set(sys.stdlib_module_names) | own


def test_it_runs_on_its_own():
    options = ["--seed", "1", "--clients", "100", "--years", "6"]
    command = [sys.executable, "-W", "error", "-m", "examples.fin_base.pension", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "years a second" in done.stdout


# -- the environments -----------------------------------------------------------------------------

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


def test_the_agent_of_a_client_ends_when_the_client_retires_leaves_or_dies(monkeypatch):
    gone = []
    for name in ("retire", "vanish"):
        original = getattr(Client, name)

        def noted(client, *rest, original=original):
            if client.status in ("working", "away"):
                gone.append(client.name)
            return original(client, *rest)

        monkeypatch.setattr(Client, name, noted)
    environment = premium_env(small())
    environment.reset(seed=4)
    decided, ended = set(), []
    for agent in environment.agent_iter():
        _, _, terminated, truncated, _ = environment.last()
        ended += [agent] * terminated
        decided.add(agent)
        environment.step(None if terminated or truncated else RULE)
    assert len(ended) == len(set(ended)) > 10
    assert set(ended) == set(gone) & decided


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
    environment = single_env(FundSim(4, Parameters(clients=60, coverage=coverage)), MANAGER)
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
    rich = FundSim(3, Parameters(clients=60, coverage=5.0))
    unmasked = {point: definition for point, definition in TEAM.items() if definition.agent != "indexer_0"}
    parallel_api_test(parallel_env(rich, unmasked), num_cycles=30)  # which knows no masks
    parallel_seed_test(lambda: parallel_env(rich, unmasked), num_cycles=10)
    check_env(single_env(rich, MANAGER), skip_render_check=True)


@pytest.mark.parametrize("points", [TEAM, PREMIUMS])
def test_the_librarys_check_finds_nothing(points):
    report = check_simulation(lambda: small(3), points, episodes=2)
    assert not [finding for finding in report.findings if finding.severity != "note"], report


@pytest.mark.parametrize("name", ["ChooseIndexation", "ChooseCut", "ChooseMix", "ChooseDemand", "Joint"])
def test_gymnasium_makes_the_teams_agents_by_their_ids(name):
    environment = gymnasium.make(f"fin_base/{name}-v0", max_steps=2)
    environment.reset(seed=1)
    assert isinstance(environment.unwrapped.simulation, FundSim)
    assert environment.unwrapped.step(RULE)[1] != 0
    environment.close()


@pytest.mark.skipif(not hasattr(pettingzoo, "aec_registry"), reason="this PettingZoo has no registry")
@pytest.mark.parametrize(("kind", "name"), [("aec", "coop"), ("aec", "premium"), ("parallel", "coop")])
def test_pettingzoo_makes_environments_by_their_ids(kind, name):
    environment = pettingzoo.make(kind, f"fin_base/{name}_v0", max_steps=3)
    if name == "coop":
        assert environment.possible_agents == AGENTS
    environment.reset(seed=1)
    for _ in range(3):
        environment.step(RULE if kind == "aec" else dict.fromkeys(environment.agents, RULE))
    assert kind == "parallel" or all(environment.truncations.values())
    environment.close()


def test_training_is_determined_by_its_seed(capsys):
    options = ["--clients", "30", "--years", "3", "--generations", "1", "--seeds", "2", "--workers", "0"]
    train.main(options)
    first = capsys.readouterr().out
    train.main(options)
    assert capsys.readouterr().out == first
    assert "trained pair" in first
