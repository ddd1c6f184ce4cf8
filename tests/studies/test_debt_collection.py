"""The agency that collects debts: its money, the law, its views, and what a better policy is worth."""

import pickle

import pytest
from studies.debt_collection.env import CASES, COLLECTOR, NAMED_CASES, NAMED_COLLECTOR, CollectionSim, lawful
from studies.debt_collection.model import CHOICES, Agency, Debtor, Parameters
from studies.debt_collection.study import HELD_OUT, LEARNED, compare

from simenv_marl import aec_env, joint_env, parallel_env, single_env
from simenv_marl.errors import InvalidActionError
from tests.worlds.models import follow_the_rule

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


VIEWS = {"aec": aec_env, "parallel": parallel_env, "single": single_env, "joint": joint_env}
ROSTER = {"possible_agents": [f"debtor_{number}" for number in range(20)], "undeclared": "rule"}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("points", [CASES, NAMED_CASES, COLLECTOR, NAMED_COLLECTOR])
def test_the_rule_through_every_view_is_the_plain_run(view, points):
    options = {}
    if points in (CASES, NAMED_CASES):
        options |= {"joint": ROSTER, "single": {"agent": "debtor_3"}}.get(view, {})
    environment = pickle.loads(pickle.dumps(VIEWS[view](CollectionSim(DAYS), points, **options)))
    agency, plain = follow_the_rule(environment, 4).agency, Agency(4)
    assert view == "single" or agency.world.month == DAYS
    while plain.world.month < agency.world.month:
        plain.advance()
    assert state(agency) == state(plain)


def test_actions_number_the_lawful_choices_and_rewards_sum_up_to_the_profit():
    environment = single_env(CollectionSim(200), COLLECTOR)
    observation, info = environment.reset(seed=4)
    counts = environment.simulation.agency.world.counts
    asked, total, over = set(), 0.0, [False]
    while not any(over):
        choices = lawful(observation)
        assert info["action_mask"].tolist() == [1] * len(choices) + [0] * (len(CHOICES) - len(choices))
        assert info["time"] % 7 < 5
        if len(choices) < len(CHOICES):
            with pytest.raises(InvalidActionError):
                environment.step(len(choices))
        asked.add(choices[-1])
        before = counts[choices[-1]]
        observation, reward, *over, info = environment.step(len(choices) - 1)
        assert counts[choices[-1]] == before + 1
        total += reward
    assert asked == set(CHOICES)
    assert over == [False, True]
    assert info["time"] == 200
    assert total == pytest.approx(environment.simulation.agency.profit / 100_00)


def test_the_learned_policy_beats_the_rule_on_unseen_seeds():
    third = CollectionSim(parameters=Parameters(arrivals=0.3, stock=20, calls=1))  # of what it has learned from
    result = compare({"learned": LEARNED}, range(HELD_OUT, HELD_OUT + 32), third).summary().loc["learned"]
    assert result["difference"] > result["difference_low"] > 0
