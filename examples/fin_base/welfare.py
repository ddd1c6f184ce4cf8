"""What a fund is worth to its members: the utility by which policies for it are compared.

In each year a pensioner lives on the pension, and a worker on the wage less the premium. Both are measured against full
income: a pension that has kept up with prices, and a wage of which no premium is paid. The utility of a year is the
mean, over all members, of the logarithm of that ratio. A loss of the same per cent thus counts the same for all, and
more the poorer a member is already.

What lies behind the last year counts as ``AFTER`` more years, in which rights keep what they buy by then, as far as
assets cover them. So it does not pay to hand out today what later pensions need.

The ratio of a pension to one that has kept up with prices is the *pension result* of the feasibility test which Dutch
funds have to pass. One point of welfare is a per cent of a year's income, for each member.
"""

from __future__ import annotations

from math import log
from typing import Final, NamedTuple

from .pension import Fund

AFTER: Final = 10
"""How many years the time after the last year counts for."""

LEAST: Final = 0.05
"""The share of full income that a member has at least, from elsewhere."""


class Year(NamedTuple):
    """A fund at the end of a year.

    Attributes:
        right: What a right of 1 from the first month buys, in prices of that month.
        coverage: Assets by provisions.
        equities: The share of the assets that is in equities.
        premium: The mean premium, as a share of the wage.
        utility: The mean logarithm of what members have lived on, relative to full income.
    """

    right: float
    coverage: float
    equities: float
    premium: float
    utility: float


class Account:
    """Keeps account of how the members of a fund have lived.

    Attributes:
        fund: The fund.
        years: The years that have gone by.
    """

    def __init__(self, fund: Fund) -> None:
        """Begin with no years."""
        self.fund = fund
        self.years: list[Year] = []
        self._lived = 0.0

    def right(self) -> float:
        """What a right of 1 from the first month buys now, in prices of that month."""
        return self.fund.company.indexed / self.fund.company.market.price_level

    def close_year(self) -> None:
        """Account for the year that ends now. It takes a time in proportion to the number of clients."""
        company, right = self.fund.company, self.right()
        premiums = [client.premium for client in self.fund.clients if client.status == "working"]
        retired = sum(client.status == "retired" for client in self.fund.clients)
        total = sum(log(1 - premium) for premium in premiums) + retired * log(max(right, LEAST))
        utility = total / max(len(premiums) + retired, 1)
        mean = sum(premiums) / max(len(premiums), 1)
        self.years.append(Year(right, company.coverage(), company.manager.equities, mean, utility))
        self._lived += utility

    def close_for_ever(self, years: float) -> None:
        """Account for years in which there is no fund any more: members live on the least."""
        self._lived += years * log(LEAST)

    def welfare(self) -> float:
        """The utility so far and what is to be expected, in per cent of a year's income."""
        covered = min(self.fund.company.coverage(), 1.0)
        return 100 * (self._lived + AFTER * log(max(self.right() * covered, LEAST)))
