"""Small models of a line or two, and what most tests need around them.

``calling``, ``script`` and ``decision`` make a model inside a test; ``define`` makes a definition.
``play``, ``step`` and ``follow_the_rule`` play an environment, in any view. ``EVERY_VIEW`` and
``EVERY_DRIVER`` repeat a test. Context managers expect an error or put registries back.
"""

import gc
import re
import sys
from collections.abc import Mapping
from contextlib import contextmanager
from time import sleep
from typing import Any, NamedTuple
from weakref import WeakSet

import greenlet
import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

from simenv_marl import RULE, aec_env, joint_env, make_step, parallel_env, single_env
from tests.extent import DRIVERS


def plainly(value):
    """The name of a test with that value: the same in every process, without memory addresses."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))


PAIR = spaces.Box(-1e6, 1e6, (2,), np.float64)


def define(**changes):
    """A definition that returns the action, observes (1, 2) and rewards 0, but for ``changes``."""
    given = {
        "observation_space": PAIR,
        "observation_space_mapping": lambda *args, **kwargs: [1.0, 2.0],
        "action_space": spaces.Discrete(10),
        "action_space_mapping": lambda action: action,
        "reward_mapping": lambda *args, **kwargs: 0.0,
    }
    if changes.keys() & {"apply", "choices"}:
        del given["action_space_mapping"]
    return make_step(**given | changes)


def decision(rule=None, /, **changes):
    """A decision function of its own, whose rule says "rule"."""

    def choose():
        return "rule"

    return define(**changes)(rule or choose)


class Script:
    """A simulation without a base class, whose main loop is a function of it."""

    def __init__(self, main):
        self.main = main
        self.episodes = 0

    def reset(self, seed=None, options=None):
        self.seed, self.options = seed, options
        self.log = []
        self.episodes += 1

    def run(self):
        return self.main(self)


class Timed(Script):
    """A script whose clock is ten ahead for each entry of its log."""

    def time(self):
        return 10.0 * len(self.log)


def script(main):
    """A factory of simulations with that main loop, which may write to ``simulation.log``."""
    return lambda: Script(main)


def calling(*functions, ends=None):
    """A factory of simulations that call functions one after the other and log what they return."""

    def main(simulation):
        for function in functions:
            simulation.log.append(function())
        return ends

    return script(main)


def unwinding(decide, log):
    """A factory of simulations that decide once, and tell when they have ended."""

    def main(simulation):
        try:
            decide()
        finally:
            log.append("unwound")

    return script(main)


def begun(env, seed=None):
    """An environment in which an episode has begun."""
    env.reset(seed=seed)
    return env


class Turn(NamedTuple):
    """What one pass of ``agent_iter`` has seen and done."""

    agent: str
    observation: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    action: Any


def play(env, actions=RULE, *, seed=None, reset=True):
    """Play an AEC environment to its end.

    ``actions`` is one action for all decisions, an iterator of them, a dict from agents to either,
    or a callable of the agent and the environment.
    """
    if reset:
        env.reset(seed=seed)
    turns = []
    for agent in env.agent_iter():
        observation, reward, terminated, truncated, info = env.last()
        action = None
        if not (terminated or truncated):
            action = actions[agent] if isinstance(actions, Mapping) else actions
            if callable(action):
                action = action(agent, env)
            elif hasattr(action, "__next__"):
                action = next(action)
        turns.append(Turn(agent, observation, reward, terminated, truncated, info, action))
        env.step(action)
    return turns


def step(env, action, agent):
    """Take an action of an agent in any view. Returns whether that has ended it."""
    if isinstance(env, AECEnv):
        env.step(action)
        return bool(env.terminations[agent] or env.truncations[agent])
    if isinstance(env, ParallelEnv):
        env.step({agent: action})
        return agent not in env.agents
    return any(
        env.step({agent: action} if isinstance(env.action_space, spaces.Dict) else action)[2:4]
    )


def follow_the_rule(env, seed=None):
    """Let the rule decide throughout, in any view. Returns the simulation."""
    if isinstance(env, AECEnv):
        play(env, seed=seed)
        return env.unwrapped.simulation
    env.reset(seed=seed)
    if isinstance(env, ParallelEnv):
        while env.agents:
            env.step(dict.fromkeys(env.agents, RULE))
    else:
        while not any(env.step(RULE)[2:4]):
            pass
    return env.unwrapped.simulation


def decisions(turns):
    """The agents in the order in which they decided."""
    return [turn.agent for turn in turns if not (turn.terminated or turn.truncated)]


def rewards_of(turns, agent):
    """An agent's rewards for its actions, in order, without the reward before the first one."""
    return [turn.reward for turn in turns if turn.agent == agent][1:]


def notes(error):
    """All notes of an error."""
    return "\n".join(getattr(error, "__notes__", ()))


def culprits(error):
    """The names of the functions that an error's traceback leads through, the culprit last."""
    names, trace = [], error.__traceback__
    while trace is not None:
        names.append(trace.tb_frame.f_code.co_name)
        trace = trace.tb_next
    return names


def alive(kind):
    """The number of objects of a type since the file of tests began, after a collection."""
    gc.collect()
    return sum(type(thing) is kind for thing in gc.get_objects())


def stacks(before=None):
    """The greenlets since the file of tests began, without each thread's own (which has no parent).

    Those that were there ``before`` are left out. Of environments that hold others one goes at a
    time.
    """
    for _ in range(1000):  # on a machine that is busy a moment may be long
        gc.collect()
        found = WeakSet(
            thing
            for thing in gc.get_objects()
            if type(thing) is greenlet.greenlet and thing.parent is not None
        )
        if before is None or found <= before:
            break
        sleep(0.01)
    return found if before is None else found - before


_unattended = decision()


def nobody_is_asked():
    """Whether no simulation counts as running in this thread: decision functions are rules."""
    return bool(_unattended() == "rule")


VIEWS = (aec_env, parallel_env, joint_env, single_env)
EVERY_VIEW = pytest.mark.parametrize("view", VIEWS)

EVERY_DRIVER = pytest.mark.parametrize("_driver", DRIVERS, indirect=True)
"""Environments are made with that driver, unless they are told otherwise."""
BY_DRIVER = pytest.mark.parametrize("driver", DRIVERS)
"""The test gets the name of the driver."""


MODELS_OF_PAGES = ("bakery", "bakery_env", "lake")
"""The modules that pages of the documentation import from the folder they are in."""


@contextmanager
def registries_put_back():
    """Put back what Gymnasium's and PettingZoo's registries held."""
    names = ("aec_registry", "parallel_registry")  # older releases have none
    registries = (
        gymnasium.registry,
        *(getattr(pettingzoo, name) for name in names if hasattr(pettingzoo, name)),
    )
    before = [dict(registry) for registry in registries]
    try:
        yield
    finally:
        for registry, entries in zip(registries, before, strict=True):
            registry.clear()
            registry.update(entries)


@contextmanager
def models_of_pages_forgotten():
    """Import the models of pages anew in the block, and forget that import afterwards.

    Names of decision points would find the decorated functions of another import as long as these
    exist. Tests that have imported a model before go on with theirs.
    """
    before = {name: sys.modules[name] for name in MODELS_OF_PAGES if name in sys.modules}
    _forget_models_of_pages()
    try:
        yield
    finally:
        _forget_models_of_pages()
        sys.modules.update(before)


def _forget_models_of_pages():
    for model in MODELS_OF_PAGES:
        sys.modules.pop(model, None)
    gc.collect()


@contextmanager
def left_as_they_were(*places):
    """Assert that the attributes of classes and modules are the same afterwards."""
    before = [held(place) for place in places]
    yield
    for place, then in zip(places, before, strict=True):
        now = held(place)
        assert now.keys() == then.keys()
        assert all(now[name] is then[name] for name in now)


def held(place):
    """The attributes of a class or module, without those that Python adds."""
    return {
        name: value
        for name, value in vars(place).items()
        if not name.startswith("__") or name == "__init__"
    }


@contextmanager
def fails(error, *words, match=None):
    """Expect an error whose notes have all of these words."""
    with pytest.raises(error, match=match) as caught:
        yield caught
    for word in words:
        assert word in notes(caught.value)
