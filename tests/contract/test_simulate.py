"""Policies back in the model: ``simulate``."""

import weakref

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings

from simenv_marl import RULE, aec_env, difference, simulate, simulate_many
from simenv_marl.errors import (
    AgentError,
    InvalidActionError,
    NoDecisionError,
    ObservationError,
    OptionValueError,
    SimulationError,
    UnknownOptionError,
    UnknownPointError,
)
from tests.worlds.many_worlds import (
    HERE,
    Answered,
    Being,
    Colony,
    Creature,
    Other,
    advised,
    beings,
    colony_points,
    designs,
    others,
    seeds,
)
from tests.worlds.models import calling, decision, decisions, notes, play, script


def test_without_policies_it_is_the_plain_run_of_a_copy():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    assert simulate(calling(ant, bee), {bee: lambda observation: 2}, points=ant).log == ["rule", 2]  # and lists it
    for arguments in ({}, {"points": ant}, {"policies": {}, "points": [ant]}):
        given_simulation = calling(ant, ant)()
        simulation = simulate(given_simulation, **arguments)
        assert simulation is not given_simulation
        assert simulation.log == ["rule", "rule"]
        assert not hasattr(given_simulation, "log")


@pytest.mark.parametrize("key", [Being.act, f"{HERE}.Being.act", "being_0"], ids=["function", "dotted", "agent"])
@pytest.mark.parametrize("own", [False, True], ids=["given", "own"])
def test_a_policy_names_points_and_agents_as_the_simulation_knows_them(key, own):
    def make():
        simulation = script(lambda simulation: simulation.log.append(Being(0).act()))()
        simulation.points = beings() if own else ()
        return simulation

    plain = vars(Being)["act"]
    points = None if own else beings()
    assert simulate(make, {key: lambda observation: 2}, points=points).log == [2]
    assert vars(Being)["act"] is plain
    with pytest.raises(ZeroDivisionError):
        simulate(make, {key: lambda observation: 1 // 0}, points=points)
    assert vars(Being)["act"] is plain


def test_policies_see_what_agents_see():
    seen, mask = [], [0, 1] + [0] * 8

    def policy(observation, info):
        seen.append((observation.tolist(), info["action_mask"].tolist()))
        return 1

    ant = decision(
        agent="ant_0",
        observation_space=spaces.Box(0, 9, (1,), np.float32),
        observation_space_mapping=difference(lambda: np.array([7 * len(seen)])),
        action_mask_mapping=lambda: mask,
    )
    assert simulate(calling(ant, ant), {ant: policy}).log == [1, 1]
    assert seen == [([0], mask), ([7], mask)]


def test_a_seed_is_handed_on_or_drawn():
    ant = decision(agent="ant_0")
    assert simulate(calling(ant), seed=7).seed == 7
    drawn = {simulate(calling(ant)).seed for _ in range(5)} | {simulate(calling(ant), seed=np.int64(7)).seed}
    assert len(drawn) > 2
    assert all(type(seed) is int for seed in drawn)


ANT, BROKEN = decision(agent="ant_0"), decision(agent="broken_0", observation_space_mapping=lambda: [1, 2, 3])


@pytest.mark.parametrize(
    ("source", "arguments", "error", "match"),
    [
        (calling(ANT), {"policies": {ANT: lambda observation: 10}}, InvalidActionError, "is not in its action space"),
        (calling(ANT), {"policies": {ANT: lambda observation: 1 // 0}}, ZeroDivisionError, "division"),
        (script(lambda simulation: ANT() // 0), {"policies": {ANT: lambda observation: 4}}, ZeroDivisionError, "div"),
        (calling(BROKEN), {"policies": {BROKEN: lambda observation: 1}}, ObservationError, "its space Box"),
    ],
    ids=["action", "policy", "model", "observation"],
)
def test_errors_tell_the_seed(source, arguments, error, match):
    with pytest.raises(error, match=match) as caught:
        simulate(source, seed=13, **arguments)
    assert "seed 13" in notes(caught.value)


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"speed": 3}, UnknownOptionError, "there is no option"),
        ({"policies": {"nobody": lambda observation: 1}}, UnknownPointError, "known are ant"),
        ({"policies": {ANT: 3}}, OptionValueError, "must be a callable"),
        ({"simulation": 3}, SimulationError, "is not a simulation"),
        ({"seed": -1}, OptionValueError, "seed must be a non-negative"),
    ],
    ids=["option", "policy of nobody", "no policy", "no simulation", "seed"],
)
def test_arguments_that_cannot_be(arguments, error, match):
    with pytest.raises(error, match=match):
        simulate(**{"simulation": calling(ANT), "points": ANT} | arguments)


def test_one_name_at_two_points_is_an_error():
    points = beings() | others(agent=lambda other: f"being_{other.number}")
    with pytest.raises(AgentError, match="has one decision point"):
        simulate(script(lambda s: (Being(0).act(), Other(0).act())), {"being_0": lambda seen: 1}, points=points)


def test_policies_may_look_ahead_by_simulations_of_their_own():
    ant = decision(agent="ant_0")
    policy = lambda observation: len(simulate(calling(ant, ant, ant), points=ant).log)  # noqa: E731
    assert simulate(calling(ant, ant), {ant: policy}).log == [3, 3]


def test_no_reward_is_asked_for():
    paid = []
    ant = decision(agent="ant_0", reward_mapping=lambda: paid.append(0) or 0.0)
    simulate(calling(ant, ant), {ant: lambda observation: 1})
    simulate_many(calling(ant, ant), {ant: lambda observations: [1] * 3}, seeds=range(3))
    assert paid == []


@given(designs, seeds)
@settings(max_examples=40)
def test_a_colony_is_what_it_would_be_without_the_library(design, seed):
    plain = Answered(design, seed)
    points = colony_points(overseen=bool(design.overseen))

    def policy(observation, info):
        return advised(observation, seed)

    by_point = {f"{HERE}.Creature.act": policy} | ({Colony.oversee: policy} if design.overseen else {})
    simulation = simulate(lambda: Colony(design), by_point, points=points, seed=seed)
    assert simulation.trace == plain.trace
    assert simulation.random.getstate() == plain.random.getstate()
    by_agent = {f"creature_{number}": policy for number in range(design.most)}
    by_agent |= {"overseer_0": policy} if design.overseen else {}
    assert simulate(lambda: Colony(design), by_agent, points=points, seed=seed).trace == plain.trace


@given(designs, seeds)
@settings(max_examples=20)
def test_some_agents_decide_by_their_policies_and_the_rest_by_their_rule(design, seed):
    chosen = {"creature_0", "creature_2"}
    plain = Answered(design, seed, lambda seed, agent, number: 3 if agent in chosen else RULE)
    points = {Creature.act: colony_points(overseen=False)[Creature.act]}
    policies = dict.fromkeys(chosen, lambda observation: 3)
    assert simulate(lambda: Colony(design), policies, points=points, seed=seed).trace == plain.trace
    env = aec_env(lambda: Colony(design), points)
    if any(decided.startswith("creature") for decided in plain.decisions):
        turns = play(env, lambda agent, env: 3 if agent in chosen else RULE, seed=seed)
        assert env.simulation.trace == plain.trace
        assert decisions(turns) == [agent for agent in plain.decisions if agent != "overseer_0"]


@pytest.mark.parametrize(
    ("of_point", "of_agent", "expected"),
    [
        (lambda observation: 3, lambda observation: 5, [3, 5]),
        (RULE, lambda observation: 5, ["rule", 5]),
        (lambda observation: 3, RULE, [3, "rule"]),
    ],
    ids=["both", "rule of the point", "rule of the agent"],
)
def test_an_agents_own_policy_comes_before_that_of_its_point(of_point, of_agent, expected):
    source = script(lambda simulation: simulation.log.extend(Being(number).act() for number in (0, 1)))
    assert simulate(source, {Being.act: of_point, "being_1": of_agent}, points=beings()).log == expected
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    policies = {ant: of_point, "ant_0": of_agent}
    assert simulate(calling(ant), policies, points=ant).log == expected[1:]
    env = aec_env(calling(ant, bee), [ant, bee], policies=policies)
    assert env.possible_agents == ["bee_0"]
    env.reset()
    env.step(1)
    assert env.simulation.log == [expected[1], 1]


@pytest.mark.parametrize("action", [1, RULE])
def test_policies_keep_nobody_alive(action):
    def main(simulation):
        for number in range(3):
            being = Being(number)
            being.act()
            watched = weakref.ref(being)
            del being
            simulation.log.append(watched() is None)

    points = beings(observation_space_mapping=lambda being: [0.0, 0.0])
    assert simulate(script(main), {Being.act: lambda observation: action}, points=points).log == [True] * 3
    many = simulate_many(script(main), {Being.act: lambda observations: [action] * 4}, points=points, seeds=range(4))
    assert [simulation.log for simulation in many] == [[True] * 3] * 4
    points |= {Other.act: beings(agent="other_0", removed_by=())[Being.act]}
    env = aec_env(script(main), points, policies={Being.act: lambda observation: action})
    with pytest.raises(NoDecisionError, match="without a decision"):  # nobody else decides
        env.reset()
    assert env.simulation.log == [True] * 3
