"""Agents that are entities: their names, rosters, births and deaths, in the AEC view."""

import gc
from collections import Counter

import pytest
from hypothesis import given, settings
from pettingzoo.test import api_test, seed_test

from simenv_marl import (
    RULE,
    TRUNCATED,
    SimEnvError,
    aec_env,
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
    AnnouncedHunt,
    Announcing,
    Answered,
    Being,
    Colony,
    Hunt,
    Other,
    Played,
    Village,
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
    assert not hasattr(env, "possible_agents")
    with pytest.raises(AttributeError):
        _ = env.max_num_agents
    env.step(1)
    assert env.agents == ["being_2", "being_0"]
    assert set(env.rewards) == set(env.terminations) == set(env.truncations) == set(env.infos) == set(env.agents)
    assert decisions(play(env, 1)) == ["being_2", "being_0", "being_2"]


@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_spaces_of_all_possible_agents_are_dicts(make):
    """Some learners ask for all at once, as the attributes of PettingZoo's base classes have it."""
    env = make(living(0, 1), beings(), possible_agents=["being_0", "being_1"])
    assert list(env.observation_spaces) == list(env.action_spaces) == env.possible_agents
    for agent in env.possible_agents:
        assert env.observation_spaces[agent] is env.observation_space(agent)
        assert env.action_spaces[agent] is env.action_space(agent)
    without = make(living(0, 1), beings())
    assert not hasattr(without, "observation_spaces")
    assert not hasattr(without, "action_spaces")


def test_where_nobody_is_named_the_rule_decides():
    env = aec_env(living(0, 1, 2), beings(agent=lambda being: None if being.number == 1 else being_of(being)))
    assert decisions(play(env, 7)) == ["being_0", "being_2"]
    assert env.simulation.log == [7, "rule", 7]
    env = aec_env(living(0), beings(agent=lambda being: ""))  # a name as any other
    env.reset()
    assert env.agents == [""]


def test_entities_of_one_name_are_one_agent():
    """The name is the agent: a model may replace the object behind it."""

    def main(simulation):
        for health in range(3):
            being = Being(0)
            being.health = health
            being.act()

    turns = play(aec_env(script(main), beings()), 1)
    assert [(turn.agent, turn.observation[1]) for turn in turns][:3] == [("being_0", 0), ("being_0", 1), ("being_0", 2)]
    assert len({turn.agent for turn in turns}) == 1


def test_spaces_of_those_who_join_late_are_their_own_and_seeded():
    env = aec_env(living(0, 1), beings())
    env.reset(seed=3)
    with pytest.raises(UnknownAgentError, match="there is no agent"):
        env.action_space("being_1")
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


def test_a_roster_is_declared_by_point_where_there_are_several():
    clerk = decision()

    def main(simulation):
        Other(0).act()
        Being(1).act()
        clerk()

    points = {clerk: define(agent="clerk_0"), **beings(), **others()}
    rosters = {Being.act: ["being_1", "being_0"], f"{HERE}.Other.act": ("other_0",)}
    env = aec_env(script(main), points, possible_agents=rosters)
    assert sorted(env.possible_agents) == ["being_0", "being_1", "clerk_0", "other_0"]
    assert decisions(play(env, 1)) == ["other_0", "being_1", "clerk_0"]
    with pytest.raises(OptionValueError, match="possible_agents must be a dict"):
        aec_env(living(0), beings() | others(), possible_agents=["being_0", "other_0"])
    env = aec_env(living(1), {clerk: define(agent="clerk_0"), **beings()}, possible_agents=["being_0", "being_1"])
    assert sorted(env.possible_agents) == ["being_0", "being_1", "clerk_0"]


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"possible_agents": ["being_0", "being_0"]}, AgentError, "being_0"),
        ({"possible_agents": [0]}, AgentError, "0"),
        ({"possible_agents": "being_0"}, SimEnvError, "being_0"),
        ({"possible_agents": {Other.act: ["other_0"]}}, OptionValueError, "Other.act"),
        ({"possible_agents": {f"{HERE}.Being.leave": ["being_0"]}}, OptionValueError, "Being.leave"),
        ({"possible_agents": NAMES, "undeclared": "ignore"}, OptionValueError, "undeclared"),
    ],
    ids=["twice", "a number", "a string", "a point that is not used", "no point", "undeclared"],
)
def test_rosters_that_cannot_be_are_refused(options, error, match):
    with pytest.raises(error, match=match):
        aec_env(living(0), beings(), **options)


def test_an_undeclared_agent_is_an_error_that_ends_the_episode():
    env = aec_env(living(0, 5, 0), beings(), possible_agents=NAMES)
    env.reset()
    with pytest.raises(AgentError, match=r"being_5.*possible_agents"):
        env.step(1)
    assert env.agents == []
    env.reset()
    assert sorted(env.agents) == NAMES
    with pytest.raises(AgentError, match="is not declared"):
        aec_env(knowing(act_in_order, 0, 3), beings(), possible_agents=NAMES).reset()


def test_an_undeclared_agent_may_follow_its_rule():
    env = aec_env(living(5, 0, 5, 1), beings(), possible_agents=NAMES, undeclared="rule")
    turns = play(env, 7)
    assert decisions(turns) == ["being_0", "being_1"]
    assert {turn.agent for turn in turns} == set(NAMES)
    assert env.simulation.log == ["rule", 7, "rule", 7]
    with pytest.raises(NoDecisionError, match="without a decision"):
        aec_env(living(5), beings(), possible_agents=NAMES, undeclared="rule").reset()


@pytest.mark.parametrize("roster", [None, NAMES[:2]])
def test_a_policy_answers_for_one_entity_even_when_that_is_removed(roster):
    observed = []

    def policy(observation, info):
        observed.append(observation.tolist())
        return 3

    def main(simulation):
        one, two = Being(0), Being(1)
        simulation.log += [one.act(), two.act(), one.act()]
        one.leave()
        simulation.log.append(two.act())

    env = aec_env(script(main), beings(), policies={"being_0": policy}, possible_agents=roster)
    assert getattr(env, "possible_agents", None) == (roster and ["being_1"])
    assert [turn.agent for turn in play(env, 7)] == ["being_1"] * 3
    assert env.simulation.log == [3, 7, 3, 7]
    assert observed == [[0, 0], [0, 0]]


# -- who is expected ------------------------------------------------------------------------------


def act_in_order(simulation):
    for being in simulation.beings:
        being.health += 1
        simulation.log.append(being.act())


def test_announced_agents_join_and_are_observed_before_their_first_decision():
    paid = []
    definition = beings(reward_mapping=lambda being: paid.append(being.number) or 0.0)
    env = aec_env(knowing(act_in_order, 0, 1, 2, 2, 0), definition)
    env.reset()
    assert env.simulation.asked
    assert set(env.simulation.asked) == {f"{HERE}.Being.act"}
    assert env.agents == ["being_0", "being_1", "being_2"]
    assert env.last()[0].tolist() == [0, 1]
    assert env.observe("being_1").tolist() == [1, 0]
    assert env.agent_selection == "being_0"
    assert paid == [0]  # to be announced asks for no reward
    env.step(1)
    assert env.last()[0].tolist() == [1, 1]  # observed anew
    assert paid == [0, 1]
    turns = play(env, 1)
    assert decisions(turns) == ["being_0", "being_1", "being_2", "being_3"]
    assert [turn.agent for turn in turns if turn.terminated] == ["being_0", "being_1", "being_2", "being_3"]


@pytest.mark.parametrize(
    ("announced", "changes", "options", "agents", "log"),
    [
        ([], {}, {}, [0], [1, 1, 1, 1]),
        ([0, 1, 2], {"agent": lambda being: f"being_{being.number}" if being.number != 1 else None}, {}, [0, 2],
         [1, "rule", 1, 1]),
        ([0, 1, 2], {}, {"policies": {"being_1": lambda observation: 5}}, [0, 2], [1, 5, 1, 1]),
        ([0, 3], {}, {"possible_agents": NAMES, "undeclared": "rule"}, [0, 1, 2], [1, 1, 1, "rule"]),
    ],
    ids=["nobody", "nobody's agent", "a policy's agent", "an undeclared agent"],
)  # fmt: skip
def test_those_who_are_announced_join_if_their_decisions_are_the_users(announced, changes, options, agents, log):
    env = aec_env(knowing(act_in_order, *announced), beings(**changes), **options)
    env.reset()
    assert env.agents == [f"being_{number}" for number in agents]
    play(env, 1, reset=False)
    assert env.simulation.log == log


def test_announced_agents_that_never_decide_end_with_the_episode_or_when_they_are_removed():
    def main(simulation):
        zero, one, two, _ = simulation.beings
        zero.act()
        two.health = 8
        two.leave()
        one.act()

    turns = play(aec_env(knowing(main, 1, 2, 3), beings()), 1)
    assert [(turn.agent, turn.terminated, turn.reward) for turn in turns] == [
        ("being_0", False, 0.0),
        ("being_2", True, 0.0),
        ("being_1", False, 0.0),
        ("being_0", True, 0.0),
        ("being_1", True, 0.0),
        ("being_3", True, 0.0),
    ]
    assert turns[1].observation.tolist() == [2, 8]


def test_decision_functions_that_are_called_to_foresee_run_their_rule():
    class Seer(Knowing):
        def expected_calls(self, point):
            self.log.append(self.beings[3].act())
            return [(self.beings[1],)]

    env = aec_env(lambda: Seer(act_in_order, announced=()), beings())
    env.reset()
    assert set(env.simulation.log) == {"rule"}
    assert env.agents == ["being_0", "being_1"]


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


@pytest.mark.parametrize("action", [3, RULE])
def test_the_decision_in_which_an_agent_is_removed_is_still_carried_out(action):
    """By ``apply`` or by the rule."""

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

    points = {Mortal.act: beings(apply=apply)[Being.act]}
    answered = ["rule" if action is RULE else "applied"]
    env = aec_env(script(main), points)
    env.reset()
    env.step(action)
    assert env.simulation.log == answered
    assert env.agent_selection == "being_0"
    observation, reward, terminated, *_ = env.last()
    assert (observation.tolist(), reward, terminated) == ([0, 30], 30.0, True)
    env.step(None)
    assert env.agent_selection == "being_1"
    env = parallel_env(script(main), points)
    env.reset()
    observations, rewards, terminations, _, infos = env.step({"being_0": action})
    assert env.simulation.log == answered
    assert (observations["being_0"].tolist(), rewards) == ([0, 30], {"being_0": 30.0, "being_1": 0.0})
    assert terminations == {"being_0": True, "being_1": False}
    assert infos["being_0"]["acted"] is True


def test_removals_of_those_who_have_not_decided_or_are_no_agents():
    def main(simulation):
        Being(3).leave()
        Being(0).act()
        Being(2).leave()
        Being(2).leave()
        Being(9).leave()
        Other(0).leave()
        Being(1).act()

    env = aec_env(script(main), beings(), possible_agents=[*NAMES, "being_3"])
    env.reset()
    assert not any(env.truncations.values())
    turns = play(env, 1)
    assert [(turn.agent, turn.terminated) for turn in turns if turn.agent != "being_3"] == [
        ("being_0", False),
        ("being_2", True),
        ("being_1", False),
        ("being_0", True),
        ("being_1", True),
    ]
    assert [turn.terminated for turn in turns if turn.agent == "being_3"] in ([], [True])
    being_2 = next(turn for turn in turns if turn.agent == "being_2")
    assert (being_2.reward, being_2.observation.tolist()) == (0.0, [0, 0])


@pytest.mark.parametrize("roster", [None, NAMES], ids=["no roster", "a roster"])
@pytest.mark.parametrize("view", [aec_env, parallel_env])
@pytest.mark.parametrize("agent", [being_of, "being_0"], ids=["by entity", "one name"])
def test_a_revived_agent_or_its_namesake_is_an_error_that_ends_the_episode(roster, view, agent):
    def main(simulation):
        one = Being(0)
        one.act()
        one.leave()
        again = simulation.again = one if simulation.seed % 2 else Being(0)
        again.whole = True
        again.act()
        simulation.log.append("decided")

    env = view(script(main), beings(agent=agent), possible_agents=roster if callable(agent) else None)
    for seed in (11, 12):
        env.reset(seed=seed)
        with pytest.raises(AgentError, match=r"being_0.*after its end") as caught:
            env.step({"being_0": 1} if view is parallel_env else 1)
        assert f"seed {seed}" in notes(caught.value)
        assert env.simulation.log == []
        assert env.agents == []
        with pytest.raises(EpisodeOverError, match="begin the next one"):
            env.step({} if view is parallel_env else 1)
    env.reset()
    assert "being_0" in env.agents


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
        simulation.crowd = [Being(number) for number in range(simulation.seed)]
        for being in simulation.crowd * 2:
            being.act()

    env = view(script(main), {Being.act: define()})
    follow_the_rule(env, 1)
    follow_the_rule(env, 1)  # another one in each episode is the one of that episode
    with pytest.warns(UserWarning, match=r"several objects decide at .*Being\.act as one agent, 'act_0'.*agent="):
        follow_the_rule(env, 2)
    follow_the_rule(env, 2)
    follow_the_rule(view(script(main), {Being.act: define(agent="all_of_them")}), 2)


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
        gone += [agent for agent, over in env.step(RULE)[2].items() if over]
    assert gone[:2] == ["being_1", "being_7"]
    assert sorted(gone) == ["being_0", "being_1", "being_2", "being_7"]


def test_a_callable_names_who_is_removed():
    def main(simulation):
        crowd = [Being(number) for number in range(4)]
        for being in crowd:
            being.act()
        banish("the woods", crowd[1])
        banish("nowhere", crowd[2])
        crowd[3].leave()
        banish(place="the woods", being=crowd[0])
        crowd[2].whole = True
        crowd[2].act()

    removed_by = {
        f"{HERE}.Being.leave": None,
        f"{HERE}.banish": lambda place, being: being_of(being) if place == "the woods" else None,
    }
    turns = play(aec_env(script(main), beings(removed_by=removed_by)), 1)
    assert [turn.agent for turn in turns if turn.terminated] == ["being_1", "being_3", "being_0", "being_2"]
    assert decisions(turns)[-1] == "being_2"


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


@pytest.mark.parametrize(
    ("removed_by", "error", "match"),
    [
        ("tests.worlds.many_worlds.Being.vanish", UnknownPointError, "vanish"),
        ("nowhere.Being.leave", UnknownPointError, "nowhere"),
        (["tests.worlds.many_worlds.Being.leave", "nowhere"], UnknownPointError, "nowhere"),
        ("tests.worlds.many_worlds.Being.act", DefinitionError, "Being.act"),
        ({f"{HERE}.banish": "being_0"}, DefinitionError, "removed_by must be a dict from dotted names"),
        ({3: None}, DefinitionError, "removed_by must be a dict from dotted names"),
        ([3], DefinitionError, "removed_by must be a dict from dotted names"),
    ],
)
def test_removals_that_cannot_be_are_refused(removed_by, error, match):
    with pytest.raises(error, match=match):
        aec_env(living(0), beings(removed_by=removed_by))
    assert Being(0).act() == "rule"


def test_everybody_else_removes_as_ever():
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


def test_the_single_view_is_over_when_its_agent_is_removed_though_the_simulation_runs_on():
    def main(simulation):
        one = Being(0)
        one.act()
        one.health = 4
        one.leave()
        simulation.log.append("on and on")
        return TRUNCATED

    env = single_env(script(main), beings(agent="hero_0"))
    env.reset()
    observation, reward, terminated, truncated, _ = env.step(1)
    assert (observation.tolist(), reward, terminated, truncated) == ([0, 4], 4.0, True, False)
    assert env.simulation.log == ["on and on"]


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
    assert env.agents == []
    env.reset()
    assert env.agent_selection == "being_0"


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


# -- who keeps whom alive -------------------------------------------------------------------------


@pytest.mark.parametrize("simulation", [Hunt, AnnouncedHunt])
@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_choices_keep_nobody_alive(make, simulation):
    """What somebody may choose from is not held until it does."""
    plain = simulation()
    plain.reset()
    plain.run()
    assert (0, 2, "rule") not in plain.log
    assert follow_the_rule(make(simulation, hunters())).log == plain.log


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
            assert {agent: result.totals[agent] for agent in plain.first} == plain.totals
            assert all(total == 0.0 for agent, total in result.totals.items() if agent not in plain.first)
            died = {entry[0] for entry in plain.trace if entry[1:] == ("died",)}
            for agent, ended in result.ends.items():
                assert ended == ((True, False) if agent in died or not design.truncates else (False, True))
            assert set(result.ends) >= set(plain.first)


# -- PettingZoo's tests ---------------------------------------------------------------------------


def test_pettingzoos_tests_pass_with_births_and_deaths():
    def village(**options):
        return aec_env(Village, colony_points(overseen=True), **options)

    with pytest.warns(UserWarning, match="possible_agents") as caught:
        api_test(village(), num_cycles=100)
    assert len(caught) == 1
    seed_test(village, num_cycles=100)


# -- rewards --------------------------------------------------------------------------------------


def test_at_the_end_those_leave_first_who_have_decided():
    """The others, whose ends say nothing, come last; both in the order of the roster."""
    ant, bee, cat, dog = (decision(agent=f"{name}_0") for name in ("ant", "bee", "cat", "dog"))

    def main(simulation):
        dog()
        bee()

    turns = play(aec_env(script(main), [ant, bee, cat, dog]), 1)
    assert [turn.agent for turn in turns if turn.terminated] == ["bee_0", "dog_0", "ant_0", "cat_0"]
