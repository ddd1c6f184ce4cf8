"""The registries of Gymnasium and PettingZoo."""

import json

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import HumanRendering

from simenv_marl import RULE, SimEnvError, register_simulation
from simenv_marl.errors import (
    OptionValueError,
    UnknownOptionError,
    UnknownPointError,
    ViewError,
)
from simenv_marl.experiments import Variant
from tests.processes import python
from tests.worlds import copied
from tests.worlds.copied import Boat, Voyage
from tests.worlds.entities import Being, beings
from tests.worlds.models import begun, calling, decision, define, play, registries_put_back

SINGLES = ["manyregistered/SteerBoat-v0", "manyregistered/SetSail-v0"]
JOINT, TURN = "manyregistered/Joint-v0", "manyregistered/Turn-v0"
COOP = "manyregistered/coop_v0"


@pytest.fixture
def register():
    """Registers simulations until the test is over."""
    with registries_put_back():
        yield register_simulation


def made(identity, **options):
    """What Gymnasium makes, without its wrappers."""
    return gymnasium.make(identity, **options).unwrapped


def test_register_simulation_gives_ids_for_points_and_multi_agent_envs():
    assert [*SINGLES, JOINT, TURN, COOP] == copied.IDS
    assert set(copied.IDS[:-1]) <= set(gymnasium.registry)
    for kind, base in (("aec", pettingzoo.AECEnv), ("parallel", pettingzoo.ParallelEnv)):
        spec = pettingzoo.spec(kind, COOP)
        assert isinstance(spec.entry_point, str)
        json.dumps(spec.kwargs)
        for identity in (COOP, spec):
            env = pettingzoo.make(kind, identity)
            assert isinstance(env, base)
            assert env.possible_agents == ["helm_0", "sail_0"]
    assert set(gymnasium.make(JOINT).action_space.spaces) == {"helm_0", "sail_0"}


def sailed(env):
    """Where the boat has come to after one step to the right."""
    env.reset(seed=1)
    env.step(np.array([1.0], np.float32))
    assert env.simulation.boat.course == 1.0
    return env.simulation.boat.place


def test_registered_single_env_runs_other_points_by_rule_or_policy(register):
    """A policy may be given under any name of the point, and then answers in every view."""
    assert -0.61 < sailed(made(SINGLES[0])) < -0.39
    assert (
        0.89
        < sailed(made(SINGLES[0], policies={Boat.set_sail: lambda observation: np.float32([1.0])}))
        < 1.11
    )
    for key in (Boat.set_sail, f"{Boat.__module__}.Boat.set_sail", "sail_0"):
        ids = register(Voyage, name="policies", policies={key: lambda observation: 0.25})
        assert ids == [
            f"policies/{title}" for title in ("SteerBoat-v0", "Joint-v0", "Turn-v0", "coop_v0")
        ]
        assert pettingzoo.make("aec", ids[-1]).possible_agents == ["helm_0"]
        assert list(made(ids[1]).action_space.spaces) == ["helm_0"]
        assert 0.14 < sailed(made(ids[0])) < 0.36


def test_gymnasium_make_of_a_registered_id_takes_options():
    env = begun(made(SINGLES[0], max_steps=1, render_mode="ansi"))
    assert env.step(RULE)[2:4] == (False, True)
    assert env.render().startswith("at ")
    env = begun(pettingzoo.make("parallel", COOP, max_steps=1, render_mode="rgb_array"))
    assert all(env.step(dict.fromkeys(env.agents, RULE))[3].values())
    assert env.render().shape == (8, 8, 3)
    with pytest.raises(UnknownOptionError, match="there is no option"):
        pettingzoo.make("aec", COOP, speed=3)
    with pytest.raises(TypeError, match="was raised from"):
        gymnasium.make(JOINT, speed=3)


@pytest.mark.filterwarnings("ignore:.*is out of date")  # Gymnasium's advice
def test_register_simulation_can_be_repeated_or_versioned(register):
    def length(ids, **options):
        return len(play(pettingzoo.make("aec", ids[-1], **options)))

    first = register(Voyage, name="versions", max_steps=1)
    assert length(first) == 3
    assert register(Voyage, name="versions") == first  # as when a notebook's cell runs again
    second = register(Voyage, name="versions", version=3, max_steps=2)
    assert first == [
        "versions/SteerBoat-v0",
        "versions/SetSail-v0",
        "versions/Joint-v0",
        "versions/Turn-v0",
        "versions/coop_v0",
    ]
    assert second == [identity.replace("v0", "v3") for identity in first]
    assert (length(first), length(second), length(second, max_steps=None)) == (26, 4, 26)
    env = begun(made(second[0]))
    assert [env.step(RULE)[3] for _ in range(2)] == [False, True]


def test_register_simulation_uses_only_the_points_that_it_is_given(register):
    steering = {
        f"{Boat.__module__}.Boat.steer_boat": define(
            action_space=spaces.Discrete(2), agent="helm_0"
        )
    }
    ids = register(Voyage, steering, name="named")
    assert ids == ["named/SteerBoat-v0", "named/Joint-v0", "named/Turn-v0", "named/coop_v0"]
    assert pettingzoo.make("aec", "named/coop_v0").possible_agents == ["helm_0"]
    assert list(made("named/Joint-v0").action_space.spaces) == ["helm_0"]
    assert made(ids[0]).action_space == spaces.Discrete(2)


def test_register_simulation_gives_no_single_env_for_points_of_entities(register):
    clerk = decision(agent="clerk_0")
    points = {clerk: define(agent="clerk_0"), **beings()}
    roster = {Being.act: ["being_0"]}  # an option of a point that the single view lacks
    ids = register(
        calling(clerk, lambda: Being(0).act()), points, name="mixed", possible_agents=roster
    )
    assert ids == ["mixed/Choose-v0", "mixed/Joint-v0", "mixed/Turn-v0", "mixed/coop_v0"]
    env = begun(made(ids[0]))
    env.step(4)
    assert env.simulation.log == [4, "rule"]
    assert pettingzoo.make("aec", ids[-1]).possible_agents == ["clerk_0", "being_0"]
    assert set(made(ids[1]).action_space.spaces) == {"clerk_0", "being_0"}


@pytest.mark.parametrize("view", ["Joint", "Turn"])
@pytest.mark.parametrize("flatten", [False, True])
def test_registered_ids_take_flatten_only_for_joint_env_and_turn_env(register, flatten, view):
    """The option of ``make`` comes before the registration's, and that before the variant's."""
    ids = register(Variant("flat", Voyage, options={"flatten": True}), flatten=flatten)
    for options, expected in (({}, flatten), ({"flatten": not flatten}, not flatten)):
        env = made(f"flat/{view}-v0", **options)
        assert isinstance(env.observation_space, spaces.Box) is expected
        check_env(env)
        envs = gymnasium.make_vec(f"flat/{view}-v0", num_envs=2, **options).unwrapped
        assert isinstance(envs.single_observation_space, spaces.Box) is expected
        envs.close()
    made(ids[0]).reset()
    pettingzoo.make("parallel", ids[-1]).reset()


def test_registered_ids_take_state_in_info_only_for_joint_and_turn_env(register):
    class Charted(Voyage):
        def state(self):
            return [self.boat.place]

    ids = register(Charted, name="charted", state_in_info=True)
    assert [made(each).reset()[1].keys() >= {"state"} for each in ids[:4]] == [
        *(False, False),
        *(True, True),
    ]
    pettingzoo.make("aec", ids[-1]).reset()


def test_registered_turn_env_works_in_make_vec(register):
    env = made(TURN, max_steps=3)
    observation, info = env.reset(seed=1)
    assert (observation["kind"], info["agent"]) == (0, "helm_0")
    assert [env.step(RULE)[3] for _ in range(3)] == [False, False, True]
    envs = begun(gymnasium.make_vec(TURN, num_envs=2, max_episode_steps=2), 1)
    ends = [envs.step(envs.action_space.sample())[3].tolist() for _ in range(2)]
    assert ends == [[False, False], [True, True]]
    envs.close()
    text = decision(agent="clerk_0", action_space=spaces.MultiBinary(2))
    number = decision(agent="guard_0")
    ids = register(calling(text, number), [text, number], name="apart")
    with pytest.raises(ViewError, match="a Discrete or a Box"):
        made("apart/Turn-v0")
    assert ids[-3:-1] == ["apart/Joint-v0", "apart/Turn-v0"]


def test_registered_ids_are_distinct_camel_case_names_of_points(register):
    """The ids of joint and turn views are taken, and names differ in spelling or class alone."""
    named = [
        "Robot.joint",
        "Robot.turn",
        "Robot.choose_2nd_route",
        "Robot.open_grip",
        "Robot.openGrip",
        "Legs.move",
        "Arms.move",
    ]
    inside = [
        f"{function}.<locals>.{name}"
        for function in "fg"
        for name in ("Boat.choose", "choose", "<lambda>")
    ]
    points = []
    for number, name in enumerate([*named, *inside]):

        def rule():
            return 0

        rule.__name__, rule.__qualname__, rule.__module__ = name.rpartition(".")[2], name, __name__
        points.append(
            define(agent=f"robot_{number}", observation_space_mapping=lambda n=number: [0, n])(rule)
        )
    ids = register(calling(*points), points, name="robots")
    assert ids[:2] == ["robots/RobotJoint-v0", "robots/RobotTurn-v0"]
    assert ids[-3:-1] == ["robots/Joint-v0", "robots/Turn-v0"]
    assert len(set(ids)) == len(ids) == len(points) + 3
    assert [made(each).reset()[0].tolist() for each in ids[:-3]] == [
        [0, number] for number in range(len(points))
    ]


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"points": "nowhere.at.all"}, UnknownPointError),
        ({"speed": 3}, UnknownOptionError),
        ({"max_steps": 0}, SimEnvError),
        ({"simulation": 3}, SimEnvError),
        *(
            ({"name": name}, OptionValueError)
            for name in ("a:b", "a/b", "", "a\n", 3, "\ud800", None)
        ),
        *(({"version": version}, OptionValueError) for version in (-1, 1.0, True)),
        ({"simulation": Variant("hot summer", Voyage), "name": None}, OptionValueError),
    ],
)
def test_register_simulation_leaves_registries_unchanged_if_it_refuses(register, changes, error):
    registries = gymnasium.registry, pettingzoo.aec_registry, pettingzoo.parallel_registry
    before = [dict(registry) for registry in registries]
    with pytest.raises(error):
        register(**{"simulation": Voyage, "points": None, "name": "broken"} | changes)
    assert [dict(registry) for registry in registries] == before


def test_registered_ids_and_specs_work_in_another_process():
    """In vectors too: spawned processes, the default outside Linux, know only the spec."""
    env = gymnasium.make(f"tests.worlds.copied:{SINGLES[0]}", max_steps=2)
    code = f"""
import gymnasium, pettingzoo
from gymnasium.envs.registration import EnvSpec
if __name__ == "__main__":
    env = gymnasium.make(EnvSpec.from_json({env.spec.to_json()!r}))
    print(env.reset(seed=5)[0].tolist())
    print([env.step([0.5])[3] for _ in range(2)])
    print(gymnasium.make("tests.worlds.copied:{JOINT}").spec.id)
    print(*[pettingzoo.make(kind, {COOP!r}).possible_agents for kind in ("aec", "parallel")])
    spawned = {{"vectorization_mode": "async", "vector_kwargs": {{"context": "spawn"}}}}
    envs = gymnasium.make_vec("tests.worlds.copied:{SINGLES[0]}", num_envs=2, **spawned)
    print(envs.reset(seed=1)[0].shape)
    envs.step(envs.action_space.sample())
    envs.close()
"""
    observation, agents = env.reset(seed=5)[0].tolist(), ["helm_0", "sail_0"]
    assert python("-W", "error", "-c", code).stdout.splitlines() == [
        str(observation),
        "[False, True]",
        JOINT,
        f"{agents} {agents}",
        "(2, 2)",
    ]


def test_registered_env_human_rendering_uses_the_simulations_rgb_arrays(register, monkeypatch):
    class Pictured(Voyage):
        render_modes = ("rgb_array",)

    shown = []
    monkeypatch.setattr(
        HumanRendering, "_render_frame", lambda env: shown.append(env.env.render().shape)
    )
    ids = register(Pictured, name="pictured")
    for identity in (ids[0], "pictured/Turn-v0"):
        env = gymnasium.make(identity, render_mode="human")
        assert env.render_mode == "human"
        env.reset(seed=1)
        env.step(env.action_space.sample())
    assert shown == [(8, 8, 3)] * 4


@pytest.mark.parametrize("name", ["two_words", "two-words"])
def test_registered_ids_with_underscores_are_found_in_both_spellings(register, name):
    """PettingZoo lists ``coop_v0`` as ``coop-v0``."""
    ids = register(Voyage, name=name)
    assert ids[-1] == f"{name}/coop_v0"
    for identity in ids[:-1]:
        assert identity in gymnasium.registry
    for kind in ("aec", "parallel"):
        for identity in (f"{name}/coop_v0", f"{name}/coop-v0"):
            assert pettingzoo.make(kind, identity).possible_agents
