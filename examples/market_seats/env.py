"""Two conditions of the market: four agents, or four people, decide how many crates to bring.

``python -m simenv_marl play examples.market_seats.env:Free --seat trader_0 trader_1 trader_2
trader_3`` serves a page with a seat for each trader.

**Observations.** What a trader knows when it decides, as ``OBSERVED`` lists it. All traders see
everything, as on the page, so the conditions differ in a rule of the market, and not in what is
known.

**Rewards.** The trader's profit of the round.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from simenv_marl import SimulationInterface, aec_env, difference, make_step
from simenv_marl.envs import SimulationAECEnv

from .model import MOST, ROUNDS, TRADERS, Market, Trader

AGENTS: Final = [f"trader_{number}" for number in range(TRADERS)]
"""The names of the agents."""

OBSERVED: Final = (
    "rounds that are over",
    "price in the round before",
    "your profit in the round before",
    "your crates in the round before",
    "crates of the others: now, or before if they decide after you",
    "traders who decide before you in this round",
)


def look(trader: Trader) -> NDArray[np.float32]:
    """Observe the market, as ``OBSERVED`` lists it."""
    market = trader.market
    seen = (
        market.round,
        market.price,
        trader.gain,
        trader.crates,
        trader.crates_of_others(),
        market.decided,
    )
    return np.array(seen, np.float32)


def display(trader: Trader) -> dict[str, float | str]:
    """Return what people and language models read in place of the observation."""
    market = trader.market
    return {
        "round": f"{market.round + 1} of {ROUNDS}",
        "price in the round before": market.price,
        "your profit in the round before": trader.gain,
        "your crates in the round before": trader.crates,
        "crates of the others: now, or before if they decide after you": trader.crates_of_others(),
        "traders who decide before you in this round": market.decided,
    }


choose = make_step(
    observation_space=Box(-np.inf, np.inf, (len(OBSERVED),), np.float32),
    observation_space_mapping=look,
    action_space=Discrete(MOST + 1),
    action_space_mapping=int,
    rule_action_mapping=int,
    reward_mapping=difference(lambda trader: trader.profit),
    agent=lambda trader: AGENTS[trader.number],
    action_labels=["no crate", "1 crate", *(f"{crates} crates" for crates in range(2, MOST + 1))],
    observation_labels=OBSERVED,
    question="How many crates do you bring to the market?",
    display_mapping=display,
)


class MarketSim(SimulationInterface):
    """The market for ten rounds, with a levy on each crate.

    Attributes:
        levy: The levy.
        market: The market of the current episode.
    """

    points: Final = {Trader.choose_crates: choose}
    render_modes = ("ansi",)

    def __init__(self, levy: float) -> None:
        self.levy = levy

    def reset(self, seed: int | None = None) -> None:
        """Begin with a new market."""
        self.market = Market(self.levy, seed)

    def run(self) -> None:
        """Play all rounds."""
        self.market.run()

    def time(self) -> float:
        """Return the number of rounds that are over."""
        return float(self.market.round)

    def reseed(self, seed: int) -> None:
        """Draw another demand for the rounds to come."""
        self.market.random.seed(seed)

    def render(self, mode: str) -> str:
        """Return the levy, the latest price, and each trader's crates and profit."""
        market = self.market
        rows = [
            f"{AGENTS[one.number]}: {one.crates} crates, profit so far {one.profit:g}"
            for one in market.traders
        ]
        return "\n".join(
            [f"Levy {market.levy:g}, round {market.round}, latest price {market.price:g}", *rows]
        )


class Free(MarketSim):
    """The condition without a levy."""

    def __init__(self) -> None:
        super().__init__(levy=0.0)


class Levied(MarketSim):
    """The condition in which each crate costs 20 more, which all get back in equal parts."""

    def __init__(self) -> None:
        super().__init__(levy=20.0)


def env(condition: Any = Free, **options: Any) -> SimulationAECEnv:
    """Make the environment of all traders in a condition."""
    return aec_env(condition, **{"possible_agents": AGENTS} | options)
