"""Warnings at run time: shared generators, agents that never come, rounds that stand still."""

import pickle
import random
import sys
import threading
import time
import warnings
from functools import partial

import cloudpickle
import numpy as np
import pytest

from simenv_marl import (
    RULE,
    aec_env,
    parallel_env,
    simulate,
    simulate_many,
    single_env,
    vector_env,
)
from simenv_marl.core.switching import generators as rng
from simenv_marl.errors import UnknownPointError
from tests.worlds.entities import HERE, Being, beings, life, story
from tests.worlds.models import begun, calling, decision, define, script
from tests.worlds.models import play as play_in_turns

DRAWS = "draws from the global generator"
ABSENT = "did not appear in the episode"


@pytest.fixture
def heard():
    """The warnings of a test, as texts."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield lambda part: [
            str(warning.message) for warning in caught if part in str(warning.message)
        ]


@pytest.fixture
def heard_alone(heard, monkeypatch):
    """Hide the threads of other tests: beside them, the thread driver can blame no simulation."""
    monkeypatch.setattr(rng, "enumerate_threads", lambda: [threading.current_thread()])
    return heard


# -- global generators ----------------------------------------------------------------------------

decide = decision(agent="chooser")


def gambler(draw, *, in_reset=False):
    """A class of simulations that use a shared generator, in the reset or before a decision."""

    class Gambler:
        def reset(self):
            self.drawn = [draw()] if in_reset else []

        def run(self):
            if not in_reset:
                self.drawn.append(draw())
            for _ in range(4):
                decide()

    return Gambler


def play(env, draw=lambda: None):
    env.reset(seed=1)
    for _ in range(4):
        draw()
        env.step(1)


@pytest.mark.parametrize(
    ("draw", "name"),
    [
        (random.random, "random"),
        (np.random.random, "numpy.random"),
        (lambda: (random.random(), np.random.random()), "random and numpy.random"),
    ],
)
@pytest.mark.parametrize("in_reset", [False, True])
def test_env_warns_once_of_a_model_that_uses_global_random_generators(
    heard_alone, draw, name, in_reset
):
    kind = gambler(draw, in_reset=in_reset)
    for make in (single_env, aec_env):
        for _ in range(2):
            play(make(kind, decide))
    (message,) = heard_alone(DRAWS)
    assert f"of {name}," in message
    assert "global_rng=True" in message
    assert "Gambler" in message


@pytest.mark.parametrize("run", [
    lambda kind: simulate(kind, {decide: lambda observation: 1}),
    lambda kind: simulate_many(
        kind, {decide: lambda observations: np.ones(len(observations), np.int64)}, seeds=[1, 2]
    ),
    lambda kind: vector_env(kind, decide, num_envs=3).reset(seed=1),
])  # fmt: skip
def test_all_env_functions_warn_of_use_of_global_random_generators(heard_alone, run):
    run(gambler(random.random))
    assert len(heard_alone(DRAWS)) == 1


def test_env_does_not_warn_of_a_users_own_random_generators(heard):
    def draw():
        return random.random() + np.random.random()

    user = decision(
        agent=lambda: [draw(), "user"][1],
        reward_mapping=lambda: draw(),
        observation_space_mapping=lambda: [draw(), draw()],
        action_space_mapping=lambda action: [draw(), action][1],
    )
    env = aec_env(calling(*[user] * 4), user)
    play(env, draw)
    simulate(calling(user, user), {user: lambda observation: [draw(), 1][1]})
    play(single_env(gambler(random.Random(3).random), decide))
    play(single_env(gambler(np.random.default_rng(3).random), decide))
    play(single_env(gambler(random.random), decide, global_rng=True))
    assert heard(DRAWS) == []


def test_env_does_not_warn_of_random_draws_in_other_threads(heard):
    over, draws_going_on = threading.Event(), threading.Event()

    def draw():
        while not over.wait(1e-4):
            random.random()
            draws_going_on.set()

    def wait():
        draws_going_on.clear()
        assert draws_going_on.wait(10)
        time.sleep(2 * sys.getswitchinterval())

    other = threading.Thread(target=draw)
    other.start()
    play(single_env(gambler(wait), decide))
    over.set()
    other.join()
    assert heard(DRAWS) == []


# -- agents that never come -----------------------------------------------------------------------


ant = decision(lambda name: 0, agent=lambda name: name)


def hill(*names):
    """A factory of simulations in which these ants take two steps."""
    return calling(*[partial(ant, name) for name in names * 2])


ANTS = hill("ant_0", "ant_1")


@pytest.mark.parametrize(
    ("options", "absent"),
    [
        ({"policies": {"ant_O": lambda observation: 1}}, "ant_O"),
        ({"possible_agents": ["ant_0", "ant_1", "ant_2"]}, "ant_2"),
    ],
    ids=["policies", "possible_agents"],
)
def test_env_warns_once_of_a_possible_agent_that_never_appears(heard, options, absent):
    env = aec_env(ANTS, ant, **options)
    for _ in range(2):
        play_in_turns(env, seed=1)
    (message,) = heard(ABSENT)
    missing, _, those_who_came = message.partition(";")
    assert absent in missing
    assert "ant_1" not in missing
    assert "ant_0, ant_1" in those_who_came


def test_simulate_warns_once_of_a_possible_agent_that_never_appears(heard):
    policies = {"ant_7": lambda observations: np.zeros(len(observations), np.int64)}
    simulate_many(ANTS, policies, seeds=range(5), points=ant)
    assert len(heard(ABSENT)) == 1
    simulate(ANTS, {"ant_8": lambda observation: 0}, points=ant)
    assert len(heard(ABSENT)) == 2


def test_env_does_not_warn_of_absent_agents_in_unfinished_episodes(heard):
    names = ["nest.1", "ant_0"]  # a dot makes no path
    play_in_turns(
        aec_env(
            hill(*names), ant, possible_agents=names, policies={"nest.1": lambda observation: 0}
        )
    )
    env = begun(aec_env(ANTS, ant, possible_agents=["ant_0", "ant_1", "ant_9"]))
    env.close()
    one, ruled = decision(agent="one_0"), decision(agent="ruled_0")
    env = begun(
        single_env(calling(one, ruled), [one, ruled], agent="one_0", policies={"ruled_0": RULE})
    )
    env.step(0)
    assert heard(ABSENT) == []


@pytest.mark.parametrize("slip", ["threading.Thread.strat", f"{__name__}.Missing.step"])
def test_aec_env_refuses_policies_for_names_that_do_not_exist(slip):
    with pytest.raises(UnknownPointError, match="neither an agent nor a decision point"):
        aec_env(ANTS, ant, policies={slip: lambda observation: 0})


# -- rounds that stand still ----------------------------------------------------------------------


def test_parallel_env_warns_if_steps_never_have_the_waiting_agents_action(heard):
    env = begun(parallel_env(ANTS, ant, possible_agents=["ant_0", "ant_1"]), 1)
    for number in range(150):
        env.step({"ant_1": 1} if number % 2 else {})
        assert len(heard("stands still")) == (number >= 99)
    assert "'ant_0'" in heard("stands still")[0]
    env.step({"ant_0": 1, "ant_1": 1})
    assert env.agents == ["ant_0", "ant_1"]
    env.step({"ant_0": 1, "ant_1": 1})
    assert env.agents == []


def test_parallel_env_does_not_warn_if_agents_act_in_turns(heard):
    one, two = decision(agent="one"), decision(agent="two")
    env = begun(parallel_env(calling(*[one, two] * 400), [one, two]), 1)
    for number in range(600):
        # Two rounds of three leave the pending agent out.
        env.step({("one", "two")[number // 3 % 2]: 1} if number % 3 == 0 else {})
    assert heard("stands still") == []


# -- functions that override a point --------------------------------------------------------------


class Tank:
    def drain(self):
        return "rule"

    @staticmethod
    def fill(amount):
        return "rule"


class Deaf(Tank):
    def drain(self):
        return "deaf"

    @staticmethod
    def fill(amount):
        return "deaf"


class Loud(Tank):
    def drain(self):
        return super().drain()


class Named(Tank):
    def drain(self):
        return Tank.drain(self)


def tanks(*kinds):
    return calling(*[lambda kind=kind: kind().drain() for kind in kinds for _ in range(2)])


OVERRIDE = "objects of these classes are no agents"
DRAIN = f"{__name__}.Tank.drain"


def test_env_warns_of_a_subclass_method_that_hides_a_decision_point(heard):
    env = begun(aec_env(tanks(Tank, Deaf), {DRAIN: define()}))
    env.step(1)
    assert not heard(OVERRIDE)
    env.step(1)
    (text,) = heard(OVERRIDE)
    assert f"{__name__}.Deaf.drain override {DRAIN}" in text
    assert env.simulation.log == [1, 1, "deaf", "deaf"]
    play_in_turns(env, 1)
    assert len(heard(OVERRIDE)) == 1
    env.close()
    assert not hasattr(Deaf.drain, "__wrapped__")


def test_env_warns_of_a_static_method_that_hides_a_decision_point(heard):
    model = calling(lambda: Tank.fill(1), lambda: Deaf.fill(2))
    assert simulate(model, {}, points={f"{__name__}.Tank.fill": define()}).log == ["rule", "deaf"]
    assert not heard(OVERRIDE)  # the rule decides everywhere
    model = calling(lambda: Tank.fill(1), lambda: Deaf.fill(2))
    points = {f"{__name__}.Tank.fill": define()}
    assert simulate(model, {"fill_0": lambda _: 3}, points=points).log == [3, "deaf"]
    assert len(heard(OVERRIDE)) == 1


@pytest.mark.parametrize(
    ("model", "points"),
    [
        (tanks(Tank, Loud, Named), {DRAIN: define()}),
        (tanks(Tank), {DRAIN: define()}),
        (tanks(Tank, Deaf), {DRAIN: define(), f"{__name__}.Deaf.drain": define()}),
    ],
)
def test_env_does_not_warn_of_an_override_that_is_a_decision_point(model, points, heard):
    play_in_turns(aec_env(model, points), 1)
    assert not heard(OVERRIDE)


def test_env_accepts_an_overridden_decision_point_in_a_models_thread(heard):
    def main(simulation):
        thread = threading.Thread(target=lambda: simulation.log.append(Deaf().drain()))
        thread.start()
        thread.join()
        simulation.log.append(Tank().drain())

    env = begun(single_env(script(main), {DRAIN: define()}))
    env.step(4)
    assert env.simulation.log == ["deaf", 4]


# -- names of agents, and functions that end them -------------------------------------------------


def test_env_warns_once_if_end_agent_names_an_unknown_agent(heard):
    for ending, expected in [("1 ends", 0), ("1 ends, 1 ends", 0), ("7 ends, 8 ends", 1)]:
        env = aec_env(life(f"0 acts, 1 acts, {ending}, 0 acts"), beings())
        play_in_turns(env, 1)
        play_in_turns(env, 1)
        texts = heard("has no effect, because no agent has had this name")
        assert len(texts) == expected
    assert "end_agent('being_7')" in texts[0]
    assert "these have: being_0, being_1" in texts[0]


def test_possible_agents_may_end_before_their_first_decision(heard):
    roster = ["being_0", "being_1", "being_2"]
    env = aec_env(life("0 acts, 1 acts, 2 ends, 0 acts"), beings(), possible_agents=roster)
    play_in_turns(env, 1)
    assert not heard("has no effect")


PAIR, DYING = life("0 acts, 1 acts, 0 acts"), life("0 acts, 1 acts, 1 leaves, 0 acts")


def test_env_warns_once_if_two_objects_have_one_agent_name(heard):
    env = aec_env(PAIR, beings(agent=lambda being: "ant"))
    play_in_turns(env, 1)
    play_in_turns(env, 1)
    (text,) = heard("several objects decide at")
    assert "'ant'" in text
    play_in_turns(aec_env(PAIR, beings()), 1)
    play_in_turns(aec_env(DYING, beings()), 1)
    assert len(heard("several objects decide at")) == 1


@pytest.mark.parametrize("deciders", [{}, {"one": lambda _: 1}])
def test_env_warns_once_if_two_split_items_have_one_agent_name(deciders, heard):
    class Yard:
        def allot(self):
            return [0, 0, 0, 0]

    def name(item, yard):
        return names[item]

    def play_all():
        model = calling(lambda: yard.allot(), lambda: yard.allot())
        points = {Yard.allot: define(split=lambda yard: ["a", "b", "c"], agent=name)}
        play_in_turns(aec_env(model, points, policies=deciders), 1)

    yard = Yard()
    names = {"a": "one", "b": "two", "c": None}
    play_all()
    assert not heard("several objects decide at")
    names["c"] = "one"
    play_all()
    (text,) = heard("several objects decide at")
    assert "as one agent, 'one'" in text


LEAVE = f"{HERE}.Being.leave"


@pytest.mark.parametrize("key", [Being.leave, LEAVE])
@pytest.mark.parametrize("form", [lambda key: key, lambda key: [key], lambda key: {key: None}])
def test_removed_by_takes_functions_or_dotted_names_and_survives_pickling(key, form, heard):
    env = aec_env(DYING, beings(removed_by=form(key)))
    for _ in range(2):
        assert story(play_in_turns(env, 1)) == "0 1 1+ 0 0+"
    assert not heard("removed_by= of")
    copied = pickle.loads(cloudpickle.dumps(env))
    assert len(play_in_turns(copied, 1)) == 5


def test_env_warns_once_if_a_removed_by_function_is_never_called(heard):
    play_in_turns(aec_env(PAIR, beings()), 1)  # nobody can have been removed
    env = begun(aec_env(life("1 acts, 0 acts, 0 acts, 0 acts"), beings()))
    env.close()
    assert not heard("removed_by= of")
    play_in_turns(env, 1)
    play_in_turns(env, 1)
    (text,) = heard("removed_by= of")
    assert f"removed_by= of {HERE}.Being.act names {LEAVE}, which the model did not" in text
    play_in_turns(aec_env(DYING, beings(removed_by=[f"{HERE}.banish", Being.leave])), 1)
    assert len(heard("removed_by= of")) == 1
