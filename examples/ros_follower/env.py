"""Environments made from a ROS 1 robot that follows a leader: the agent chooses its velocity.

``follower.py`` is the robot's controller, a ROS node, and ``world.py`` a simulated world on
simulated time. Both are ordinary ROS nodes, in the system's Python.

The reward is minus the error of the distance to the leader, which should be one metre, for each
step of 0.1 s.
"""

from __future__ import annotations

import math
import subprocess
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box

from simenv_marl import Definition, make_step, single_env
from simenv_marl.envs import SimulationEnv
from simenv_marl.remote import ProcessSimulation

COMMAND: Final = ("/usr/bin/python3", str(Path(__file__).parent / "follower.py"))
"""The controller, with the world that it starts."""


def missing() -> str:
    """Name what is missing for running the nodes; empty if nothing is missing."""
    packages = "python3-rospy python3-rosmaster python3-geometry-msgs python3-rosgraph-msgs"
    imports = "import geometry_msgs, rosgraph_msgs, rosmaster, rospy"
    try:
        found = subprocess.run(
            [COMMAND[0], "-c", imports], check=False, capture_output=True, timeout=60
        ).returncode
    except OSError:
        found = 1
    return f"ROS 1 (Debian: apt-get install {packages})" if found else ""


POINTS: Final[dict[str, Definition]] = {
    "follower.velocity": make_step(
        observation_space=Box(-np.inf, np.inf, (2,), np.float32),
        observation_space_mapping=lambda call: [call.ahead, call.left],
        observation_labels=["metres ahead", "metres to the left"],
        action_space=Box(np.array([0, -1], np.float32), np.array([1, 1], np.float32)),
        action_space_mapping=lambda action: action.tolist(),
        rule_action_mapping=lambda velocity: np.array(velocity, np.float32),
        action_labels=["metres per second forward", "radians per second to the left"],
        reward_mapping=lambda call: -abs(math.hypot(call.ahead, call.left) - 1.0),
        agent="follower_0",
        question="How fast does the robot drive and turn?",
        display_mapping=lambda call: {
            "leader ahead": f"{call.ahead:.2f} m",
            "leader to the left": f"{call.left:.2f} m",
        },
    )
}
"""The decision point of the controller, with its definition."""


def follower() -> ProcessSimulation:
    """Make the simulation. Option of ``reset``: the simulated ``seconds``."""
    return ProcessSimulation(COMMAND, POINTS)


def env(**options: Any) -> SimulationEnv:
    """Make the environment of the follower."""
    return single_env(follower, **options)
