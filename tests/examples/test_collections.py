"""The agency that collects debts: its money, the law, its views, and what a better policy is worth."""

import ast
import collections
import copy
import pickle
import subprocess
import sys
from pathlib import Path
from random import Random

import numpy as np
import pytest
from examples.fin_base import blocks
from examples.fin_base import collections as model
from examples.fin_base.collections import CALL, CHOICES, FEE, LIMITATION, VALIDATION, Agency, Debtor, Parameters, Plan
from examples.fin_base.collections_env import (
    CASES,
    COLLECTOR,
    NAMED_CASES,
    NAMED_COLLECTOR,
    POINT,
    SPACE,
    STATE_SPACE,
    CollectionSim,
    lawful,
    observe,
)
from examples.fin_base.collections_study import HELD_OUT, LEARNED, Thresholds, compare, learn
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, seed_test

from simenv_marl import (
    RULE,
    aec_env,
    branch,
    joint_env,
    parallel_env,
    simulate,
    single_env,
    vector_env,
)
from simenv_marl.errors import InvalidActionError
from simenv_marl.testing import check_simulation
from tests.worlds.models import follow_the_rule

ROOT = Path(__file__).parents[2]
DAYS = 60


def state(agency):
    """All that there is to know of an agency and its debtors."""
    plain = [name for name in vars(Debtor(Agency(0))) if name not in ("agency", "calls", "contract", "draw", "life")]
    return (
        agency.world.month,
        agency.cents,
        [[getattr(debtor, name) for name in plain] for debtor in agency.cases.values()],
        [tuple(debtor.calls) for debtor in agency.cases.values()],
        [(debtor.draw.getstate(), debtor.life.getstate()) for debtor in agency.cases.values()],
        [(contract.debtor.name, contract.cents, contract.missed) for contract in agency.world.contracts.values()],
        dict(agency.world.ledger.flows),
        dict(agency.world.counts),
        len(agency.world.calendar),
    )


def plain(seed, days=DAYS):
    agency = Agency(seed)
    for _ in range(days):
        agency.advance()
    return agency


# -- the model ------------------------------------------------------------------------------------


def test_the_model_knows_nothing_of_reinforcement_learning():
    tree = ast.parse(Path(model.__file__).read_text())
    imported = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert {name.split(".")[0] for name in imported} <= set(sys.stdlib_module_names) | {"blocks"}


def test_the_standard_librarys_collections_is_not_shadowed():
    assert blocks.Counter is collections.Counter
    assert model.deque is collections.deque
    assert sys.modules["collections"] is collections is not model


def test_it_runs_on_its_own():
    command = [sys.executable, "-m", "examples.fin_base.collections", "--days", "90", "--seed", "3"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, cwd=ROOT)
    assert f"{plain(3, 90).profit / 100:.2f}" in run.stdout.splitlines()[2]


def test_the_seed_determines_everything():
    assert state(plain(5)) == state(plain(5)) != state(plain(6))


def test_debts_are_bought_for_a_while_alone():
    agency = Agency(1, Parameters(stock=0, buying=30))
    for _ in range(60):
        agency.advance()
    days = [debtor.arrived for debtor in agency.cases.values()]
    assert 15 < max(days) < 30


def test_decisions_do_not_change_the_lives_of_debtors(monkeypatch):
    decided = plain(1, 90).cases
    monkeypatch.setattr(Agency, "choose_contact", lambda *call: "leave")
    left_alone = plain(1, 90).cases
    common = [(decided[number], left_alone[number]) for number in decided.keys() & left_alone.keys()]
    assert len(common) > 50
    assert all(one.life.getstate() == other.life.getstate() for one, other in common)
    assert all(one.employed == other.employed for one, other in common)
    assert any(one.draw.getstate() != other.draw.getstate() for one, other in common)


class Audit:
    """Has an agency choose at random among what is lawful, and checks the law and the staff by the record alone."""

    def __init__(self, seed, **parameters):
        self.agency = agency = Agency(seed, Parameters(**parameters))
        self.draw, self.calls, self.letters = Random(seed), {}, {}
        self.eager = self.draw.choice([0.0, 0.9])  # how often it calls where that is lawful
        self.today = collections.Counter()
        agency.world.calendar.every(1, self.end_day, start=0)

    def choose(self, agency, debtor, choices):
        assert agency is self.agency
        assert "leave" in choices
        assert debtor.status == "open"
        day, eager = agency.world.month, "call" in choices and self.draw.random() < self.eager
        choice = "call" if eager else self.draw.choice(choices)
        calls, letters = self.calls.setdefault(debtor, []), self.letters.setdefault(debtor, [])
        assert choice == "leave" or day % 7 < 5
        if choice == "call":
            self.today[day] += 1
            assert letters
            assert not debtor.ceased
            assert len([earlier for earlier in calls if earlier > day - 7]) < 7
            assert debtor.talked is None or day >= debtor.talked + 7
            calls.append(day)
        elif choice == "write":
            assert not debtor.ceased
            letters.append(day)
        elif choice == "sue":
            assert letters[0] + VALIDATION <= day
            assert day < debtor.since + LIMITATION
        return choice

    def end_day(self):
        assert self.today[self.agency.world.month] <= self.agency.parameters.calls
        self.agency.world.check()


def test_no_cent_is_lost_and_no_law_broken_by_random_lawful_choices(monkeypatch):
    counts, week_of_calls, last_calls = collections.Counter(), 0, 0
    for seed in range(200):
        draw = Random(seed)
        audit = Audit(seed, arrivals=draw.choice([0.0, 0.5, 1.0]), stock=draw.randrange(1, 20), calls=draw.randrange(9))
        monkeypatch.setattr(Agency, "choose_contact", lambda *call, audit=audit: audit.choose(*call))
        for _ in range(150):
            audit.agency.advance()
        counts += audit.agency.world.counts
        last_calls += any(number == audit.agency.parameters.calls > 0 for number in audit.today.values())
        week_of_calls += any(len([day for day in calls if day > calls[-1] - 7]) == 7 for calls in audit.calls.values())
    assert last_calls > 60  # the staff was fully used somewhere
    assert week_of_calls > 0  # and so were the seven calls
    happened = {"paid", "insolvent", "not owed", "dismissed", "nothing to garnish", "Plan granted"}
    assert happened | set(CHOICES) <= set(counts)


def test_an_unlawful_choice_is_refused(monkeypatch):
    monkeypatch.setattr(Agency, "choose_contact", lambda *call: "sue")
    with pytest.raises(ValueError, match="not lawful"):
        Agency(1).work()


@pytest.fixture
def case():
    """A debtor who was written to long ago, on a day when anything is lawful."""
    agency = Agency(1, Parameters(arrivals=0.0, stock=1, calls=3))
    (debtor,) = agency.cases.values()
    agency.world.month, debtor.since, debtor.notified, debtor.letters = 100, 0, 0, 1
    return debtor


def now(debtor):
    return debtor.agency.lawful(debtor)


def test_anything_is_lawful_now_and_then(case):
    assert now(case) == CHOICES


def test_no_call_and_no_lawsuit_before_the_notice(case):
    case.notified = None
    assert now(case) == ("leave", "write")


@pytest.mark.parametrize(("days", "lawful"), [(VALIDATION - 1, False), (VALIDATION, True)])
def test_no_lawsuit_before_the_validation_period_has_ended(case, days, lawful):
    case.notified = 100 - days
    assert ("sue" in now(case)) == lawful
    assert "call" in now(case)


@pytest.mark.parametrize(("age", "lawful"), [(LIMITATION - 1, True), (LIMITATION, False)])
def test_no_lawsuit_for_a_time_barred_debt(case, age, lawful):
    case.since = 100 - age
    assert ("sue" in now(case)) == lawful
    assert {"write", "call"} < set(now(case))


@pytest.mark.parametrize(("days", "lawful"), [((94,) + (99,) * 6, False), ((93,) + (99,) * 6, True), ((99,) * 6, True)])
def test_at_most_seven_calls_in_seven_days(case, days, lawful):
    case.calls.extend(days)
    assert now(case) == (CHOICES if lawful else ("leave", "write", "sue"))


@pytest.mark.parametrize(("talked", "lawful"), [(100, False), (94, False), (93, True)])
def test_no_call_within_seven_days_after_a_conversation(case, talked, lawful):
    case.talked = talked
    assert now(case) == (CHOICES if lawful else ("leave", "write", "sue"))


def test_a_debtor_who_asks_for_no_communication_can_only_be_sued(case):
    case.ceased = True
    assert now(case) == ("leave", "sue")


def test_a_dispute_stops_the_collection_until_the_debt_is_verified(case):
    case.letters, case.draw = 1, Random(0)
    case.draw.random = lambda: 0.03  # below the chance of a dispute
    case.receive()
    assert case.status == "disputed"
    assert now(case) == ("leave",)
    case.draw.random = lambda: 0.7  # the debt is owed
    for _ in range(30):
        case.agency.world.advance()
    assert case.status == "open"


def test_no_call_without_staff_and_nothing_without_money(case):
    case.agency.calls_left = 0
    assert now(case) == ("leave", "write", "sue")
    case.agency.calls_left = 1
    case.world.ledger.move(case.agency, case.world.outside, case.agency.cents - FEE + 1, "loss")
    assert now(case) == ("leave", "write", "call")
    case.world.ledger.move(case.agency, case.world.outside, case.agency.cents - CALL + 1, "loss")
    assert now(case) == ("leave", "write")
    case.world.ledger.move(case.agency, case.world.outside, case.agency.cents, "loss")
    assert now(case) == ("leave",)


def test_the_choices_of_a_call_are_what_is_lawful(monkeypatch):
    seen, rule = set(), Agency.choose_contact

    def noted(agency, debtor, choices):
        assert choices == agency.lawful(debtor)
        seen.add(choices)
        return rule(agency, debtor, choices)

    monkeypatch.setattr(Agency, "choose_contact", noted)
    plain(1, 360)
    assert len(seen) >= 6


def test_a_plan_is_denied_that_takes_too_long_and_a_second_one(case):
    case.employed, case.wage, case.living, case.balance = True, 2000_00, 1900_00, 24 * 80_00 + 1
    assert Plan(case).submit() == "takes too long"
    case.balance -= 1
    assert Plan(case).submit() is None
    assert case.status == "plan"
    case.reopen()
    assert Plan(case).submit() == "broke a plan"


def test_a_plan_ends_with_the_second_missed_instalment_or_with_the_debt(case):
    case.balance = 250_00
    case.repay("plan", 100_00)
    plan, world = case.contract, case.world
    world.ledger.move(case, world.outside, case.cents, "loss")
    assert (plan.perform(), case.status, plan.perform(), case.status) == (False, "plan", False, "open")
    assert not plan.in_force
    case.repay("plan", 100_00)
    world.ledger.move(world.outside, case, 260_00, "gift")
    assert [case.contract.perform() for _ in range(3)] == [True] * 3
    assert (case.status, case.balance, case.collected, world.contracts) == ("paid", 0, 250_00, {})
    assert case.agency.profit == 250_00
    world.check()


# -- the environments -----------------------------------------------------------------------------


VIEWS = {
    "aec": aec_env,
    "parallel": parallel_env,
    "single": single_env,
    "joint": joint_env,
}
ROSTER = {"possible_agents": [f"debtor_{number}" for number in range(20)], "undeclared": "rule"}


@pytest.mark.parametrize("driver", ["greenlet", "thread"])
@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("points", [CASES, NAMED_CASES, COLLECTOR, NAMED_COLLECTOR])
def test_the_rule_through_every_view_is_the_plain_run(view, points, driver):
    options = {"driver": driver}
    if points in (CASES, NAMED_CASES):
        options |= {"joint": ROSTER, "single": {"agent": "debtor_3"}}.get(view, {})
    agency = follow_the_rule(VIEWS[view](CollectionSim(DAYS), points, **options), 4).agency
    expected = plain(4, agency.world.month)
    assert view == "single" or agency.world.month == DAYS
    assert state(agency) == state(expected)


@pytest.mark.parametrize("points", [COLLECTOR, NAMED_COLLECTOR])
def test_a_vector_that_does_what_the_rule_does_is_the_plain_run(points):
    told = []
    for seed in (4, 5):
        environment, actions, over = single_env(CollectionSim(DAYS), points), [], False
        environment.reset(seed=seed)
        while not over:
            _, _, terminated, truncated, info = environment.step(RULE)
            actions.append(info["rule_action"])
            over = terminated or truncated
        told.append(actions)
    envs = vector_env(CollectionSim(DAYS), points, num_envs=2)
    envs.reset(seed=[4, 5])
    profits = np.zeros(2)
    for actions in zip(*told, strict=False):
        _, rewards, *_ = envs.step(np.array(actions))
        profits += rewards
    envs.close()
    shorter = int(np.argmin([len(actions) for actions in told]))
    assert profits[shorter] == pytest.approx(plain(4 + shorter).profit / 100_00)


@pytest.mark.parametrize("points", [CASES, NAMED_CASES, COLLECTOR, NAMED_COLLECTOR])
def test_no_cent_is_lost_by_random_legal_actions(points):
    environment = aec_env(CollectionSim(DAYS), points, state_space=STATE_SPACE)
    for seed in range(5):
        environment.reset(seed=seed)
        generator = np.random.default_rng(seed)
        for _ in environment.agent_iter():
            observation, _, terminated, truncated, info = environment.last()
            assert SPACE.contains(observation)
            legal = np.flatnonzero(info["action_mask"])
            environment.step(None if terminated or truncated else int(generator.choice(legal)))
        environment.simulation.agency.world.check()
        assert STATE_SPACE.contains(environment.state())


def test_actions_number_the_choices_that_arrive_with_the_call():
    environment = single_env(CollectionSim(DAYS), COLLECTOR)
    observation, info = environment.reset(seed=4)
    asked, over = set(), False
    while not over:
        choices = lawful(observation)
        assert info["action_mask"].tolist() == [1] * len(choices) + [0] * (len(CHOICES) - len(choices))
        asked.add(tuple(choices))
        before = environment.simulation.agency.world.counts.copy()
        observation, _, *over, info = environment.step(len(choices) - 1)
        after = environment.simulation.agency.world.counts
        assert after[choices[-1]] == before[choices[-1]] + 1
        over = any(over)
    assert {choices[-1] for choices in asked} == set(CHOICES)


def test_what_is_not_lawful_is_refused():
    for points in (COLLECTOR, NAMED_COLLECTOR):
        environment = single_env(CollectionSim(DAYS), points)
        environment.reset(seed=4)
        with pytest.raises(InvalidActionError):
            environment.step(CHOICES.index("call"))


def test_fixed_actions_in_rounds_never_become_others():
    environment = parallel_env(CollectionSim(DAYS, Parameters(calls=1)), NAMED_CASES)
    _, infos = environment.reset(seed=4)
    counts, unused = environment.simulation.agency.world.counts, 0
    while environment.agents and unused < 3:
        call = {agent for agent in environment.agents if infos[agent]["action_mask"][CHOICES.index("call")]}
        actions = {agent: CHOICES.index("call" if agent in call else "leave") for agent in environment.agents}
        if not call:
            actions = {
                agent: CHOICES.index("write" if infos[agent]["action_mask"][1] else "leave") for agent in actions
            }
        *_, infos = environment.step(actions)
        unused += sum(not infos[agent]["acted"] for agent in call if agent in infos)
    assert unused >= 3
    assert not counts["sue"]


def test_a_debtor_who_has_paid_is_no_longer_an_agent():
    environment = aec_env(CollectionSim(200), CASES)
    environment.reset(seed=4)
    agency, rewards, ended, cut = environment.simulation.agency, collections.Counter(), {}, set()
    debtors = {}
    for agent in environment.agent_iter():
        _, reward, terminated, truncated, _ = environment.last()
        rewards[agent] += reward
        debtors.update((debtor.name, debtor) for debtor in agency.cases.values())
        if terminated:
            assert agent not in ended
            ended[agent] = debtors[agent].status
        elif truncated:
            cut.add(agent)
        else:
            assert agent not in ended
        environment.step(None if terminated or truncated else RULE)
    assert {"paid", "nothing to garnish", "not owed"} <= set(ended.values())
    assert {debtors[name].name for name in cut} <= {debtor.name for debtor in agency.cases.values()}
    assert not set(ended) & {debtor.name for debtor in agency.cases.values()}
    for agent, reward in rewards.items():
        assert reward == pytest.approx((debtors[agent].collected - debtors[agent].spent) / 100_00)
    silent = sum(debtor.collected for name, debtor in debtors.items() if name not in rewards)
    assert agency.profit == pytest.approx(100_00 * sum(rewards.values()) + silent)


def test_one_agents_rewards_sum_up_to_the_utility_and_time_is_in_days():
    environment = single_env(CollectionSim(200), COLLECTOR)
    _, info = environment.reset(seed=4)
    total, times, over = 0.0, [info["time"]], False
    while not over:
        _, reward, terminated, truncated, info = environment.step(RULE)
        total += reward
        times.append(info["time"])
        over = terminated or truncated
    assert (terminated, truncated) == (False, True)
    assert total == pytest.approx(environment.simulation.agency.profit / 100_00)
    assert times == sorted(times)
    assert (times[0], times[-1]) == (0, 200)
    assert all(day % 7 < 5 for day in times[:-1])


def test_an_episode_is_terminated_when_all_cases_are_closed():
    environment = single_env(CollectionSim(parameters=Parameters(arrivals=0.0, stock=2, buying=0)), COLLECTOR)
    environment.reset(seed=4)
    over = (False, False)
    while not any(over):
        _, _, *over, info = environment.step(RULE)
    assert over == [True, False]
    assert info["time"] < environment.simulation.days
    assert not environment.simulation.agency.cases


def test_observations_show_nothing_that_a_collector_cannot_know(case):
    before = observe(case.agency, case, CHOICES)
    case.wage, case.living, case.cushion, case.employed = 1, 2, 3, not case.employed
    case.willingness, case.reach, case.payday = 0.99, 0.99, 999
    case.world.ledger.move(case.world.outside, case, 12345, "gift")
    assert (observe(case.agency, case, CHOICES) == before).all()


def to_the_end(environment):
    over = False
    while not over:
        _, _, terminated, truncated, _ = environment.step(RULE)
        over = terminated or truncated
    return environment.simulation.agency


def test_branches_have_the_same_past_and_other_futures():
    environment = single_env(CollectionSim(DAYS), COLLECTOR)
    environment.reset(seed=4)
    for _ in range(150):
        environment.step(RULE)
    expected = state(environment.simulation.agency)
    newest = max(environment.simulation.agency.cases)

    def look(copied, number):
        past = state(copied.simulation.agency)[:3]
        agency = to_the_end(copied)
        bought = [(debtor.wage, debtor.arrived) for debtor in agency.cases.values() if debtor.number > newest]
        return past, agency.profit, bought

    first, second, third = branch(environment, look, 3, seeds=[1, 1, 2])
    assert first == second
    assert first[0] == third[0] == expected[:3]
    assert first[1] != third[1]
    assert not {wage for wage, _ in first[2]} & {wage for wage, _ in third[2]}
    assert [day for _, day in first[2]] != [day for _, day in third[2]]
    (exact,) = branch(environment, look, 1)
    assert exact[1] == plain(4).profit
    assert state(environment.simulation.agency) == expected


@pytest.mark.parametrize(
    "generator",
    [lambda agency: agency.random, lambda agency: agency.cases[0].draw, lambda agency: agency.cases[0].life],
)
def test_purchases_and_debtors_are_drawn_anew(generator):
    draws = []
    for seed in (3, 3, 4):
        simulation = CollectionSim()
        simulation.reset(len(draws))
        simulation.reseed(seed)
        draws.append(generator(simulation.agency).random())
    assert draws[0] == draws[1] != draws[2]


def test_all_cases_that_are_due_are_announced_to_a_round():
    environment = parallel_env(CollectionSim(DAYS), CASES)
    environment.reset(seed=4)
    agency = environment.simulation.agency
    first = [debtor.name for debtor in agency.cases.values() if debtor.due == 0]
    assert sorted(environment.agents) == sorted(first)
    assert len(first) > 5
    assert agency.world.month == 0
    *_, infos = environment.step(dict.fromkeys(environment.agents, RULE))
    assert all(infos[name]["acted"] for name in first)
    assert agency.world.month == 1


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))])
def test_a_copy_goes_on_like_the_original(copied):
    simulation = CollectionSim(DAYS)
    simulation.reset(4)
    for _ in range(30):
        simulation.agency.advance()
    other = copied(simulation)
    assert state(other.agency) == state(simulation.agency) == state(plain(4, 30))
    other.run()
    assert state(simulation.agency) == state(plain(4, 30))
    assert state(other.agency) == state(plain(4))
    simulation.run()
    assert state(simulation.agency) == state(plain(4))


class Lenient(CollectionSim):
    """An agency that has sent all notices long ago: on its first days everything is lawful."""

    def reset(self, seed=None):
        super().reset(seed)
        for debtor in self.agency.cases.values():
            debtor.notified, debtor.since = -100, -200


def test_others_checks_pass():
    with pytest.warns(UserWarning, match="possible_agents"):  # debtors become known as they arrive
        api_test(aec_env(CollectionSim(DAYS), CASES), num_cycles=30)
    for points in (COLLECTOR, NAMED_COLLECTOR):
        api_test(aec_env(CollectionSim(DAYS), points), num_cycles=30)
        parallel_api_test(parallel_env(Lenient(5, Parameters(calls=99)), points), num_cycles=30)
        seed_test(lambda points=points: aec_env(CollectionSim(DAYS), points), num_cycles=10)
        lenient = Lenient(5, Parameters(arrivals=0.0, calls=99))  # the check knows no masks
        check_env(single_env(lenient, points), skip_render_check=True)


@pytest.mark.parametrize("points", [CASES, COLLECTOR, NAMED_CASES])
def test_the_librarys_check_finds_nothing(points):
    report = check_simulation(lambda: CollectionSim(30), points, episodes=2)
    assert not [finding for finding in report.findings if finding.severity != "note"], report


# -- what a better policy is worth ----------------------------------------------------------------


def test_a_shared_policy_is_the_same_for_one_agent_and_for_many():
    one = simulate(CollectionSim(200), {"collector_0": Thresholds()}, points=COLLECTOR, seed=4)
    many = simulate(CollectionSim(200), {POINT: Thresholds()}, points=CASES, seed=4)
    assert state(one.agency) == state(many.agency) != state(plain(4, 200))


def test_the_search_is_determined_by_its_seed():
    first, again, other = (learn(1, seed, episodes=1, simulation=CollectionSim(30)) for seed in (1, 1, 2))
    assert first == again != other


def test_the_learned_policy_beats_the_rule_on_unseen_seeds():
    third = CollectionSim(parameters=Parameters(arrivals=0.3, stock=20, calls=1))  # of what it has learned from
    result = compare({"learned": LEARNED}, range(HELD_OUT, HELD_OUT + 32), third).summary().loc["learned"]
    assert result["difference"] > result["difference_low"] > 0
