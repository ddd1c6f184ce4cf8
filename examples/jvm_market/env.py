"""A market town in Java as environments: what farms sow and what shops ask for bread become decisions of agents.

The model, ``Market.java``, keeps its own main loop in a JVM of its own, in which farms and shops begin and give up. It
knows the client ``clients/java/SimEnv.java`` and nothing else of environments, and runs without them: ``java
market.Market 7``.

- ``market``: the simulation.
- ``plain``: what comes out of the model where it runs without an environment.
- ``raw_env`` and ``env``: all farms and shops, as a PettingZoo AEC environment, bare and in PettingZoo's wrapper.
- ``parallel_env``: the same as a PettingZoo parallel environment.

Farms (``farm_1``, ...) sow some plots of wheat every fourth week, a ``Discrete``; shops (``shop_9``, ...) set a price
every week, a ``Box``. Each is rewarded with what it has earned since its last decision. The episode is truncated after
two years, and ends when there is no shop any more.
"""

from __future__ import annotations

import json
import subprocess
from typing import Any, Final

import numpy as np
import pettingzoo
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

import simenv_marl
from simenv_marl import Definition, ProcessSimulation, SimulationAECEnv, SimulationParallelEnv, difference, make_step

from .build import build, java

WEEKS: Final = 104
"""After how many weeks an episode is truncated."""

PLOTS: Final = 20
"""How many a farm has."""

PRICES: Final = (0.5, 4.0)
"""The least and the most that a loaf may cost."""

SOW, PRICE = "farm.sow", "shop.price"
"""The decision points, as the model names them."""

# -- what is observed, decided and rewarded -------------------------------------------------------


def farm_sees(c: Any) -> NDArray[np.float32]:
    """Its money, its plots last time, what wheat is worth, what is in the granary, and how many farms there are."""
    return np.array([c.money, c.plots, c.wheat_price, c.granary, c.farms], np.float32)


def shop_sees(c: Any) -> NDArray[np.float32]:
    """Its money, its last price, what it has baked and sold then, what wheat is worth, and how many shops there are."""
    return np.array([c.money, c.price, c.baked, c.sold, c.wheat_price, c.shops], np.float32)


def points() -> dict[str, Definition]:
    """Define both decision points, for ``points=``."""
    return {
        SOW: make_step(
            observation_space=Box(-1e3, 1e4, (5,), np.float32),
            observation_space_mapping=farm_sees,
            action_space=Discrete(PLOTS + 1),
            action_space_mapping=int,
            reward_mapping=difference(lambda c: c.earned),
            agent=lambda c: c.entity,
        ),
        PRICE: make_step(
            observation_space=Box(-1e3, 1e4, (6,), np.float32),
            observation_space_mapping=shop_sees,
            action_space=Box(*PRICES, (1,), np.float32),
            action_space_mapping=lambda action: float(np.asarray(action).item()),
            reward_mapping=difference(lambda c: c.earned),
            agent=lambda c: c.entity,
        ),
    }


# -- the simulation -------------------------------------------------------------------------------


def command(weeks: int = WEEKS) -> list[str]:
    """Say how the model is started, and compile it where it is not yet.

    Args:
        weeks: After how many an episode is truncated.

    Returns:
        The program and its arguments. The JVM is kept small, as there may be many of them.

    Raises:
        RuntimeError: There is no JDK.
    """
    small = ["-XX:+UseSerialGC", "-XX:TieredStopAtLevel=1", "-Xmx128m"]
    return [java()[0], *small, f"-Dmarket.weeks={weeks}", "-cp", str(build()), "market.Market"]


def market(weeks: int = WEEKS) -> ProcessSimulation:
    """Make the simulation; the attribute ``result`` of it is what came out of its last episode.

    Args:
        weeks: After how many an episode is truncated.
    """
    return ProcessSimulation(command(weeks), points())


def plain(seed: int, weeks: int = WEEKS) -> dict[str, Any]:
    """Run the model without an environment.

    Args:
        seed: Of its generator.
        weeks: After how many it ends.

    Returns:
        ``truncated`` and ``result``, with all digits.
    """
    said = subprocess.run([*command(weeks), str(seed)], capture_output=True, check=True, timeout=60)
    ended: dict[str, Any] = json.loads(said.stdout)
    return ended


# -- environments ---------------------------------------------------------------------------------


def raw_env(weeks: int = WEEKS, **options: Any) -> SimulationAECEnv:
    """Make the AEC environment of all farms and shops.

    Args:
        weeks: After how many an episode is truncated.
        **options: As of ``simenv_marl.aec_env``.
    """
    return simenv_marl.aec_env(market(weeks), **options)


def env(weeks: int = WEEKS, **options: Any) -> pettingzoo.AECEnv:
    """Make the same in PettingZoo's wrapper."""
    return OrderEnforcingWrapper(raw_env(weeks, **options))


def parallel_env(weeks: int = WEEKS, **options: Any) -> SimulationParallelEnv:
    """Make the parallel environment of all farms and shops.

    Args:
        weeks: After how many an episode is truncated.
        **options: As of ``simenv_marl.parallel_env``.
    """
    return simenv_marl.parallel_env(market(weeks), **options)
