"""What PettingZoo and Gymnasium check, on shapes of simulations that are awkward for them.

Warnings are errors.
"""

import random
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test, state_test
from pettingzoo.utils import wrappers
from pettingzoo.utils.conversions import parallel_to_aec, turn_based_aec_to_parallel

from simenv_marl import RULE, TRUNCATED, aec_env, clone, generate_env, parallel_env, single_env
from simenv_marl.envs import pad_agents
from tests.worlds.entities import HERE, ROSTER, AnnouncingColony, ColonyDesign, colony_points
from tests.worlds.models import define, play

OBSERVATION = spaces.Box(-10, 10, (3,), np.float32)
STEPS = {
    "observation_space": OBSERVATION,
    "observation_space_mapping": lambda walk: [walk.place, walk.moves % 10, 1.0],
    "action_space": spaces.Discrete(3),
    "action_space_mapping": {0: -1.0, 1: 0.0, 2: 1.0},
    "reward_mapping": lambda walk: walk.place / 10,
}
PUSHES = {
    "action_space": spaces.Box(-1, 1, (1,), np.float32),
    "action_space_mapping": lambda action: float(action[0]),
}
MASKED = {"action_mask_mapping": lambda walk: [1, walk.moves % 2, 1]}


class Walk:
    """A random walk that those take further who are named in some order."""

    render_modes = ("ansi",)

    def __init__(self, order=("ant", "bee"), times=20, ends=None):
        self.order, self.times, self.ends = order, times, ends

    def reset(self, seed=None):
        self.random, self.place, self.moves = random.Random(seed), 1.0, 1

    def run(self):
        order = list(self.order) * self.times
        if not self.order:
            order = self.random.choices(["ant", "bee", "cat"], k=self.random.randrange(1, 40))
        for name in order:
            step = getattr(self, name)() + self.random.uniform(-0.5, 0.5)
            self.moves += 1
            self.place = max(-9.0, min(9.0, self.place + step))
        return self.ends

    def render(self, mode):
        return f"at {self.place}"

    @define(agent="ant_0", **STEPS)
    def ant(self):
        return 0.5

    @define(agent="bee_0", **STEPS | PUSHES)
    def bee(self):
        return -0.5

    @define(agent="cat_0", **STEPS, **MASKED)
    def cat(self):
        return 0.1


def walk(*order, **options):
    return lambda: Walk(order, **options)


ANT, BEE, CAT = Walk.ant, Walk.bee, Walk.cat
TWICE_IN_A_ROW = walk("ant", "ant", "bee")
SHAPES = {
    "one agent": (walk("ant"), ANT, {}),
    "one step": (walk("ant", times=1), [BEE, ANT], {}),
    "twice in a row": (TWICE_IN_A_ROW, [ANT, BEE], {}),
    "any order": (walk(), [ANT, BEE, CAT], {}),
    "one never acts": (walk("bee", "cat"), [ANT, BEE, CAT], {}),
    "truncated by itself": (walk("ant", times=1, ends=TRUNCATED), ANT, {}),
    "truncated by steps": (Walk, [ANT, BEE], {"max_steps": 7}),
    "policies": (TWICE_IN_A_ROW, [ANT, BEE], {"policies": {BEE: RULE}}),
}


def made(shape, view, render_mode=None):
    simulation, points, options = shape
    return generate_env(simulation, points, **options | {"view": view})(render_mode=render_mode)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
def test_aec_and_parallel_envs_pass_pettingzoos_tests(shape):
    api_test(made(shape, "aec"), num_cycles=100)
    seed_test(partial(made, shape, "aec"), num_cycles=100)
    env = made(shape, "aec", "ansi")
    api_test(wrappers.OrderEnforcingWrapper(wrappers.AssertOutOfBoundsWrapper(env)), num_cycles=50)
    env.reset()
    assert env.render() == f"at {env.simulation.place}"
    if shape not in (SHAPES["any order"], SHAPES["one never acts"]):
        # Its tests of rounds do not know of masks in infos, and a masked action is illegal.
        parallel_api_test(made(shape, "parallel"), num_cycles=100)
        parallel_seed_test(partial(made, shape, "parallel"), num_cycles=100)


# of those who have not been called yet
@pytest.mark.filterwarnings("ignore:Observation numpy array is all zeros")
def test_envs_converted_between_aec_and_parallel_pass_pettingzoos_tests():
    api_test(parallel_to_aec(made(SHAPES["twice in a row"], "parallel")), num_cycles=20)
    parallel_api_test(
        turn_based_aec_to_parallel(aec_env(walk("ant", "bee"), [ANT, BEE])), num_cycles=20
    )


def test_clones_pass_pettingzoos_and_gymnasiums_tests():
    kits = {
        "aec": api_test,
        "parallel": parallel_api_test,
        "single": partial(check_env, skip_render_check=True),
    }
    for view, kit in kits.items():
        env = (
            made(SHAPES["twice in a row"], view)
            if view != "single"
            else single_env(walk("ant"), ANT)
        )
        env.reset(seed=1)
        kit(clone(env))


# PettingZoo keeps a list of its own environments whose observations may be dicts.
@pytest.mark.filterwarnings("ignore:Observation is not a NumPy array")
@pytest.mark.filterwarnings("ignore:Observation space for each agent probably should be")
def test_envs_with_masks_in_observations_pass_pettingzoos_tests():
    seen = {
        "observation_space": spaces.Dict(
            {"observation": OBSERVATION, "action_mask": spaces.Box(0, 1, (3,), np.int8)}
        ),
        "observation_space_mapping": lambda walk: {
            "observation": [walk.place, walk.moves % 10, 1.0]
        },
    }
    shape = walk("bee", "cat"), {CAT: define(agent="cat_0", **STEPS | seen, **MASKED)}, {}
    api_test(made(shape, "aec"), num_cycles=100)
    seed_test(partial(made, shape, "aec"), num_cycles=100)
    parallel_api_test(made(shape, "parallel"), num_cycles=100)


# where none are declared
@pytest.mark.filterwarnings(r"ignore:\s*This environment does not have possible_agents")
@pytest.mark.filterwarnings("ignore:No agents present")  # after the end, where there is none
# all that there is to see of the absent
@pytest.mark.filterwarnings("ignore:Observation numpy array is all zeros")
@pytest.mark.parametrize("roster", ["unknown", "declared", "padded"])
def test_envs_with_births_and_deaths_pass_pettingzoos_tests(roster):
    declared = {"possible_agents": {f"{HERE}.Creature.act": ROSTER[:6]}, "undeclared": "rule"}
    options = {} if roster == "unknown" else declared | {"state_space": "observations"}

    def make(view, **more):
        colony = AnnouncingColony(ColonyDesign(initial=4, most=8, ticks=6, overseen="after"))
        env = view(colony, colony_points(overseen=True), **options | more)
        return pad_agents(env) if roster == "padded" else env

    turns, rounds = partial(make, aec_env), partial(make, parallel_env)
    api_test(turns(), num_cycles=60)
    seed_test(turns, num_cycles=30)
    parallel_api_test(rounds(), num_cycles=60)
    parallel_seed_test(rounds, num_cycles=30)
    if options:
        state_test(turns(), rounds())


# -- its wrappers ---------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*Illegal move made, game terminating")
def test_pettingzoos_wrapper_terminates_an_env_after_an_illegal_action():
    env = wrappers.TerminateIllegalWrapper(aec_env(walk("bee", "cat"), [CAT]), illegal_reward=-1)
    env.reset(seed=1)
    while env.infos["cat_0"]["action_mask"][1]:
        env.step(0)
    env.step(1)
    assert env.last()[1:4] == (-1.0, True, True)
    env.step(None)
    assert env.agents == env.unwrapped.agents == []
    assert len(play(env, 0, seed=1)) == 21


# -- Gymnasium ------------------------------------------------------------------------------------


SINGLES = {
    "one agent": (walk("ant"), ANT, {}),
    "one step": (walk("ant", times=1), ANT, {}),
    "masked": (walk("bee", "cat"), CAT, {}),
    "truncated": (TWICE_IN_A_ROW, BEE, {"max_steps": 3}),
    "policies": (Walk, [ANT, BEE], {"policies": {BEE: lambda observation: [0.5]}}),
}


# Render modes can be tested on registered environments alone.
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
@pytest.mark.parametrize("shape", SINGLES.values(), ids=SINGLES.keys())
def test_single_env_passes_gymnasiums_check_env(shape):
    check_env(made(shape, "single"))
    check_env(made(shape, "single", "ansi"))
