"""What the tests share: definitions, simulations and players."""

import gc
import re
from collections.abc import Mapping
from time import sleep
from typing import Any, NamedTuple
from weakref import WeakSet

import greenlet
import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

from simenv_marl import RULE, make_step


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
