"""Agents that are entities: their names, rosters, births and deaths, in the AEC view."""

import gc
import warnings
import weakref
from collections import Counter

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from pettingzoo.test import api_test, seed_test

from simenv_marl import (
    RULE,
    TRUNCATED,
    SimEnvError,
    aec_env,
    difference,
    joint_env,
    parallel_env,
    single_env,
)
from simenv_marl.errors import (
    AgentError,
    DefinitionError,
    EpisodeOverError,
    NoDecisionError,
    OptionValueError,
    UnknownAgentError,
    UnknownPointError,
)
from tests.worlds.many_worlds import (
    HERE,
    NAMES_OF_THE_VILLAGE,
    AnnouncedHunt,
    Announcing,
    Answered,
    Being,
    Colony,
    Hunt,
    Other,
    Played,
    Village,
    advised,
    answer,
    banish,
    being_of,
    beings,
    colony,
    colony_points,
    designs,
    hunters,
    others,
    seeds,
)
from tests.worlds.models import decision, decisions, define, follow_the_rule, notes, play, script


class Knowing:
    """A simulation that knows which calls are to come."""

    def __init__(self, main, *, announced):
        self.main, self.announced, self.asked = main, announced, []

    def reset(self, seed=None):
        self.log, self.beings = [], [Being(number) for number in range(4)]

    def run(self):
        return self.main(self)

    def expected_calls(self, point):
        self.asked.append(point)
        return [(self.beings[number],) for number in self.announced]


def knowing(main, *announced):
    return lambda: Knowing(main, announced=announced)


def living(*numbers, ends=None):
    """A factory of simulations in which those beings decide, one after the other."""

    def main(simulation):
        simulation.beings = {number: Being(number) for number in numbers}
        for number in numbers:
            simulation.log.append(simulation.beings[number].act())
        return ends

    return script(main)


def leaving(*others, before=lambda being: None):
    """A factory of simulations in which a being decides and goes; then others decide."""

    def main(simulation):
        simulation.beings = [Being(0), *(Being(number) for number in others)]
        first, *following = simulation.beings
        first.act()
        before(first)
        first.leave()
        for being in following:
            being.act()

    return script(main)


# -- names ----------------------------------------------------------------------------------------


def test_an_agent_for_each_entity_joins_when_it_first_decides():
    env = aec_env(living(2, 0, 2), beings(removed_by=()))
    env.reset()
    assert env.agents == ["being_2"]
    env.step(1)
    assert env.agents == ["being_2", "being_0"]
    assert set(env.rewards) == set(env.terminations) == set(env.truncations) == set(env.infos) == set(env.agents)
    assert decisions(play(env, 1)) == ["being_2", "being_0", "being_2"]


def test_without_a_roster_there_are_no_possible_agents():
    env = aec_env(living(0), beings())
    assert not hasattr(env, "possible_agents")
    env.reset()
    assert not hasattr(env, "possible_agents")
    with pytest.raises(AttributeError):
        _ = env.max_num_agents


@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_spaces_of_all_possible_agents(make):
    """Some learners ask for all at once, as the attributes of PettingZoo's base classes have it."""
    env = make(living(0, 1), beings(), possible_agents=["being_0", "being_1"])
    assert list(env.observation_spaces) == list(env.action_spaces) == env.possible_agents
    for agent in env.possible_agents:
        assert env.observation_spaces[agent] is env.observation_space(agent)
        assert env.action_spaces[agent] is env.action_space(agent)
    without = make(living(0, 1), beings())
    assert not hasattr(without, "observation_spaces")
    assert not hasattr(without, "action_spaces")


def test_nobody_is_named_and_the_rule_decides():
    env = aec_env(living(0, 1, 2), beings(agent=lambda being: None if being.number == 1 else being_of(being)))
    assert decisions(play(env, 7)) == ["being_0", "being_2"]
    assert env.simulation.log == [7, "rule", 7]


@pytest.mark.parametrize("name", [0, 1.5, b"being", ("being", 0), ["being_0"], True])
def test_what_is_no_name_is_an_error_that_ends_the_episode(name):
    env = aec_env(living(0, 1), beings(agent=lambda being: name if being.number else "being_0"))
    env.reset()
    with pytest.raises(AgentError, match=r"Being\.act"):
        env.step(1)
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step(1)
    env.reset()
    assert env.agent_selection == "being_0"


def test_an_empty_name_is_a_name_or_refused_but_never_silently_the_rule():
    env = aec_env(living(0), beings(agent=lambda being: ""))
    try:
        env.reset()
    except SimEnvError:
        return
    assert env.agents == [""]


def test_one_name_at_two_points_is_an_error():
    def main(simulation):
        Being(0).act()
        Other(0).act()

    env = aec_env(script(main), beings() | others(agent=lambda other: f"being_{other.number}"))
    env.reset()
    with pytest.raises(AgentError, match=r"being_0.*Being\.act.*Other\.act"):
        env.step(1)
    assert env.agents == []


def test_an_entity_is_not_told_from_another_of_the_same_name():
    """The name is the agent: a model may replace the object behind it."""

    def main(simulation):
        for health in range(3):
            being = Being(0)
            being.health = health
            being.act()

    turns = play(aec_env(script(main), beings()), 1)
    assert [(turn.agent, turn.observation[1]) for turn in turns][:3] == [("being_0", 0), ("being_0", 1), ("being_0", 2)]
    assert len({turn.agent for turn in turns}) == 1


def test_spaces_of_those_who_join_late():
    env = aec_env(living(0, 1), beings())
    env.reset(seed=3)
    with pytest.raises(UnknownAgentError, match="there is no agent"):
        env.action_space("being_1")
    with pytest.raises(LookupError, match="there is no agent"):
        env.observation_space("nobody")
    env.step(1)
    space = env.action_space("being_1")
    assert space is env.action_space("being_1")
    assert env.observation_space("being_1") is env.observation_space("being_1")
    assert space is not env.action_space("being_0")
    drawn = [space.sample() for _ in range(20)]
    env.reset(seed=3)
    env.step(1)
    assert [env.action_space("being_1").sample() for _ in range(20)] == drawn
    assert [env.action_space("being_0").sample() for _ in range(20)] != drawn


# -- rosters --------------------------------------------------------------------------------------


NAMES = ["being_0", "being_1", "being_2"]


def test_declared_agents_are_there_from_the_start():
    env = aec_env(living(2, 0), beings(), possible_agents=NAMES)
    assert env.possible_agents == NAMES
    assert env.max_num_agents == 3
    assert env.observation_space("being_1") is env.observation_space("being_1")
    env.reset(seed=1)
    assert sorted(env.agents) == NAMES
    assert env.agent_selection == "being_2"
    assert env.observe("being_1").tolist() == [0, 0]
    assert set(env.rewards) == set(env.infos) == set(NAMES)
    turns = play(env, 1)
    assert decisions(turns) == ["being_2", "being_0"]
    ends = [turn for turn in turns if turn.terminated]
    assert sorted(turn.agent for turn in ends) == NAMES
    assert next(turn for turn in ends if turn.agent == "being_1").reward == 0.0
    assert env.possible_agents == NAMES


def test_what_is_not_known_is_zero_clipped_into_the_space():
    space = spaces.Dict(
        {
            "box": spaces.Box(np.array([1, -5], np.float32), np.array([2, -3], np.float32)),
            "number": spaces.Discrete(3, start=4),
            "bits": spaces.MultiBinary(2),
            "pair": spaces.Tuple((spaces.MultiDiscrete([3, 3], start=[1, 0]), spaces.Box(0, 255, (1,), np.uint8))),
        }
    )
    told = {"box": [1, -3], "number": 4, "bits": [0, 1], "pair": ([1, 0], [7])}
    env = aec_env(
        living(0),
        beings(observation_space=space, observation_space_mapping=lambda being: told),
        possible_agents=NAMES[:2],
    )
    env.reset()
    blank = env.observe("being_1")
    assert blank in space
    assert blank["box"].tolist() == [1, -3]
    assert blank["number"] == 4
    assert blank["pair"][0].tolist() == [1, 0]
    assert env.observe("being_1")["box"] is not blank["box"]


def test_a_roster_by_point():
    def main(simulation):
        Other(0).act()
        Being(1).act()

    rosters = {Being.act: ["being_1", "being_0"], f"{HERE}.Other.act": ("other_0",)}
    env = aec_env(script(main), beings() | others(), possible_agents=rosters)
    assert sorted(env.possible_agents) == ["being_0", "being_1", "other_0"]
    assert decisions(play(env, 1)) == ["other_0", "being_1"]


def test_a_roster_beside_agents_with_names_of_their_own():
    clerk = decision()

    def main(simulation):
        Being(1).act()
        clerk()

    points = {clerk: define(agent="clerk_0"), **beings()}
    env = aec_env(script(main), points, possible_agents=["being_0", "being_1"])
    assert sorted(env.possible_agents) == ["being_0", "being_1", "clerk_0"]
    assert decisions(play(env, 1)) == ["being_1", "clerk_0"]


def test_a_list_is_not_enough_for_two_points():
    with pytest.raises(OptionValueError, match="possible_agents must be a dict"):
        aec_env(living(0), beings() | others(), possible_agents=["being_0", "other_0"])


@pytest.mark.parametrize(
    ("roster", "error"),
    [
        (["being_0", "being_0"], AgentError),
        ([0], AgentError),
        ("being_0", SimEnvError),
        ({Other.act: ["other_0"]}, OptionValueError),
        ({f"{HERE}.Being.leave": ["being_0"]}, OptionValueError),
    ],
)
def test_rosters_that_cannot_be(roster, error):
    with pytest.raises(error):
        aec_env(living(0), beings(), possible_agents=roster)


def test_an_undeclared_agent_is_an_error_that_ends_the_episode():
    env = aec_env(living(0, 5, 0), beings(), possible_agents=NAMES)
    env.reset()
    with pytest.raises(AgentError, match=r"being_5.*possible_agents"):
        env.step(1)
    assert env.agents == []
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step(1)
    env.reset()
    assert sorted(env.agents) == NAMES


def test_an_undeclared_agent_may_follow_its_rule():
    env = aec_env(living(5, 0, 5, 1), beings(), possible_agents=NAMES, undeclared="rule")
    turns = play(env, 7)
    assert decisions(turns) == ["being_0", "being_1"]
    assert {turn.agent for turn in turns} == set(NAMES)
    assert env.simulation.log == ["rule", 7, "rule", 7]


def test_undeclared_is_error_or_rule():
    with pytest.raises(OptionValueError, match="undeclared"):
        aec_env(living(0), beings(), possible_agents=NAMES, undeclared="ignore")


def test_nobody_who_is_declared_decides():
    env = aec_env(living(5), beings(), possible_agents=NAMES, undeclared="rule")
    with pytest.raises(NoDecisionError, match="without a decision"):
        env.reset()


def test_a_policy_answers_for_one_entity():
    observed = []

    def policy(observation, info):
        observed.append(observation.tolist())
        return 3

    env = aec_env(living(0, 1, 0), beings(), policies={"being_0": policy})
    turns = play(env, 7)
    assert {turn.agent for turn in turns} == {"being_1"}
    assert env.simulation.log == [3, 7, 3]
    assert observed == [[0, 0], [0, 0]]


def test_a_policy_answers_for_one_of_a_roster():
    env = aec_env(living(0, 1), beings(), possible_agents=NAMES[:2], policies={"being_0": lambda observation: 3})
    assert env.possible_agents == ["being_1"]
    assert {turn.agent for turn in play(env, 7)} == {"being_1"}
    assert env.simulation.log == [3, 7]


# -- who is expected ------------------------------------------------------------------------------


def act_in_order(simulation):
    for being in simulation.beings:
        being.health += 1
        simulation.log.append(being.act())


def test_announced_agents_join_and_are_observed_before_their_first_decision():
    env = aec_env(knowing(act_in_order, 1, 2), beings())
    env.reset()
    assert env.simulation.asked
    assert set(env.simulation.asked) == {f"{HERE}.Being.act"}
    assert env.agents == ["being_0", "being_1", "being_2"]
    assert env.observe("being_1").tolist() == [1, 0]
    assert env.agent_selection == "being_0"
    turns = play(env, 1)
    assert decisions(turns) == ["being_0", "being_1", "being_2", "being_3"]
    assert [turn.agent for turn in turns if turn.terminated] == ["being_0", "being_1", "being_2", "being_3"]


def test_to_be_announced_asks_for_no_reward():
    paid = []
    definition = beings(reward_mapping=lambda being: paid.append(being.number) or 0.0)
    env = aec_env(knowing(act_in_order, 0, 1, 2), definition)
    env.reset()
    assert paid == [0]
    env.step(1)
    assert paid == [0, 1]


def test_the_decision_of_one_who_was_announced_is_observed_anew():
    env = aec_env(knowing(act_in_order, 1), beings())
    env.reset()
    env.step(1)
    assert env.last()[0].tolist() == [1, 1]


def test_who_is_announced_twice_or_decides_already_joins_once():
    env = aec_env(knowing(act_in_order, 0, 1, 1, 0), beings())
    env.reset()
    assert env.agents == ["being_0", "being_1"]
    assert env.last()[0].tolist() == [0, 1]


def test_nobody_may_be_announced():
    env = aec_env(knowing(act_in_order), beings())
    env.reset()
    assert env.agents == ["being_0"]


def test_an_announced_agent_that_never_decides_ends_with_the_episode():
    def main(simulation):
        simulation.beings[0].act()

    turns = play(aec_env(knowing(main, 0, 3), beings()), 1)
    assert [(turn.agent, turn.terminated, turn.reward) for turn in turns] == [
        ("being_0", False, 0.0),
        ("being_0", True, 0.0),
        ("being_3", True, 0.0),
    ]


def test_to_announce_an_undeclared_agent_is_to_let_it_decide():
    with pytest.raises(AgentError, match="is not declared"):
        aec_env(knowing(act_in_order, 0, 3), beings(), possible_agents=NAMES).reset()
    env = aec_env(knowing(act_in_order, 0, 3), beings(), possible_agents=NAMES, undeclared="rule")
    assert {turn.agent for turn in play(env, 1)} == set(NAMES)
    assert env.simulation.log == [1, 1, 1, "rule"]


def test_who_is_nobodys_agent_may_be_announced():
    definition = beings(agent=lambda being: None if being.number == 1 else being_of(being))
    env = aec_env(knowing(act_in_order, 0, 1, 2), definition)
    env.reset()
    assert env.agents == ["being_0", "being_2"]


def test_agents_of_policies_may_be_announced():
    env = aec_env(knowing(act_in_order, 0, 1, 2), beings(), policies={"being_1": lambda observation: 5})
    assert {turn.agent for turn in play(env, 1)} == {"being_0", "being_2", "being_3"}
    assert env.simulation.log == [1, 5, 1, 1]


def test_points_with_an_agent_of_their_own_may_be_announced():
    clerk = define(agent="clerk_0", observation_space_mapping=lambda number: [number, 0], reward_mapping=lambda n: 0.0)

    @clerk
    def work(number):
        return number

    class Office:
        def reset(self):
            pass

        def run(self):
            Being(0).act()
            work(4)

        def expected_calls(self, point):
            return [(7,)] if point.endswith("work") else []

    env = aec_env(Office, {work: clerk, **beings()})
    env.reset()
    assert env.observe("clerk_0").tolist() == [7, 0]
    env.step(1)
    assert env.last()[0].tolist() == [4, 0]


def test_decision_functions_that_are_called_to_foresee_run_their_rule():
    class Seer(Knowing):
        def expected_calls(self, point):
            self.log.append(self.beings[3].act())
            return [(self.beings[1],)]

    env = aec_env(lambda: Seer(act_in_order, announced=()), beings())
    env.reset()
    assert set(env.simulation.log) == {"rule"}
    assert env.agents == ["being_0", "being_1"]


def test_an_error_in_foreseeing_surfaces():
    class Blind(Knowing):
        def expected_calls(self, point):
            raise ZeroDivisionError

    env = aec_env(lambda: Blind(act_in_order, announced=()), beings())
    with pytest.raises(ZeroDivisionError):
        env.reset()
    assert env.agents == []


# -- deaths ---------------------------------------------------------------------------------------


def test_a_removed_agent_is_rewarded_and_observed_while_it_is_whole():
    def main(simulation):
        first, second = simulation.beings = Being(0), Being(1)
        first.act()
        second.act()
        first.health = 5
        first.leave()
        simulation.log.append(first.whole)
        second.act()

    env = aec_env(script(main), beings())
    env.reset()
    env.step(1)
    env.step(1)
    assert env.simulation.log == [False]
    assert env.agent_selection == "being_0"
    assert env.rewards == {"being_0": 5.0, "being_1": 0.0}
    observation, reward, terminated, truncated, info = env.last()
    assert (observation.tolist(), reward, terminated, truncated, info) == ([0, 5], 5.0, True, False, {})
    assert type(reward) is float
    assert type(terminated) is type(truncated) is bool
    env.step(None)
    assert env.agents == ["being_1"]
    assert env.agent_selection == "being_1"
    assert env.last()[1:4] == (0.0, False, False)
    env.step(1)
    assert [turn.agent for turn in play(env, reset=False)] == ["being_1"]


def test_an_agent_ends_once():
    calls = []

    def main(simulation):
        one = Being(0)
        one.act()
        one.leave()
        one.whole = True
        one.leave()
        simulation.being = Being(1)
        simulation.being.act()

    env = aec_env(script(main), beings(reward_mapping=lambda being: calls.append(being.number) or 1.0))
    turns = play(env, 1)
    assert [(turn.agent, turn.terminated) for turn in turns] == [
        ("being_0", False),
        ("being_0", True),
        ("being_1", False),
        ("being_1", True),
    ]
    assert calls == [0, 0, 1, 1]


@pytest.mark.parametrize("action", [3, RULE])
def test_removed_in_mid_decision(action):
    """By ``apply`` or by the rule: the decision of the agent that ends is still carried out."""

    def apply(action, being):
        being.health = 10 * action
        being.leave()
        return "applied"

    class Mortal(Being):
        def act(self):
            self.health = 30
            self.leave()
            return "rule"

    def main(simulation):
        simulation.log.append(Mortal(0).act())
        simulation.log.append(Mortal(1).act())

    definition = beings(apply=apply)[Being.act]
    env = aec_env(script(main), {Mortal.act: definition})
    env.reset()
    env.step(action)
    assert env.simulation.log == ["rule" if action is RULE else "applied"]
    assert env.agent_selection == "being_0"
    observation, reward, terminated, *_ = env.last()
    assert (observation.tolist(), reward, terminated) == ([0, 30], 30.0, True)
    env.step(None)
    assert env.agent_selection == "being_1"


def test_several_are_removed_at_once():
    def main(simulation):
        crowd = [Being(number) for number in range(5)]
        for being in crowd:
            being.health = being.number
            being.act()
        for number in (3, 0, 2):
            crowd[number].leave()
        crowd[1].act()
        crowd[4].leave()
        crowd[1].leave()

    env = aec_env(script(main), beings())
    turns = play(env, 1)
    assert [turn.agent for turn in turns] == [
        *(f"being_{number}" for number in range(5)),
        "being_3",
        "being_0",
        "being_2",
        "being_1",
        "being_4",
        "being_1",
    ]
    ends = {turn.agent: (turn.reward, turn.terminated) for turn in turns if turn.terminated}
    assert ends == {f"being_{number}": (float(number), True) for number in range(5)}


def test_rewards_are_those_of_the_latest_step():
    """Every reward stands in ``rewards`` for one step, and in what ``last`` says until the agent's next step."""

    def main(simulation):
        one, two, three = simulation.beings = [Being(number) for number in range(3)]
        for being in (one, two, three):
            being.health = 10 + being.number
            being.act()
        one.leave()
        two.leave()
        three.act()

    env = aec_env(script(main), beings())
    env.reset()
    env.step(1)
    env.step(1)
    assert set(env.rewards.values()) == {0.0}
    env.step(1)
    assert env.rewards == {"being_0": 10.0, "being_1": 11.0, "being_2": 12.0}
    env.step(None)
    assert env.rewards == {"being_1": 0.0, "being_2": 0.0}
    assert env.last()[1] == 11.0
    env.step(None)
    assert env.last()[1] == 12.0
    env.step(1)
    assert env.rewards == {"being_2": 12.0}
    env.step(None)
    assert env.agents == []


def test_who_was_declared_and_is_removed_before_it_decides():
    def main(simulation):
        Being(0).act()
        Being(2).leave()
        Being(1).act()

    env = aec_env(script(main), beings(), possible_agents=NAMES)
    turns = play(env, 1)
    assert [(turn.agent, turn.terminated) for turn in turns] == [
        ("being_0", False),
        ("being_2", True),
        ("being_1", False),
        ("being_0", True),
        ("being_1", True),
    ]
    assert turns[1].reward == 0.0
    assert turns[1].observation.tolist() == [0, 0]


def test_who_was_announced_and_is_removed_before_it_decides():
    def main(simulation):
        zero, one, two, _ = simulation.beings
        zero.act()
        two.health = 8
        two.leave()
        one.act()

    turns = play(aec_env(knowing(main, 1, 2), beings()), 1)
    assert [turn.agent for turn in turns] == ["being_0", "being_2", "being_1", "being_0", "being_1"]
    assert (turns[1].reward, turns[1].observation.tolist()) == (0.0, [2, 8])


def test_who_is_removed_before_the_first_decision():
    def main(simulation):
        Being(1).leave()
        Being(0).act()

    env = aec_env(script(main), beings(), possible_agents=NAMES[:2])
    env.reset()
    assert not any(env.truncations.values())
    turns = play(env, 1)
    assert decisions(turns) == ["being_0"]
    ended = [turn.agent for turn in turns if turn.terminated]
    assert ended in (["being_1", "being_0"], ["being_0"])


def test_who_was_never_an_agent_may_be_removed():
    def main(simulation):
        Being(0).act()
        Being(9).leave()
        Other(0).leave()
        Being(0).act()

    turns = play(aec_env(script(main), beings()), 1)
    assert [turn.agent for turn in turns] == ["being_0"] * 3


@pytest.mark.parametrize("roster", [None, NAMES])
def test_a_revived_agent_is_an_error_that_ends_the_episode(roster):
    def main(simulation):
        one = Being(0)
        one.act()
        one.leave()
        one.whole = True
        one.act()
        simulation.log.append("decided")

    env = aec_env(script(main), beings(), possible_agents=roster)
    env.reset()
    with pytest.raises(AgentError, match=r"being_0.*after its end"):
        env.step(1)
    assert env.simulation.log == []
    assert env.agents == []
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step(1)
    env.reset()
    assert env.agent_selection == "being_0"


def test_a_namesake_of_a_removed_agent_is_an_error_too():
    env = aec_env(leaving(1, 0), beings())
    env.reset()
    env.step(1)
    env.step(None)
    with pytest.raises(AgentError, match="after its end"):
        env.step(1)


def test_an_end_does_not_outlast_its_episode():
    env = aec_env(leaving(1), beings())
    assert [turn.agent for turn in play(env, 1)] == [turn.agent for turn in play(env, 1)]


def test_all_are_removed_and_the_simulation_goes_on():
    def main(simulation):
        for number in range(2):
            being = Being(number)
            being.act()
            being.leave()
        simulation.log.append("on and on")

    turns = play(env := aec_env(script(main), beings()), 1)
    assert [turn.agent for turn in turns] == ["being_0", "being_0", "being_1", "being_1"]
    assert env.simulation.log == ["on and on"]
    assert env.agents == []


def test_the_ends_of_the_removed_and_of_the_others_are_told_apart():
    def main(simulation):
        first, second = Being(0), Being(1)
        first.act()
        second.act()
        first.leave()
        return TRUNCATED

    turns = play(aec_env(script(main), beings()), 1)
    assert {turn.agent: (turn.terminated, turn.truncated) for turn in turns[2:]} == {
        "being_0": (True, False),
        "being_1": (False, True),
    }


def test_a_removal_in_the_last_step():
    def main(simulation):
        first, second = Being(0), Being(1)
        first.act()
        second.act()
        first.leave()
        Being(2).act()
        simulation.log.append("too far")

    env = aec_env(script(main), beings(), max_steps=2)
    turns = play(env, 1)
    assert {turn.agent: (turn.terminated, turn.truncated) for turn in turns[2:]} == {
        "being_0": (True, False),
        "being_1": (False, True),
        "being_2": (False, True),
    }
    assert len(turns) == 5
    assert env.simulation.log == []


@pytest.mark.parametrize(
    "removed_by",
    [
        f"{HERE}.banish",
        [f"{HERE}.Being.leave", f"{HERE}.banish"],
        {f"{HERE}.Being.leave": None, f"{HERE}.banish": None},
    ],
)
def test_a_bare_name_means_the_agent_of_its_first_argument(removed_by):
    def main(simulation):
        one = Being(0)
        one.act()
        banish("nowhere", one)  # its first argument is no being
        one.whole = True
        one.act()

    turns = play(aec_env(script(main), beings(removed_by=removed_by)), 1)
    assert [turn.agent for turn in turns] == ["being_0"] * 3


@pytest.mark.parametrize("view", [aec_env, parallel_env, single_env])
def test_several_entities_under_one_name_are_warned_of_once(view):
    """Nothing was said of agents, and so they are taken to be one, whose rewards and differences mix."""

    def main(simulation):
        for being in simulation.crowd * 2:
            being.act()

    class Model:
        def reset(self):
            self.crowd = [Being(number) for number in range(size)]

        def run(self):
            main(self)

    def play_through(env):
        env.reset()
        if view is aec_env:
            play(env, 1)
        elif view is single_env:
            while not env.step(1)[2]:
                pass
        else:
            while env.agents:
                env.step(dict.fromkeys(env.agents, 1))

    size = 1
    env = view(Model, {Being.act: define()})
    play_through(env)
    play_through(env)  # another one in each episode is the one of that episode
    size = 2
    with pytest.warns(UserWarning, match=r"several objects decide at .*Being\.act as one agent, 'act_0'.*agent="):
        play_through(env)
    play_through(env)
    play_through(view(Model, {Being.act: define(agent="all_of_them")}))


class Bound:
    """A being that cannot be referred to weakly."""

    __slots__ = ("health", "hunt", "number", "whole")

    def __init__(self, number):
        self.number, self.health, self.whole, self.hunt = number, 0, True, None

    def act(self):
        return "rule"

    def leave(self):
        self.whole = False


@pytest.mark.parametrize("kind", [Being, Bound])
def test_a_bare_name_means_who_the_entity_was_where_it_is_named_no_more(kind):
    def main(simulation):
        crowd = [kind(number) for number in range(4)]
        for being in crowd[:3]:
            being.act()
        for being in (crowd[1], crowd[3], crowd[1]):  # one was never met, and one has gone already
            being.whole = False
            being.leave()
        crowd[2].number = 7
        crowd[2].act()
        crowd[2].whole = False
        crowd[2].leave()
        crowd[0].act()

    points = {
        kind.act: define(
            agent=lambda being: f"being_{being.number}" if being.whole else None,
            removed_by=f"{__name__}.Bound.leave" if kind is Bound else f"{HERE}.Being.leave",
        )
    }
    turns = play(aec_env(script(main), points), 1)
    ends = [turn.agent for turn in turns if turn.terminated]
    assert ends[:2] == ["being_1", "being_7"]
    assert [turn.agent for turn in turns if not turn.terminated][-1] == "being_0"
    env = parallel_env(script(main), points)
    env.reset()
    gone = []
    while env.agents:
        *_, terminations, _, _ = env.step(dict.fromkeys(env.agents, 1))
        gone += [agent for agent, over in terminations.items() if over]
    assert gone[:2] == ["being_1", "being_7"]
    assert sorted(gone) == ["being_0", "being_1", "being_2", "being_7"]


def test_a_bare_name_that_can_never_mean_an_agent_is_warned_of():
    """A method of something else is called on that, and not on an entity."""
    with pytest.warns(UserWarning, match=r"leave.*not on a Being.*ends no agent.*callable"):
        env = aec_env(script(lambda simulation: Being(0).act()), beings(removed_by=f"{HERE}.Other.leave"))
    assert len(play(env, 1)) == 2


def test_a_callable_names_who_is_removed():
    def main(simulation):
        crowd = [Being(number) for number in range(3)]
        for being in crowd:
            being.act()
        banish("the woods", crowd[1])
        banish("nowhere", crowd[2])
        banish(place="the woods", being=crowd[0])
        crowd[2].whole = True
        crowd[2].act()

    removed_by = {f"{HERE}.banish": lambda place, being: being_of(being) if place == "the woods" else None}
    turns = play(aec_env(script(main), beings(removed_by=removed_by)), 1)
    assert [turn.agent for turn in turns if turn.terminated] == ["being_1", "being_0", "being_2"]
    assert decisions(turns)[-1] == "being_2"


def test_several_functions_remove():
    def main(simulation):
        crowd = [Being(number) for number in range(3)]
        for being in crowd:
            being.act()
        banish("the woods", crowd[1])
        crowd[0].leave()
        crowd[2].act()

    removed_by = {f"{HERE}.Being.leave": None, f"{HERE}.banish": lambda place, being: being_of(being)}
    turns = play(aec_env(script(main), beings(removed_by=removed_by)), 1)
    assert [turn.agent for turn in turns[3:]] == ["being_1", "being_0", "being_2", "being_2"]


class Leaver:
    def __init__(self, number):
        self.number = number

    def go(self):
        return "rule"

    def come(self):
        return "rule"

    def leave(self):
        pass


class Young(Leaver):
    pass


class Old(Leaver):
    pass


def test_the_last_observation_is_of_the_last_arguments():
    class Walker:
        def walk(self, place):
            return "rule"

    def main(simulation):
        simulation.walker = Walker()
        simulation.walker.walk(1)
        simulation.walker.walk(2)

    point = define(agent=lambda walker, place: "walker_0", observation_space_mapping=lambda walker, place: [place, 0])
    turns = play(aec_env(script(main), {Walker.walk: point}), 1)
    assert [turn.observation[0] for turn in turns] == [1, 2, 2]


def test_one_removal_ends_the_agents_of_several_points():
    leave = f"{__name__}.Leaver.leave"
    points = {
        Leaver.go: define(agent=lambda it: f"goer_{it.number}", removed_by=leave),
        Leaver.come: define(agent=lambda it: f"comer_{it.number}", removed_by=leave),
    }

    def main(simulation):
        one, two = Leaver(1), Leaver(2)
        one.go()
        one.come()
        two.come()
        one.leave()
        two.come()

    turns = play(aec_env(script(main), points), 1)
    assert sorted(turn.agent for turn in turns if turn.terminated) == ["comer_1", "comer_2", "goer_1"]
    assert [turn.agent for turn in turns[3:5]] in (["goer_1", "comer_1"], ["comer_1", "goer_1"])


def test_a_removal_that_is_inherited_ends_agents_of_its_subclasses_alone():
    def main(simulation):
        young, old = Young(1), Old(1)
        young.go()
        old.leave()
        young.go()
        young.leave()

    leave = f"{__name__}.Leaver.leave"
    definition = define(agent=lambda it: f"young_{it.number}", removed_by=leave)
    turns = play(aec_env(script(main), {f"{__name__}.Young.go": definition}), 1)
    assert [(turn.agent, turn.terminated) for turn in turns] == [("young_1", 0), ("young_1", 0), ("young_1", 1)]


def test_agents_of_one_name_end_as_well():
    """In the single view, the episode is over then; the simulation still runs to its end."""

    def main(simulation):
        one = Being(0)
        one.act()
        one.health = 4
        one.leave()
        simulation.log.append("on and on")
        return TRUNCATED

    definition = beings(agent="hero_0")
    env = single_env(script(main), definition)
    env.reset()
    observation, reward, terminated, truncated, _ = env.step(1)
    assert (observation.tolist(), reward, terminated, truncated) == ([0, 4], 4.0, True, False)
    assert env.simulation.log == ["on and on"]
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step(1)


@pytest.mark.parametrize("view", [aec_env, parallel_env])
def test_an_agent_of_one_name_is_not_revived_either(view):
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        for _ in range(3):
            one.act()
        one.leave()
        two.act()

    env = view(script(main), beings(agent="hero_0"))
    env.reset()
    for _ in range(2):
        env.step({"hero_0": 1} if view is parallel_env else 1)
    with pytest.raises(AgentError, match="hero_0"):
        env.step({"hero_0": 1} if view is parallel_env else 1)
    assert env.agents == []


@pytest.mark.parametrize(
    ("removed_by", "error"),
    [
        ("tests.worlds.many_worlds.Being.vanish", UnknownPointError),
        ("nowhere.Being.leave", UnknownPointError),
        (["tests.worlds.many_worlds.Being.leave", "nowhere"], UnknownPointError),
        ("tests.worlds.many_worlds.Being.act", DefinitionError),
    ],
)
def test_removals_that_cannot_be(removed_by, error):
    with pytest.raises(error):
        aec_env(living(0), beings(removed_by=removed_by))
    assert Being(0).act() == "rule"


@pytest.mark.parametrize("removed_by", [{f"{HERE}.banish": "being_0"}, {3: None}, [3]])
def test_removals_that_are_not_even_defined(removed_by):
    with pytest.raises(DefinitionError, match="removed_by must be a dict from dotted names"):
        beings(removed_by=removed_by)


def test_removals_are_what_they_were_for_everybody_else():
    leave, act = vars(Being)["leave"], vars(Being)["act"]
    env = aec_env(leaving(1), beings())
    env.reset()
    outside = Being(0)
    assert outside.act() == "rule"
    outside.leave()
    assert not outside.whole
    assert env.agents == ["being_0"]
    env.close()
    assert vars(Being)["leave"] is leave
    assert vars(Being)["act"] is act


def test_points_that_were_named_while_another_environment_was_open():
    """What ``Being.act`` is then stands for it as well, even when that environment is gone."""
    first = aec_env(living(0), beings())
    first.reset()
    named = beings()
    first.close()
    del first
    gc.collect()
    env = aec_env(living(0, 1), named)
    assert decisions(play(env, 1)) == ["being_0", "being_1"]
    assert env.simulation.log == [1, 1]


def test_an_error_in_a_last_reward_surfaces():
    changes = {"reward_mapping": lambda being: 1.0 + being.health, "observation_space_mapping": lambda being: [0, 0]}
    env = aec_env(leaving(1, before=lambda being: setattr(being, "health", None)), beings(**changes))
    env.reset()
    with pytest.raises(TypeError) as caught:
        env.step(1)
    assert "being_0" in notes(caught.value)
    assert env.agents == []
    env.reset()
    assert env.agent_selection == "being_0"


@pytest.mark.parametrize("ends", ["return", "remove"])
def test_an_error_in_a_last_reward_says_whose_it_was(ends):
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        one.act()
        two.act()
        one.health = None
        if ends == "remove":
            one.leave()
        two.health = 1

    env = aec_env(
        script(main),
        beings(reward_mapping=lambda being: 1.0 + being.health, observation_space_mapping=lambda being: [0, 0]),
    )
    env.reset(seed=19)
    env.step(1)
    with pytest.raises(TypeError) as caught:
        env.step(1)
    assert "being_0" in notes(caught.value)
    assert "seed 19" in notes(caught.value)


def test_an_error_after_a_removal_says_after_whose_decision_it_was():
    def main(simulation):
        simulation.beings = one, two = Being(0), Being(1)
        one.act()
        two.act()
        one.leave()
        raise ZeroDivisionError

    env = aec_env(script(main), beings())
    env.reset()
    env.step(1)
    with pytest.raises(ZeroDivisionError) as caught:
        env.step(1)
    assert "being_1" in notes(caught.value)
    assert "being_0" not in notes(caught.value)


def test_policies_agents_are_removed_without_a_word():
    def main(simulation):
        one, two = Being(0), Being(1)
        one.act()
        two.act()
        one.leave()
        two.act()

    turns = play(aec_env(script(main), beings(), policies={"being_0": lambda observation: 3}), 1)
    assert [turn.agent for turn in turns] == ["being_1"] * 3


# -- who keeps whom alive -------------------------------------------------------------------------


@pytest.mark.parametrize("announced", [False, True])
def test_the_environment_keeps_nobody_alive(announced):
    class Town:
        def reset(self):
            self.beings = [Being(number) for number in range(3)]
            self.seen = [weakref.ref(being) for being in self.beings]
            self.log = []

        def run(self):
            for number in range(3):
                self.beings[number].act()
            del self.beings[0]
            gc.collect()
            self.log.append([seen() is not None for seen in self.seen])
            self.beings[0].act()

        if announced:

            def expected_calls(self, point):
                return [(being,) for being in self.beings]

    env = aec_env(Town, beings(removed_by=()))
    turns = play(env, 1)
    assert env.simulation.log == [[False, True, True]]
    last = next(turn for turn in turns if turn.terminated and turn.agent == "being_0")
    assert last.reward == 0.0
    assert last.observation.tolist() == [0, 0]


def test_a_set_of_weak_references_is_as_it_would_be():
    """As Mesa keeps its agents: whoever is held by nobody else decides no more."""

    class Herd:
        def reset(self, seed=None):
            self.beings, self.weakly, self.log = [Being(n) for n in range(4)], weakref.WeakSet(), []
            self.weakly.update(self.beings)

        def run(self):
            for number in (0, 2):
                for being in sorted(self.weakly, key=being_of):
                    self.log.append((being.number, being.act()))
                    del being
                self.beings[number].leave()
                self.beings[number] = None
            self.log.append(sorted(being.number for being in self.weakly))

    plain = Herd()
    plain.reset()
    plain.run()
    assert plain.log[-1] == [1, 3]
    env = aec_env(Herd, beings())
    turns = play(env)
    assert env.simulation.log == plain.log
    assert len([turn for turn in turns if turn.terminated]) == 4


@pytest.mark.parametrize("simulation", [Hunt, AnnouncedHunt])
@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_choices_keep_nobody_alive(make, simulation):
    """What somebody may choose from is not held until it does."""
    plain = simulation()
    plain.reset()
    plain.run()
    assert (0, 2, "rule") not in plain.log
    env = make(simulation, hunters())
    if make is aec_env:
        play(env)
    else:
        env.reset()
        while env.agents:
            env.step(dict.fromkeys(env.agents, RULE))
    assert env.simulation.log == plain.log


# -- everything at once ---------------------------------------------------------------------------


def played(env, answers, seed):
    """Play a colony; check PettingZoo's books at every step."""
    result = Played(env.unwrapped.simulation)
    env.reset(seed=seed)
    booked, given_answers = Counter(), Counter()
    booked.update(env.rewards)
    gone = set()
    for agent in env.agent_iter():
        assert agent not in gone
        assert agent in env.agents
        assert len(set(env.agents)) == len(env.agents)
        for book in (env.rewards, env.terminations, env.truncations, env.infos):
            assert set(book) == set(env.agents)
        observation, reward, terminated, truncated, _ = env.last()
        assert observation in env.observation_space(agent)
        result.totals[agent] += reward
        assert type(reward) is float
        assert type(terminated) is type(truncated) is bool
        if terminated or truncated:
            result.ends[agent] = (terminated, truncated)
            gone.add(agent)
            env.step(None)
        else:
            result.decisions.append(agent)
            env.step(answers(agent, given_answers[agent], observation))
            given_answers[agent] += 1
        booked.update(env.rewards)
    assert {a: t for a, t in booked.items() if t} == {a: t for a, t in result.totals.items() if t}
    return result


@given(designs, seeds)
@settings(max_examples=120)
def test_a_colony_is_what_it_would_be_without_the_library(design, seed):
    plain = Answered(design, seed)
    if not plain.decisions:
        return
    for simulation in (Colony, Announcing):
        for roster in (False, True):
            env = colony(aec_env, design, simulation, roster=roster)
            result = played(env, lambda agent, number, observation: answer(seed, agent, number), seed)
            assert result.decisions == plain.decisions
            assert env.simulation.trace == plain.trace
            assert env.simulation.random.getstate() == plain.random.getstate()
            decided = {agent: result.totals[agent] for agent in plain.first}
            assert decided == plain.totals
            assert all(total == 0.0 for agent, total in result.totals.items() if agent not in plain.first)
            died = {entry[0] for entry in plain.trace if entry[1:] == ("died",)}
            for agent, ended in result.ends.items():
                assert ended == ((True, False) if agent in died or not design.truncates else (False, True))
            assert set(result.ends) >= set(plain.first)


@given(designs, seeds)
@settings(max_examples=60)
def test_observations_tell_what_is_needed(design, seed):
    """The answers follow from the observations alone, if these are those of the moment."""
    plain = Answered(design, seed)
    env = colony(aec_env, design, Announcing)
    result = played(env, lambda agent, number, observation: advised(observation, seed), seed)
    assert result.decisions == plain.decisions
    assert env.simulation.trace == plain.trace


@given(designs, seeds)
@settings(max_examples=60)
def test_with_rule_throughout_a_colony_is_the_plain_run(design, seed):
    plain = Colony(design)
    plain.reset(seed)
    plain.run()
    for view, roster in ((aec_env, False), (parallel_env, False), (joint_env, True)):
        for simulation in (Colony, Announcing):
            found = follow_the_rule(colony(view, design, simulation, roster=roster), seed)
            assert found.trace == plain.trace
            assert found.random.getstate() == plain.random.getstate()


# -- PettingZoo's tests ---------------------------------------------------------------------------


def village(**options):
    return aec_env(Village, colony_points(overseen=True), **options)


def test_api_with_births_and_deaths():
    with pytest.warns(UserWarning, match="possible_agents") as caught:
        api_test(village(), num_cycles=100)
    assert len(caught) == 1


def test_seeds_with_births_and_deaths():
    seed_test(village, num_cycles=100)


def test_api_with_a_roster():
    with warnings.catch_warnings():
        # Those that are never born are observed as zeros.
        warnings.filterwarnings("ignore", message="Observation numpy array is all zeros")
        api_test(village(possible_agents=NAMES_OF_THE_VILLAGE), num_cycles=100)
    seed_test(lambda: village(possible_agents=NAMES_OF_THE_VILLAGE), num_cycles=100)


# -- rewards --------------------------------------------------------------------------------------


def test_differences_are_kept_by_agent():
    def main(simulation):
        one, two = Being(0), Being(1)
        for health in (3, 10):
            for being in (one, two):
                being.health = health * (being.number + 1)
                being.act()
        two.health = 100
        two.leave()
        one.act()

    env = aec_env(script(main), beings(reward_mapping=difference(lambda being: being.health)))
    turns = play(env, 1)
    assert [(turn.agent, turn.reward) for turn in turns] == [
        ("being_0", 0.0),
        ("being_1", 0.0),
        ("being_0", 7.0),
        ("being_1", 14.0),
        ("being_1", 80.0),
        ("being_0", 0.0),
        ("being_0", 0.0),
    ]


def test_at_the_end_those_leave_first_who_have_decided():
    """The others, whose ends say nothing, come last; both in the order of the roster."""
    ant, bee, cat, dog = (decision(agent=f"{name}_0") for name in ("ant", "bee", "cat", "dog"))

    def main(simulation):
        dog()
        bee()

    turns = play(aec_env(script(main), [ant, bee, cat, dog]), 1)
    assert [turn.agent for turn in turns if turn.terminated] == ["bee_0", "dog_0", "ant_0", "cat_0"]
