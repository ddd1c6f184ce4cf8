"""Environments made from a market town in Java: farms sow wheat, and shops price bread.

The model, ``Market.java``, has its own main loop in its own JVM; farms and shops enter and leave
the market. The client ``clients/java/SimEnv.java`` is its only connection to environments, and it
runs without them: ``java market.Market 7``.

- ``market``: the simulation.
- ``plain``: the result of the model when it runs without an environment.
- ``raw_env`` and ``env``: all farms and shops, as a PettingZoo AEC environment, without and with
  PettingZoo's wrapper.
- ``parallel_env``: the same as a PettingZoo parallel environment.

Farms (``farm_1``, ...) choose a number of plots of wheat every fourth week, a ``Discrete``; shops
(``shop_9``, ...) set a price every week, a ``Box``. The reward of each is its earnings since its
last decision. The episode is truncated after two years, and terminates when no shop is left.
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
from simenv_marl import Definition, difference, make_step
from simenv_marl.envs import SimulationAECEnv, SimulationParallelEnv
from simenv_marl.remote import ProcessSimulation

from .build import build, java

WEEKS: Final = 104
"""The number of weeks after which an episode is truncated."""

PLOTS: Final = 20
"""The number of plots of a farm."""

PRICES: Final = (0.5, 4.0)
"""The lowest and the highest price of a loaf."""

SOW, PRICE = "farm.sow", "shop.price"
"""The decision points, with the model's names."""

# -- observations, actions, rewards ---------------------------------------------------------------


def farm_sees(c: Any) -> NDArray[np.float32]:
    """Observe a farm's money and plots, the wheat price, the granary and the number of farms."""
    return np.array([c.money, c.plots, c.wheat_price, c.granary, c.farms], np.float32)


def shop_sees(c: Any) -> NDArray[np.float32]:
    """Observe a shop's money, price, loaves baked and sold, the wheat price, the shops' number."""
    return np.array([c.money, c.price, c.baked, c.sold, c.wheat_price, c.shops], np.float32)


def points() -> dict[str, Definition]:
    """Return the definitions of both decision points, for ``points=``."""
    return {
        SOW: make_step(
            observation_space=Box(-1e3, 1e4, (5,), np.float32),
            observation_space_mapping=farm_sees,
            action_space=Discrete(PLOTS + 1),
            action_space_mapping=int,
            reward_mapping=difference(lambda c: c.earned),
            agent=lambda c: c.entity,
            question="How many plots do you sow with wheat?",
            display_mapping=lambda c: {
                "your money": c.money,
                "your plots": c.plots,
                "price of wheat": c.wheat_price,
                "wheat in the granary": c.granary,
                "farms": c.farms,
            },
            action_labels=[f"{plots} plots" for plots in range(PLOTS + 1)],
            observation_labels=["money", "plots", "price of wheat", "granary", "farms"],
        ),
        PRICE: make_step(
            observation_space=Box(-1e3, 1e4, (6,), np.float32),
            observation_space_mapping=shop_sees,
            action_space=Box(*PRICES, (1,), np.float32),
            action_space_mapping=lambda action: float(np.asarray(action).item()),
            reward_mapping=difference(lambda c: c.earned),
            agent=lambda c: c.entity,
            question="What does a loaf of bread cost?",
            display_mapping=lambda c: {
                "your money": c.money,
                "your price": c.price,
                "loaves baked": c.baked,
                "loaves sold": c.sold,
                "price of wheat": c.wheat_price,
                "shops": c.shops,
            },
            action_labels=["price of a loaf"],
            observation_labels=["money", "price", "baked", "sold", "price of wheat", "shops"],
        ),
    }


# -- the simulation -------------------------------------------------------------------------------


def command(weeks: int = WEEKS) -> list[str]:
    """Return the command that starts the model, and compile the model if necessary.

    Args:
        weeks: The number of weeks after which an episode is truncated.

    Returns:
        The program and its arguments. The JVM's memory is small, as there may be many JVMs.

    Raises:
        RuntimeError: There is no JDK.
    """
    small = ["-XX:+UseSerialGC", "-XX:TieredStopAtLevel=1", "-Xmx128m"]
    return [java()[0], *small, f"-Dmarket.weeks={weeks}", "-cp", str(build()), "market.Market"]


def market(weeks: int = WEEKS) -> ProcessSimulation:
    """Make the simulation; its attribute ``result`` holds the result of the last episode.

    Args:
        weeks: The number of weeks after which an episode is truncated.
    """
    return ProcessSimulation(command(weeks), points())


def plain(seed: int, weeks: int = WEEKS) -> dict[str, Any]:
    """Run the model without an environment.

    Args:
        seed: The seed of the model.
        weeks: The number of weeks after which the run is truncated.

    Returns:
        ``truncated`` and ``result``, in full precision.
    """
    said = subprocess.run([*command(weeks), str(seed)], capture_output=True, check=True, timeout=60)
    ended: dict[str, Any] = json.loads(said.stdout)
    return ended


# -- environments ---------------------------------------------------------------------------------


def raw_env(weeks: int = WEEKS, **options: Any) -> SimulationAECEnv:
    """Make the AEC environment of all farms and shops.

    Args:
        weeks: The number of weeks after which an episode is truncated.
        **options: The options of ``simenv_marl.aec_env``.
    """
    return simenv_marl.aec_env(market(weeks), **options)


def env(weeks: int = WEEKS, **options: Any) -> pettingzoo.AECEnv:
    """Make the same environment in PettingZoo's wrapper."""
    return OrderEnforcingWrapper(raw_env(weeks, **options))


def parallel_env(weeks: int = WEEKS, **options: Any) -> SimulationParallelEnv:
    """Make the parallel environment of all farms and shops.

    Args:
        weeks: The number of weeks after which an episode is truncated.
        **options: The options of ``simenv_marl.parallel_env``.
    """
    return simenv_marl.parallel_env(market(weeks), **options)
