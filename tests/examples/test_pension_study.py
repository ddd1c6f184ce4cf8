"""The pension study: the utility, the policies, the worlds, and the script from one end to the other."""

import json
from math import exp, log
from types import SimpleNamespace

import numpy as np
import pytest
from examples.fin_base import study
from examples.fin_base.env import MANAGER, MIXES, TEAM, FundSim
from examples.fin_base.observations import OBSERVED, OF_A_CLIENT
from examples.fin_base.pension import Parameters
from examples.fin_base.policies import Constant, Linear, nearest_lawful
from examples.fin_base.study import FACTORS, HOME, INDEXER, PREMIUM
from examples.fin_base.welfare import AFTER, LEAST, Account
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import RULE, aec_env, simulate


def small_world(returns="expected", lives="as expected", population="steady", clients=30, years=4):
    return WORLD(returns, lives, population, clients, years)


WORLD = study.world


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(study, "world", small_world)


# -- the utility ----------------------------------------------------------------------------------


def a_fund(*members, indexed=1.0, prices=1.0, coverage=1.2):
    company = SimpleNamespace(
        indexed=indexed,
        market=SimpleNamespace(price_level=prices),
        coverage=lambda: coverage,
        manager=SimpleNamespace(equities=0.4),
    )
    return SimpleNamespace(
        company=company, clients=[SimpleNamespace(status=status, premium=premium) for status, premium in members]
    )


def test_a_year_is_worth_the_mean_logarithm_of_what_members_live_on():
    fund = a_fund(("working", 0.2), ("working", 0.1), ("retired", 0.0), ("away", 0.3), indexed=0.9, prices=1.2)
    account = Account(fund)
    account.close_year()
    [year] = account.years
    assert year.utility == pytest.approx((log(0.8) + log(0.9) + log(0.75)) / 3)
    assert (year.right, year.coverage, year.equities, year.premium) == pytest.approx((0.75, 1.2, 0.4, 0.15))
    assert account.welfare() == pytest.approx(100 * (year.utility + AFTER * log(0.75)))


def test_only_rights_that_are_covered_count_after_the_last_year():
    assert Account(a_fund(coverage=1.0)).welfare() == Account(a_fund(coverage=3.0)).welfare() == 0
    assert Account(a_fund(coverage=0.8)).welfare() == pytest.approx(100 * AFTER * log(0.8))
    assert Account(a_fund(coverage=0.0)).welfare() == pytest.approx(100 * AFTER * log(LEAST))


def test_a_fund_without_members_has_years_without_utility():
    account = Account(a_fund())
    account.close_year()
    assert account.years[0].utility == 0


def test_the_years_of_a_run_are_those_of_its_fund():
    simulation = simulate(FundSim(5, Parameters(clients=60)), {}, seed=3)
    years = simulation.account.years
    assert len(years) == 5
    assert simulation.welfare() == pytest.approx(
        100
        * (
            sum(year.utility for year in years)
            + AFTER * log(simulation.account.right() * min(1, simulation.fund.company.coverage()))
        )
    )
    assert years[-1].coverage == pytest.approx(simulation.fund.company.coverage())


def test_a_fund_that_cannot_pay_pensions_leaves_the_least_for_all_years_to_come(monkeypatch):
    simulation = FundSim(10, Parameters(clients=60))
    simulation.reset(3)
    company = simulation.fund.company
    company.world.ledger.move(company, company.world.outside, company.cents, "stolen")
    simulation.run()
    assert company.rations
    assert simulation.time() < 1
    assert simulation.welfare() == pytest.approx(100 * log(LEAST) * (10 - simulation.time() + AFTER), rel=1e-3)


@pytest.mark.parametrize("points", [TEAM, {point: TEAM[point] for point in MANAGER}])
def test_rewards_of_the_team_sum_up_to_the_welfare_gained_since_the_first_decision(points):
    environment = aec_env(FundSim(6, Parameters(clients=60)), points)
    environment.reset(seed=2)
    before = None
    earned = 0.0
    for agent in environment.agent_iter():
        _, reward, terminated, truncated, _ = environment.last()
        if agent == "manager_0":
            before = environment.simulation.welfare() if before is None else before
            earned += reward
        environment.step(None if terminated or truncated else RULE)
    assert earned == pytest.approx(environment.simulation.welfare() - before)


# -- policies -------------------------------------------------------------------------------------


@given(st.lists(st.booleans(), min_size=1).filter(any), st.data())
def test_the_nearest_lawful_level_is_lawful_and_none_is_nearer(lawful, data):
    level = data.draw(st.integers(0, len(lawful) - 1))
    chosen = nearest_lawful(level, np.array(lawful, np.int8))
    assert lawful[chosen]
    assert abs(chosen - level) == min(abs(other - level) for other, own in enumerate(lawful) if own)


@given(st.floats(0.01, 0.99))
def test_learning_starts_with_the_level_that_it_is_told(share):
    observation = np.linspace(-3, 10, len(OBSERVED)).astype(np.float32)
    assert Linear.start(share, len(OBSERVED)).share(observation) == pytest.approx(share)


def test_a_linear_policy_weighs_each_number_in_its_own_unit():
    from examples.fin_base.policies import SPREAD, USUAL

    for place in range(len(OBSERVED) + len(OF_A_CLIENT)):
        weights = [0.0] * (len(USUAL) + 1)
        weights[place] = 2.0
        observation = USUAL.copy()
        observation[place] += SPREAD[place]
        policy = Linear(tuple(weights))
        assert policy.share(USUAL) == 0.5
        assert policy.share(observation) == pytest.approx(1 / (1 + exp(-2)), rel=1e-5)
        assert policy(observation, {"action_mask": np.ones(11, np.int8)}) == 9
        assert policy(observation, {"action_mask": np.array([1] * 6 + [0] * 5, np.int8)}) == 5


def test_extreme_sums_are_no_errors():
    observation = np.full(len(OBSERVED), 1e6, np.float32)
    for weight, level in ((1e6, 4), (-1e6, 0)):
        assert Linear((weight,) * (len(OBSERVED) + 1))(observation, {"action_mask": np.ones(5, np.int8)}) == level


# -- worlds ---------------------------------------------------------------------------------------


def test_home_is_the_fund_as_the_model_has_it():
    assert world_after(10, **HOME) == simulate(FundSim(10, Parameters(clients=200)), {}, seed=1).fund.company.cents


def world_after(years, **levels):
    return simulate(WORLD(**levels, years=years), {}, seed=1).fund.company.cents


def test_worlds_are_what_they_are_called():
    def fund(seed=1, years=20, **levels):
        return simulate(WORLD(**levels, clients=500, years=years), {}, seed=seed).fund

    deaths, fewer = (
        sum(fund(seed, 5, lives=lives).world.counts["died"] for seed in range(4)) for lives in FACTORS["lives"]
    )
    assert deaths > 1.15 * fewer
    home, poor, longer, ageing = fund(), fund(returns="poor"), fund(lives="longer"), fund(population="ageing")
    assert home.company.tables == longer.company.tables
    assert len(home.clients) > 1.2 * len(ageing.clients)
    assert home.world.ledger.flows["returns"] > poor.world.ledger.flows["returns"]
    assert home.market.bond_yield == poor.market.bond_yield == longer.market.bond_yield == ageing.market.bond_yield


# -- learning -------------------------------------------------------------------------------------


@pytest.mark.usefixtures("small")
def test_training_is_determined_by_its_seed():
    start = {INDEXER: Linear.start(0.5, len(OBSERVED))}
    first, again, other = (study.train(start, study.TEAM, 1, seed, 0) for seed in (1, 1, 2))
    assert first == again != other
    assert set(first) == {INDEXER}


@pytest.mark.usefixtures("small")
def test_the_best_constants_are_no_worse_than_any(monkeypatch):
    best = study.best_constants(2, 0)
    every = [{"manager_0": Constant(mix), INDEXER: Constant(by)} for mix in range(len(MIXES)) for by in range(5)]
    assert study.rate([best], study.TEAM, range(2), 0)[0] == max(study.rate(every, study.TEAM, range(2), 0))


@pytest.mark.usefixtures("small")
def test_what_was_learned_is_not_learned_again(tmp_path, monkeypatch):
    found = study.learned(tmp_path, 1, 1, 0)
    assert set(found) == {"constant pair", "constant premium", "trained pair", "trained premiums", "both trained"}
    assert set(found["both trained"]) == {"manager_0", INDEXER, PREMIUM}
    monkeypatch.setattr(study, "rate", None)
    assert json.dumps(study.learned(tmp_path, 1, 1, 0), default=vars) == json.dumps(found, default=vars)


# -- the script -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("small")
def test_from_one_end_to_the_other_and_nothing_twice(tmp_path, capsys, monkeypatch):
    pytest.importorskip("seaborn")
    arguments = ["--quick", "--generations", "1", "--workers", "0", "--out", str(tmp_path)]
    study.main(arguments)
    shown = capsys.readouterr().out
    for name in ("compared", "worlds", "moved"):
        assert (tmp_path / f"pension-{name}.md").read_text() in shown
    for name in ("worlds", "learned", "years"):
        assert (tmp_path / f"pension-{name}.png").stat().st_size > 10_000
    lines = (tmp_path / "pension-worlds.md").read_text().splitlines()
    assert [line.split(" | ")[0].removeprefix("| ") for line in lines[2:]] == [
        f"{returns}, {lives}, {population}"
        for returns in FACTORS["returns"]
        for lives in FACTORS["lives"]
        for population in FACTORS["population"]
    ]
    stored = sorted((tmp_path / "runs").glob("*.jsonl"))
    before = [path.read_bytes() for path in stored]
    study.main(arguments)
    assert [path.read_bytes() for path in sorted((tmp_path / "runs").glob("*.jsonl"))] == before
    assert shown.split("| policy", 1)[1] in capsys.readouterr().out


@pytest.mark.usefixtures("small")
def test_a_run_that_fails_is_no_row_of_the_table(tmp_path):
    def broken(observation, info):
        raise ZeroDivisionError

    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        study.run(tmp_path, [HOME], {"broken": {INDEXER: broken}}, 2, 0)
