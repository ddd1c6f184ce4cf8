"""Section 4: generate_env, aec_env, single_env and their options."""

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, generate_env, joint_env, parallel_env, single_env
from simenv_marl.errors import (
    AgentError,
    DefinitionError,
    InvalidActionError,
    NoDecisionError,
    OptionValueError,
    UnknownOptionError,
    UnknownPointError,
    ViewError,
)
from tests.worlds.models import (
    EVERY_VIEW,
    Script,
    begun,
    calling,
    decision,
    decisions,
    define,
    plainly,
    play,
)

PUMP, FAN = decision(agent="pump_0"), decision(agent="fan_0")
NAMED = define(agent=lambda name: name)(lambda name: "rule")
BOTH = calling(PUMP, FAN, PUMP)


# -- what is made ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("points", "options", "base"),
    [
        (PUMP, {}, gymnasium.Env),
        ([PUMP, FAN], {}, pettingzoo.AECEnv),
        (NAMED, {}, pettingzoo.AECEnv),
        ([PUMP, FAN], {"policies": {FAN: RULE}}, gymnasium.Env),
        ([PUMP, FAN], {"policies": {"fan_0": lambda observation: 1}}, gymnasium.Env),
        ([PUMP, NAMED], {"policies": {NAMED: lambda observation: 1}}, gymnasium.Env),
        (PUMP, {"view": "aec"}, pettingzoo.AECEnv),
    ],
)
def test_generate_env_returns_an_environment_class(points, options, base):
    env_class = generate_env(BOTH, points, **options)
    assert isinstance(env_class, type)
    assert issubclass(env_class, base)
    one, two = env_class(), env_class()
    assert type(one) is type(two) is env_class
    assert one.unwrapped.simulation is not two.unwrapped.simulation


@EVERY_VIEW
def test_environments_do_not_share_spaces(view):
    seeing, acting = spaces.Box(0, 1, (3,), np.float32), spaces.Discrete(4)
    pump = decision(observation_space=seeing, action_space=acting, agent="pump_0")
    env, other = (view(calling(pump), pump) for _ in range(2))

    def spaces_of(env):
        if view is single_env:
            return env.observation_space, env.action_space
        if view is joint_env:
            return env.observation_space["pump_0"], env.action_space["pump_0"]
        return env.observation_space("pump_0"), env.action_space("pump_0")

    assert spaces_of(env) == (seeing, acting)
    assert [
        space is again for space, again in zip(spaces_of(env), spaces_of(env), strict=True)
    ] == [True, True]
    assert len({id(space) for space in (*spaces_of(env), *spaces_of(other), seeing, acting)}) == 6


class Rendering(Script):
    render_modes = ("ansi", "rgb_array")
    render_fps = 0.5

    def __init__(self):
        super().__init__(lambda simulation: PUMP())

    def render(self, mode):
        return mode


@EVERY_VIEW
def test_envs_have_gymnasium_metadata_and_a_random_generator(view):
    plain = view(calling(PUMP), PUMP)
    assert (
        plain.metadata["render_fps"],
        list(plain.metadata["render_modes"]),
        plain.render_mode,
    ) == (4, [], None)
    env = view(Rendering, PUMP)
    assert str(env)
    assert env.unwrapped is env
    assert isinstance(env.simulation, Rendering)
    assert isinstance(env.metadata["name"], str)
    made = generate_env(Rendering, PUMP)  # which Gymnasium asks as a class
    for metadata in (env.metadata, made.metadata):
        assert (metadata["render_fps"], metadata["render_modes"]) == (0.5, ["ansi", "rgb_array"])
    assert env.metadata.get("is_parallelizable") == {aec_env: False, parallel_env: True}.get(view)
    env.reset(seed=3)
    assert env.unwrapped.np_random_seed == 3
    assert env.unwrapped.np_random.random() == np.random.default_rng(3).random()
    env.unwrapped.np_random = generator = np.random.default_rng(5)
    assert env.unwrapped.np_random is generator
    assert env.unwrapped.np_random_seed == -1


# -- options --------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [aec_env, single_env, generate_env])
@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        *(
            (given, UnknownOptionError, list(given)[-1])
            for given in ({"max_step": 3}, {"seed": 1}, {"max_steps": 3, "colour": "red"})
        ),
        *(({"max_steps": wrong}, OptionValueError, "max_steps") for wrong in (0, -1, 2.0, "3")),
        *(({"driver": wrong}, OptionValueError, "driver") for wrong in ("magic", None)),
        *(
            ({"plugins": wrong}, OptionValueError, "plugins")
            for wrong in ("text", 3, {PUMP: print})
        ),
        *(
            ({"policies": wrong}, OptionValueError, "polic")
            for wrong in (3, [PUMP], {"pump_0": 3}, {"pump_0": None})
        ),
        ({"render_mode": 3}, OptionValueError, "render_mode"),
        *(
            ({"policies": {key: lambda observation: 1}}, UnknownPointError, "known are pump")
            for key in (
                "fan_0",
                "tests.contract.test_environments.Nobody.decides",
                "no.where",
                3,
                None,
            )
        ),
        ({"policies": {PUMP: RULE}}, UnknownPointError, "no decision point is left"),
    ],
    ids=plainly,
)
def test_vector_env_refuses_invalid_options(make, options, error, match):
    with pytest.raises(error, match=match):
        make(BOTH, PUMP, **options)


def test_generate_env_refuses_unknown_views():
    for view in ("", "AEC", 3):
        with pytest.raises(OptionValueError, match="view must be None"):
            generate_env(BOTH, PUMP, view=view)
    for points in ([PUMP, FAN], NAMED):
        with pytest.raises(ViewError, match="needs one active decision point"):
            generate_env(BOTH, points, view="single")


def test_instances_of_a_generated_env_can_change_its_options():
    env_class = generate_env(BOTH, [PUMP, FAN], view="aec", max_steps=1)
    assert len(decisions(play(env_class()))) == 1
    assert len(decisions(play(env_class(max_steps=2)))) == 2
    assert len(decisions(play(env_class(max_steps=None)))) == 3
    assert decisions(play(env_class(max_steps=None, policies={"pump_0": RULE}))) == ["fan_0"]
    with pytest.raises(UnknownOptionError, match="there is no option"):
        env_class(colour="red")


# -- max_steps ------------------------------------------------------------------------------------


def test_max_steps_counts_only_legal_actions_of_the_user():
    env = begun(
        aec_env(
            calling(*[PUMP, FAN] * 5),
            [PUMP, FAN],
            max_steps=3,
            policies={FAN: lambda observation: 1},
        )
    )
    for _ in range(3):
        with pytest.raises(InvalidActionError, match="is not in its action space"):
            env.step(99)
        env.step(1)
    assert env.truncations == {"pump_0": True}
    env.step(None)
    assert env.agents == []
    assert decisions(play(env, 1)) == ["pump_0"] * 3


# -- policies -------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["fan_0", FAN])
@pytest.mark.parametrize(
    ("policy", "answer"),
    [(lambda observation: 4, 4), (RULE, "rule"), (lambda observation: RULE, "rule")],
)
def test_decision_points_with_a_policy_do_not_appear_as_agents(key, policy, answer):
    env = aec_env(BOTH, [PUMP, FAN], policies={key: policy})
    assert env.possible_agents == ["pump_0"]
    env.reset()
    assert env.agents == ["pump_0"]
    assert set(env.rewards) == set(env.infos) == {"pump_0"}
    assert decisions(play(env, 5)) == ["pump_0", "pump_0"]
    assert env.simulation.log == [5, answer, 5]
    with pytest.raises(NoDecisionError, match="without a decision"):
        aec_env(calling(FAN), [PUMP, FAN], policies={key: policy}).reset()


def first_legal(observation, info=None):
    return info["action_mask"].tolist().index(1)


@pytest.mark.parametrize(
    ("policy", "answer"),
    [
        (first_legal, 3),
        (lambda observation, scale=2: scale, 2),
        (lambda *arguments: len(arguments[0]), 2),
        (len, 2),
    ],
)
def test_policies_take_an_observation_and_optionally_an_info(policy, answer):
    masks = {"action_mask_mapping": lambda: [0] * 3 + [1] * 7} if answer == 3 else {}
    decide = decision(agent="decider_0", **masks)
    env = aec_env(calling(decide, PUMP), [decide, PUMP], policies={"decider_0": policy})
    play(env, 1)
    assert env.simulation.log == [answer, 1]


def test_env_checks_and_maps_the_actions_of_policies():
    fan = decision(agent="fan_0", action_space_mapping=lambda action: ("mapped", action))
    env = aec_env(calling(fan, PUMP), [fan, PUMP], policies={fan: lambda observation: np.int64(3)})
    play(env, 1)
    assert env.unwrapped.simulation.log == [("mapped", 3), 1]
    env = begun(aec_env(calling(PUMP, fan), [fan, PUMP], policies={fan: lambda observation: 10}))
    with pytest.raises(InvalidActionError, match="is not in its action space"):
        env.step(1)
    env.reset()


def test_policies_can_be_given_for_agents_named_by_a_callable():
    calls = calling(
        *[lambda name=name: NAMED(name) for name in ("herd.1", "Sheep 2", "herd.1", "c")]
    )
    env = aec_env(calls, NAMED, policies={"herd.1": lambda observation: 7, "c": RULE})
    assert decisions(play(env, 1)) == ["Sheep 2"]
    assert env.simulation.log == [7, 1, 7, "rule"]


# -- agents ---------------------------------------------------------------------------------------


def test_decision_points_of_an_agent_need_equal_spaces_and_one_policy():
    few = {"agent": lambda: "pump_0", "action_space": spaces.Discrete(3)}
    named, other = decision(**few), decision(agent=lambda: "pump_0")
    for first, second in ((PUMP, named), (named, other)):
        env = begun(aec_env(calling(first, second), [first, second]))
        with pytest.raises(AgentError, match="whose spaces or policies differ"):
            env.step(1)
    again = decision(agent=lambda: "pump_0")
    env = begun(
        aec_env(calling(PUMP, again), [PUMP, again], policies={again: lambda observation: 1})
    )
    with pytest.raises(AgentError, match="whose spaces or policies differ"):
        env.step(1)


# -- definitions of the simulation ----------------------------------------------------------------


class Hut:
    """What its simulation has a definition for."""

    def heat(self):
        return "rule"

    def air(self):
        return "rule"


class Housed(Script):
    points = {  # noqa: RUF012 - as simulations have it
        f"{__name__}.Hut.heat": define(
            agent="heat_0", action_space_mapping=lambda action: 10 * action
        ),
        f"{__name__}.Hut.air": define(agent="air_0"),
    }

    def __init__(self):
        super().__init__(lambda simulation: simulation.log.extend([Hut().heat(), Hut().air()]))


@pytest.mark.parametrize(
    "source", [Housed, lambda: Housed(), Housed()], ids=["class", "factory", "instance"]
)
def test_decision_point_given_by_name_has_the_simulations_definition(source):
    for named in (f"{__name__}.Hut.heat", [Hut.heat]):
        env = begun(single_env(source, named))
        env.step(3)
        assert env.simulation.log == [30, "rule"]
    with pytest.raises(DefinitionError, match="has no definition here"):
        single_env(source, Rendering.render)
    assert aec_env(source, {Hut.heat: define(agent="mine")}).possible_agents == ["mine"]
