"""Policies back in the model: ``simulate``."""

import weakref
from functools import partial

import numpy as np
import pytest
from hypothesis import given

from simenv_marl import RULE, aec_env, simulate, simulate_many
from simenv_marl.errors import (
    InvalidActionError,
    NoDecisionError,
    OptionValueError,
    SimulationError,
    UnknownOptionError,
    UnknownPointError,
)
from tests.extent import examples
from tests.worlds.entities import (
    HERE,
    AnsweredColony,
    Being,
    Colony,
    Other,
    beings,
    colony_designs,
    colony_points,
    colony_policy,
    seeds,
)
from tests.worlds.models import BY_DRIVER, calling, decision, fails, notes, script
from tests.worlds.valued import LEFT, Duel, points


def test_simulate_without_policies_runs_a_copy_of_the_model_unchanged():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    # and lists it
    assert simulate(calling(ant, bee), {bee: lambda observation: 2}, points=ant).log == ["rule", 2]
    for arguments in ({}, {"points": ant}, {"policies": {}, "points": [ant]}):
        given_simulation = calling(ant, ant)()
        simulation = simulate(given_simulation, **arguments)
        assert simulation is not given_simulation
        assert simulation.log == ["rule", "rule"]
        assert not hasattr(given_simulation, "log")


def test_simulate_passes_its_seed_on_or_draws_one():
    ant = decision(agent="ant_0")
    assert simulate(calling(ant), seed=7).seed == 7
    drawn = {simulate(calling(ant)).seed for _ in range(5)} | {
        simulate(calling(ant), seed=np.int64(7)).seed
    }
    assert len(drawn) > 2
    assert all(type(seed) is int for seed in drawn)
    with pytest.raises(OptionValueError, match="seed must be a non-negative"):
        simulate(calling(ant), seed=-1)


ANT = decision(agent="ant_0")


def test_errors_in_simulate_name_the_seed():
    for source, policy, error, match in (
        (calling(ANT), lambda observation: 10, InvalidActionError, "is not in its action space"),
        (calling(ANT), lambda observation: 1 // 0, ZeroDivisionError, "division"),
        (
            script(lambda simulation: ANT() // 0),
            lambda observation: 4,
            ZeroDivisionError,
            "division",
        ),
    ):
        with fails(error, "seed 13", match=match):
            simulate(source, {ANT: policy}, seed=13)


@pytest.mark.parametrize("run", [simulate, partial(simulate_many, seeds=[1])], ids=["one", "many"])
@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"speed": 3}, UnknownOptionError, "there is no option"),
        ({"max_steps": 3}, OptionValueError, r"max_steps has no effect .* evaluate"),
        ({"policies": {"nobody": lambda observation: 1}}, UnknownPointError, "known are ant"),
        ({"policies": {ANT: 3}}, OptionValueError, "must be a callable"),
        ({"simulation": 3}, SimulationError, "is not a simulation"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_simulate_refuses_invalid_arguments(run, arguments, error, match):
    with pytest.raises(error, match=match):
        run(**{"simulation": calling(ANT), "policies": None, "points": ANT} | arguments)


@given(colony_designs, seeds)
@examples(40)
def test_simulate_runs_random_models_with_births_like_without_policies(design, seed):
    plain = AnsweredColony(design, seed)
    points = colony_points(overseen=bool(design.overseen))

    def policy(observation, info):
        return colony_policy(observation, seed)

    by_point = {f"{HERE}.Creature.act": policy} | (
        {Colony.oversee: policy} if design.overseen else {}
    )
    simulation = simulate(lambda: Colony(design), by_point, points=points, seed=seed)
    assert simulation.trace == plain.trace
    assert simulation.random.getstate() == plain.random.getstate()
    by_agent = {f"creature_{number}": policy for number in range(design.most)}
    by_agent |= {"overseer_0": policy} if design.overseen else {}
    assert simulate(lambda: Colony(design), by_agent, points=points, seed=seed).trace == plain.trace


@pytest.mark.parametrize(
    ("of_point", "of_agent", "expected"),
    [
        (lambda observation: 3, lambda observation: 5, [3, 5]),
        (RULE, lambda observation: 5, ["rule", 5]),
        (lambda observation: 3, RULE, [3, "rule"]),
    ],
    ids=["both", "rule of the point", "rule of the agent"],
)
def test_simulate_prefers_an_agents_policy_to_its_decision_points_policy(
    of_point, of_agent, expected
):
    source = script(
        lambda simulation: simulation.log.extend(Being(number).act() for number in (0, 1))
    )
    assert (
        simulate(source, {Being.act: of_point, "being_1": of_agent}, points=beings()).log
        == expected
    )
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    env = aec_env(calling(ant, bee), [ant, bee], policies={ant: of_point, "ant_0": of_agent})
    assert env.possible_agents == ["bee_0"]
    env.reset()
    env.step(1)
    assert env.simulation.log == [expected[1], 1]


@pytest.mark.parametrize("undeclared", ["error", "rule"])
@pytest.mark.parametrize("declared", [["being_0"], {Being.act: ["being_0"]}])
def test_simulate_accepts_possible_agents(declared, undeclared):
    def main(simulation):
        simulation.log = [Being(number).act() for number in (0, 1)]

    given = {"points": beings(), "possible_agents": declared, "undeclared": undeclared}
    assert simulate(script(main), {Being.act: lambda seen: 3}, **given).log == [3, 3]
    assert simulate(script(main), {"being_1": lambda seen: 3}, **given).log == ["rule", 3]


@pytest.mark.parametrize("workers", [0, 2])
def test_simulate_many_accepts_possible_agents(workers):
    def main(simulation):
        simulation.log = [Being(number).act() for number in (0, 1)]

    found = simulate_many(
        script(main),
        {Being.act: lambda seen: [4] * len(seen), "being_1": lambda seen: [3] * len(seen)},
        points=beings(),
        possible_agents={Being.act: ["being_0", "being_1"]},
        seeds=range(3),
        workers=workers,
    )
    assert [simulation.log for simulation in found] == [[4, 3]] * 3


@pytest.mark.parametrize("action", [1, RULE])
def test_simulate_keeps_no_entity_alive_after_its_decision(action):
    def main(simulation):
        for number in range(3):
            being = Being(number)
            being.act()
            watched = weakref.ref(being)
            del being
            simulation.log.append(watched() is None)

    points = beings(observation_space_mapping=lambda being: [0.0, 0.0])
    assert (
        simulate(script(main), {Being.act: lambda observation: action}, points=points).log
        == [True] * 3
    )
    many = simulate_many(
        script(main), {Being.act: lambda observations: [action] * 4}, points=points, seeds=range(4)
    )
    assert [simulation.log for simulation in many] == [[True] * 3] * 4
    points |= {Other.act: beings(agent="other_0", removed_by=())[Being.act]}
    env = aec_env(script(main), points, policies={Being.act: lambda observation: action})
    with pytest.raises(NoDecisionError, match="without a decision"):  # nobody else decides
        env.reset()
    assert env.simulation.log == [True] * 3


@BY_DRIVER
def test_simulate_passes_policies_the_simulation_of_their_own_episode(driver):
    asked = []

    def policy(observation, *, _simulation):
        asked.append(_simulation)
        return 0

    done = simulate(Duel, {LEFT: policy}, points=points(), seed=1, driver=driver)
    assert asked
    assert all(simulation is done for simulation in asked)


def test_simulate_error_note_counts_the_decisions_of_policies():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    policies = {"ant_0": lambda observation: 1, "bee_0": lambda observation: 2}
    with pytest.raises(ZeroDivisionError) as caught:
        simulate(calling(ant, bee, ant, lambda: 1 / 0), policies, points=[ant, bee], seed=1)
    assert "after decision 3, of 'ant_0'" in notes(caught.value)
