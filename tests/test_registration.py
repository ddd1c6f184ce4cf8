"""The registries of Gymnasium and PettingZoo."""

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import HumanRendering
from pettingzoo.test import api_test, parallel_api_test

from simenv_marl import RULE, SimEnvError, register_simulation
from simenv_marl.errors import OptionValueError, UnknownOptionError, UnknownPointError
from simenv_marl.experiments import Variant
from tests.worlds import many_registered
from tests.worlds.many_registered import Boat, Voyage
from tests.worlds.many_worlds import Being, beings
from tests.worlds.models import calling, decision, define, play
from tests.worlds.undone import registries_put_back

ROOT = Path(__file__).parent.parent
SINGLES = ["manyregistered/SteerBoat-v0", "manyregistered/SetSail-v0"]
JOINT, COOP = "manyregistered/Joint-v0", "manyregistered/coop_v0"


@pytest.fixture
def register():
    """Registers simulations until the test is over."""
    with registries_put_back():
        yield register_simulation


def made(identity, **options):
    """What Gymnasium makes, without its wrappers."""
    return gymnasium.make(identity, **options).unwrapped


def test_there_is_an_id_for_each_point_and_one_for_all_views_of_several_agents():
    assert [*SINGLES, JOINT, COOP] == many_registered.IDS
    assert set(many_registered.IDS[:-1]) <= set(gymnasium.registry)
    for kind, base in (("aec", pettingzoo.AECEnv), ("parallel", pettingzoo.ParallelEnv)):
        spec = pettingzoo.spec(kind, COOP)
        assert isinstance(spec.entry_point, str)
        json.dumps(spec.kwargs)
        for identity in (COOP, spec):
            env = pettingzoo.make(kind, identity)
            assert isinstance(env, base)
            assert env.possible_agents == ["helm_0", "sail_0"]
    assert set(gymnasium.make(JOINT).action_space.spaces) == {"helm_0", "sail_0"}
    flat = gymnasium.make(JOINT, flatten=True)
    assert flat.action_space.shape == (2,)
    assert flat.observation_space.shape == (4,)


@pytest.mark.parametrize(
    ("options", "low", "high"),
    [({}, -0.61, -0.39), ({"policies": {Boat.set_sail: lambda observation: np.float32([1.0])}}, 0.89, 1.11)],
    ids=["rule", "policy"],
)
def test_all_other_points_run_their_rule_or_the_policy_that_is_given(options, low, high):
    env = made(SINGLES[0], **options)
    env.reset(seed=1)
    env.step(np.array([1.0], np.float32))
    assert env.simulation.boat.course == 1.0
    envs = gymnasium.make_vec(SINGLES[0], num_envs=2, **options).unwrapped
    envs.reset(seed=1)
    envs.step(np.ones((2, 1), np.float32))
    for simulation in (env.simulation, *envs.get_attr("simulation")):
        assert low < simulation.boat.place < high
    envs.close()


@pytest.mark.parametrize("identity", SINGLES)
def test_a_single_view_has_the_spaces_of_its_point(identity):
    env = gymnasium.make(identity)
    observation, _ = env.reset(seed=1)
    assert observation in env.observation_space == many_registered.PLACE
    assert env.action_space == many_registered.PUSH
    assert isinstance(env.unwrapped.simulation, Voyage)


def test_options_are_given_when_it_is_made():
    env = made(SINGLES[0], max_steps=1, render_mode="ansi")
    env.reset()
    assert env.step(RULE)[2:4] == (False, True)
    assert env.render().startswith("at ")
    env = pettingzoo.make("parallel", COOP, max_steps=1, render_mode="rgb_array")
    env.reset()
    assert all(env.step(dict.fromkeys(env.agents, RULE))[3].values())
    assert env.render().shape == (8, 8, 3)
    with pytest.raises(UnknownOptionError, match="there is no option"):
        pettingzoo.make("aec", COOP, speed=3)
    with pytest.raises(TypeError, match="was raised from"):
        gymnasium.make(JOINT, speed=3)


def lengths(ids, **options):
    """How many steps a single view takes, and how many turns one of several agents does."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is out of date")  # Gymnasium's advice
        env = made(ids[0], **options)
    env.reset()
    steps = 1
    while not any(env.step(RULE)[2:4]):
        steps += 1
    return steps, len(play(pettingzoo.make("aec", ids[-1], **options), RULE))


def test_options_are_those_of_the_registration_which_may_be_repeated_and_have_versions(register):
    first = register(Voyage, name="versions", max_steps=1)
    assert lengths(first) == (1, 3)
    assert register(Voyage, name="versions") == first  # as when a notebook's cell runs again
    second = register(Voyage, name="versions", version=3, max_steps=2)
    assert first == ["versions/SteerBoat-v0", "versions/SetSail-v0", "versions/Joint-v0", "versions/coop_v0"]
    assert second == ["versions/SteerBoat-v3", "versions/SetSail-v3", "versions/Joint-v3", "versions/coop_v3"]
    assert lengths(first) == (12, 26)
    assert lengths(second) == (2, 4)
    assert lengths(second, max_steps=None) == (12, 26)


def test_points_are_those_that_are_named(register):
    ids = register(Voyage, Boat.set_sail, name="named")
    assert ids == ["named/SetSail-v0", "named/Joint-v0", "named/coop_v0"]
    assert pettingzoo.make("aec", "named/coop_v0").possible_agents == ["sail_0"]
    assert list(made("named/Joint-v0").action_space.spaces) == ["sail_0"]
    ids = register(Voyage, f"{Boat.__module__}.Boat.steer_boat", name="named")
    assert ids[0] == "named/SteerBoat-v0"


@pytest.mark.parametrize("key", [Boat.set_sail, f"{Boat.__module__}.Boat.set_sail"], ids=["function", "name"])
def test_points_may_be_given_with_their_definitions(register, key):
    ids = register(Voyage, {key: define(agent="sail_0", action_space=spaces.Discrete(2))}, name="defined")
    assert ids[0] == "defined/SetSail-v0"
    assert made(ids[0]).action_space == spaces.Discrete(2)
    assert pettingzoo.make("aec", ids[-1]).action_space("sail_0") == spaces.Discrete(2)


def test_goals_may_be_registered(register):
    ant = decision(
        agent="ant_0",
        goal_space=spaces.Box(0, 1, (1,), np.float32),
        achieved_goal_mapping=lambda: [0.5],
        desired_goal_mapping=lambda: [1],
        compute_reward=lambda achieved, desired, info: -np.abs(achieved - desired).sum(-1),
    )
    ids = register(calling(ant, ant), ant, name="goals")
    env = gymnasium.make(ids[0])
    assert set(env.observation_space.spaces) == {"observation", "achieved_goal", "desired_goal"}
    assert env.unwrapped.compute_reward(np.zeros((3, 1)), np.ones((3, 1)), [{}] * 3).tolist() == [-1, -1, -1]


@pytest.mark.parametrize(
    ("options", "answer"),
    [
        ({"possible_agents": ["being_0"]}, "rule"),
        ({"possible_agents": {Being.act: ["being_0"]}}, "rule"),  # an option of a point that the single view lacks
        ({"policies": {"being_0": lambda observation: 7}, "possible_agents": ["being_0"]}, 7),
    ],
    ids=["roster", "roster by point", "policy"],
)
def test_entities_have_no_single_view_and_are_in_that_of_another_point(register, options, answer):
    clerk = decision(agent="clerk_0")
    points = {clerk: define(agent="clerk_0"), **beings()}
    ids = register(calling(clerk, lambda: Being(0).act()), points, name="mixed", **options)
    assert ids == ["mixed/Choose-v0", "mixed/Joint-v0", "mixed/coop_v0"]
    env = made(ids[0])
    env.reset()
    env.step(4)
    assert env.simulation.log == [4, answer]
    if answer == "rule":
        assert pettingzoo.make("aec", ids[-1]).possible_agents == ["clerk_0", "being_0"]
        assert set(made(ids[1]).action_space.spaces) == {"clerk_0", "being_0"}


def test_points_may_be_functions_that_nobody_has_decorated(register):
    ids = register(calling(lambda: Being(0).act()), beings(agent="hero_0", removed_by=()), name="plain")
    assert ids[0] == "plain/Act-v0"
    env = made(ids[0])
    env.reset()
    env.step(4)
    assert env.simulation.log == [4]
    env.close()
    assert Being(0).act() == "rule"


def test_policies_of_registered_simulations(register):
    """Who is answered by a policy is so in every view, by whatever name it was given."""
    for key in (Boat.set_sail, f"{Boat.__module__}.Boat.set_sail", "sail_0"):
        ids = register(Voyage, name="policies", policies={key: lambda observation: 0.25})
        assert ids == ["policies/SteerBoat-v0", "policies/Joint-v0", "policies/coop_v0"]
        assert pettingzoo.make("aec", ids[-1]).possible_agents == ["helm_0"]
        assert list(made(ids[1]).action_space.spaces) == ["helm_0"]
        env = made(ids[0])
        env.reset(seed=1)
        env.step(np.array([1.0], np.float32))
        assert 0.14 < env.simulation.boat.place < 0.36


@pytest.mark.parametrize("flatten", [False, True])
def test_flatten_is_an_option_of_the_joint_view_alone(register, flatten):
    """It may be one of the variant, of the registration and of the one who makes it, who comes first."""
    ids = register(Variant("flat", Voyage, options={"flatten": True}), flatten=flatten)
    for options, expected in (({}, flatten), ({"flatten": not flatten}, not flatten)):
        env = made("flat/Joint-v0", **options)
        assert isinstance(env.action_space, spaces.Box) is expected
        check_env(env)
        envs = gymnasium.make_vec("flat/Joint-v0", num_envs=2, **options).unwrapped
        assert isinstance(envs.single_action_space, spaces.Box) is expected
        envs.close()
    made(ids[0]).reset()
    pettingzoo.make("parallel", ids[-1]).reset()


def test_names_of_points_become_camel_case_and_are_told_apart(register):
    """The id of the joint view is taken, names may differ in how they are written alone, and classes share names."""
    named = ["Robot.joint", "Robot.choose_2nd_route", "Robot.open_grip", "Robot.openGrip", "Legs.move", "Arms.move"]
    inside = [f"{function}.<locals>.{name}" for function in "fg" for name in ("Boat.choose", "choose", "<lambda>")]
    points = []
    for number, name in enumerate([*named, *inside]):

        def rule():
            return 0

        rule.__name__, rule.__qualname__, rule.__module__ = name.rpartition(".")[2], name, __name__
        points.append(define(agent=f"robot_{number}", observation_space_mapping=lambda n=number: [0, n])(rule))
    ids = register(calling(*points), points, name="robots")
    assert ids[:2] == ["robots/RobotJoint-v0", "robots/Choose2ndRoute-v0"]
    assert "robots/Joint-v0" in ids
    assert len(set(ids)) == len(ids) == len(points) + 2
    assert [made(each).reset()[0].tolist() for each in ids[:-2]] == [[0, number] for number in range(len(points))]


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"points": "nowhere.at.all"}, UnknownPointError),
        ({"speed": 3}, UnknownOptionError),
        ({"max_steps": 0}, SimEnvError),
        ({"simulation": 3}, SimEnvError),
        *(
            ({"name": name}, OptionValueError)
            for name in ("a:b", "a/b", "a.b", "a b", "", "a\n", 3, "\ud800", ["a"], None)
        ),
        *(({"version": version}, OptionValueError) for version in (-1, "2", 1.0, True, None)),
        ({"simulation": Variant("hot summer", Voyage), "name": None}, OptionValueError),
    ],
)
def test_what_cannot_be_registered_leaves_the_registries_as_they_were(register, changes, error):
    registries = gymnasium.registry, pettingzoo.aec_registry, pettingzoo.parallel_registry
    before = [dict(registry) for registry in registries]
    with pytest.raises(error):
        register(**{"simulation": Voyage, "points": None, "name": "broken"} | changes)
    assert [dict(registry) for registry in registries] == before


@pytest.mark.parametrize("identity", many_registered.IDS[:-1])
@pytest.mark.parametrize("mode", [None, "ansi", "rgb_array"])
def test_gymnasiums_check(identity, mode):
    check_env(made(identity, render_mode=mode))


def test_pettingzoos_tests():
    api_test(pettingzoo.make("aec", COOP), num_cycles=20)
    parallel_api_test(pettingzoo.make("parallel", COOP), num_cycles=20)


@pytest.mark.parametrize("identity", many_registered.IDS[:-1])
def test_specs_can_be_written_down(identity):
    env = gymnasium.make(identity, max_steps=2)
    text = env.spec.to_json()
    json.loads(text)
    again = gymnasium.make(EnvSpec.from_json(text))
    assert again.spec == env.spec
    told = [(one.reset(seed=3), one.unwrapped.step(RULE), one.unwrapped.step(RULE)) for one in (env, again)]
    assert repr(told[0]) == repr(told[1])
    assert told[0][2][3] is True
    assert isinstance(env.spec.entry_point, str)


def run_apart(code):
    """Run some code in a process of its own, in which nothing is imported yet."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_in_another_process_by_module_and_id():
    """And in vectors: where processes are spawned, as on all systems but Linux, they know no more than the spec."""
    code = f"""
import gymnasium
if __name__ == "__main__":
    for identity in {many_registered.IDS[:-1]!r}:
        env = gymnasium.make("tests.worlds.many_registered:" + identity)
        env.reset(seed=5)
        env.step(env.action_space.sample())
        env.close()
        print(env.spec.id)
    import pettingzoo
    print(pettingzoo.make("aec", {COOP!r}).possible_agents)
    print(pettingzoo.make("parallel", {COOP!r}).possible_agents)
    spawned = {{"vectorization_mode": "async", "vector_kwargs": {{"context": "spawn"}}}}
    envs = gymnasium.make_vec("tests.worlds.many_registered:{SINGLES[0]}", num_envs=2, **spawned)
    observations, _ = envs.reset(seed=1)
    envs.step(envs.action_space.sample())
    envs.close()
    print(observations.shape)
"""
    assert run_apart(code).splitlines() == [*many_registered.IDS[:-1], *["['helm_0', 'sail_0']"] * 2, "(2, 2)"]


@pytest.mark.parametrize(
    ("prefix", "import_first"), [("", "import tests.worlds.many_registered"), ("tests.worlds.many_registered:", "")]
)
def test_in_another_process_by_its_spec(prefix, import_first):
    """A spec that was written down says all that is needed, as those of other environments do."""
    text = gymnasium.make(f"{prefix}{SINGLES[0]}", max_steps=2).spec.to_json()
    code = f"""
import gymnasium
{import_first}
from gymnasium.envs.registration import EnvSpec
env = gymnasium.make(EnvSpec.from_json({text!r}))
print(env.reset(seed=5)[0].tolist())
"""
    here, _ = gymnasium.make(SINGLES[0]).reset(seed=5)
    assert run_apart(code) == str(here.tolist())


@pytest.mark.parametrize("identity", [*SINGLES, JOINT])
def test_make_vec_limits_episodes(identity):
    env = gymnasium.make_vec(identity, num_envs=2, max_episode_steps=2)
    env.reset(seed=1)
    for truncated in (False, True):
        *_, truncations, _ = env.step(env.action_space.sample())
        assert truncations.tolist() == [truncated] * 2
    env.close()
    shorter = gymnasium.make_vec(identity, num_envs=1, max_episode_steps=9, max_steps=1)
    shorter.reset(seed=1)
    assert shorter.step(shorter.action_space.sample())[3].tolist() == [True]
    shorter.close()


@pytest.mark.parametrize("identity", [*SINGLES, JOINT])
def test_modes_that_the_simulation_lacks_are_made_up_for(identity):
    env = gymnasium.make(identity, render_mode="rgb_array_list")
    env.reset(seed=1)
    env.step(env.action_space.sample())
    frames = env.render()
    assert [frame.shape for frame in frames] == [(8, 8, 3)] * 2
    assert env.render() == []
    again = gymnasium.make(env.spec)
    again.reset(seed=1)
    assert len(again.render()) == 1
    with pytest.warns(UserWarning, match="depth_array"):
        assert made(identity, render_mode="depth_array").render_mode is None


def test_pictures_for_people_are_made_of_arrays(register, monkeypatch):
    class Pictured(Voyage):
        render_modes = ("rgb_array",)

    shown = []
    monkeypatch.setattr(HumanRendering, "_render_frame", lambda env: shown.append(env.env.render().shape))
    ids = register(Pictured, name="pictured")
    env = gymnasium.make(ids[0], render_mode="human")
    assert env.render_mode == "human"
    env.reset(seed=1)
    env.step(env.action_space.sample())
    assert shown == [(8, 8, 3)] * 2
