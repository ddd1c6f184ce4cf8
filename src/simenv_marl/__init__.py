"""Reinforcement learning environments out of simulations that know nothing of reinforcement learning.

The layers, each importing only from those above it::

    errors        the tree of errors
    simulation    what a simulation is; RULE and TRUNCATED
    _spaces       casting observations to spaces, checking actions against them
    _driver       what runs around us: simulations, mappings, plugins, threads that simulations have started
    _generators   a state of the global generators for each environment that asks for one
    _wrappers     functions that stand in front of others: decision functions, exposed functions
    decision      make_step: definitions, decision points, decision functions
    _greenlets    switching between a simulation's stack and its user's, in one thread
    _threads      the same, between a thread of the simulation's and its user's
    _patches      places in a model, and what is to stand there for a while
    _handlers     handlers, and the calls in which they take part
    _iterables    iterables whose items are handed out with handlers
    plugins       handlers for everybody, for a while, for one environment; traces
    _points       what ``points=`` names
    variants      a model with all that an experiment changes, under one name
    _options      the options of environments
    _bindings     decision points under an environment's definitions, ready to be called
    _plan         what an environment is made of, checked before anything runs
    _record       what an episode knows of one agent; rewards and observations
    _provenance   what an environment was made of, for results files
    _episode      what happens when: decisions, rewards, observations, ends, errors
    _together     the turns of many episodes taken together
    _rounds       the same in rounds, in which all agents may act
    _surroundings what an environment's simulation finds around it whenever it is at work
    _session      a simulation over all episodes of one environment
    policies      policies back in the model's own loop
    _parcels      what crosses from one process to another
    _stacks       observations, actions and masks of many decisions, stacked
    _batches      many simulations whose decisions are answered together
    _ledger       what learners want to know of many episodes
    _spread       work that is spread over processes by joblib
    many          the public functions for many simulations at once
    demonstrations data sets of who has decided what; comparisons with the rule
    plots         pictures of what they have found
    envs          views: an episode read as a PettingZoo or Gymnasium environment
    branching     exact continuations of an episode that is going on
    registration  into the registries of Gymnasium and PettingZoo
    testing       checks of a simulation; imported by its users alone
    __main__      the same on the command line
"""

from . import errors
from .branching import branch
from .core.provenance import provenance
from .core.variant import Variant
from .decision import Definition, difference, make_step
from .envs import (
    SimulationAECEnv,
    SimulationEnv,
    SimulationJointEnv,
    SimulationParallelEnv,
    SimulationVectorEnv,
    aec_env,
    generate_env,
    joint_env,
    parallel_env,
    single_env,
    vector_env,
)
from .errors import *  # noqa: F403 - the whole tree is public
from .hooks.handlers import Call, ChangedArgs, ChangedResult
from .hooks.plugins import (
    attach_handler,
    attached_handlers,
    decision_points,
    expose_to_plugins,
    exposed_functions,
    handlers,
    remove_handler,
    trace,
)
from .many.collect import Trajectories, collect_episodes, simulate_many
from .many.demonstrations import Comparison, Mixture, compare_with_rule, record_dataset, save_dataset
from .many.plots import plot_returns, plot_timeline
from .many.simulate import simulate
from .registration import register_simulation
from .simulation import RULE, TRUNCATED, SimulationInterface

__version__ = "0.1.0"

__all__ = [
    "RULE",
    "TRUNCATED",
    "Call",
    "ChangedArgs",
    "ChangedResult",
    "Comparison",
    "Definition",
    "Mixture",
    "SimulationAECEnv",
    "SimulationEnv",
    "SimulationInterface",
    "SimulationJointEnv",
    "SimulationParallelEnv",
    "SimulationVectorEnv",
    "Trajectories",
    "Variant",
    "aec_env",
    "attach_handler",
    "attached_handlers",
    "branch",
    "collect_episodes",
    "compare_with_rule",
    "decision_points",
    "difference",
    "errors",
    "expose_to_plugins",
    "exposed_functions",
    "generate_env",
    "handlers",
    "joint_env",
    "make_step",
    "parallel_env",
    "plot_returns",
    "plot_timeline",
    "provenance",
    "record_dataset",
    "register_simulation",
    "remove_handler",
    "save_dataset",
    "simulate",
    "simulate_many",
    "single_env",
    "trace",
    "vector_env",
]
__all__ += errors.__all__
