"""Reinforcement learning environments out of simulations that know nothing of reinforcement learning.

The layers, each importing only from those above it::

    errors        the tree of errors
    simulation    what a simulation is; RULE and TRUNCATED
    _spaces       casting observations to spaces, checking actions against them
    _driver       switching between a simulation's stack and its user's
    decision      make_step: definitions, decision points, decision functions
    _points       what ``points=`` names, and patches for what nobody has decorated
    _plan         what an environment is made of, checked before anything runs
    _record       what an episode knows of one agent; rewards and observations
    _episode      what happens when: decisions, rewards, observations, ends, errors
    _session      a simulation over all episodes of one environment
    policies      policies back in the model's own loop
    envs          views: an episode read as a PettingZoo or Gymnasium environment
    registration  into the registries of Gymnasium and PettingZoo
    testing       checks of a simulation; imported by its users alone
    __main__      the same on the command line
"""

from . import errors
from .decision import Definition, difference, make_step
from .envs import (
    SimulationAECEnv,
    SimulationEnv,
    SimulationJointEnv,
    SimulationParallelEnv,
    aec_env,
    generate_env,
    joint_env,
    parallel_env,
    single_env,
)
from .errors import *  # noqa: F403 - the whole tree is public
from .policies import simulate
from .registration import register_simulation
from .simulation import RULE, TRUNCATED, SimulationInterface

__version__ = "0.1.0"

__all__ = [
    "RULE",
    "TRUNCATED",
    "Definition",
    "SimulationAECEnv",
    "SimulationEnv",
    "SimulationInterface",
    "SimulationJointEnv",
    "SimulationParallelEnv",
    "aec_env",
    "difference",
    "errors",
    "generate_env",
    "joint_env",
    "make_step",
    "parallel_env",
    "register_simulation",
    "simulate",
    "single_env",
]
__all__ += errors.__all__
