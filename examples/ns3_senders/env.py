"""Senders in a simulated network, each of which is an agent: the simulator is ns-3, a process of its own.

``senders.cpp`` is the model, and knows nothing of environments: who sends decides on a rate where an acknowledgement or
a timer says so, by a rule like TCP's. It asks through the client ``clients/cpp/simenv.hpp``.

- ``program``: the compiled model.
- ``senders``: the simulation.
- ``raw_env`` and ``parallel_env``: its PettingZoo environments.

**What a sender decides.** By what to multiply its rate, up to twice and down to half of it: the power of two that is
its action.

**What it sees.** Its rate; how much longer the latest round trip took than the shortest so far; which share of the
packets was lost that were sent at this rate; whether it was a timer that went off.

**What it is rewarded for.** Each second brings the logarithm of what arrives, so that a share that goes from the rich
to the poor is a gain; and each 0.1 s for which packets have to queue costs as much as to halve that.
"""

from __future__ import annotations

import math
import os
import shlex
import shutil
import subprocess
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from simenv_marl import Definition, ProcessSimulation, SimulationAECEnv, SimulationParallelEnv, difference, make_step
from simenv_marl import aec_env as aec
from simenv_marl import parallel_env as parallel

HERE: Final = Path(__file__).parent
SOURCES: Final = (HERE / "senders.cpp", HERE.parents[1] / "clients" / "cpp" / "simenv.hpp")
MODULES: Final = ("ns3-internet", "ns3-point-to-point", "ns3-traffic-control")

# -- the program ----------------------------------------------------------------------------------


def missing() -> str:
    """What is not installed that compiling the model takes; empty where nothing is missing."""
    tools = [tool for tool in ("g++", "pkg-config") if shutil.which(tool) is None]
    if tools:
        return f"{' and '.join(tools)} (Debian: apt-get install g++ pkg-config)"
    found = subprocess.run(["pkg-config", "--exists", *MODULES], check=False, timeout=60)
    return "" if found.returncode == 0 else "ns-3 (Debian: apt-get install libns3-dev libgsl-dev)"


def program(folder: Path = HERE / "out") -> Path:
    """Compile the model, where it was not or has changed since.

    Args:
        folder: Where the program lies.

    Returns:
        The program.

    Raises:
        RuntimeError: Something is missing, or it does not compile.
    """
    target = folder / "senders"
    if target.exists() and all(source.stat().st_mtime < target.stat().st_mtime for source in SOURCES):
        return target
    if lacking := missing():
        raise RuntimeError(f"the model of the senders cannot be compiled without {lacking}")
    folder.mkdir(parents=True, exist_ok=True)
    command = ["pkg-config", "--cflags", "--libs", *MODULES]
    flags = shlex.split(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)
    made = folder / f"senders.{os.getpid()}"  # which takes its place when it is whole
    command = ["g++", "-std=c++17", "-O2", f"-I{SOURCES[1].parent}", str(SOURCES[0]), *flags, "-o", str(made)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
    if done.returncode:
        raise RuntimeError(f"the model of the senders does not compile:\n{done.stderr[:4000]}")
    return made.replace(target)


# -- what is observed, decided and rewarded -------------------------------------------------------

OBSERVED: Final = (
    "the rate: how often 1 Mbit/s has to be doubled",
    "the latest round trip: how often the shortest has to be doubled",
    "the share that was lost",
    "whether a timer went off",
)


def observe(call: Any) -> NDArray[np.float32]:
    """Observe what ``OBSERVED`` lists."""
    values = np.log2(call.rate / 1e6), np.log2(call.rtt / call.least_rtt), call.loss, call.timer
    return np.array(values, np.float32)


def to_factor(action: Any) -> float:
    """What an action decides: by what to multiply the rate."""
    return float(2.0 ** np.asarray(action, float).item())


_elapsed = difference(attrgetter("time"))


def reward(call: Any) -> float:
    """What the time since the sender's latest decision was worth to it."""
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
    )
}
"""The decision point of the model, and what it is to an environment."""


# -- environments ---------------------------------------------------------------------------------


def senders() -> ProcessSimulation:
    """The simulation. Options of ``reset``: ``seconds`` of simulated time, and how many ``hosts`` there are."""
    return ProcessSimulation([str(program())], POINTS)


def raw_env(**options: Any) -> SimulationAECEnv:
    """All senders, one after the other as they decide: an AEC environment."""
    return aec(senders, **options)


def parallel_env(**options: Any) -> SimulationParallelEnv:
    """All senders, in rounds: a parallel environment."""
    return parallel(senders, **options)
