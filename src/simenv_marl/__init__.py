"""Turns a simulation into reinforcement learning environments, without a change to its main loop.

The functions in which it decides something become the agents of a PettingZoo environment, or one of
them becomes the agent of a Gymnasium environment::

    from simenv_marl import RULE, aec_env, make_step

    env = aec_env(Simulation, {"package.module.Model.decide": make_step(...)})

To begin with:

- ``make_step`` defines the observations, actions and rewards of an agent that decides in a function
  of the model;
- ``aec_env``, ``parallel_env``, ``single_env``, ``joint_env`` and ``vector_env`` make environments;
- ``RULE`` as an action lets the model's own function decide;
- ``simulate`` and ``evaluate`` run the simulation with policies, and compare these with the rule;
- ``clone`` copies an environment in mid-episode, ``save_episode`` writes its episode to a file;
- ``python -m simenv_marl check MODULE:SIMULATION`` checks a simulation.

All other names are in rooms, which are imported when they are first used:

- ``simenv_marl.plugins``: handlers before, after and instead of a model's functions;
- ``simenv_marl.envs``: the classes of environments;
- ``simenv_marl.planning``: values of actions, and policies that decide by them;
- ``simenv_marl.experiments``: evaluations, designs, resumable experiments, effects, variants;
- ``simenv_marl.data``: trajectories, data sets, comparisons with the rule, plots;
- ``simenv_marl.remote``: simulators in processes of their own;
- ``simenv_marl.seats``: people and language models decide;
- ``simenv_marl.testing``: checks of a simulation;
- ``simenv_marl.errors``: the exception classes.

``core/episode.py`` alone determines the order of events. ``docs/contributing.md`` follows one
decision through the package.
"""

import sys
import sysconfig
from importlib import import_module
from typing import TYPE_CHECKING, Any

if sysconfig.get_config_var("Py_GIL_DISABLED"):
    raise ImportError(
        "simenv_marl needs a Python with the global interpreter lock: greenlet crashes in"
        " free-threaded builds. Use the ordinary build of the same version"
    )

if TYPE_CHECKING:
    from .core.copies.clone import branch, clone
    from .core.switching.generators import Streams, reseed_generators
    from .decision import Definition, difference, make_step
    from .envs import (
        aec_env,
        generate_env,
        joint_env,
        parallel_env,
        single_env,
        turn_env,
        vector_env,
    )
    from .episodes import load_episode, save_episode
    from .errors import SimEnvError
    from .experiments.evaluation import evaluate
    from .registration import register_simulation
    from .runs import simulate, simulate_many
    from .simulation import RULE, TRUNCATED, SimulationInterface, SteppedSimulation

__version__ = "0.1.0"

__all__ = [
    "RULE", "TRUNCATED", "Definition", "SimEnvError", "SimulationInterface", "SteppedSimulation",
    "Streams", "aec_env", "branch", "clone", "difference", "evaluate", "generate_env", "joint_env",
    "load_episode", "make_step", "parallel_env", "register_simulation", "reseed_generators",
    "save_episode", "simulate", "simulate_many", "single_env", "turn_env", "vector_env",
]  # fmt: skip

ROOMS = (
    "data",
    "envs",
    "errors",
    "experiments",
    "planning",
    "plugins",
    "remote",
    "seats",
    "testing",
)
"""The modules in which all other public names are."""

_MODULES = {
    "core.copies.clone": ("branch", "clone"),
    "core.switching.generators": ("Streams", "reseed_generators"),
    "decision": ("Definition", "difference", "make_step"),
    "envs": (
        "aec_env",
        "generate_env",
        "joint_env",
        "parallel_env",
        "single_env",
        "turn_env",
        "vector_env",
    ),
    "episodes": ("load_episode", "save_episode"),
    "errors": ("SimEnvError",),
    "experiments.evaluation": ("evaluate",),
    "runs": ("simulate", "simulate_many"),
    "registration": ("register_simulation",),
    "simulation": ("RULE", "TRUNCATED", "SimulationInterface", "SteppedSimulation"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name or a room when it is first used."""
    if name in ROOMS:
        return import_module(f".{name}", __name__)
    if name in _MODULE_OF:
        value = getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)
        globals()[name] = value
        return value
    if not name.startswith("_"):
        for room in ROOMS:
            if name in getattr(import_module(f".{room}", __name__), "__all__", ()):
                error: type[Exception] = AttributeError
                if sys._getframe(1).f_code.co_name == "_handle_fromlist":
                    error = ImportError  # else Python's own error would not name the room
                raise error(
                    f"{name} is in simenv_marl.{room}: from simenv_marl.{room} import {name}"
                )
    raise AttributeError(f"module 'simenv_marl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *ROOMS, "__version__"})
