"""Environments made from e-pucks that sweep an arena: each robot is an agent.

The simulator is Enki, in C++. ``robots.cpp`` is the model, which runs in a process of its own.
Robots come in pairs and leave in mid-episode.

- ``robots``: the simulation.
- ``raw_env`` and ``parallel_env``: the PettingZoo environments.

**Actions.** A robot chooses how it turns, from 1 (left, on the spot) to -1 (right).

**Observations.** A robot sees four infrared sensors, the distance and the angle of the nearest
other robot and of the nearest dirty cell that no other robot is nearer to, and the charge of its
battery.

**Rewards.** Each robot gets the number of cells that all robots have swept since its previous
decision.
"""

from __future__ import annotations

import shutil
import subprocess
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from simenv_marl import Definition, difference, make_step
from simenv_marl import aec_env as aec
from simenv_marl import parallel_env as parallel
from simenv_marl.envs import SimulationAECEnv, SimulationParallelEnv
from simenv_marl.remote import ProcessSimulation

from ..compiling import compiled

HERE: Final = Path(__file__).parent
SOURCES: Final = (HERE / "robots.cpp", HERE.parents[1] / "clients" / "cpp" / "simenv.hpp")
COMMAND: Final = ("g++", "-std=c++17", "-O2", f"-I{SOURCES[1].parent}", "-x", "c++")


def missing() -> str:
    """Name what is missing for compiling the model; empty if nothing is missing."""
    if shutil.which("g++") is None:
        return "g++ (Debian: apt-get install g++)"
    header = "#include <enki/PhysicalEngine.h>"
    found = subprocess.run(
        [*COMMAND, "-E", "-"], check=False, input=header, capture_output=True, text=True, timeout=60
    )
    return "" if found.returncode == 0 else "Enki (Debian: apt-get install libenki-dev)"


def program(folder: Path = HERE / "out") -> Path:
    """Compile the model, unless the program is up to date: see ``compiled``.

    ``folder`` is that of the program.
    """
    return compiled(
        folder / "robots", SOURCES, missing, lambda: [*COMMAND, str(SOURCES[0]), "-lenki"]
    )


def observe(call: Any) -> NDArray[np.float32]:
    """Observe a robot: four sensors, two distances, two angles and the charge.

    Sensors are in thousands, distances in metres, and angles in radians.
    """
    (other, to_other), (dirt, to_dirt) = call.other, call.dirt
    sensors = np.asarray(call.sensors) / 1000
    return np.array(
        [*sensors, other / 100, to_other, dirt / 100, to_dirt, call.charge / 120], np.float32
    )


OBSERVED: Final = (
    *(f"sensor {number}, in thousands" for number in range(1, 5)),
    "metres to the nearest robot",
    "radians to the nearest robot",
    "metres to the nearest dirt",
    "radians to the nearest dirt",
    "charge, full at 1",
)
"""The labels of the observation."""


def display(call: Any) -> dict[str, str]:
    """Return what people and language models read in place of the observation."""
    (other, to_other), (dirt, to_dirt) = call.other, call.dirt
    return {
        "nearest dirt": f"{dirt / 100:.2f} m, at {np.degrees(to_dirt):.0f}°",
        "nearest robot": f"{other / 100:.2f} m, at {np.degrees(to_other):.0f}°",
        "sensors": ", ".join(f"{sensor:.0f}" for sensor in call.sensors),
        "charge": f"{call.charge:.0f} s",
    }


POINTS: Final[dict[str, Definition]] = {
    "robot.turn": make_step(
        observation_space=Box(-np.inf, np.inf, (9,), np.float32),
        observation_space_mapping=observe,
        action_space=Box(-1.0, 1.0, (1,), np.float32),
        action_space_mapping=lambda action: float(np.asarray(action).item()),
        rule_action_mapping=lambda turn: np.array([turn], np.float32),
        reward_mapping=difference(attrgetter("swept")),
        agent=attrgetter("entity"),
        question="How does the robot turn?",
        display_mapping=display,
        action_labels=["from -1 to 1"],
        observation_labels=OBSERVED,
    )
}
"""The decision point of the model, with its definition."""


def robots() -> ProcessSimulation:
    """Make the simulation. Option of ``reset``: the simulated ``seconds``."""
    return ProcessSimulation([str(program())], POINTS)


def raw_env(**options: Any) -> SimulationAECEnv:
    """Make the AEC environment, in which robots decide one after another."""
    return aec(robots, **options)


def parallel_env(**options: Any) -> SimulationParallelEnv:
    """Make the parallel environment, in which robots decide in rounds."""
    return parallel(robots, **options)
