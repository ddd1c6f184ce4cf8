"""Policies back in the model: ``simulate``."""

import weakref

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings

from simenv_marl import RULE, TRUNCATED, aec_env, difference, simulate, simulate_many
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


def test_without_policies_it_is_the_plain_run():
    ant = decision(agent="ant_0")
    simulation = simulate(calling(ant, ant))
    assert simulation.log == ["rule", "rule"]
    simulation = simulate(calling(ant, ant), points=ant)
    assert simulation.log == ["rule", "rule"]
    simulation = simulate(calling(ant, ant), {}, points=[ant])
    assert simulation.log == ["rule", "rule"]


def test_policies_by_agent_and_by_point():
    ant, bee, cat = (decision(agent=f"{name}_0") for name in ("ant", "bee", "cat"))
    source = calling(ant, bee, cat, ant)
    policies = {"ant_0": lambda observation: 1, bee: lambda observation, info: 2}
    assert simulate(source, policies, points=[ant, bee, cat]).log == [1, 2, "rule", 1]
    assert simulate(source, policies | {"cat_0": RULE}, points=[ant, bee, cat]).log == [1, 2, "rule", 1]


def test_a_policy_names_its_point_by_itself():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    assert simulate(calling(ant, bee), {bee: lambda observation: 2}, points=ant).log == ["rule", 2]
    name = f"{Being.__module__}.Being.act"
    plain = vars(Being)["act"]
    source = script(lambda simulation: simulation.log.append(Being(3).act()))
    assert simulate(source, {name: lambda observation: 2}, points=beings()).log == [2]
    assert vars(Being)["act"] is plain


def test_policies_see_what_agents_see():
    seen = []

    def policy(observation, info):
        seen.append((observation.tolist(), info["action_mask"].tolist()))
        return 1

    ant = decision(
        agent="ant_0",
        observation_space=spaces.Box(0, 9, (1,), np.float32),
        observation_space_mapping=lambda: [len(seen)],
        action_mask_mapping=lambda: [0, 1] + [0] * 8,
    )
    assert simulate(calling(ant, ant), {ant: policy}).log == [1, 1]
    assert seen == [([0], [0, 1] + [0] * 8), ([1], [0, 1] + [0] * 8)]


def test_seeds():
    class Seeded:
        def reset(self, seed):
            self.seed = seed

        def run(self):
            pass

    assert simulate(Seeded, seed=7).seed == 7
    assert simulate(Seeded, seed=np.int64(7)).seed == 7
    drawn = {simulate(Seeded).seed for _ in range(5)}
    assert len(drawn) > 1
    assert all(type(seed) is int for seed in drawn)
    with pytest.raises(OptionValueError, match="seed must be a non-negative"):
        simulate(Seeded, seed=-1)


def test_what_is_simulated_is_returned():
    ant = decision(agent="ant_0")
    given_simulation = calling(ant)()
    simulation = simulate(given_simulation, {ant: lambda observation: 1})
    assert simulation is not given_simulation  # it is copied
    assert simulation.log == [1]
    assert not hasattr(given_simulation, "log")
    assert simulate(type("Simulation", (), {"reset": lambda self: None, "run": lambda self: TRUNCATED})) is not None


def test_simulations_of_their_own_points():
    ant = decision(agent="ant_0")

    class Own:
        points = (ant,)

        def reset(self):
            self.log = []

        def run(self):
            self.log.append(ant())

    assert simulate(Own).log == ["rule"]
    assert simulate(Own, {"ant_0": lambda observation: 3}).log == [3]


def test_errors_surface():
    ant = decision(agent="ant_0")
    with pytest.raises(InvalidActionError, match="is not in its action space") as caught:
        simulate(calling(ant), {ant: lambda observation: 10}, seed=13)
    assert "seed 13" in notes(caught.value)
    with pytest.raises(ZeroDivisionError):
        simulate(calling(ant), {ant: lambda observation: 1 // 0})
    with pytest.raises(ZeroDivisionError) as caught:
        simulate(script(lambda simulation: ant() // 0), {ant: lambda observation: 4}, seed=13)
    assert "seed 13" in notes(caught.value)
    broken = decision(agent="broken_0", observation_space_mapping=lambda: [1, 2, 3])
    with pytest.raises(ObservationError, match="its space Box"):
        simulate(calling(broken), {broken: lambda observation: 1})
    with pytest.raises(UnknownOptionError, match="there is no option"):
        simulate(calling(ant), {ant: lambda observation: 1}, speed=3)
    with pytest.raises(UnknownPointError, match="known are ant"):
        simulate(calling(ant), {"nobody": lambda observation: 1}, points=ant)
    with pytest.raises(OptionValueError, match="must be a callable"):
        simulate(calling(ant), {ant: 3})
    with pytest.raises(SimulationError, match="is not a simulation"):
        simulate(3)


def test_an_error_unwinds_and_puts_back_what_was_patched():
    ended, plain = [], vars(Being)["act"]

    def main(simulation):
        try:
            Being(0).act()
        finally:
            ended.append(True)

    with pytest.raises(ZeroDivisionError):
        simulate(script(main), {"being_0": lambda observation: 1 // 0}, points=beings())
    assert ended == [True]
    assert vars(Being)["act"] is plain


def test_one_name_at_two_points_is_an_error_here_too():
    definitions = beings() | others(agent=lambda other: f"being_{other.number}")

    def main(simulation):
        Being(0).act()
        Other(0).act()

    with pytest.raises(AgentError, match="has one decision point"):
        simulate(script(main), {"being_0": lambda observation: 1}, points=definitions)


def test_simulations_within_policies():
    """A policy may look ahead by a simulation of its own."""
    ant = decision(agent="ant_0")

    def policy(observation):
        return len(simulate(calling(ant, ant, ant), points=ant).log)

    assert simulate(calling(ant, ant), {ant: policy}).log == [3, 3]


def test_differences_in_what_policies_observe():
    levels = iter(range(0, 100, 7))
    ant = decision(
        agent="ant_0",
        observation_space=spaces.Box(-99, 99, (1,), np.float64),
        observation_space_mapping=difference(lambda: np.array([next(levels)])),
    )
    assert simulate(calling(ant, ant, ant), {ant: lambda observation: int(observation[0])}).log == [0, 7, 7]


def test_no_reward_is_asked_for():
    paid = []
    ant = decision(agent="ant_0", reward_mapping=lambda: paid.append(0) or 0.0)
    simulate(calling(ant, ant), {ant: lambda observation: 1})
    simulate_many(calling(ant, ant), {ant: lambda observations: [1] * 3}, seeds=range(3))
    assert paid == []


def test_it_is_the_run_of_the_environment_with_the_same_policies():
    ant = decision(agent="ant_0", observation_space_mapping=lambda: [1, 3])
    bee = decision(agent="bee_0")
    source = calling(ant, bee, bee, ant)
    policies = {"ant_0": lambda observation: int(observation[1]), "bee_0": lambda observation: 7}
    env = aec_env(source, [ant, bee])
    play(env, lambda agent, env: policies[agent](env.last()[0]))
    assert simulate(source, policies, points=[ant, bee]).log == env.simulation.log == [3, 7, 7, 3]


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
def test_some_by_their_policies_and_the_rest_by_their_rule(design, seed):
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


# -- who answers for whom -------------------------------------------------------------------------


def test_whoever_is_named_is_answered_by_what_is_named_for_it():
    """An agent's own policy comes before that of its point, and so before its point's rule."""

    def main(simulation):
        for number in (0, 1):
            simulation.log.append(Being(number).act())

    own = {"being_1": lambda observation: 5}
    assert simulate(script(main), {Being.act: lambda observation: 3} | own, points=beings()).log == [3, 5]
    assert simulate(script(main), {Being.act: RULE} | own, points=beings()).log == ["rule", 5]
    assert simulate(script(main), {Being.act: lambda observation: 3, "being_1": RULE}, points=beings()).log == [
        3,
        "rule",
    ]
    ant = decision(agent="ant_0")
    assert simulate(calling(ant), {ant: RULE, "ant_0": lambda observation: 5}, points=ant).log == [5]
    assert simulate(calling(ant), {ant: lambda observation: 3, "ant_0": RULE}, points=ant).log == ["rule"]


def test_agents_of_policies_are_no_agents_of_the_environment_whatever_else_is_named():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    policies = {ant: RULE, "ant_0": lambda observation: 5}
    env = aec_env(calling(ant, bee), [ant, bee], policies=policies)
    assert env.possible_agents == ["bee_0"]
    env.reset()
    env.step(1)
    assert env.simulation.log == [5, 1]


@pytest.mark.parametrize("key", [Being.act, f"{HERE}.Being.act", "being_0"])
def test_simulations_of_their_own_definitions(key):
    """Definitions that only the simulation itself knows are found, by whatever name a policy is given."""

    def make():
        simulation = script(lambda simulation: simulation.log.append(Being(0).act()))()
        simulation.points = beings()
        return simulation

    assert simulate(make, {key: lambda observation: 3}).log == [3]


@pytest.mark.parametrize("action", [1, RULE])
def test_policies_keep_nobody_alive(action):
    """What the model lets go of after a decision is gone at once."""

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
