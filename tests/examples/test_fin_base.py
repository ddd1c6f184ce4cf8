"""The pension fund: its money, its end, and a training in a small way."""

import numpy as np
import pytest
from examples.fin_base import pension, train
from examples.fin_base.env import PREMIUMS, TEAM, FundSim

from simenv_marl import RULE, aec_env, single_env
from tests.worlds.models import play


def fund(years, coverage):
    return FundSim(years, pension.Parameters(clients=60, coverage=coverage))


def test_pension_fund_loses_no_money_with_random_legal_actions():
    generator = np.random.default_rng(0)

    def draw(agent, env):
        return int(
            generator.choice(np.flatnonzero(env.infos[agent].get("action_mask", np.ones(5))))
        )

    environment = aec_env(fund(12, 1.0), TEAM | PREMIUMS)  # poor enough for plans, cuts and demands
    for seed in range(10):
        play(environment, draw, seed=seed)
        environment.simulation.fund.world.check()


@pytest.mark.parametrize(("coverage", "ends"), [(0.02, [True, False]), (1.5, [False, True])])
def test_pension_fund_episode_ends_with_unpaid_pensions_or_its_last_year(coverage, ends):
    manager = {
        point: definition for point, definition in TEAM.items() if definition.agent == "manager_0"
    }
    environment = single_env(fund(4, coverage), manager)
    environment.reset(seed=1)
    over = [False, False]
    while not any(over):
        _, _, *over, _ = environment.step(RULE)
    assert over == ends
    assert bool(environment.simulation.fund.company.rations) == ends[0]


def test_pension_fund_model_prints_its_years(capsys):
    pension.main(["--clients", "30", "--years", "2"])
    assert "years a second" in capsys.readouterr().out


@pytest.mark.thorough
def test_pension_fund_training_depends_only_on_its_seed(capsys):
    options = [
        "--clients",
        "30",
        "--years",
        "3",
        "--generations",
        "1",
        "--seeds",
        "2",
        "--workers",
        "0",
    ]
    train.main(options)
    first = capsys.readouterr().out
    train.main(options)
    assert capsys.readouterr().out == first
    assert "trained pair" in first
