"""Environments made from senders in a simulated network: each sender is an agent.

The simulator is ns-3, in C++. ``senders.cpp`` is the model, which runs in a process of its own and
does not depend on environments: at an acknowledgement or a timeout, a sender chooses its rate by a
rule like TCP's. The model asks for decisions through the client ``clients/cpp/simenv.hpp``.

- ``program``: the compiled model.
- ``senders``: the simulation.
- ``raw_env`` and ``parallel_env``: the PettingZoo environments.

**Actions.** A sender chooses the factor of its rate, from one half to two: the action is its
exponent to base two.

**Observations.** A sender sees its rate, the ratio of the latest round-trip time to the shortest so
far, the share of lost packets among those sent at this rate, and whether the decision comes from a
timeout.

**Rewards.** Each second brings the logarithm of the throughput, so that capacity that moves from a
fast sender to a slow one is a gain. Each 0.1 s of queueing delay costs as much as half the
throughput.
"""

from __future__ import annotations

import math
import shlex
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
SOURCES: Final = (HERE / "senders.cpp", HERE.parents[1] / "clients" / "cpp" / "simenv.hpp")
MODULES: Final = ("ns3-internet", "ns3-point-to-point", "ns3-traffic-control")

# -- the program ----------------------------------------------------------------------------------


def missing() -> str:
    """Name the missing tools and libraries for compiling the model; empty if nothing is missing."""
    tools = [tool for tool in ("g++", "pkg-config") if shutil.which(tool) is None]
    if tools:
        return f"{' and '.join(tools)} (Debian: apt-get install g++ pkg-config)"
    found = subprocess.run(["pkg-config", "--exists", *MODULES], check=False, timeout=60)
    return "" if found.returncode == 0 else "ns-3 (Debian: apt-get install libns3-dev libgsl-dev)"


def program(folder: Path = HERE / "out") -> Path:
    """Compile the model, unless the program is up to date: see ``compiled``.

    ``folder`` is that of the program.
    """
    return compiled(folder / "senders", SOURCES, missing, command)


def command() -> list[str]:
    """Return the command of the compiler, with the flags of ns-3."""
    asked = ["pkg-config", "--cflags", "--libs", *MODULES]
    flags = shlex.split(
        subprocess.run(asked, check=True, capture_output=True, text=True, timeout=60).stdout
    )
    return ["g++", "-std=c++17", "-O2", f"-I{SOURCES[1].parent}", str(SOURCES[0]), *flags]


# -- observations, actions, rewards ---------------------------------------------------------------

OBSERVED: Final = (
    "the rate: how often 1 Mbit/s has to be doubled",
    "the latest round trip: how often the shortest has to be doubled",
    "the share that was lost",
    "whether a timer went off",
)


def observe(call: Any) -> NDArray[np.float32]:
    """Observe a sender, as ``OBSERVED`` lists it."""
    values = np.log2(call.rate / 1e6), np.log2(call.rtt / call.least_rtt), call.loss, call.timer
    return np.array(values, np.float32)


def display(call: Any) -> dict[str, str]:
    """Return what people and language models read in place of the observation."""
    return {
        "rate": f"{call.rate / 1e6:.2f} Mbit/s",
        "latest round trip": f"{1000 * call.rtt:.0f} ms",
        "shortest round trip": f"{1000 * call.least_rtt:.0f} ms",
        "lost": f"{100 * call.loss:.0f} %",
    }


def to_factor(action: Any) -> float:
    """Map an action to a factor of the rate."""
    return float(2.0 ** np.asarray(action, float).item())


_elapsed = difference(attrgetter("time"))


def reward(call: Any) -> float:
    """Compute the reward for the time since the sender's previous decision."""
    arrived = call.rate * (1 - call.loss)
    queueing = call.rtt - call.least_rtt
    return float(_elapsed(call) * (math.log2(1 + arrived / 1e5) - 10 * queueing))


POINTS: Final[dict[str, Definition]] = {
    "sender.rate": make_step(
        observation_space=Box(-np.inf, np.inf, (len(OBSERVED),), np.float32),
        observation_space_mapping=observe,
        action_space=Box(-1.0, 1.0, (1,), np.float32),
        action_space_mapping=to_factor,
        reward_mapping=reward,
        agent=attrgetter("entity"),
        question="By which power of two does the sender change its rate?",
        display_mapping=display,
        action_labels=["power of two"],
        observation_labels=OBSERVED,
    )
}
"""The decision point of the model, with its definition."""


# -- environments ---------------------------------------------------------------------------------


def senders() -> ProcessSimulation:
    """Make the simulation.

    Options of ``reset``: the simulated ``seconds``, and the number of ``hosts``.
    """
    return ProcessSimulation([str(program())], POINTS)


def raw_env(**options: Any) -> SimulationAECEnv:
    """Make the AEC environment, in which senders decide one after another."""
    return aec(senders, **options)


def parallel_env(**options: Any) -> SimulationParallelEnv:
    """Make the parallel environment, in which senders decide in rounds."""
    return parallel(senders, **options)
