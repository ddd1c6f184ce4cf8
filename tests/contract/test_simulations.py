"""Section 2, and 5.1 of the contract: what a simulation is, how it is made, reset, seeded and ended."""

import threading
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, TRUNCATED, SimulationInterface, aec_env, generate_env, single_env
from simenv_marl.errors import NoDecisionError, NotResetError, OptionValueError, SimulationError
from tests.worlds.many_worlds import beings
from tests.worlds.models import Script, calling, decision, decisions, define, plainly, play, script

# -- sources --------------------------------------------------------------------------------------


class Model:
    @define()
    def decide(self):
        return 0


class Simulation(SimulationInterface):
    made = 0

    def __init__(self):
        type(self).made += 1
        self.parts = ["as made"]
        self.resets = 0

    def reset(self):
        self.resets += 1
        self.model = Model()

    def run(self):
        for _ in range(2):
            self.parts.append(self.model.decide())


def test_an_instance_is_copied():
    original = Simulation()
    one, two = aec_env(original, Model.decide), aec_env(original, Model.decide)
    play(one, 4)
    play(two, 5)
    assert original.parts == ["as made"]
    assert original.resets == 0
    assert not hasattr(original, "model")
    assert one.unwrapped.simulation.parts == ["as made", 4, 4]
    assert two.unwrapped.simulation.parts == ["as made", 5, 5]


def test_an_instance_is_copied_as_it_stands_when_the_environment_is_made():
    original = Simulation()
    original.parts.append("grown")
    env = single_env(original, Model.decide)
    original.parts.append("too late")
    assert env.unwrapped.simulation.parts == ["as made", "grown"]


@pytest.mark.parametrize("kind", ["class", "factory"])
def test_classes_and_factories_make_one_simulation_for_each_environment(kind):
    source = Simulation if kind == "class" else lambda: Simulation()
    envs = [single_env(source, Model.decide) for _ in range(3)]
    assert len({id(env.unwrapped.simulation) for env in envs}) == 3
    assert all(type(env.unwrapped.simulation) is Simulation for env in envs)


@pytest.mark.parametrize("view", ["aec", "single"])
def test_a_simulation_is_made_once_and_reset_for_each_episode(view):
    before = Simulation.made
    env_class = generate_env(lambda: Simulation(), Model.decide, view=view)
    env = env_class()
    assert Simulation.made == before + 1
    simulation = env.unwrapped.simulation
    for number in (1, 2, 3):
        env.reset()
        assert env.unwrapped.simulation is simulation
        assert simulation.resets == number
        env.step(1)
    env.close()
    env.reset()
    assert env.unwrapped.simulation is simulation
    assert Simulation.made == before + 1


def test_anything_that_runs_and_resets_is_a_simulation():
    class Duck:
        __slots__ = ("log",)

        def reset(self):
            self.log = []

        def run(self):
            self.log.append(Model().decide())

    for source in (Duck, Duck(), lambda: Duck()):
        env = single_env(source, Model.decide)
        env.reset()
        env.reset()  # in mid-episode, without a stop
        env.step(3)
        assert env.unwrapped.simulation.log == [3]


def test_the_interface_asks_for_run_and_reset_alone():
    with pytest.raises(TypeError):
        SimulationInterface()

    class Least(SimulationInterface):
        def reset(self):
            pass

        def run(self):
            Model().decide()

    env = single_env(Least, Model.decide)
    env.reset()
    env.close()


class NoReset:
    def run(self):
        pass


class NoRun:
    def reset(self):
        pass


class Lockable(Simulation):
    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()


@pytest.mark.parametrize(
    "source", [3, "Simulation", None, NoReset(), NoReset, NoRun, NoRun(), lambda: None, Lockable()], ids=plainly
)
def test_what_is_no_simulation_is_refused(source):
    with pytest.raises(SimulationError, match="simulation") as caught:
        single_env(source, Model.decide)
    assert isinstance(caught.value, TypeError)


def test_an_error_in_a_factory_surfaces_as_itself():
    def source():
        raise KeyError("factory")

    with pytest.raises(KeyError, match="factory"):
        single_env(source, Model.decide)


# -- seeds and options ----------------------------------------------------------------------------


def recording(reset_of: Any) -> Any:
    class Recording:
        def __init__(self):
            self.got = []

        reset = reset_of

        def run(self):
            Model().decide()

    return Recording


def reset_plain(self):
    self.got.append({})


def reset_seed(self, seed=None):
    self.got.append({"seed": seed})


def reset_seed_required(self, seed):
    self.got.append({"seed": seed})


def reset_both(self, seed=None, options=None):
    self.got.append({"seed": seed, "options": options})


def reset_keywords(self, *, seed=None, options=None):
    self.got.append({"seed": seed, "options": options})


def reset_anything(self, **keywords):
    self.got.append(keywords)


def reset_options(self, options=None):
    self.got.append({"options": options})


@pytest.mark.parametrize("make", [aec_env, single_env])
@pytest.mark.parametrize(
    ("reset", "expected"),
    [
        (reset_plain, {}),
        (reset_seed, {"seed": 7}),
        (reset_seed_required, {"seed": 7}),
        (reset_both, {"seed": 7, "options": {"size": 3}}),
        (reset_keywords, {"seed": 7, "options": {"size": 3}}),
        (reset_anything, {"seed": 7, "options": {"size": 3}}),
        (reset_options, {"options": {"size": 3}}),
    ],
)
def test_reset_gets_what_it_takes(make, reset, expected):
    env = make(recording(reset), Model.decide)
    env.reset(seed=7, options={"size": 3})
    assert env.unwrapped.simulation.got == [expected]


def test_options_that_were_not_given_are_none():
    env = single_env(recording(reset_both), Model.decide)
    env.reset(seed=1)
    assert env.unwrapped.simulation.got == [{"seed": 1, "options": None}]


def seeds_of(env):
    return [got["seed"] for got in env.unwrapped.simulation.got]


@pytest.mark.parametrize("make", [aec_env, single_env])
def test_a_simulation_always_gets_an_integer_seed(make):
    env = make(recording(reset_seed), Model.decide)
    for seed in (None, None, 0, None, np.int64(4), 2**40):
        env.reset(seed=seed)
    seeds = seeds_of(env)
    assert all(type(seed) is int for seed in seeds)
    assert (seeds[2], seeds[4], seeds[5]) == (0, 4, 2**40)
    assert len(set(seeds)) == 6


@pytest.mark.parametrize("make", [aec_env, single_env])
def test_seeds_follow_from_the_last_that_was_given(make):
    one, two = (make(recording(reset_seed), Model.decide) for _ in range(2))
    one.reset()
    one.reset(seed=3)
    for _ in range(2):
        for env in (one, two):
            env.reset(seed=5)
            for _ in range(3):
                env.reset()
    assert seeds_of(one)[2:] == seeds_of(two)
    assert seeds_of(two)[:4] == seeds_of(two)[4:]
    assert len(set(seeds_of(two))) == 4


def test_the_views_draw_the_same_seeds():
    aec, single = (make(recording(reset_seed), Model.decide) for make in (aec_env, single_env))
    for env in (aec, single):
        env.reset(seed=5)
        env.reset()
    assert seeds_of(aec) == seeds_of(single)


def test_two_unseeded_environments_differ():
    one, two = (single_env(recording(reset_seed), Model.decide) for _ in range(2))
    one.reset()
    two.reset()
    assert seeds_of(one) != seeds_of(two)


@pytest.mark.parametrize("make", [aec_env, single_env])
@pytest.mark.parametrize("seed", [-1, 1.5, "1", [1]])
def test_seeds_that_are_none_are_refused_and_nothing_happens(make, seed):
    env = make(recording(reset_seed), Model.decide)
    env.reset(seed=1)
    with pytest.raises(OptionValueError, match="seed must be a non-negative"):
        env.reset(seed=seed)
    assert seeds_of(env) == [1]
    env.step(3)


def several_points():
    def choose(name):
        return 0

    decide = decision(choose, agent=lambda name: name)
    other = decision()
    return calling(other, *[lambda name=name: decide(name) for name in "abcab"]), [decide, other]


def samples(env, agent):
    return [env.action_space(agent).sample() for _ in range(8)]


def sample_all(env, seed):
    env.reset(seed=seed)
    drawn = {}
    for agent in env.agent_iter():
        terminated = env.last()[2]
        drawn.setdefault(agent, samples(env, agent))
        env.step(None if terminated else 1)
    return drawn


def test_action_spaces_are_seeded_those_of_late_joiners_included():
    simulation, points = several_points()
    one, two = aec_env(simulation, points), aec_env(simulation, points)
    two.reset(seed=9)  # another history
    first = sample_all(one, 3)
    assert set(first) == {"choose_0", "a", "b", "c"}
    assert sample_all(one, 3) == first
    assert sample_all(two, 3) == first
    assert sample_all(two, 4) != first


def test_a_declared_agents_action_space_is_seeded_before_it_is_asked_for_and_after():
    points = [decision(agent="a_0"), decision(agent="b_0")]
    one, two = (aec_env(calling(*points), points) for _ in range(2))
    spaces_before = {agent: two.action_space(agent) for agent in ("a_0", "b_0")}
    for env in (one, two):
        env.reset(seed=3)
    assert {agent: two.action_space(agent) for agent in ("a_0", "b_0")} == spaces_before
    for agent in ("a_0", "b_0"):
        assert two.action_space(agent) is spaces_before[agent]
        assert samples(one, agent) == samples(two, agent)


def test_the_single_view_seeds_its_action_space():
    envs = [single_env(calling(decide := decision()), decide) for _ in range(2)]
    for env in envs:
        env.reset(seed=3)
    drawn = [[env.action_space.sample() for _ in range(8)] for env in envs]
    assert drawn[0] == drawn[1]


def test_spaces_are_the_environments_own():
    decide = decision(action_space=spaces.Discrete(1000))
    one, two = (aec_env(calling(decide), decide) for _ in range(2))
    assert one.action_space("choose_0") is one.action_space("choose_0")
    assert one.action_space("choose_0") is not two.action_space("choose_0")
    assert one.observation_space("choose_0") is not two.observation_space("choose_0")
    assert one.action_space("choose_0") == spaces.Discrete(1000)
    single = [single_env(calling(decide), decide) for _ in range(2)]
    assert single[0].action_space is not single[1].action_space
    assert single[0].observation_space is not single[1].observation_space


# -- ends -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ends", "truncated"), [(None, False), (TRUNCATED, True), (True, False), (0, False), ("truncated", False)]
)
def test_the_return_of_run_ends_the_episode(ends, truncated):
    one, two = decision(agent="a_0"), decision(agent="b_0")
    env = single_env(calling(one, ends=ends), one)
    env.reset()
    flags = env.step(1)[2:4]
    assert flags == (not truncated, truncated)
    assert [type(flag) for flag in flags] == [bool, bool]
    env = aec_env(calling(one, two, one, ends=ends), [one, two])
    turns = play(env)
    ended = [turn for turn in turns if turn.terminated or turn.truncated]
    assert {turn.agent for turn in ended} == {"a_0", "b_0"}
    assert len(ended) == 2
    assert {(turn.terminated, turn.truncated) for turn in ended} == {(not truncated, truncated)}
    assert {type(flag) for turn in turns for flag in (turn.terminated, turn.truncated)} == {bool}


def test_flags_in_the_books_are_python_bools():
    one, two = decision(agent="a_0"), decision(agent="b_0")
    env = aec_env(calling(one, two), [one, two])
    env.reset()
    assert env.terminations == env.truncations == {"a_0": False, "b_0": False}
    env.step(1)
    env.step(1)
    assert env.terminations == {"a_0": True, "b_0": True}
    assert env.truncations == {"a_0": False, "b_0": False}
    assert all(type(flag) is bool for flag in [*env.terminations.values(), *env.truncations.values()])


def test_stop_is_called_to_unwind_and_only_then():
    class Stoppable(Script):
        stops = 0

        def stop(self):
            self.stops += 1

    decide = decision()
    env = single_env(lambda: Stoppable(lambda simulation: decide()), decide)
    env.reset()
    env.step(1)
    env.reset()
    assert env.unwrapped.simulation.stops == 0
    env.reset()
    assert env.unwrapped.simulation.stops == 1
    env.close()
    assert env.unwrapped.simulation.stops == 2
    env.close()
    assert env.unwrapped.simulation.stops == 2


@pytest.mark.parametrize("make", [aec_env, single_env])
def test_an_episode_without_a_decision_is_an_error(make):
    decide = decision()
    empty = [True]

    def main(simulation):
        if not empty[0]:
            decide()

    env = make(script(main), decide)
    with pytest.raises(NoDecisionError, match="without a decision") as caught:
        env.reset()
    assert isinstance(caught.value, RuntimeError)
    with pytest.raises(NotResetError, match="no episode yet"):
        env.step(1)
    empty[0] = False
    env.reset()
    env.step(1)
    empty[0] = True
    with pytest.raises(NoDecisionError, match="without a decision"):
        env.reset()


def test_an_episode_in_which_nobody_is_an_agent_is_one_without_a_decision():
    decide = decision(agent=lambda: None)
    with pytest.raises(NoDecisionError, match="without a decision"):
        aec_env(calling(decide, decide), decide).reset()


def test_an_episode_in_which_policies_answer_everything_is_one_without_a_decision():
    decide, other = decision(), decision(agent="other_0")
    with pytest.raises(NoDecisionError, match="without a decision"):
        aec_env(calling(decide), [decide, other], policies={decide: lambda observation: 1}).reset()


# -- decisions where nobody can be asked ----------------------------------------------------------


def test_decisions_while_a_simulation_is_made_or_reset_run_their_rule():
    class Early:
        def __init__(self):
            self.made = Model().decide()

        def reset(self):
            self.at_reset = Model().decide()

        def run(self):
            self.ran = Model().decide()

    env = single_env(Early, Model.decide)
    for _ in range(2):
        env.reset()
        env.step(5)
        simulation = env.unwrapped.simulation
        assert (simulation.made, simulation.at_reset, simulation.ran) == (0, 0, 5)


def test_decisions_while_it_is_stopped_or_rendered_run_their_rule():
    seen = []

    class Late(Script):
        def stop(self):
            seen.append(Model().decide())

        def render(self, mode):
            seen.append(Model().decide())
            return mode

    env = single_env(lambda: Late(lambda simulation: Model().decide()), Model.decide, render_mode="ansi")
    env.reset()
    assert env.render() == "ansi"
    env.close()
    assert seen == [0, 0]


def test_decisions_in_mappings_run_their_rule():
    seen = []

    def observe():
        seen.append(Model().decide())
        return [0, 0]

    def ask(*args):
        seen.append(Model().decide())
        return args[0] if args else [1] * 10

    decide = decision(
        observation_space_mapping=observe,
        reward_mapping=lambda: Model().decide(),
        action_space_mapping=ask,
        action_mask_mapping=ask,
        agent=lambda: f"agent_{Model().decide()}",
    )
    env = aec_env(calling(decide, decide), [decide, Model.decide], policies={Model.decide: lambda observation: 7})
    assert decisions(play(env, 3)) == ["agent_0", "agent_0"]
    assert set(seen) == {0}
    assert env.unwrapped.simulation.log == [3, 3]


def test_decisions_in_policies_run_their_rule():
    seen = []
    other = decision(agent="other_0")

    def policy(observation):
        seen.append(Model().decide())
        return 1

    env = aec_env(calling(other, lambda: Model().decide()), [other, Model.decide], policies={other: policy})
    assert decisions(play(env, 3)) == ["decide_0"]
    assert seen == [0]


def test_decisions_called_from_rules_are_decisions_like_any_other():
    inner = decision(agent="inner_0")
    outer = decision(lambda: ("outer", inner()), agent="outer_0")
    env = aec_env(calling(outer, outer), [outer, inner])
    turns = play(env, iter([RULE, 4, 5]))
    assert decisions(turns) == ["outer_0", "inner_0", "outer_0"]
    assert env.unwrapped.simulation.log == [("outer", 4), 5]


# -- how often it is made -------------------------------------------------------------------------


@pytest.mark.parametrize("points", [None, "given"])
def test_a_factory_makes_one_simulation_for_each_environment(points):
    made = []
    ant = decision(agent="ant_0")

    def factory():
        made.append(calling(ant)())
        made[-1].points = ant
        return made[-1]

    env = aec_env(factory, points and ant)
    env.reset()
    env.reset()
    assert made == [env.simulation]
    cls = generate_env(factory, points and ant)
    envs = [cls(), cls(), cls(max_steps=3)]
    assert made[1:] == [env.simulation for env in envs]


def test_rosters_may_be_iterators():
    def main(simulation):
        return None

    cls = generate_env(script(main), beings(), possible_agents=(f"being_{number}" for number in range(2)))
    assert cls().possible_agents == cls().possible_agents == ["being_0", "being_1"]
    (point,) = beings()
    cls = generate_env(script(main), beings(), possible_agents={point: (f"being_{number}" for number in range(2))})
    assert cls().possible_agents == cls().possible_agents == ["being_0", "being_1"]


@pytest.mark.parametrize("roster", [5, {"being_0": 5}])
def test_what_is_no_roster(roster):
    with pytest.raises(OptionValueError, match="possible_agents"):
        aec_env(script(lambda simulation: None), beings(), possible_agents=roster)


def test_a_reset_may_be_any_callable():
    class Ready(Simulation):
        def __init__(self):
            super().__init__()
            self.got = []
            self.reset = partial(self.begin, "size")

        def begin(self, what, seed):
            self.model = Model()
            self.got.append((what, seed))

    env = single_env(lambda: Ready(), Model.decide)
    for seed in (1, 2):
        env.reset(seed=seed)
    assert env.unwrapped.simulation.got == [("size", 1), ("size", 2)]
