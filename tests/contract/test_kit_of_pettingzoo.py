"""What ``pettingzoo.test`` has, on both examples and where agents are born and die."""

from functools import partial

import pytest
from examples.greenhouse_coop.env import GreenhouseSim
from examples.wolf_sheep.env import Meadow, sheep_points
from pettingzoo import test as kit

from simenv_marl import aec_env, parallel_env
from simenv_marl.envs import pad_agents
from tests.worlds.many_worlds import ROSTER, Announcing, Creature, Design, colony_points

SHEEP = 12
POINT = f"{Creature.__module__}.{Creature.act.__qualname__}"


class Pasture(Meadow):
    def __init__(self):
        super().__init__(10, width=6, height=6, initial_sheep=SHEEP, initial_wolves=2)


class Colony(Announcing):
    def __init__(self):
        super().__init__(Design(initial=4, most=8, ticks=6, overseen="after"))


FLOCK = {"possible_agents": [f"sheep_{number}" for number in range(1, SHEEP + 1)], "undeclared": "rule"}
WORLDS = {
    "greenhouse": (GreenhouseSim, None, {}),
    "greenhouse, padded": (GreenhouseSim, None, {"padded": True}),
    "sheep": (Pasture, sheep_points(), {}),
    "sheep, declared": (Pasture, sheep_points(), FLOCK),
    "sheep, padded": (Pasture, sheep_points(), FLOCK | {"padded": True}),
    "colony": (Colony, colony_points(overseen=True), {}),
    "colony, declared": (Colony, colony_points(overseen=True), {"possible_agents": {POINT: ROSTER}}),
    "colony, padded": (Colony, colony_points(overseen=True), {"possible_agents": {POINT: ROSTER}, "padded": True}),
}
DECLARED = [name for name in WORLDS if name not in ("sheep", "colony")]
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


def test_turns_and_rounds_pass_its_tests(world):
    kit.api_test(maker(world, aec_env)(), num_cycles=60)
    kit.seed_test(maker(world, aec_env), num_cycles=30)
    kit.parallel_api_test(maker(world, parallel_env)(), num_cycles=60)
    kit.parallel_seed_test(maker(world, parallel_env), num_cycles=30)


@pytest.mark.parametrize("name", DECLARED)
def test_states_pass_its_test(name):
    make = partial(maker, WORLDS[name], state_space="observations")
    kit.state_test(make(aec_env)(), make(parallel_env)())
