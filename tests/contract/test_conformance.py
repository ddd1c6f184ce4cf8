"""What PettingZoo and Gymnasium check, on shapes of simulations that are awkward for them. Warnings are errors."""

import random
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env, data_equivalence
from pettingzoo.test import api_test, seed_test
from pettingzoo.utils import wrappers

from simenv_marl import RULE, TRUNCATED, aec_env, generate_env, make_step, single_env
from simenv_marl.errors import InvalidActionError
from tests.worlds.models import play

OBSERVATION = spaces.Box(-10, 10, (3,), np.float32)


def define(agent, **changes):
    return make_step(
        **{
            "observation_space": OBSERVATION,
            "observation_space_mapping": lambda walk: [walk.place, walk.moves % 10, 1.0],
            "action_space": spaces.Discrete(3),
            "action_space_mapping": {0: -1.0, 1: 0.0, 2: 1.0},
            "reward_mapping": lambda walk: walk.place / 10,
            "agent": agent,
        }
        | changes
    )


def every_other(walk):
    return [1, walk.moves % 2, 1]


class Walk:
    """A random walk that those take further who are named in some order."""

    render_modes = ("ansi",)

    def __init__(self, order=("ant", "bee")):
        self.order = order

    def reset(self, seed=None):
        self.random, self.place, self.moves = random.Random(seed), 1.0, 1

    def run(self):
        order = list(self.order) * 20
        if not self.order:
            order = self.random.choices(["ant", "bee", "cat"], k=self.random.randrange(1, 40))
        for name in order:
            step = getattr(self, name)() + self.random.uniform(-0.5, 0.5)
            self.moves += 1
            self.place = max(-9.0, min(9.0, self.place + step))

    def render(self, mode):
        return f"at {self.place}"

    @define("ant_0")
    def ant(self):
        return 0.5

    @define(
        "bee_0", action_space=spaces.Box(-1, 1, (1,), np.float32), action_space_mapping=lambda action: float(action[0])
    )
    def bee(self):
        return -0.5

    @define("cat_0", action_mask_mapping=every_other)
    def cat(self):
        return 0.1


class Step(Walk):
    def run(self):
        self.place += self.ant()


class Truncated(Step):
    def run(self):
        super().run()
        return TRUNCATED


def walk(*order):
    return lambda: Walk(order)


ANT, BEE, CAT = Walk.ant, Walk.bee, Walk.cat
TWICE_IN_A_ROW = walk("ant", "ant", "bee")
SHAPES = {
    "one agent": lambda **options: aec_env(walk("ant"), ANT, **options),
    "one step": lambda **options: aec_env(Step, [BEE, ANT], **options),
    "twice in a row": lambda **options: aec_env(TWICE_IN_A_ROW, [ANT, BEE], **options),
    "any order": lambda **options: aec_env(walk(), [ANT, BEE, CAT], **options),
    "one never acts": lambda **options: aec_env(walk("bee", "cat"), [ANT, BEE, CAT], **options),
    "truncated by itself": lambda **options: aec_env(Truncated, ANT, **options),
    "truncated by steps": lambda **options: aec_env(Walk, [ANT, BEE], max_steps=7, **options),
    "policies": lambda **options: aec_env(TWICE_IN_A_ROW, [ANT, BEE], policies={BEE: RULE}, **options),
    "a class": lambda **options: generate_env(TWICE_IN_A_ROW, [ANT, BEE])(**options),
    "a class of one": lambda **options: generate_env(TWICE_IN_A_ROW, ANT, view="aec")(**options),
}


@pytest.mark.parametrize("make", SHAPES.values(), ids=SHAPES.keys())
def test_pettingzoos_tests_pass(make):
    api_test(make(), num_cycles=100)
    seed_test(make, num_cycles=100)
    env = make(render_mode="ansi")
    api_test(wrappers.OrderEnforcingWrapper(wrappers.AssertOutOfBoundsWrapper(env)), num_cycles=50)
    env.reset()
    assert env.render() == f"at {env.unwrapped.simulation.place}"


def test_pettingzoos_tests_pass_with_masks_in_observations():
    cat = define(
        "cat_0",
        observation_space=spaces.Dict({"observation": OBSERVATION, "action_mask": spaces.Box(0, 1, (3,), np.int8)}),
        observation_space_mapping=lambda walk: {"observation": [walk.place, walk.moves % 10, 1.0]},
        action_mask_mapping=every_other,
    )

    def make():
        return aec_env(walk("bee", "cat"), {CAT: cat})

    with warnings.catch_warnings():
        # PettingZoo keeps a list of its own environments whose observations may be dicts.
        warnings.filterwarnings("ignore", message="Observation is not a NumPy array")
        warnings.filterwarnings("ignore", message="Observation space for each agent probably should be")
        api_test(make(), num_cycles=100)
    seed_test(make, num_cycles=100)


# -- its wrappers ---------------------------------------------------------------------------------


def test_order_is_enforced():
    env = wrappers.OrderEnforcingWrapper(aec_env(walk(), [ANT, BEE, CAT]))
    with pytest.raises(AttributeError):
        _ = env.agents
    turns = play(env, lambda agent, env: env.action_space(agent).sample(env.infos[agent].get("action_mask")), seed=3)
    assert len(turns) > 3
    env.reset()
    with pytest.raises(AssertionError):
        list(env.agent_iter())


def test_actions_out_of_bounds_are_refused_or_clipped():
    env = wrappers.AssertOutOfBoundsWrapper(aec_env(Walk, [ANT, BEE]))
    env.reset(seed=1)
    with pytest.raises(AssertionError):
        env.step(3)
    env.step(2)
    assert env.agent_selection == "bee_0"
    env = wrappers.ClipOutOfBoundsWrapper(aec_env(Walk, BEE))
    env.reset(seed=1)
    with pytest.raises(InvalidActionError, match="is not in its action space"):
        env.unwrapped.step(np.array([3], np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env.step(np.array([3], np.float32))
    unclipped = aec_env(Walk, BEE)
    unclipped.reset(seed=1)
    unclipped.step(np.array([1], np.float32))
    assert data_equivalence(env.last(), unclipped.last())


def test_illegal_actions_terminate():
    env = wrappers.TerminateIllegalWrapper(aec_env(walk("bee", "cat"), [CAT]), illegal_reward=-1)
    env.reset(seed=1)
    unwrapped = env.unwrapped
    while env.infos["cat_0"]["action_mask"][1]:
        env.step(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env.step(1)
    assert env.last()[1:4] == (-1.0, True, True)
    env.step(None)
    assert env.agents == unwrapped.agents == []
    turns = play(env, 0, seed=1)
    assert len(turns) == 21


# -- Gymnasium ------------------------------------------------------------------------------------


SINGLES = {
    "one agent": lambda **options: single_env(walk("ant"), ANT, **options),
    "one step": lambda **options: single_env(Step, ANT, **options),
    "masked": lambda **options: single_env(walk("bee", "cat"), CAT, **options),
    "truncated": lambda **options: single_env(TWICE_IN_A_ROW, BEE, max_steps=3, **options),
    "policies": lambda **options: single_env(Walk, [ANT, BEE], policies={BEE: lambda observation: [0.5]}, **options),
    "a class": lambda **options: generate_env(Walk, ANT)(**options),
}


@pytest.mark.parametrize("make", SINGLES.values(), ids=SINGLES.keys())
def test_gymnasiums_check_passes(make):
    with warnings.catch_warnings():
        # The only one: render modes can be tested on registered environments alone.
        warnings.filterwarnings("ignore", message=".*Not able to test alternative render modes")
        check_env(make())
        check_env(make(render_mode="ansi"))


def test_gymnasium_makes_generated_classes_limits_their_time_and_makes_vectors_of_them():
    name = "simenv_test/Ant-v0"
    gymnasium.register(id=name, entry_point=generate_env(TWICE_IN_A_ROW, ANT))
    try:
        env = gymnasium.make(name, render_mode="ansi", max_episode_steps=2)
        check_env(env.unwrapped)
        for _ in range(2):
            observation, info = env.reset(seed=3)
            assert observation in env.observation_space
            assert info == {}
            assert env.step(1)[2:4] == (False, False)
            assert env.render().startswith("at ")
            assert env.step(1)[2:4] == (False, True)
        assert isinstance(env.unwrapped.simulation, Walk)
        env.unwrapped.step(RULE)
        env.close()
        envs = gymnasium.make_vec(name, num_envs=3, vectorization_mode="sync")
    finally:
        del gymnasium.registry[name]
    observations, _ = envs.reset(seed=5)
    assert observations.shape == (3, 3)
    for _ in range(60):
        observations, rewards, *_ = envs.step(envs.action_space.sample())
        assert observations in envs.observation_space
        assert rewards.shape == (3,)
    envs.close()
