"""Environments are copied and pickled at any time; what comes out is to be reset."""

import copy
import pickle
from functools import partial

import cloudpickle
import pytest
from gymnasium.wrappers import TimeLimit
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from simenv_marl import RULE, aec_env, generate_env, joint_env, parallel_env, single_env
from simenv_marl.envs import SimulationAECEnv
from simenv_marl.errors import ClosedError, NotResetError
from simenv_marl.experiments import Variant
from tests.processes import python
from tests.worlds.copied import Walk, WalkEnv, blow, define_walk
from tests.worlds.models import BY_DRIVER

VIEWS = {
    make.__name__: partial(make, Walk, Walk.choose)
    for make in (aec_env, parallel_env, single_env, joint_env)
}
MAKERS = VIEWS | {
    "generated": partial(WalkEnv, max_steps=2),
    "generated without a name": lambda: generate_env(Walk, Walk.choose, view="aec")(max_steps=2),
}
COPIES = pytest.mark.parametrize(
    "copied",
    [
        copy.deepcopy,
        copy.copy,
        lambda env: pickle.loads(pickle.dumps(env)),
        lambda env: cloudpickle.loads(cloudpickle.dumps(env)),
    ],
    ids=["deepcopy", "copy", "pickle", "cloudpickle"],
)


def episode(env, **reset):
    """What an episode of any view with random actions tells."""
    told = [env.reset(**reset)]
    if hasattr(env, "agent_iter"):
        for agent in env.agent_iter():
            observation, *rest = env.last()
            told.append((agent, observation.tolist(), *rest))
            env.step(None if rest[1] or rest[2] else env.action_space(agent).sample())
    elif hasattr(env, "agents"):
        while env.agents:
            told.append(env.step({agent: env.action_space(agent).sample() for agent in env.agents}))
    else:
        ended = False
        while not ended:
            told.append(env.step(env.action_space.sample()))
            ended = told[-1][2] or told[-1][3]
    return repr(told), list(env.unwrapped.simulation.steps)


@pytest.mark.parametrize("name", MAKERS)
@COPIES
def test_copied_env_gives_the_same_episodes_as_the_original(name, copied):
    """Before the first episode, after it, and when it was closed; its generators come along."""
    env = MAKERS[name]()
    for number in range(3):
        twin = copied(env)
        assert isinstance(
            twin, SimulationAECEnv if name == "generated without a name" else type(env)
        )
        assert twin.simulation is not env.simulation
        seed = {} if number else {"seed": 5}
        assert episode(twin, **seed) == episode(env, **seed)
        assert episode(copied(env)) == episode(env)
        if number == 1:
            env.close()
    assert twin.provenance()["points"] == env.provenance()["points"]


@COPIES
@pytest.mark.parametrize("make", [lambda env: TimeLimit(env, 3), OrderEnforcingWrapper])
def test_copied_env_keeps_its_wrapper(copied, make):
    env = make((aec_env if make is OrderEnforcingWrapper else single_env)(Walk, Walk.choose))
    twin = copied(env)
    assert type(twin) is type(env)
    assert episode(twin, seed=2) == episode(env, seed=2)


@pytest.mark.parametrize("make", VIEWS.values(), ids=VIEWS)
@COPIES
def test_copied_env_needs_a_reset_if_copied_in_mid_episode(make, copied):
    env = make()
    env.reset(seed=1)
    env.np_random.random(3)
    twin = copied(env)
    assert twin.np_random.bit_generator.state == env.np_random.bit_generator.state
    assert episode(twin) == episode(env)
    env.reset(seed=1)
    env.step(RULE)
    twin = copied(env)
    assert getattr(twin, "agents", []) == []
    for _ in range(2):
        with pytest.raises(NotResetError, match=r"copy.*reset\(\).*clone\(\)"):
            twin.step(RULE)
    env.step(RULE)  # where it stood
    twin.reset(seed=5)
    twin.step(RULE)
    env.close()
    twin.close()
    with pytest.raises(ClosedError):
        twin.step(RULE)
    assert episode(copied(env), seed=3) == episode(make(), seed=3)


@BY_DRIVER
@COPIES
def test_copied_env_has_all_options(copied, driver):
    """Undecorated points, policies, plugins, variants, rosters and all other options."""
    points = {f"{Walk.__module__}.Walk.drift": define_walk(agent="wind_0"), Walk.choose: None}
    variant = Variant(
        "long", Walk, parameters={"length": 7}, plugins=[(blow, Walk.drift, "instead")]
    )
    env = aec_env(
        variant, points, policies={Walk.choose: RULE}, max_steps=3, driver=driver, global_rng=True
    )
    twin = copied(env)
    assert twin.possible_agents == ["wind_0"]
    assert twin.provenance() == env.provenance()
    assert twin.provenance()["variant"] == "long"
    env.close()


MODEL = """
import pickle, sys, cloudpickle
from simenv_marl import aec_env, difference, single_env
from tests.worlds.models import define

class Model:
    def reset(self, seed=None):
        self.total = 0
    def run(self):
        for _ in range(3):
            self.total += self.one() + self.two()
    @define(agent="one_0", reward_mapping=difference(lambda model: model.total))
    def one(self):
        return 1
    def two(self):
        return 10
"""


def test_cloudpickle_carries_an_env_of_a_scripts_model_to_another_process():
    """A model in ``__main__``, with and without decorators, with lambdas, as in a notebook."""
    code = """
two = define(agent="two_0", action_space_mapping=lambda action: action)
points = {Model.one: None, Model.two: two}
env = aec_env(Model, points, policies={"two_0": lambda observation: 5})
env.reset()
env.close()
sys.stdout.buffer.write(cloudpickle.dumps(env))
"""
    pickled = python("-c", MODEL + code, text=False).stdout
    code = """
import sys, pickle
from tests.worlds.models import play
env = pickle.loads(sys.stdin.buffer.read())
print([turn.reward for turn in play(env, 2, seed=1)], env.simulation.total, env.simulation.two())
"""
    ran = python("-c", code, text=False, input=pickled)
    assert ran.stdout.strip() == b"[0.0, 7.0, 7.0, 7.0] 21 10"
