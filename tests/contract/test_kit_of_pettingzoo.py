"""All that ``pettingzoo.test`` has, and PettingZoo's wrappers, on both examples and where agents are born and die."""

import sys
from functools import partial
from itertools import count
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from examples.greenhouse_coop.env import WATERING, GreenhouseSim
from examples.wolf_sheep.env import Meadow, sheep_points
from gymnasium import spaces
from pettingzoo import test as kit
from pettingzoo.utils import wrappers
from pettingzoo.utils.conversions import aec_to_parallel

from simenv_marl import RULE, aec_env, make_step, parallel_env
from simenv_marl.envs import pad_agents
from tests.worlds.many_worlds import ROSTER, Announcing, Creature, Design, colony_points
from tests.worlds.models import play

SHEEP = 12
POINT = f"{Creature.__module__}.{Creature.act.__qualname__}"


class Painted:
    """A simulation with a picture in every mode."""

    render_modes = ("ansi", "human", "rgb_array")

    def render(self, mode):
        return {"ansi": "a picture", "rgb_array": np.zeros((2, 3, 3), np.uint8)}.get(mode)


class Greenhouse(Painted, GreenhouseSim):
    pass


class Pasture(Painted, Meadow):
    def __init__(self, ticks=10, **changes):
        super().__init__(ticks, **{"width": 6, "height": 6, "initial_sheep": SHEEP, "initial_wolves": 2} | changes)


class Colony(Painted, Announcing):
    def __init__(self):
        super().__init__(Design(initial=4, most=8, ticks=6, overseen="after"))


FLOCK = {"possible_agents": [f"sheep_{number}" for number in range(1, SHEEP + 1)], "undeclared": "rule"}
WORLDS = {
    "greenhouse": (Greenhouse, None, {}),
    "greenhouse, padded": (Greenhouse, None, {"padded": True}),
    "sheep": (Pasture, sheep_points(), {}),
    "sheep, declared": (Pasture, sheep_points(), FLOCK),
    "sheep, padded": (Pasture, sheep_points(), FLOCK | {"padded": True}),
    "colony": (Colony, colony_points(overseen=True), {}),
    "colony, declared": (Colony, colony_points(overseen=True), {"possible_agents": {POINT: ROSTER}}),
    "colony, padded": (Colony, colony_points(overseen=True), {"possible_agents": {POINT: ROSTER}, "padded": True}),
}
DECLARED = [name for name in WORLDS if name not in ("sheep", "colony")]
MET = {
    "api_test",
    "bombardment_test",
    "collect_render_results",
    "max_cycles_test",
    "parallel_api_test",
    "parallel_seed_test",
    "performance_benchmark",
    "render_test",
    "seed_test",
    "state_test",
    "test_save_obs",
}
NOT_MET = {"manual_control_test"}  # it presses keys, for games that are played by hand

pytestmark = [
    pytest.mark.filterwarnings(f"ignore:{message}")
    for message in (
        r"\s*This environment does not have possible_agents",  # PettingZoo's rule where no roster is declared
        "No agents present",  # after the end, where there is none
        ".* maximum .* space value is infinity",  # of the energy of sheep
        "Observation numpy array is all zeros",  # all that there is to see of the absent
    )
]


@pytest.fixture(params=WORLDS)
def world(request):
    return WORLDS[request.param]


def maker(world, view, **options):
    simulation, points, given = world
    given = given | options
    padded = given.pop("padded", False)
    make = partial(view, simulation, points, **given)
    return (lambda **more: pad_agents(make(**more))) if padded else make


def test_nothing_of_the_kit_is_left_out():
    tests = {name for name, value in vars(kit).items() if callable(value) and not isinstance(value, ModuleType)}
    assert tests == MET | NOT_MET


def test_turns_and_rounds_pass_its_tests(world):
    kit.api_test(maker(world, aec_env)(), num_cycles=60)
    kit.seed_test(maker(world, aec_env), num_cycles=30)
    kit.parallel_api_test(maker(world, parallel_env)(), num_cycles=60)
    kit.parallel_seed_test(maker(world, parallel_env), num_cycles=30)


def test_pictures_are_rendered(world):
    kit.render_test(maker(world, aec_env))
    assert kit.collect_render_results(maker(world, aec_env, render_mode="ansi")()) == ["a picture"] * 5


def test_the_benchmark_plays_any_number_of_episodes(world, monkeypatch):
    clock = SimpleNamespace(time=count().__next__)  # it goes by how often it is looked at, and not by the seconds
    monkeypatch.setattr(sys.modules["pettingzoo.test.performance_benchmark"], "time", clock)
    kit.performance_benchmark(maker(world, aec_env)())


@pytest.mark.parametrize("name", DECLARED)
def test_states_pass_its_test(name):
    make = partial(maker, WORLDS[name], state_space="observations")
    kit.state_test(make(aec_env)(), make(parallel_env)())


@pytest.mark.parametrize("name", [name for name in DECLARED if "colony" not in name])
def test_episodes_have_as_many_rounds_as_max_steps(name):
    """The creatures of a colony decide once a round, twice or never, and so have no such number."""
    simulation, points, options = WORLDS[name]

    def env(view, max_cycles):
        if simulation is Pasture:
            fed = partial(Pasture, max_cycles, initial_wolves=1, sheep_gain_from_food=1000.0)
            return maker((fed, points, options), view)()
        return maker(WORLDS[name], view, max_steps=max_cycles * (2 if view is aec_env else 1))()

    kit.max_cycles_test(SimpleNamespace(env=partial(env, aec_env), parallel_env=partial(env, parallel_env)))


def test_one_agent_after_many_resets():
    """With more agents the test fails of any environment: it takes what ``step`` returns for an observation."""
    kit.bombardment_test(aec_env(Greenhouse, WATERING), cycles=20)


def test_observations_that_are_pictures_are_saved(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (point,) = WATERING
    seen = make_step(
        observation_space=spaces.Box(0, 255, (4, 6, 3), np.uint8),
        observation_space_mapping=lambda greenhouse: np.full((4, 6, 3), greenhouse.day),
        action_space=spaces.Discrete(2),
        action_space_mapping=float,
        reward_mapping=lambda greenhouse: 0.0,
        agent="waterer_0",
    )
    env = aec_env(Greenhouse, {point: seen})
    kit.test_save_obs(env)
    assert [path.name for path in tmp_path.glob("saved_observations/*/*")] == ["waterer_0.png"]
    assert "did not save" not in capsys.readouterr().out


# -- its wrappers: those that look at actions are in test_conformance.py, those for films in test_wrappers.py ---


class Wrapped(wrappers.BaseParallelWrapper):
    """A wrapper that changes nothing."""


def test_wrapped_environments_pass_its_tests(world):
    for wrapper in (wrappers.BaseWrapper, wrappers.OrderEnforcingWrapper):
        kit.api_test(wrapper(maker(world, aec_env)()), num_cycles=30)
    kit.parallel_api_test(Wrapped(maker(world, parallel_env)()), num_cycles=30)


def length_in_rounds(env, seed):
    env.reset(seed=seed)
    rounds = 0
    while env.agents:
        env.step(dict.fromkeys(env.agents, RULE))
        rounds += 1
    return rounds


@pytest.mark.parametrize(
    ("view", "wrapper", "length"),
    [
        (parallel_env, wrappers.MultiEpisodeParallelEnv, length_in_rounds),
        (aec_env, wrappers.MultiEpisodeEnv, lambda env, seed: len(play(env, seed=seed))),
    ],
    ids=["rounds", "turns"],
)
def test_wrappers_make_one_of_many_episodes(world, view, wrapper, length):
    make = maker(world, view)
    episodes = [length(make(), seed) for seed in (1, 2, 3)]
    assert length(wrapper(make(), num_episodes=3), 1) == sum(episodes)


def test_rounds_are_not_made_of_turns():
    """PettingZoo's conversion needs turns in one order, of moves that wait for each other: see ``parallel_env``."""
    with pytest.raises(AssertionError, match="is_parallelizable"):
        aec_to_parallel(aec_env(Greenhouse))
