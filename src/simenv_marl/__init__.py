"""Turns a simulation into reinforcement learning environments, without a change to its main loop.

The simulation stays as it is. The functions in which it decides something become the agents of a PettingZoo
environment, or one of them becomes the agent of a Gymnasium environment::

    from simenv_marl import RULE, aec_env, make_step

    env = aec_env(Simulation, {"package.module.Model.decide": make_step(...)})

To begin with:

- ``make_step`` defines the observations, actions and rewards of an agent that decides in a function of the model;
- ``aec_env``, ``parallel_env``, ``single_env``, ``joint_env`` and ``vector_env`` make environments;
- ``RULE`` as an action lets the model's own function decide;
- ``simulate`` and ``evaluate`` run the simulation with policies, and compare these with the rule;
- ``python -m simenv_marl check MODULE:SIMULATION`` checks a simulation.

The rooms of the package; each imports only from those below it::

    __main__                            the command line
    templates                           models to start from: the command line copies them
    planning                            values of actions, and policies that decide by them
    testing, registration, branching    checks of a simulation; registries; exact continuations of an episode
    callbacks                           exceptions in callbacks of C code
    experiments                         policies compared on the same seeds; designs; resumable experiments; effects
    envs                                views: an episode as a PettingZoo or Gymnasium environment
    many                                policies in the model, in one simulation or in many at once; plots
    core                                the order of events: plans, stacks, sessions, episodes, agents
    remote                              simulators outside Python: processes that call for decisions
    decision                            make_step: definitions and decision points
    hooks                               stand-ins for a model's functions; handlers around their calls
    stepped                             simulations of models that are made with a seed and stepped
    simulation                          the interface of simulations; RULE and TRUNCATED
    errors                              the exception classes

``core/episode.py`` alone determines the order of events. ``docs/contributing.md`` follows one decision through the
rooms.
"""

from . import errors
from .branching import branch
from .callbacks import CallbackGuard
from .core.provenance import provenance
from .core.reseeding import reseed_generators
from .core.variant import Variant
from .decision import Definition, decision_points, difference, make_step
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
from .experiments.designs import design
from .experiments.effects import Effects, effects, sobol_indices
from .experiments.evaluation import Evaluation, evaluate
from .experiments.runs import run_experiment
from .hooks.attached import Call, ChangedArgs, ChangedResult
from .hooks.plugins import (
    attach_handler,
    attached_handlers,
    expose_to_plugins,
    handlers,
    remove_handler,
    trace,
)
from .hooks.targets import exposed_functions
from .many.collect import Trajectories, collect_episodes, simulate_many
from .many.comparison import Comparison, compare_with_rule
from .many.demonstrations import record_dataset, save_dataset
from .many.mixture import Mixture
from .many.plots import plot_returns, plot_timeline
from .many.simulate import simulate
from .planning.policy import RolloutPolicy
from .planning.tree import TreeSearchPolicy
from .planning.values import ActionValues, action_values
from .registration import register_simulation
from .remote.process import ProcessSimulation
from .simulation import RULE, TRUNCATED, SimulationInterface
from .stepped import SteppedSimulation

__version__ = "0.1.0"

__all__ = [
    "RULE",
    "TRUNCATED",
    "ActionValues",
    "Call",
    "CallbackGuard",
    "ChangedArgs",
    "ChangedResult",
    "Comparison",
    "Definition",
    "Effects",
    "Evaluation",
    "Mixture",
    "ProcessSimulation",
    "RolloutPolicy",
    "SimulationAECEnv",
    "SimulationEnv",
    "SimulationInterface",
    "SimulationJointEnv",
    "SimulationParallelEnv",
    "SimulationVectorEnv",
    "SteppedSimulation",
    "Trajectories",
    "TreeSearchPolicy",
    "Variant",
    "action_values",
    "aec_env",
    "attach_handler",
    "attached_handlers",
    "branch",
    "collect_episodes",
    "compare_with_rule",
    "decision_points",
    "design",
    "difference",
    "effects",
    "errors",
    "evaluate",
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
    "reseed_generators",
    "run_experiment",
    "save_dataset",
    "simulate",
    "simulate_many",
    "single_env",
    "sobol_indices",
    "trace",
    "vector_env",
]
__all__ += errors.__all__
