"""A market: each round, four traders decide in turn how many crates to bring.

All crates sell at one price. A crate that is brought lowers the price of all others. So four
traders who each do the best for themselves bring more than the number at which they together earn
most: 8 crates each in place of 5. A levy on each crate can mend that; it is paid back to all
traders, in equal parts. With a levy of 20 each does best with 5 crates, if all others do so.

``python -m examples.market_seats.model`` runs the model without any environment.
"""

from __future__ import annotations

from math import ceil
from random import Random
from typing import Final

ROUNDS: Final = 10
TRADERS: Final = 4
MOST: Final = 10
"""The most crates that a trader can bring."""

COST: Final = 10
"""What a crate costs a trader."""

DEMAND: Final = 50
"""The mean of the price at which no crate is bought; each crate lowers the price by 1."""

SPREAD: Final = 4
"""How much demand can differ from its mean. It is known when all have decided."""


class Trader:
    """A trader.

    Attributes:
        market: Its market.
        number: Its number, from 0.
        crates: The crates that it brings in this round, if it has decided, or brought in the round
            before.
        gain: Its profit of the round before.
        profit: Its profit so far.
    """

    def __init__(self, market: Market, number: int) -> None:
        self.market, self.number = market, number
        self.crates, self.gain, self.profit = 0, 0.0, 0.0

    def crates_of_others(self) -> int:
        """Return the crates of all others: of this round if decided, else of the round before."""
        return sum(trader.crates for trader in self.market.traders if trader is not self)

    def choose_crates(self) -> int:
        """Choose how many crates to bring to the market.

        The rule takes the number that earns most beside the crates of the others, as they are now.
        """
        own_levy = self.market.levy * (1 - 1 / TRADERS)  # as a part of it comes back
        best = (DEMAND - COST - own_levy - self.crates_of_others()) / 2
        return min(max(ceil(best - 0.5), 0), MOST)  # the lower of two that earn as much


class Market:
    """The market, for ten rounds.

    Attributes:
        levy: What each crate costs besides; it is paid back to all traders, in equal parts.
        random: The random generator of the demand.
        traders: The four traders.
        round: The number of rounds that are over.
        decided: How many traders have decided in this round.
        price: The price of the round before.
    """

    def __init__(self, levy: float = 0.0, seed: int | None = None) -> None:
        self.levy, self.random = levy, Random(seed)
        self.traders = [Trader(self, number) for number in range(TRADERS)]
        self.round, self.decided, self.price = 0, 0, 0.0

    def play_round(self) -> None:
        """Let all traders decide, each round another one first, and sell."""
        first = self.round % TRADERS
        for trader in self.traders[first:] + self.traders[:first]:
            trader.crates = trader.choose_crates()
            self.decided += 1
        brought = sum(trader.crates for trader in self.traders)
        self.price = float(max(0, DEMAND + self.random.randint(-SPREAD, SPREAD) - brought))
        for trader in self.traders:
            trader.gain = (
                trader.crates * (self.price - COST - self.levy) + self.levy * brought / TRADERS
            )
            trader.profit += trader.gain
        self.round, self.decided = self.round + 1, 0

    def run(self) -> None:
        """Play all rounds that are left."""
        while self.round < ROUNDS:
            self.play_round()


if __name__ == "__main__":
    for levy in (0.0, 20.0):
        market = Market(levy, seed=1)
        market.run()
        print(
            f"levy {levy:g}: profits {', '.join(f'{trader.profit:g}' for trader in market.traders)}"
        )
