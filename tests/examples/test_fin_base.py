"""The pension fund: money, law and people on their own, its environments, and a training in a small way."""

import ast
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pettingzoo
import pytest
from examples.fin_base import blocks, company, economy, law, pension, people, train
from examples.fin_base.env import PREMIUMS, TEAM, FundSim, premium_env, team_env
from examples.fin_base.pension import Parameters
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

    def noting(original):
        def noted(client, *rest):
            if client.status in ("working", "away"):
                gone.append(client.name)
            return original(client, *rest)

        return noted

    for name in ("retire", "vanish"):
        monkeypatch.setattr(Client, name, noting(getattr(Client, name)))
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
