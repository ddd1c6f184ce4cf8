"""Agents that are entities: their names, rosters, births and deaths."""

import re
from weakref import ref

import pytest
from hypothesis import given

from simenv_marl import (
    RULE,
    TRUNCATED,
    SimEnvError,
    aec_env,
    parallel_env,
    simulate,
    single_env,
)
from simenv_marl.errors import (
    AgentError,
    DefinitionError,
    EpisodeOverError,
    InvalidActionError,
    NoDecisionError,
    OptionValueError,
    UnknownAgentError,
    UnknownPointError,
)
from tests.extent import examples
from tests.worlds import entities
from tests.worlds.entities import (
    HERE,
    AnnouncingColony,
    AnsweredColony,
    Being,
    Colony,
    Other,
    being_of,
    beings,
    colony,
    colony_designs,
    life,
    others,
    play_colony,
    seeds,
    story,
)
from tests.worlds.models import (
    begun,
    decision,
    decisions,
    define,
    fails,
    follow_the_rule,
    notes,
    play,
    script,
)

NAMES = ["being_0", "being_1", "being_2"]
IN_ORDER = "0 health 1, 0 acts, 1 health 1, 1 acts, 2 health 1, 2 acts, 3 health 1, 3 acts"


# -- names ----------------------------------------------------------------------------------------


def test_aec_env_adds_an_agent_when_its_entity_first_decides():
    def name(being):
        """Its number is its name; the first being is no agent."""
        named.append(being.number)
        return being_of(being) if being.number else None

    named = []
    env = aec_env(life("2 acts, 0 acts, 1 acts, 2 acts"), beings(agent=name, removed_by=()))
    for _ in range(2):
        del named[:]
        env.reset()
        assert env.agents == ["being_2"]
        with pytest.raises(AttributeError):
            _ = env.max_num_agents
        env.step(1)
        assert env.agents == ["being_2", "being_1"]
    assert decisions(play(env, 1, reset=False)) == ["being_1", "being_2"]
    assert env.simulation.log == [1, "rule", 1, 1]
    assert named == [2, 0, 1, 2]  # once for each decision


@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_envs_with_possible_agents_have_dicts_of_spaces(make):
    """Some learners ask for all at once, as the attributes of PettingZoo's base classes have it."""
    env = make(life("0 acts"), beings(), possible_agents=NAMES)
    assert list(env.observation_spaces) == list(env.action_spaces) == env.possible_agents
    for agent in env.possible_agents:
        assert env.observation_spaces[agent] is env.observation_space(agent)
        assert env.action_spaces[agent] is env.action_space(agent)
    without = make(life("0 acts"), beings())
    assert not hasattr(without, "observation_spaces")
    assert not hasattr(without, "action_spaces")
    assert not hasattr(without, "possible_agents")


@pytest.mark.filterwarnings("ignore:several objects decide")
def test_entities_with_one_agent_name_are_one_agent():
    """The name is the agent: a model may replace the object behind it."""
    named = beings(agent=lambda being: "")
    turns = play(
        aec_env(life("0 acts, 1 health 1, 1 acts, 2 health 2, 2 acts, 2 health 9"), named), 1
    )
    assert {turn.agent for turn in turns} == {""}
    assert [(turn.observation[1], turn.reward) for turn in turns] == [
        (0, 0.0),
        (1, 1.0),
        (2, 2.0),
        (9, 9.0),
    ]


def test_agents_that_join_late_get_separate_seeded_spaces():
    def drawn(env, seed):
        env.reset(seed=seed)
        env.step(1)
        return {
            agent: [env.action_space(agent).sample() for _ in range(20)] for agent in env.agents
        }

    env, other = (aec_env(life("0 acts, 1 acts"), beings()) for _ in range(2))
    other.reset(seed=9)  # another history
    with pytest.raises(UnknownAgentError, match="there is no agent"):
        other.action_space("being_1")
    samples = drawn(env, 3)
    assert env.action_space("being_1") is env.action_space("being_1")
    assert env.action_space("being_1") is not env.action_space("being_0")
    assert env.observation_space("being_1") is env.observation_space("being_1")
    assert samples["being_0"] != samples["being_1"]
    assert drawn(env, 3) == drawn(other, 3) == samples
    assert drawn(other, 4) != samples


# -- rosters --------------------------------------------------------------------------------------


def test_possible_agents_are_all_in_agents_after_the_reset():
    roster = [*NAMES, "being_3"]
    env = aec_env(life("2 acts, 0 acts"), beings(), possible_agents=iter(roster))
    assert env.possible_agents == roster
    assert env.max_num_agents == 4
    env.reset(seed=1)
    assert env.agents == roster
    assert env.agents is not env.possible_agents
    assert env.num_agents == 4
    assert env.agent_selection == "being_2"
    assert env.observe("being_1").tolist() == [0, 0]
    assert set(env.rewards) == set(env.infos) == set(roster)
    turns = play(env, 1)
    assert story(turns) == "2 0 0+ 2+ 1+ 3+"
    assert turns[-1].reward == 0.0
    assert env.possible_agents == roster


def test_possible_agents_are_given_per_decision_point_if_there_are_several():
    clerk = decision()

    def main(simulation):
        Other(0).act()
        Being(1).act()
        clerk()

    points = {clerk: define(agent="clerk_0"), **beings(), **others()}
    rosters = {Being.act: ["being_1", "being_0"], f"{HERE}.Other.act": iter(["other_0"])}
    env = aec_env(script(main), points, possible_agents=rosters)
    assert sorted(env.possible_agents) == ["being_0", "being_1", "clerk_0", "other_0"]
    assert decisions(play(env, 1)) == ["other_0", "being_1", "clerk_0"]


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"possible_agents": ["being_0", "being_0"]}, AgentError, "being_0"),
        ({"possible_agents": [0]}, AgentError, "0"),
        ({"possible_agents": "being_0"}, SimEnvError, "being_0"),
        ({"possible_agents": 5}, OptionValueError, "possible_agents"),
        ({"possible_agents": {"being_0": 5}}, OptionValueError, "possible_agents"),
        ({"possible_agents": {Other.act: ["other_0"]}}, OptionValueError, "Other.act"),
        (
            {"possible_agents": {f"{HERE}.Being.leave": ["being_0"]}},
            OptionValueError,
            "Being.leave",
        ),
        ({"possible_agents": NAMES, "undeclared": "ignore"}, OptionValueError, "undeclared"),
        (
            {"possible_agents": NAMES, "points": beings() | others()},
            OptionValueError,
            "possible_agents must be a dict",
        ),
    ],
)
def test_envs_refuse_invalid_possible_agents(options, error, match):
    with pytest.raises(error, match=match):
        aec_env(life("0 acts"), **{"points": beings()} | options)


def test_agent_outside_possible_agents_raises_an_error():
    env = begun(aec_env(life("0 acts, 5 acts, 0 acts"), beings(), possible_agents=NAMES))
    with pytest.raises(AgentError, match=r"being_5.*possible_agents"):
        env.step(1)
    assert env.agents == []
    env.reset()
    assert sorted(env.agents) == NAMES
    with pytest.raises(AgentError, match="is not declared"):
        aec_env(life(IN_ORDER, announced=[0, 3]), beings(), possible_agents=NAMES).reset()


def test_agent_outside_possible_agents_can_follow_the_models_rule():
    options = {"possible_agents": NAMES, "undeclared": "rule"}
    env = aec_env(life("5 acts, 0 acts, 5 acts, 1 acts"), beings(), **options)
    assert sorted(story(play(env, 7)).split()) == ["0", "0+", "1", "1+", "2+"]
    assert env.simulation.log == ["rule", 7, "rule", 7]
    with pytest.raises(NoDecisionError, match="without a decision"):
        aec_env(life("5 acts"), beings(), **options).reset()


# -- who is expected ------------------------------------------------------------------------------


def test_expected_calls_let_agents_join_and_observe_before_they_decide():
    paid = []
    definition = beings(reward_mapping=lambda being: paid.append(being.number) or 0.0)
    env = begun(aec_env(life(IN_ORDER, announced=[0, 1, 2, 2, 0]), definition))
    assert set(env.simulation.asked) == {f"{HERE}.Being.act"}
    assert env.agents == NAMES
    assert env.last()[0].tolist() == [0, 1]
    assert env.observe("being_1").tolist() == [1, 0]
    assert paid == [0]  # to be announced asks for no reward
    env.step(1)
    assert env.last()[0].tolist() == [1, 1]  # observed anew
    assert paid == [0, 1]
    assert story(play(env, 1)) == "0 1 2 3 0+ 1+ 2+ 3+"


@pytest.mark.parametrize(
    ("announced", "changes", "options", "agents", "log"),
    [
        (
            [0, 1, 2],
            {"agent": lambda being: being_of(being) if being.number != 1 else None},
            {},
            [0, 2],
            [1, "rule", 1, 1],
        ),
        ([0, 1, 2], {}, {"policies": {"being_1": lambda observation: 5}}, [0, 2], [1, 5, 1, 1]),
        (
            [0, 3],
            {},
            {"possible_agents": NAMES, "undeclared": "rule"},
            [0, 1, 2],
            [1, 1, 1, "rule"],
        ),
    ],
    ids=["no agent", "a policy's agent", "an undeclared agent"],
)
def test_expected_calls_add_no_agent_that_a_policy_decides_for(
    announced, changes, options, agents, log
):
    env = begun(aec_env(life(IN_ORDER, announced=announced), beings(**changes), **options))
    assert env.agents == [f"being_{number}" for number in agents]
    play(env, 1, reset=False)
    assert env.simulation.log == log


def test_agents_of_expected_calls_that_never_decide_end_with_the_episode():
    program = life("0 acts, 2 health 8, 2 leaves, 1 acts, 3 health 4", announced=[1, 2, 3])
    turns = play(aec_env(program, beings()), 1)
    assert story(turns) == "0 2+ 1 0+ 1+ 3+"
    assert [turn.reward for turn in turns] == [0.0] * 6
    assert turns[1].observation.tolist() == [2, 8]
    assert turns[-1].observation.tolist() == [3, 4]  # observed anew on the call that was to come


def test_agent_observes_the_first_of_its_expected_calls():
    named = beings(agent=lambda being: "late" if being.number else "early")
    env = begun(aec_env(life("0 acts, 4 acts", announced=[4, 3, 0]), named))
    assert env.observe("late").tolist() == [4, 0]


# -- deaths ---------------------------------------------------------------------------------------


def test_removed_agent_is_rewarded_and_observed_before_its_removal():
    env = begun(aec_env(life("0 acts, 1 acts, 0 health 5, 0 leaves, 1 acts"), beings()))
    env.step(1)
    env.step(1)
    assert env.simulation.beings[0].whole is False
    assert env.agent_selection == "being_0"
    assert env.rewards == {"being_0": 5.0, "being_1": 0.0}
    observation, *told = env.last()
    assert (observation.tolist(), told) == ([0, 5], [5.0, True, False, {}])
    with pytest.raises(InvalidActionError, match="has ended"):
        env.step(1)
    assert env.agents == ["being_0", "being_1"]
    env.step(None)
    assert env.agents == ["being_1"]
    assert env.agent_selection == "being_1"
    assert env.last()[1:4] == (0.0, False, False)
    env.step(1)
    assert story(play(env, reset=False)) == "1+"


class Mortal(Being):
    """Leaves whenever it acts."""

    def act(self):
        self.health = 30
        self.leave()
        return "rule"


@pytest.mark.parametrize(("action", "answered"), [(3, "applied"), (RULE, "rule")])
def test_agent_removed_during_its_decision_still_gets_its_action_applied(action, answered):
    def apply(action, being):
        being.act()
        return "applied"

    points = {Mortal.act: beings(apply=apply)[Being.act]}
    env = begun(aec_env(life("0 acts, 1 acts", kind=Mortal), points))
    env.step(action)
    assert env.simulation.log == [answered]
    assert env.agent_selection == "being_0"
    observation, reward, terminated, *_ = env.last()
    assert (observation.tolist(), reward, terminated) == ([0, 30], 30.0, True)
    env.step(None)
    assert env.agent_selection == "being_1"
    env = begun(parallel_env(life("0 acts, 1 acts", kind=Mortal), points))
    _, rewards, terminations, _, infos = env.step({"being_0": action})
    assert rewards == {"being_0": 30.0, "being_1": 0.0}
    assert terminations == {"being_0": True, "being_1": False}
    assert infos["being_0"]["acted"] is True


def if_whole(being):
    return being_of(being) if being.whole else None


UNSEEN = {"observation_space_mapping": lambda being: [0, 0], "reward_mapping": lambda being: 0.0}


def banished(place, being):
    return being_of(being) if being.health else None


LEAVE, BANISH = f"{HERE}.Being.leave", f"{HERE}.banish"
GOING = "0 acts, 1 acts, 2 acts, 1 whole 0, 1 leaves, 3 whole 0, 3 leaves, 1 leaves"
RENAMED = f"{GOING}, 2 number 7, 2 acts, 2 whole 0, 2 leaves, 0 acts"


@pytest.mark.parametrize(
    ("program", "changes", "options", "expected"),
    [
        # Those who have not decided, and those who are no agents.
        (
            "3 leaves, 0 acts, 2 leaves, 2 leaves, 9 leaves, 1 acts",
            {},
            {"possible_agents": NAMES},
            "0 2+ 1 0+ 1+",
        ),
        # In the last step.
        ("0 acts, 1 acts, 0 leaves, 2 acts, 2 fails", {}, {"max_steps": 2}, "0 1 0+ 1~ 2~"),
        # A bare name means the agent of the first argument, which here is no being.
        *(
            ("0 acts, 0 banished, 0 whole 1, 0 acts", {"removed_by": removed_by}, {}, "0 0 0+")
            for removed_by in (BANISH, [LEAVE, BANISH], {LEAVE: None, BANISH: None})
        ),
        # ... or who it was, where it is named no more: one was never met, and one has gone already.
        (RENAMED, UNSEEN | {"agent": if_whole}, {}, "0 1 2 1+ 7 7+ 0 0+ 2+"),
        # A callable names who is removed.
        (
            (
                "0 acts, 1 acts, 2 acts, 1 health 1, 1 banished, 2 banished, 0 leaves, 2 whole 1,"
                " 2 acts"
            ),
            {"removed_by": {LEAVE: None, BANISH: banished}},
            {},
            "0 1 2 1+ 0+ 2 2+",
        ),
    ],
)
def test_env_removes_agents_when_a_removed_by_function_is_called(
    program, changes, options, expected
):
    env = aec_env(life(program), beings(**changes), **options)
    assert story(play(env, 1)) == expected


@pytest.mark.parametrize("view", [aec_env, parallel_env])
@pytest.mark.parametrize(
    ("agent", "roster"), [(being_of, None), (being_of, NAMES), ("being_0", None)]
)
@pytest.mark.parametrize("again", [0, 1], ids=["revived", "a namesake"])
def test_agent_that_decides_after_its_end_raises_an_error(view, agent, roster, again):
    program = life(f"0 acts, 0 leaves, {again} number 0, {again} whole 1, {again} acts, 0 fails")
    env = begun(view(program, beings(agent=agent), possible_agents=roster), 11)
    with fails(AgentError, "seed 11", match=r"being_0.*after its end"):
        env.step({"being_0": 1} if view is parallel_env else 1)
    assert env.agents == []
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step({} if view is parallel_env else 1)
    env.reset()
    assert "being_0" in env.agents


@pytest.mark.parametrize("view", [aec_env, parallel_env, single_env])
def test_env_warns_once_if_entities_without_agent_names_are_one_agent(view):
    """Without ``agent=``, the entities count as one agent, whose rewards and differences mix."""

    def main(simulation):
        simulation.crowd = [Being(number) for number in range(simulation.seed)]
        for being in simulation.crowd * 2:
            being.act()

    env = view(script(main), {Being.act: define()})
    follow_the_rule(env, 1)
    follow_the_rule(env, 1)  # another one in each episode is the one of that episode
    with pytest.warns(
        UserWarning, match=r"several objects decide at .*Being\.act as one agent, 'act_0'.*agent="
    ):
        follow_the_rule(env, 2)
    follow_the_rule(env, 2)
    follow_the_rule(view(script(main), {Being.act: define(agent="all_of_them")}), 2)


class Young(Being):
    def go(self):
        return "rule"

    def come(self):
        return "rule"


def test_removed_by_an_inherited_method_ends_only_agents_of_the_subclass():
    points = {
        Young.go: define(agent=lambda it: f"goer_{it.number}", removed_by=LEAVE),
        Young.come: define(agent=lambda it: f"comer_{it.number}", removed_by=LEAVE),
    }

    def main(simulation):
        one, two = Young(1), Young(2)
        one.go()
        one.come()
        two.come()
        Being(2).leave()
        one.leave()
        two.come()

    told = story(play(aec_env(script(main), points), 1)).split()
    assert (sorted(told[3:5]), told[5:]) == (["comer_1+", "goer_1+"], ["comer_2", "comer_2+"])


@pytest.mark.parametrize(
    ("removed_by", "error", "match"),
    [
        ("tests.worlds.entities.Being.vanish", UnknownPointError, "vanish"),
        (["tests.worlds.entities.Being.leave", "nowhere.leave"], UnknownPointError, "nowhere"),
        ("tests.worlds.entities.Being.act", DefinitionError, "Being.act"),
    ],
)
def test_envs_refuse_invalid_removed_by(removed_by, error, match):
    with pytest.raises(error, match=match):
        aec_env(life("0 acts"), beings(removed_by=removed_by))
    assert Being(0).act() == "rule"


@pytest.mark.usefixtures("_collected")  # an environment of another test would still patch the class
def test_removed_by_functions_work_unchanged_outside_an_env():
    leave, act = vars(Being)["leave"], vars(Being)["act"]
    env = begun(aec_env(life("0 acts, 1 acts"), beings()))
    outside = Being(0)
    assert outside.act() == "rule"
    outside.leave()
    assert env.agents == ["being_0"]
    env.close()
    assert (vars(Being)["leave"], vars(Being)["act"]) == (leave, act)


def test_single_env_terminates_when_its_agent_is_removed():
    program = life("0 acts, 0 health 4, 0 leaves, 1 health 7", ends=TRUNCATED)
    env = begun(single_env(program, beings(agent="hero_0")))
    observation, *told = env.step(1)[:4]
    assert (observation.tolist(), told) == ([0, 4], [4.0, True, False])
    assert env.simulation.beings[1].health == 7


@pytest.mark.parametrize(
    ("program", "whose"),
    [
        ("0 acts, 1 acts, 0 health -1", "being_0"),
        ("0 acts, 1 acts, 0 health -1, 0 leaves, 0 health 0", "being_0"),
        ("0 acts, 1 acts, 0 leaves, 0 fails", "being_1"),
    ],
)
def test_error_in_a_removed_agents_last_reward_names_the_agent(program, whose):
    env = begun(
        aec_env(life(program), beings(reward_mapping=lambda being: 1 / (being.health + 1))), 19
    )
    env.step(1)
    with pytest.raises(ZeroDivisionError) as caught:
        env.step(1)
    assert set(re.findall(r"being_\d", notes(caught.value))) == {whose}
    assert "seed 19" in notes(caught.value)
    assert env.agents == []
    env.reset()
    assert env.agent_selection == "being_0"


class Forgetting(entities.AnnouncingLife):
    """A life that logs whether a being is gone once it is forgotten."""

    def happens(self, number, what, *value):
        if what == "forgotten":
            forgotten = ref(self.beings.pop(number))
            self.log.append(forgotten() is None)
        else:
            super().happens(number, what, *value)


@pytest.mark.parametrize("announced", [None, [0, 1]])
@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_env_does_not_keep_an_entity_alive_for_its_choices(make, announced):
    """What somebody may choose from is not held until it does."""

    def living(being, *, _simulation):
        return list(_simulation.beings.values())

    points = beings(choices=living, removed_by=())
    program = "0 acts, 1 acts, 2 forgotten, 0 acts, 3 forgotten, 1 acts, 4 forgotten"
    env = make(lambda: Forgetting(program, announced, None, Being), points)
    assert follow_the_rule(env).log == ["rule", "rule", True, "rule", True, "rule", True]


# -- ends by name ---------------------------------------------------------------------------------


BY_NAME = beings(removed_by=())


@pytest.mark.filterwarnings("ignore:end_agent.'being_7'. has no effect")
def test_end_agent_gives_the_agent_a_last_reward_and_observation():
    program = (
        "0 acts, 1 acts, 2 acts, 1 health 2, 1 ends, 7 ends, 1 health 9, 0 acts, 1 ends, 2 acts"
    )
    turns = play(aec_env(life(program), BY_NAME), 1)
    assert story(turns) == "0 1 2 1+ 0 2 0+ 2+"
    assert (turns[3].observation.tolist(), turns[3].reward) == ([1, 2], 2.0)
    env = begun(
        parallel_env(
            life("0 acts, 1 acts, 1 health 3, 1 ends, 0 acts"), BY_NAME, possible_agents=NAMES[:2]
        )
    )
    _, rewards, terminations, *_ = env.step({"being_0": 1, "being_1": 1})
    assert (rewards["being_1"], terminations) == (3.0, {"being_0": False, "being_1": True})
    assert env.agents == ["being_0"]


def test_end_agent_does_nothing_outside_an_environment():
    program = life("0 acts, 0 ends, 0 acts")
    env = begun(aec_env(program, BY_NAME))
    plain = begun(program())
    plain.run()  # while an environment is in use, too
    assert plain.log == simulate(program, points=BY_NAME).log == ["rule", "rule"]
    assert env.agents == ["being_0"]
    with pytest.raises(AgentError, match="after its end"):
        env.step(1)


# -- everything at once ---------------------------------------------------------------------------


@given(colony_designs, seeds)
@examples(120)
def test_aec_env_runs_random_models_with_births_like_without_an_env(design, seed):
    plain = AnsweredColony(design, seed)
    if not plain.decisions:
        return
    for simulation in (Colony, AnnouncingColony):
        for roster in (False, True):
            env = colony(aec_env, design, simulation, roster=roster)
            decided, totals, ends = play_colony(env, seed)
            assert decided == plain.decisions
            assert env.simulation.trace == plain.trace
            assert env.simulation.random.getstate() == plain.random.getstate()
            assert {agent: totals[agent] for agent in plain.first} == plain.totals
            assert all(total == 0.0 for agent, total in totals.items() if agent not in plain.first)
            died = {entry[0] for entry in plain.trace if entry[1:] == ("died",)}
            for agent, ended in ends.items():
                assert ended == (
                    (True, False) if agent in died or not design.truncates else (False, True)
                )
            assert set(ends) >= set(plain.first)
