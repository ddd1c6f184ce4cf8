"""A market whose traders decide by functions of every kind."""

from collections.abc import Generator
from typing import Any

OPEN = True


def price(good: str, *, rebate: int = 0) -> int:
    """The price of a good."""
    return 10 - rebate


class Trader:
    fee = 1

    def bid(self, good: str, limit: int = 5) -> int:
        """The most that this trader pays."""
        return limit

    @staticmethod
    def rounded(amount: float) -> int:
        return int(amount)

    @classmethod
    def opening(cls) -> int:
        return cls.fee

    def haggle(self, good: str) -> Generator[str, int, int]:
        step = yield good
        return 50 + step

    async def wire(self, amount: int) -> int:
        return amount

    @property
    def quote(self) -> int:
        return 1

    def __hidden(self) -> int:
        return 7

    def look(self) -> int:
        return self.__hidden()

    def day(self) -> list[Any]:
        """All decisions of a day, as the trader calls them."""
        return [self.bid("tea"), self.bid("tea", limit=6), self.rounded(2.5), self.opening()]


class Broker(Trader):
    fee = 2


class Junior(Broker):
    fee = 3


class Dealer(Trader):
    fee = 4


class Cautious(Trader):
    def bid(self, good: str, limit: int = 5) -> int:
        return super().bid(good, limit) - 1
