"""The blocks and the pension fund on their own: money, rights, people, the law. No reinforcement learning."""

import ast
import copy
import math
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest
from examples.fin_base import blocks, company, economy, law, pension, people
from examples.fin_base.blocks import Calendar, Contract, Entity, Request, Shortage, World, share
from examples.fin_base.company import Company, Manager, Regulator
from examples.fin_base.economy import OLDEST, STEP, Climate, Market, Mortality, annuity_factors
from examples.fin_base.law import MINIMUM, RETIREMENT
from examples.fin_base.pension import Fund, Parameters
from examples.fin_base.people import (
    Admission,
    Client,
    Contribution,
    PensionContract,
    RecoveryPlan,
    Transfer,
    clients_of,
)
from hypothesis import given
from hypothesis import strategies as st

ROOT = Path(__file__).parents[2]
DECISIONS = (
    (Company, "set_premium"),
    (Company, "choose_indexation"),
    (Company, "choose_cut"),
    (Manager, "choose_mix"),
    (Regulator, "choose_demand"),
    (Client, "choose_to_join"),
    (Client, "choose_extra"),
    (Client, "choose_to_leave"),
)


def state(fund):
    """All that there is to know of a fund, but for how often what has happened."""
    company, world = fund.company, fund.world
    slots = sorted({slot for kind in Client.__mro__ for slot in getattr(kind, "__slots__", ())} - {"__weakref__"})
    plain = [slot for slot in slots if slot not in ("world", "company", "contract", "may_owe")]
    return (
        world.month,
        {name: entity.cents for name, entity in world.entities.items()},
        [[getattr(client, slot) for slot in plain] for client in clients_of(world)],
        [
            (number, contract.debtor.name, contract.creditor.name, contract.cents, contract.missed)
            for number, contract in world.contracts.items()
        ],
        dict(world.ledger.flows),
        len(world.calendar),
        (company.coverage(), company.policy_coverage(), company.measured_short, company.indexed),
        company.manager.equities,
        (fund.market.inflation, fund.market.bond_yield, fund.market.price_level),
        (fund.people.getstate(), fund.market.random.getstate(), world.random.getstate()),
    )


def decide_at_random(monkeypatch, seed):
    """Have all decisions taken at random, with values within reason and beyond."""
    draw = Random(seed)
    wild = lambda *_: draw.choice((-1.0, 0.0, 0.01, 0.3, 0.9, 1.0, 7.0))  # noqa: E731
    for kind, name in DECISIONS:
        monkeypatch.setattr(kind, name, wild)
    monkeypatch.setattr(Client, "choose_extra", lambda client: draw.choice(law.EXTRAS))
    monkeypatch.setattr(Client, "choose_to_join", lambda client: draw.random() < 0.8)
    monkeypatch.setattr(Client, "choose_to_leave", lambda client: draw.random() < 0.5)


def shaken(seed, clients=30):
    """A small fund whose start may be poor or rich, in which much happens."""
    draw = Random(f"{seed}/parameters")
    return Fund(
        seed,
        Parameters(clients=clients, coverage=draw.choice((0.02, 0.8, 1.0, 1.15, 1.6)), job_change=0.05, entry=0.2),
    )


def coverage_from_scratch(fund):
    """The coverage as it is by the rights of each client."""
    company = fund.company
    factors = annuity_factors(company.tables, fund.market.yield_steps, RETIREMENT)
    sums = [0] * OLDEST
    for client in clients_of(fund.world):
        sums[OLDEST - 1 - client.age] += client.accrued
    provisions = sum(right * factor for right, factor in zip(sums, factors, strict=True))
    return company.cents / provisions if provisions else 2.0


# -- blocks ---------------------------------------------------------------------------------------


@given(st.integers(0, 10**12), st.lists(st.integers(0, 10**6), min_size=1, max_size=40).filter(any))
def test_shares_sum_up_to_the_whole_and_are_less_than_a_cent_off(cents, weights):
    parts = share(cents, weights)
    assert sum(parts) == cents
    total = sum(weights)
    assert all(abs(part * total - cents * weight) < total for part, weight in zip(parts, weights, strict=True))


@pytest.mark.parametrize(("cents", "weights"), [(5, []), (5, [0, 0]), (5, [2, -1]), (-5, [1])])
def test_what_cannot_be_shared_is_refused(cents, weights):
    with pytest.raises(ValueError):
        share(cents, weights)


@pytest.mark.parametrize(("cents", "error"), [(1.0, TypeError), (True, TypeError), (-1, ValueError), (101, Shortage)])
def test_a_ledger_that_refuses_to_move_money_moves_none(cents, error):
    world = World(0)
    rich, poor = Entity(world), Entity(world)
    world.ledger.move(world.outside, rich, 100, "gift")
    with pytest.raises(error):
        world.ledger.move(rich, poor, cents, "loan")
    assert (rich.cents, poor.cents, world.outside.cents) == (100, 0, -100)
    assert world.ledger.flows == {"gift": 100}


@pytest.mark.parametrize("wrong", [1, -1, 0.0])
def test_the_check_finds_a_cent_that_did_not_come_from_another(wrong):
    world = World(0)
    entity = Entity(world)
    world.ledger.move(world.outside, entity, 5, "gift")
    world.check()
    entity.cents += wrong
    with pytest.raises(AssertionError):
        world.check()


def test_only_the_outside_may_owe():
    world = World(0)
    debtor, creditor = Entity(world), Entity(world)
    debtor.cents, creditor.cents = -5, 5
    with pytest.raises(AssertionError, match="entity_1 has -5 cents"):
        world.check()


def test_money_of_one_who_vanishes_is_inherited():
    world = World(0)
    entity, heir = Entity(world), Entity(world)
    world.ledger.move(world.outside, entity, 5, "gift")
    entity.vanish(heir)
    assert (heir.cents, entity.name in world.entities) == (5, False)
    world.check()


def test_ids_are_counted_on_the_world():
    assert [Entity(World(0)).name for _ in range(2)] == ["entity_1", "entity_1"]  # 0 is the outside
    world = World(0)
    assert [Entity(world).name, Entity(world).name] == ["entity_1", "entity_2"]


def test_a_contract_is_paid_from_its_start_every_so_many_months_until_its_end():
    world = World(0)
    payee = Entity(world)
    contract = Contract(world.outside, payee, 7, "rent", start=2, every=3, end=9)
    paid = []
    for _ in range(12):
        before = payee.cents
        world.advance()
        paid.append(payee.cents - before)
    assert paid == [0, 0, 7, 0, 0, 7, 0, 0, 7, 0, 0, 0]
    assert not contract.in_force


def test_a_contract_that_is_terminated_or_cannot_be_paid_moves_nothing():
    world = World(0)
    debtor, creditor = Entity(world), Entity(world)
    contract = Contract(debtor, creditor, 7, "rent")
    world.advance()
    assert (contract.missed, creditor.cents) == (1, 0)
    world.ledger.move(world.outside, debtor, 100, "gift")
    contract.terminate()
    contract.terminate()
    world.advance()
    assert (contract.missed, creditor.cents) == (1, 0)


@pytest.mark.parametrize("every", [0, -1])
def test_a_contract_recurs(every):
    world = World(0)
    with pytest.raises(ValueError):
        Contract(Entity(world), Entity(world), 7, "rent", every=every)


def test_a_contract_binds_entities_of_one_world():
    with pytest.raises(ValueError):
        Contract(Entity(World(0)), Entity(World(0)), 7, "rent")


def test_a_calendar_keeps_the_order_of_months_and_of_entries():
    calendar, seen = Calendar(), []
    calendar.at(2, seen.append, "c")
    calendar.at(1, seen.append, "a")
    calendar.at(2, seen.append, "d")
    calendar.at(1, lambda: calendar.at(1, seen.append, "b"))
    calendar.every(5, lambda: seen.append("often"), start=4)
    for month in range(2):
        calendar.run(month)
    assert seen == ["a", "b"]
    for month in range(2, 10):
        calendar.run(month)
    assert seen == ["a", "b", "c", "d", "often", "often"]


def test_a_request_is_granted_or_denied_and_counted():
    class Wish(Request):
        def objection(self):
            return None if self.applicant.cents else "too poor"

        def carry_out(self):
            self.applicant.world.ledger.move(self.applicant, self.applicant.world.outside, 1, "wish")

    world = World(0)
    entity = Entity(world)
    assert Wish(entity).submit() == "too poor"
    world.ledger.move(world.outside, entity, 1, "gift")
    assert Wish(entity).submit() is None
    assert entity.cents == 0
    assert world.counts == {"Wish denied: too poor": 1, "Wish granted": 1}


def test_streams_of_a_world_are_determined_by_its_seed_and_their_names():
    draws = [World(seed).stream(name).random() for seed, name in ((1, "a"), (1, "a"), (1, "b"), (2, "a"))]
    assert draws[0] == draws[1]
    assert len(set(draws)) == 3


# -- people and markets ---------------------------------------------------------------------------


def test_the_standard_ultimate_life_table():
    alive, table = 1.0, {}
    for age, probability in enumerate(Mortality().monthly()):
        if age >= 20 * 12:
            if age % 12 == 0:
                table[age // 12] = 100_000 * alive
            alive *= 1 - probability
    expected = {20: 100_000.0, 65: 94_579.7, 80: 75_657.2, 100: 6_248.2}  # l_x as published with the parameters
    assert {age: round(table[age], 1) for age in expected} == expected


def test_monthly_probabilities_are_the_integral_of_the_force():
    mortality = Mortality(factor=1.3)
    monthly = mortality.monthly()
    for age in (0, 300, 801, 1200):
        steps = 1000
        hazard = sum(mortality.force((age + (step + 0.5) / steps) / 12) for step in range(steps)) / steps / 12
        assert monthly[age] == pytest.approx(1 - math.exp(-hazard), rel=1e-6)
    assert monthly[-1] == 1


def test_people_die_as_often_as_the_formula_says():
    parameters = Parameters(clients=4000, entry=0.0, job_change=0.0)
    fund = Fund(5, parameters)
    expected = variance = 0.0
    monthly = parameters.mortality.monthly()
    for _ in range(60):
        for client in clients_of(fund.world):
            probability = monthly[client.age]
            expected += probability
            variance += probability * (1 - probability)
        fund.advance()
    assert abs(fund.world.counts["died"] - expected) < 4 * math.sqrt(variance)
    assert expected > 100


@pytest.mark.parametrize(("age", "steps"), [(300, 10), (RETIREMENT, 0), (1000, -2), (1439, 32)])
def test_annuity_factors_are_discounted_expected_payments(age, steps):
    monthly = Mortality().monthly()
    value, alive = 0.0, 1.0
    for month in range(age, OLDEST):
        if month >= RETIREMENT:
            value += alive / 12 / (1 + STEP * steps) ** ((month - age) / 12)
        alive *= 1 - monthly[month]
    assert annuity_factors(Mortality(), steps, RETIREMENT)[OLDEST - 1 - age] == pytest.approx(value)


def test_the_market_is_what_its_climate_says_in_the_long_run():
    climate = Climate()
    market = Market(climate, Random(3))
    inflation, yields, equities = [], [], []
    for _ in range(120_000):
        market.advance()
        inflation.append(market.inflation)
        yields.append(market.bond_yield)
        equities.append(math.log1p(market.equity_return))

    def moments(values):
        mean = sum(values) / len(values)
        return mean, math.sqrt(sum((value - mean) ** 2 for value in values) / len(values))

    assert moments(inflation) == pytest.approx((climate.inflation, climate.inflation_sd), rel=0.05)
    assert moments(yields) == pytest.approx((climate.bond_yield, climate.yield_sd), rel=0.08)
    mean, deviation = moments(equities)
    assert 12 * mean == pytest.approx(climate.bond_yield + climate.equity_premium, abs=0.006)
    assert math.sqrt(12) * deviation == pytest.approx(climate.equity_sd, rel=0.02)
    shocks = [
        [now - memory ** (1 / 12) * before for before, now in pairwise(values)]
        for values, memory in ((inflation, climate.inflation_memory), (yields, climate.yield_memory), (equities, 0.0))
    ]
    for (one, two), correlation in zip(((0, 1), (0, 2), (1, 2)), climate.correlations, strict=True):
        (a, sd_a), (b, sd_b) = moments(shocks[one]), moments(shocks[two])
        products = zip(shocks[one], shocks[two], strict=True)
        found = sum((x - a) * (y - b) for x, y in products) / len(shocks[one]) / sd_a / sd_b
        assert found == pytest.approx(correlation, abs=0.02)


# -- the fund -------------------------------------------------------------------------------------


def test_no_cent_is_created_or_lost_whatever_is_decided(monkeypatch):
    missed = 0
    for seed in range(1000):
        with monkeypatch.context() as patch:
            decide_at_random(patch, seed)
            fund = shaken(seed, clients=15)
            for _ in range(25):
                fund.advance()
                fund.world.check()
            missed += fund.world.counts["pensions rationed"]
    assert missed  # some ran out of money, and some had enough
    assert missed < 1000 * 25


def test_coverage_is_known_at_any_time_and_equals_the_one_from_scratch(monkeypatch):
    for seed in range(10):
        with monkeypatch.context() as patch:
            decide_at_random(patch, seed)
            fund = shaken(seed, clients=60)
            for _ in range(50):
                fund.advance()
                assert fund.company.coverage() == coverage_from_scratch(fund)


@pytest.mark.parametrize("wild", [False, True])
def test_the_same_seed_is_the_same_run_to_the_last_bit(monkeypatch, wild):
    def run(seed):
        with monkeypatch.context() as patch:
            if wild:
                decide_at_random(patch, 1)
            fund = Fund(seed, Parameters(clients=150))
            fund.run(60)
            return state(fund), fund.world.counts

    assert run(7) == run(7)
    assert run(7) != run(8)


def test_a_copy_goes_on_by_itself_as_the_fund_does():
    fund = Fund(3, Parameters(clients=80))
    fund.run(18)
    before = state(fund)
    twin = copy.deepcopy(fund)
    twin.run(24)
    assert state(fund) == before
    fund.run(24)
    assert state(twin) == state(fund) != before


def test_what_is_decided_about_people_does_not_change_the_market(monkeypatch):
    plain = Fund(4, Parameters(clients=50))
    plain.run(48)
    decide_at_random(monkeypatch, 4)
    other = Fund(4, Parameters(clients=50))
    other.run(48)
    assert plain.market.random.getstate() == other.market.random.getstate()
    assert plain.market.price_level == other.market.price_level
    assert plain.company.cents != other.company.cents


def test_everything_happens():
    seen = set()
    for seed, coverage in ((1, 1.15), (2, 0.85), (3, 1.0)):
        fund = Fund(seed, Parameters(clients=600, coverage=coverage, climate=Climate(equity_sd=0.25)))
        fund.run(360)
        seen |= {event for event, count in fund.world.counts.items() if count}
        flows = set(fund.world.ledger.flows)
        assert flows >= {"premium", "pension", "wages", "returns", "losses", "transfer", "estate", "spending"}
    assert seen >= {
        "Admission granted",
        "Admission denied: too old",
        "Contribution granted",
        "Contribution denied: above the highest premium",
        "Contribution denied: cannot be afforded",
        "Transfer granted",
        "Transfer denied: coverage is too low",
        "RecoveryPlan granted",
        "RecoveryPlan denied: cuts too little",
        "declined",
        "changed jobs",
        "came back",
        "retired",
        "died",
        "indexed",
        "short",
        "cut",
    }


def test_pensions_are_rationed_where_the_money_does_not_suffice():
    fund = Fund(2, Parameters(clients=200, entry=0.0))
    world, company = fund.world, fund.company
    pensions = [contract for contract in world.contracts.values() if isinstance(contract, PensionContract)]
    world.ledger.move(company, world.outside, company.cents - 1001, "theft")
    assert sum(company.ration().values()) == 1001
    before = {contract.number: contract.creditor.cents for contract in pensions}
    for contract in pensions:
        assert not contract.perform()
    assert company.cents == 0
    due = sum(contract.cents for contract in pensions)
    for contract in pensions:
        assert abs(contract.creditor.cents - before[contract.number] - 1001 * contract.cents / due) < 1
    world.check()


def test_who_retires_pays_no_more_and_draws_a_twelfth_of_the_rights_a_month():
    fund = Fund(1, Parameters(clients=200, entry=0.0))
    client = client_with(fund, "working")
    premium = client.contract
    client.retire()
    assert not premium.in_force
    assert (client.status, client.contract.cents) == ("retired", client.accrued // 12)
    before, rights = client.cents, client.accrued
    fund.world.perform_contracts()
    assert client.cents == before + client.accrued // 12
    assert client.accrued == rights


def test_indexation_and_cuts_change_rights_and_pensions_alike():
    fund = Fund(1, Parameters(clients=200))
    before = {client.name: client.accrued for client in clients_of(fund.world)}
    fund.company.change_rights(-0.1)
    for client in clients_of(fund.world):
        assert client.accrued == pytest.approx(0.9 * before[client.name], abs=1)
        if client.status == "retired":
            assert client.contract.cents == client.accrued // 12
    assert fund.company.indexed == pytest.approx(0.9)


def test_a_year_above_the_minimum_ends_the_row_of_measurements():
    fund = Fund(1, Parameters(clients=100))
    company = with_coverage(fund, 1.0)
    company.conclude_year()
    assert company.measured_short == 1
    with_coverage(fund, 1.2)
    company.conclude_year()
    assert company.measured_short == 0


def test_clients_pay_more_when_they_have_savings_and_less_when_they_could_not_pay():
    fund = Fund(1, Parameters(clients=300))
    world = fund.world
    client = next(c for c in clients_of(world) if c.works and 45 * 12 <= c.age < 50 * 12)
    assert client.choose_extra() == 0.0
    world.ledger.move(world.outside, client, client.wage, "gift")
    assert client.choose_extra() == 0.25
    client.extra, client.contract.missed = 0.5, 1
    assert client.choose_extra() == 0.25
    fund.company.review(client)
    assert client.contract.missed == 0  # a new year


# -- requests and the law -------------------------------------------------------------------------


def client_with(fund, status):
    return next(client for client in clients_of(fund.world) if client.status == status)


def denied_requests(fund):
    """A request of each kind that is denied, with the reason."""
    company = fund.company
    working, retired = max(clients_of(fund.world), key=lambda client: client.born), client_with(fund, "retired")
    yield Admission(working, company), "a client already"
    yield Admission(Client(company, 65 * 12, 3_000_000, 0.5), company), "too old"
    yield Contribution(retired, 0.5), "not working"
    oldest = min((client for client in clients_of(fund.world) if client.works), key=lambda client: client.born)
    yield Contribution(oldest, 0.5), "above the highest premium"
    dear = next(c for c in clients_of(fund.world) if c.works and 0.3 < company.cost_rate(c) * 1.5 <= 0.35)
    yield Contribution(dear, 0.5), "cannot be afforded"
    yield Transfer(retired), "retired"
    yield Transfer(working), "coverage is too low"
    yield RecoveryPlan(company, 0.01, 0.02), "cuts too little"


def test_a_request_that_is_denied_changes_nothing():
    fund = Fund(1, Parameters(clients=400, coverage=0.9))
    for request, reason in denied_requests(fund):
        before = state(fund)
        assert request.submit() == reason
        assert state(fund) == before


def test_who_pays_more_can_pay_less_again_and_has_to_where_it_becomes_too_dear():
    fund = Fund(1, Parameters(clients=400))
    company = fund.company
    client = next(c for c in clients_of(fund.world) if c.works and company.cost_rate(c) * 1.5 > law.HIGHEST_PREMIUM)
    client.extra = 0.5
    assert Contribution(client, 0.25).submit() is None
    assert client.extra == 0.25
    client.extra = 0.5
    company.review(client)
    assert client.extra == 0


def test_nobody_can_take_more_along_than_there_is(monkeypatch):
    fund = Fund(1, Parameters(clients=100))
    world, company = fund.world, fund.company
    world.ledger.move(company, world.outside, company.cents - 5, "theft")
    monkeypatch.setattr(Company, "coverage", lambda company: 1.2)
    assert Transfer(client_with(fund, "working")).submit() == "the money is lacking"


def test_a_transfer_takes_the_value_along_and_ends_all_rights():
    fund = Fund(1, Parameters(clients=100))
    client, company = client_with(fund, "working"), fund.company
    provisions, assets, value = company.provisions(), company.cents, client.value()
    contract = client.contract
    assert Transfer(client).submit() is None
    assert company.cents == assets - value
    assert company.provisions() == pytest.approx(provisions - value, abs=1)
    assert client.name not in fund.world.entities
    assert not contract.in_force
    fund.world.check()


def with_coverage(fund, coverage):
    """Let the company's assets be such, and the policy coverage with them."""
    world, company = fund.world, fund.company
    change = round(coverage * company.provisions()) - company.cents
    world.ledger.move(*((world.outside, company) if change > 0 else (company, world.outside)), abs(change), "test")
    for _ in range(12):
        company.measure()
    return company


@pytest.mark.parametrize(("coverage", "behind", "indexed"), [(1.09, 0.2, 0), (1.11, 0.2, 0.03), (1.3, 0.2, 0.07)])
def test_rights_are_indexed_as_the_law_allows_it_by_coverage(monkeypatch, coverage, behind, indexed):
    fund = Fund(1, Parameters(clients=100))
    company = with_coverage(fund, coverage)
    monkeypatch.setattr(Company, "choose_indexation", lambda company: 5.0)
    fund.market.inflation, fund.market.price_level = 0.03, 1 + behind
    company.conclude_year()
    assert company.indexed == pytest.approx(1 + indexed)


def test_the_risk_of_the_assets_is_not_raised_in_a_shortfall(monkeypatch):
    fund = Fund(1, Parameters(clients=100))
    monkeypatch.setattr(Manager, "choose_mix", lambda manager: 0.8)
    manager = with_coverage(fund, 1.0).manager
    manager.rebalance()
    assert manager.equities == 0.4
    with_coverage(fund, 1.2)
    manager.rebalance()
    assert manager.equities == 0.8


def test_the_sixth_measurement_below_the_minimum_brings_a_cut_however_the_company_decides(monkeypatch):
    fund = Fund(1, Parameters(clients=100))
    company = with_coverage(fund, 0.97)
    monkeypatch.setattr(Company, "choose_cut", lambda company: 0.0)
    for _ in range(5):
        company.conclude_year()
    assert company.indexed == 1
    tenth = (1 - company.policy_coverage() / MINIMUM) / 10
    company.conclude_year()
    assert company.indexed == pytest.approx(1 - tenth)
    assert fund.world.counts["RecoveryPlan denied: cuts too little"] == 1


def test_a_critical_coverage_brings_a_cut_at_once(monkeypatch):
    fund = Fund(1, Parameters(clients=100))
    company = with_coverage(fund, 0.85)
    before = company.provisions()
    company.conclude_year()
    assert company.indexed < 1
    assert company.provisions() == pytest.approx(before * company.indexed, rel=1e-5)


@pytest.mark.parametrize(("coverage", "lowest"), [(1.2, 1.0), (1.3, 0.8)])
def test_premiums_cover_their_cost_unless_coverage_is_high(monkeypatch, coverage, lowest):
    fund = Fund(1, Parameters(clients=100))
    company = with_coverage(fund, coverage)
    monkeypatch.setattr(Company, "set_premium", lambda company, client: 0.0)
    client = min((c for c in clients_of(fund.world) if c.works), key=lambda client: -client.born)
    company.review(client)
    assert client.premium == pytest.approx(lowest * company.cost_rate(client))
    assert client.contract.cents == round(client.premium * client.wage / 12)


# -- the files ------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", [blocks, company, economy, law, pension, people])
def test_the_model_knows_nothing_of_environments(module):
    tree = ast.parse(Path(module.__file__).read_text())
    imported = [
        name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
    ]
    own = {"blocks", "company", "economy", "law", "people"}
    assert {name.split(".")[0] for name in imported} <= set(sys.stdlib_module_names) | own


@pytest.mark.parametrize(
    ("module", "options", "said"),
    [
        ("blocks", ["--months", "30"], "no cent appeared or vanished"),
        ("pension", ["--clients", "100", "--years", "6"], "years a second"),
    ],
)
def test_it_runs_on_its_own(module, options, said):
    command = [sys.executable, "-W", "error", "-m", f"examples.fin_base.{module}", "--seed", "1", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert said in done.stdout
