"""What PettingZoo and Gymnasium check, on shapes of simulations that are awkward for them. Warnings are errors."""

import random
import warnings

import gymnasium
import numpy as np
import pytest
import simpy
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env, data_equivalence
from pettingzoo.test import api_test, seed_test
from pettingzoo.utils import wrappers

from simenv_marl import RULE, TRUNCATED, aec_env, generate_env, make_step, single_env
from simenv_marl.errors import InvalidActionError
from tests.worlds.models import play

OBSERVATION = spaces.Box(-10, 10, (3,), np.float32)


class Being:
    """Observes a walk that it shares with the others."""

    def __init__(self, seed):
        self.random = random.Random(seed)
        self.place, self.time = 1.0, 1

    def observe(self, *_):
        return [self.place, self.time % 10, 1.0]

    def reward(self, *_):
        return self.place / 10

    def move(self, decision):
        self.time += 1
        self.place = max(-9.0, min(9.0, self.place + decision + self.random.uniform(-0.5, 0.5)))


def define(agent, **changes):
    return make_step(
        **{
            "observation_space": OBSERVATION,
            "observation_space_mapping": Being.observe,
            "action_space": spaces.Discrete(3),
            "action_space_mapping": {0: -1.0, 1: 0.0, 2: 1.0},
            "reward_mapping": Being.reward,
            "agent": agent,
        }
        | changes
    )


class Beings(Being):
    @define("ant_0")
    def ant(self):
        return 0.5

    @define(
        "bee_0", action_space=spaces.Box(-1, 1, (1,), np.float32), action_space_mapping=lambda action: float(action[0])
    )
    def bee(self):
        return -0.5

    @define("cat_0", action_mask_mapping=lambda self: [1, self.time % 2, 1])
    def cat(self):
        return 0.1

    @define(lambda self, number: f"mouse_{number}")
    def mouse(self, number):
        return 0.2


class Simulation:
    """Its episodes are as long as they are, and of the order that a subclass gives."""

    length = 20
    ends = None
    render_modes = ("ansi",)

    def reset(self, seed=None):
        self.beings = Beings(seed)

    def run(self):
        for kind in self.order(self.beings.random):
            decide = getattr(self.beings, kind[0])
            self.beings.move(decide(*kind[1:]))
        return self.ends

    def render(self, mode):
        return f"at {self.beings.place}"

    def order(self, rng):
        return [("ant",), ("bee",)] * self.length


class One(Simulation):
    def order(self, rng):
        return [("ant",)] * self.length


class Single(Simulation):
    def order(self, rng):
        return [("ant",)]


class TwiceInARow(Simulation):
    def order(self, rng):
        return [("ant",), ("ant",), ("bee",)] * self.length


class AnyOrder(Simulation):
    def order(self, rng):
        return [(rng.choice(["ant", "bee", "cat"]),) for _ in range(rng.randrange(1, 40))]


class NeverActs(Simulation):
    def order(self, rng):
        return [("bee",), ("cat",)] * self.length


class Truncated(Simulation):
    ends = TRUNCATED


class JoinsLate(Simulation):
    def order(self, rng):
        return [("mouse", min(number // 4, rng.randrange(5))) for number in range(self.length)]


class InAProcess(Simulation):
    def run(self):
        env, beings = simpy.Environment(), self.beings

        def live(kind, pause):
            while True:
                yield env.timeout(pause)
                beings.move(getattr(beings, kind)())

        env.process(live("ant", 2))
        env.process(live("bee", 3))
        env.run(until=40)


ANT, BEE, CAT, MOUSE = Beings.ant, Beings.bee, Beings.cat, Beings.mouse

SHAPES = {
    "one agent": lambda **options: aec_env(One, ANT, **options),
    "one step": lambda **options: aec_env(Single, ANT, **options),
    "one step of one of two": lambda **options: aec_env(Single, [BEE, ANT], **options),
    "in turn": lambda **options: aec_env(Simulation, [ANT, BEE], **options),
    "twice in a row": lambda **options: aec_env(TwiceInARow, [ANT, BEE], **options),
    "any order": lambda **options: aec_env(AnyOrder, [ANT, BEE, CAT], **options),
    "one never acts": lambda **options: aec_env(NeverActs, [ANT, BEE, CAT], **options),
    "a process": lambda **options: aec_env(InAProcess, [BEE, ANT], **options),
    "truncated by itself": lambda **options: aec_env(Truncated, [ANT, BEE], **options),
    "truncated by steps": lambda **options: aec_env(Simulation, [ANT, BEE], max_steps=7, **options),
    "policies": lambda **options: aec_env(TwiceInARow, [ANT, BEE], policies={BEE: RULE}, **options),
    "a class": lambda **options: generate_env(TwiceInARow, [ANT, BEE])(**options),
    "a class of one": lambda **options: generate_env(TwiceInARow, ANT, view="aec")(**options),
}
SHAPED = pytest.mark.parametrize("make", SHAPES.values(), ids=SHAPES.keys())


# -- PettingZoo -----------------------------------------------------------------------------------


@SHAPED
def test_api(make):
    api_test(make(), num_cycles=100)


@SHAPED
def test_seeds(make):
    seed_test(make, num_cycles=100)


@SHAPED
def test_api_of_wrapped_environments(make):
    api_test(wrappers.OrderEnforcingWrapper(wrappers.AssertOutOfBoundsWrapper(make())), num_cycles=50)


@SHAPED
def test_api_with_rendering(make):
    env = make(render_mode="ansi")
    api_test(env, num_cycles=10)
    env.reset()
    assert env.render() == f"at {env.unwrapped.simulation.beings.place}"


def late_joiners():
    return aec_env(JoinsLate, MOUSE)


def test_api_of_agents_that_join_late():
    with pytest.warns(UserWarning, match="possible_agents") as caught:
        api_test(late_joiners(), num_cycles=100)
    assert len(caught) == 1


def test_seeds_of_agents_that_join_late():
    # Without a roster PettingZoo's test seeds but those that are there at reset, which must not matter.
    seed_test(late_joiners, num_cycles=100)


def test_api_of_late_joiners_beside_declared_agents():
    class Both(JoinsLate):
        def order(self, rng):
            return [("ant",), *super().order(rng)]

    with pytest.warns(UserWarning, match="possible_agents") as caught:
        api_test(aec_env(Both, [ANT, MOUSE]), num_cycles=100)
    assert len(caught) == 1
    seed_test(lambda: aec_env(Both, [ANT, MOUSE]), num_cycles=100)


def test_api_of_observations_with_masks():
    space = spaces.Dict({"observation": OBSERVATION, "action_mask": spaces.Box(0, 1, (3,), np.int8)})
    definition = define(
        "cat_0",
        observation_space=space,
        observation_space_mapping=lambda self: {"observation": self.observe()},
        action_mask_mapping=lambda self: [1, self.time % 2, 1],
    )

    def make():
        return aec_env(NeverActs, {CAT: definition})

    with warnings.catch_warnings():
        # PettingZoo keeps a list of its own environments whose observations may be dicts.
        warnings.filterwarnings("ignore", message="Observation is not a NumPy array")
        warnings.filterwarnings("ignore", message="Observation space for each agent probably should be")
        api_test(make(), num_cycles=100)
    seed_test(make, num_cycles=100)


# -- its wrappers ---------------------------------------------------------------------------------


def test_order_enforcing():
    env = wrappers.OrderEnforcingWrapper(aec_env(AnyOrder, [ANT, BEE, CAT]))
    with pytest.raises(AttributeError):
        _ = env.agents
    turns = play(env, lambda agent, env: env.action_space(agent).sample(env.infos[agent].get("action_mask")), seed=3)
    assert len(turns) > 3
    with pytest.raises(AssertionError):
        list_without_steps(env)


def list_without_steps(env):
    env.reset()
    return list(env.agent_iter())


def test_assert_out_of_bounds():
    env = wrappers.AssertOutOfBoundsWrapper(aec_env(Simulation, [ANT, BEE]))
    env.reset(seed=1)
    with pytest.raises(AssertionError):
        env.step(3)
    env.step(2)
    assert env.agent_selection == "bee_0"


def test_clip_out_of_bounds():
    env = wrappers.ClipOutOfBoundsWrapper(aec_env(Simulation, BEE))
    env.reset(seed=1)
    with pytest.raises(InvalidActionError, match="is not in its action space"):
        env.unwrapped.step(np.array([3], np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env.step(np.array([3], np.float32))
    unclipped = aec_env(Simulation, BEE)
    unclipped.reset(seed=1)
    unclipped.step(np.array([1], np.float32))
    assert data_equivalence(env.last(), unclipped.last())


def test_terminate_illegal():
    env = wrappers.TerminateIllegalWrapper(aec_env(NeverActs, [CAT]), illegal_reward=-1)
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
    "one agent": lambda **options: single_env(One, ANT, **options),
    "one step": lambda **options: single_env(Single, ANT, **options),
    "one of two": lambda **options: single_env(TwiceInARow, BEE, **options),
    "a process": lambda **options: single_env(InAProcess, BEE, **options),
    "masked": lambda **options: single_env(NeverActs, CAT, **options),
    "truncated": lambda **options: single_env(Truncated, ANT, max_steps=3, **options),
    "policies": lambda **options: single_env(
        Simulation, [ANT, BEE], policies={BEE: lambda observation: [0.5]}, **options
    ),
    "a class": lambda **options: generate_env(Simulation, ANT)(**options),
}


@pytest.mark.parametrize("make", SINGLES.values(), ids=SINGLES.keys())
def test_gymnasiums_check(make):
    with warnings.catch_warnings():
        # The only one: render modes can be tested on registered environments alone.
        warnings.filterwarnings("ignore", message=".*Not able to test alternative render modes")
        check_env(make())
        check_env(make(render_mode="ansi"))


@pytest.fixture
def registered():
    env_class = generate_env(TwiceInARow, ANT)
    gymnasium.register(id="simenv_test/Ant-v0", entry_point=env_class)
    yield "simenv_test/Ant-v0"
    del gymnasium.registry["simenv_test/Ant-v0"]


def test_gymnasium_makes_it(registered):
    env = gymnasium.make(registered, render_mode="ansi")
    check_env(env.unwrapped)
    observation, info = env.reset(seed=3)
    assert observation in env.observation_space
    assert info == {}
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert type(reward) is float
    assert (terminated, truncated) == (False, False)
    assert env.render().startswith("at ")
    assert isinstance(env.unwrapped.simulation, TwiceInARow)
    env.unwrapped.step(RULE)
    env.close()


def test_gymnasium_limits_its_time(registered):
    env = gymnasium.make(registered, max_episode_steps=2)
    for _ in range(2):
        env.reset()
        assert env.step(1)[2:4] == (False, False)
        assert env.step(1)[2:4] == (False, True)


def test_gymnasium_makes_vectors_of_it(registered):
    envs = gymnasium.make_vec(registered, num_envs=3, vectorization_mode="sync")
    observations, _ = envs.reset(seed=5)
    assert observations.shape == (3, 3)
    for _ in range(60):
        observations, rewards, *_ = envs.step(envs.action_space.sample())
        assert observations in envs.observation_space
        assert rewards.shape == (3,)
    envs.close()


def test_the_views_tell_the_same_story():
    """One agent, the same seed and actions: the AEC and the single view differ in form alone."""
    single, aec = single_env(TwiceInARow, ANT), aec_env(TwiceInARow, ANT)
    rng = np.random.default_rng(1)
    observation, info = single.reset(seed=8)
    aec.reset(seed=8)
    assert data_equivalence((observation, 0.0, False, False, info), aec.last())
    terminated = False
    while not terminated:
        action = rng.integers(3)
        *told, terminated, truncated, info = single.step(action)
        aec.step(action)
        assert data_equivalence((*told, terminated, truncated, info), aec.last())
