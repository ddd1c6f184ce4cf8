"""Section 4: generate_env, aec_env, single_env and their options."""

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium import spaces

import simenv_marl
from simenv_marl import RULE, TRUNCATED, aec_env, generate_env, joint_env, parallel_env, single_env
from simenv_marl.errors import (
    AgentError,
    DefinitionError,
    InvalidActionError,
    OptionValueError,
    UnknownOptionError,
    UnknownPointError,
    ViewError,
)
from tests.worlds.models import Script, calling, decision, decisions, define, plainly, play, rewards_of, script

PUMP, FAN = decision(agent="pump_0"), decision(agent="fan_0")
NAMED = define(agent=lambda name: name)(lambda name: "rule")
BOTH = calling(PUMP, FAN, PUMP)


# -- what is made ---------------------------------------------------------------------------------


def test_generate_env_returns_a_class():
    env_class = generate_env(BOTH, PUMP)
    assert isinstance(env_class, type)
    assert issubclass(env_class, gymnasium.Env)
    one, two = env_class(), env_class()
    assert isinstance(one, env_class)
    assert one.unwrapped.simulation is not two.unwrapped.simulation


@pytest.mark.parametrize(
    ("points", "options", "base"),
    [
        (PUMP, {}, gymnasium.Env),
        ([PUMP], {}, gymnasium.Env),
        ([PUMP, FAN], {}, pettingzoo.AECEnv),
        (NAMED, {}, pettingzoo.AECEnv),
        ([PUMP, FAN], {"policies": {FAN: RULE}}, gymnasium.Env),
        ([PUMP, FAN], {"policies": {"fan_0": lambda observation: 1}}, gymnasium.Env),
        ([PUMP, NAMED], {"policies": {NAMED: lambda observation: 1}}, gymnasium.Env),
        (PUMP, {"view": "aec"}, pettingzoo.AECEnv),
        (PUMP, {"view": "single"}, gymnasium.Env),
        ([PUMP, FAN], {"view": "aec"}, pettingzoo.AECEnv),
        ([PUMP, FAN], {"view": "single", "policies": {"fan_0": RULE}}, gymnasium.Env),
    ],
)
def test_views(points, options, base):
    env_class = generate_env(BOTH, points, **options)
    assert issubclass(env_class, base)
    assert isinstance(env_class(), base)


def test_the_functions_return_what_they_say():
    assert isinstance(aec_env(BOTH, PUMP), pettingzoo.AECEnv)
    assert isinstance(single_env(BOTH, PUMP), gymnasium.Env)


@pytest.mark.parametrize("points", [[PUMP, FAN], NAMED], ids=["two", "callable"])
def test_the_single_view_is_refused_where_there_is_not_one_agent(points):
    with pytest.raises(ViewError, match="needs one active decision point"):
        single_env(BOTH, points)
    with pytest.raises(ViewError, match="needs one active decision point"):
        generate_env(BOTH, points, view="single")


@pytest.mark.parametrize("view", ["", "AEC", "dual", 3], ids=repr)
def test_unknown_views_are_refused(view):
    with pytest.raises(OptionValueError, match="view must be None"):
        generate_env(BOTH, PUMP, view=view)


def test_unwrapped_and_simulation():
    for env in (aec_env(BOTH, PUMP), single_env(BOTH, PUMP), generate_env(BOTH, PUMP)()):
        assert env.unwrapped is env
        assert isinstance(env.unwrapped.simulation, Script)
    wrapped = pettingzoo.utils.wrappers.OrderEnforcingWrapper(aec_env(BOTH, PUMP))
    assert isinstance(wrapped.unwrapped.simulation, Script)
    wrapped = gymnasium.wrappers.OrderEnforcing(single_env(BOTH, PUMP))
    assert isinstance(wrapped.unwrapped.simulation, Script)


def test_what_environments_say_about_themselves():
    for env in (aec_env(BOTH, PUMP), single_env(BOTH, PUMP), generate_env(BOTH, PUMP)()):
        assert isinstance(env.metadata["name"], str)
        assert list(env.metadata["render_modes"]) == []
        assert env.render_mode is None
        assert str(env)
        assert repr(env)


def test_spaces():
    space = spaces.Box(0, 1, (3,), np.float32)
    pump = decision(observation_space=space, action_space=spaces.Discrete(4), agent="pump_0")
    env = aec_env(calling(pump), pump)
    assert env.observation_space("pump_0") == space
    assert env.action_space("pump_0") == spaces.Discrete(4)
    env = single_env(calling(pump), pump)
    assert (env.observation_space, env.action_space) == (space, spaces.Discrete(4))


def test_spaces_of_agents_that_are_named_by_a_callable():
    env = aec_env(calling(lambda: NAMED("a"), lambda: NAMED("b")), NAMED)
    env.reset()
    space = env.action_space("a")
    assert space == spaces.Discrete(10)
    with pytest.raises(LookupError, match="there is no agent"):
        env.action_space("b")
    env.step(1)
    assert env.action_space("a") is space
    assert env.action_space("b") == spaces.Discrete(10)
    assert env.action_space("b") is not space


@pytest.mark.parametrize("method", ["action_space", "observation_space", "observe"])
def test_agents_that_nobody_knows_are_lookup_errors(method):
    env = aec_env(BOTH, [PUMP, FAN])
    env.reset()
    with pytest.raises(simenv_marl.errors.UnknownAgentError) as caught:
        getattr(env, method)("nobody_0")
    assert isinstance(caught.value, LookupError)


# -- options --------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [aec_env, single_env, generate_env])
@pytest.mark.parametrize("options", [{"max_step": 3}, {"seed": 1}, {"max_steps": 3, "colour": "red"}])
def test_unknown_options_are_refused(make, options):
    with pytest.raises(UnknownOptionError, match=list(options)[-1]) as caught:
        make(BOTH, PUMP, **options)
    assert isinstance(caught.value, TypeError)


def test_unknown_options_of_instances_are_refused():
    with pytest.raises(UnknownOptionError, match="there is no option"):
        generate_env(BOTH, PUMP)(colour="red")


@pytest.mark.parametrize("make", [aec_env, single_env, generate_env])
@pytest.mark.parametrize(
    "options",
    [
        {"max_steps": 0},
        {"max_steps": -1},
        {"max_steps": 2.0},
        {"max_steps": "3"},
        {"driver": "magic"},
        {"driver": None},
        {"policies": 3},
        {"policies": [PUMP]},
        {"policies": {"pump_0": 3}},
        {"policies": {"pump_0": None}},
        {"render_mode": "human"},
    ],
    ids=plainly,
)
def test_options_that_cannot_be_are_refused(make, options):
    with pytest.raises(OptionValueError) as caught:
        make(BOTH, PUMP, **options)
    assert isinstance(caught.value, ValueError)


def test_the_default_driver_has_a_name():
    env = single_env(BOTH, PUMP, driver="greenlet")
    env.reset()
    env.step(1)


def test_instances_may_change_the_options_of_their_class():
    env_class = generate_env(BOTH, [PUMP, FAN], view="aec", max_steps=1)
    assert len(decisions(play(env_class()))) == 1
    assert len(decisions(play(env_class(max_steps=2)))) == 2
    assert len(decisions(play(env_class(max_steps=None)))) == 3
    assert decisions(play(env_class(max_steps=None, policies={"pump_0": RULE}))) == ["fan_0"]


# -- max_steps ------------------------------------------------------------------------------------


@pytest.mark.parametrize("actions", [1, RULE])
def test_max_steps_runs_on_to_the_next_decision_and_truncates(actions):
    counted = []
    pump = decision(agent="pump_0", reward_mapping=lambda: len(counted))

    def main(simulation):
        for number in range(5):
            counted.append(number)
            simulation.log.append(pump())

    env = single_env(script(main), pump, max_steps=2)
    for _ in range(2):
        counted.clear()
        env.reset()
        assert env.step(actions)[1:4] == (2.0, False, False)
        # The second step lets the model run up to its third decision, and is rewarded there.
        assert env.step(actions)[1:4] == (3.0, False, True)
        assert counted == [0, 1, 2]
        assert len(env.unwrapped.simulation.log) == 2
        with pytest.raises(simenv_marl.errors.EpisodeOverError):
            env.step(actions)
    env.close()


def test_max_steps_that_the_episode_reaches_by_itself_terminate_it():
    env = single_env(calling(PUMP, PUMP), PUMP, max_steps=2)
    env.reset()
    env.step(1)
    assert env.step(1)[2:4] == (True, False)
    env = single_env(calling(PUMP, PUMP, ends=TRUNCATED), PUMP, max_steps=20)
    env.reset()
    env.step(1)
    assert env.step(1)[2:4] == (False, True)


def test_max_steps_truncate_all_agents():
    env = aec_env(calling(*[PUMP, FAN] * 5), [PUMP, FAN], max_steps=3)
    turns = play(env, 1)
    assert decisions(turns) == ["pump_0", "fan_0", "pump_0"]
    assert [(turn.terminated, turn.truncated) for turn in turns[3:]] == [(False, True)] * 2


def test_max_steps_count_neither_illegal_actions_nor_dead_steps_nor_policies():
    env = aec_env(calling(*[PUMP, FAN] * 5), [PUMP, FAN], max_steps=3, policies={FAN: lambda observation: 1})
    env.reset()
    for _ in range(3):
        with pytest.raises(InvalidActionError, match="is not in its action space"):
            env.step(99)
        env.step(1)
    assert env.truncations == {"pump_0": True}
    env.step(None)
    assert env.agents == []
    assert decisions(play(env, 1)) == ["pump_0"] * 3


def test_max_steps_reward_the_agent_whose_decision_has_arisen_too():
    level = [0]
    pump = decision(agent="pump_0", reward_mapping=lambda: level[0])
    fan = decision(agent="fan_0", reward_mapping=lambda: -level[0])

    def main(simulation):
        level[0] = 0
        while True:
            level[0] += 1
            pump()
            level[0] += 10
            fan()

    env = aec_env(script(main), [pump, fan], max_steps=3)
    turns = play(env, 1)
    assert decisions(turns) == ["pump_0", "fan_0", "pump_0"]
    assert rewards_of(turns, "pump_0") == [12.0, 22.0]
    assert rewards_of(turns, "fan_0") == [-22.0]


# -- policies -------------------------------------------------------------------------------------


class Counting:
    """A policy that counts how often it was asked."""

    def __init__(self):
        self.asked = []

    def __call__(self, observation):
        self.asked.append(observation.tolist())
        return len(self.asked)

    def method(self, observation, info):
        self.asked.append((observation.tolist(), info))
        return 8


@pytest.mark.parametrize("key", ["fan_0", FAN], ids=["agent", "point"])
@pytest.mark.parametrize("points", [[PUMP, FAN], PUMP], ids=["listed", "unlisted"])
def test_policies_answer_and_are_no_agents(key, points):
    if points is PUMP and key == "fan_0":
        with pytest.raises(UnknownPointError, match="known are pump"):
            aec_env(BOTH, points, policies={key: lambda observation: 1})
        return
    policy = Counting()
    env = aec_env(BOTH, points, policies={key: policy})
    assert env.possible_agents == ["pump_0"]
    env.reset()
    assert env.agents == ["pump_0"]
    assert set(env.rewards) == set(env.infos) == {"pump_0"}
    turns = play(env, 5)
    assert decisions(turns) == ["pump_0", "pump_0"]
    assert env.unwrapped.simulation.log == [5, 1, 5]
    assert policy.asked == [[1.0, 2.0]]


class Room:
    @define(agent="warmer_0")
    def warm(self):
        return "rule"

    @define()
    def cool(self):
        return "rule"


def room():
    return calling(Room().warm, Room().cool)


def test_policies_may_name_points_by_their_dotted_name():
    for points in ([Room.cool, Room.warm], Room.cool):
        env = aec_env(room(), points, policies={f"{__name__}.Room.warm": lambda observation: 4})
        play(env, 1)
        assert env.unwrapped.simulation.log == [4, 1]


def test_a_policy_may_be_rule():
    for key in ("warmer_0", Room.warm, f"{__name__}.Room.warm"):
        env = aec_env(room(), [Room.cool, Room.warm], policies={key: RULE})
        assert env.possible_agents == ["cool_0"]
        play(env, 1)
        assert env.unwrapped.simulation.log == ["rule", 1]


def test_a_policy_may_answer_rule():
    env = aec_env(room(), [Room.cool, Room.warm], policies={Room.warm: lambda observation: RULE})
    play(env, 1)
    assert env.unwrapped.simulation.log == ["rule", 1]


def one_argument(observation):
    return len(observation)


def two_arguments(observation, info):
    return info["action_mask"].tolist().index(1)


def optional_info(observation, info=None):
    return info["action_mask"].tolist().index(1)


def other_default(observation, scale=2):
    return scale


class Stateful:
    def __call__(self, observation, info):
        return two_arguments(observation, info)

    def act(self, observation):
        return 2


@pytest.mark.parametrize(
    ("policy", "answer"),
    [
        (one_argument, 2),
        (two_arguments, 3),
        (optional_info, 3),
        (other_default, 2),
        (Stateful(), 3),
        (Stateful().act, 2),
        (lambda observation: 1, 1),
        (lambda *arguments: 3, 3),
        (len, 2),
    ],
)
def test_policies_are_callables_of_the_observation_or_of_observation_and_info(policy, answer):
    masked = decision(agent="masked_0", action_mask_mapping=lambda: [0, 0, 0, 1, 1, 1, 1, 1, 1, 1])
    plain = decision(agent="masked_0")
    decide = masked if answer == 3 else plain
    env = aec_env(calling(decide, PUMP), [decide, PUMP], policies={"masked_0": policy})
    play(env, 1)
    assert env.unwrapped.simulation.log == [answer, 1]


def test_a_policys_action_is_checked_and_mapped():
    fan = decision(agent="fan_0", action_space_mapping=lambda action: ("mapped", action))
    env = aec_env(calling(fan, PUMP), [fan, PUMP], policies={fan: lambda observation: np.int64(3)})
    play(env, 1)
    assert env.unwrapped.simulation.log == [("mapped", 3), 1]
    env = aec_env(calling(PUMP, fan), [fan, PUMP], policies={fan: lambda observation: 10})
    env.reset()
    with pytest.raises(InvalidActionError, match="is not in its action space"):
        env.step(1)
    env.reset()


def test_policies_of_agents_that_a_callable_names():
    calls = calling(*[lambda name=name: NAMED(name) for name in ("a", "b", "a", "c")])
    env = aec_env(calls, NAMED, policies={"a": lambda observation: 7})
    assert decisions(play(env, 1)) == ["b", "c"]
    assert env.unwrapped.simulation.log == [7, 1, 7, 1]
    env = aec_env(calls, NAMED, policies={"a": RULE, "c": RULE})
    assert decisions(play(env, 1)) == ["b"]
    assert env.unwrapped.simulation.log == ["rule", 1, "rule", "rule"]
    env = aec_env(calling(PUMP, *[lambda: NAMED("a")] * 2), [PUMP, NAMED], policies={NAMED: lambda observation: 6})
    assert decisions(play(env, 1)) == ["pump_0"]
    assert env.unwrapped.simulation.log == [1, 6, 6]


def test_policies_of_agents_that_a_callable_names_may_have_any_name():
    calls = calling(*[lambda name=name: NAMED(name) for name in ("herd.1", "Sheep 2", "c")])
    env = aec_env(calls, NAMED, policies={"herd.1": lambda observation: 7, "Sheep 2": lambda observation: 8})
    assert decisions(play(env, 1)) == ["c"]
    assert env.unwrapped.simulation.log == [7, 8, 1]


@pytest.mark.parametrize("key", ["nobody_0", "tests.contract.test_environments.Nobody.decides", "no.where", 3, None])
def test_policies_for_nobody_are_refused(key):
    with pytest.raises(UnknownPointError, match="known are fan"):
        aec_env(BOTH, [PUMP, FAN], policies={key: lambda observation: 1})


def test_policies_for_everybody_leave_no_environment():
    with pytest.raises(UnknownPointError, match="no decision point is left"):
        aec_env(BOTH, PUMP, policies={PUMP: RULE})


def test_policies_observe_in_order_with_everybody_else():
    level = [0]
    pump = decision(agent="pump_0", observation_space_mapping=lambda: [level[0], 0])
    fan = decision(agent="fan_0", observation_space_mapping=lambda: [level[0], 0])

    def main(simulation):
        level[0] = 0
        for _ in range(2):
            level[0] += pump()
            level[0] += fan()

    policy = Counting()
    env = aec_env(script(main), [pump, fan], policies={"fan_0": policy})
    turns = play(env, 5)
    assert [turn.observation[0] for turn in turns] == [0, 6, 13]
    assert policy.asked == [[5.0, 0.0], [11.0, 0.0]]


# -- agents ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [3, 1.0, ("a",), b"a", True], ids=repr)
def test_a_callable_that_names_no_string_is_an_error(name):
    decide = decision(agent=lambda: name)
    env = aec_env(calling(decide), decide)
    with pytest.raises(AgentError, match="must return a string or None") as caught:
        env.reset()
    assert isinstance(caught.value, ValueError)


def test_an_agent_has_one_decision_point():
    named = decision(agent=lambda: "pump_0")
    env = aec_env(calling(PUMP, named), [PUMP, named])
    env.reset()
    with pytest.raises(AgentError, match="has one decision point"):
        env.step(1)
    other = decision(agent=lambda: "pump_0")
    env = aec_env(calling(named, other), [named, other])
    env.reset()
    with pytest.raises(AgentError, match="has one decision point"):
        env.step(1)


# -- rendering ------------------------------------------------------------------------------------


class Rendering(Script):
    render_modes = ("ansi", "rgb_array")

    def __init__(self):
        super().__init__(lambda simulation: PUMP())

    def render(self, mode):
        return f"{mode} of {self.episodes}"


@pytest.mark.parametrize("make", [aec_env, parallel_env, single_env, joint_env])
def test_metadata_say_what_clients_ask_for(make):
    class Slow(Rendering):
        render_fps = 0.5

    assert make(Rendering, PUMP).metadata["render_fps"] == 4
    metadata = make(Slow, PUMP, max_steps=3).metadata
    assert metadata["render_fps"] == 0.5
    assert metadata.get("is_parallelizable") == {aec_env: False, parallel_env: True}.get(make)


@pytest.mark.parametrize("make", [aec_env, parallel_env, single_env, joint_env])
def test_every_view_has_a_generator(make):
    env = make(Rendering, PUMP)
    env.reset(seed=3)
    assert env.unwrapped.np_random_seed == 3
    assert env.unwrapped.np_random.random() == np.random.default_rng(3).random()
    env.unwrapped.np_random = generator = np.random.default_rng(5)
    assert env.unwrapped.np_random is generator
    assert env.unwrapped.np_random_seed == -1


class Hut:
    """What its simulation has a definition for."""

    def heat(self):
        return "rule"

    def air(self):
        return "rule"


class Housed:
    points = {  # noqa: RUF012 - as simulations have it
        f"{__name__}.Hut.heat": define(agent="heat_0", action_space_mapping=lambda action: 10 * action),
        f"{__name__}.Hut.air": define(agent="air_0"),
    }

    def reset(self):
        self.log = []

    def run(self):
        self.log += [Hut().heat(), Hut().air()]


@pytest.mark.parametrize("named", [f"{__name__}.Hut.heat", Hut.heat, [Hut.heat]])
@pytest.mark.parametrize("source", [Housed, lambda: Housed(), Housed()], ids=["class", "factory", "instance"])
def test_a_point_that_is_named_has_the_simulations_own_definition(source, named):
    env = single_env(source, named)
    env.reset()
    env.step(3)
    assert env.simulation.log == [30, "rule"]
    env.close()
    with pytest.raises(DefinitionError, match="has no definition here"):
        single_env(Housed, Rendering.render)
    assert single_env(source, {Hut.heat: define(agent="mine")}).unwrapped is not None


def test_instances_may_choose_their_render_mode():
    env = generate_env(Rendering, PUMP)(render_mode="rgb_array")
    env.reset()
    assert env.render() == "rgb_array of 1"
    assert list(generate_env(Rendering, PUMP).metadata["render_modes"]) == ["ansi", "rgb_array"]
