"""The welfare of a fund's members: the utility by which policies are compared.

In each year a pensioner lives on the pension, and a worker on the wage less the premium. Each is
measured relative to full income: a pension that has kept up with prices, or a wage without a
premium. The utility of a year is the mean, over all members, of the logarithm of that ratio. So a
loss of the same percentage counts the same for all members, and a loss of the same amount counts
more for a member who is poorer already.

The time after the last year counts as ``AFTER`` more years, in which rights keep their purchasing
power, as far as assets cover them. So it does not pay to spend today what later pensions need.

One point of welfare is one per cent of a year's income, for each member.
"""

from __future__ import annotations

from math import log
from typing import Final, NamedTuple

from .pension import Fund

AFTER: Final = 10  # the number of years that the time after the last year counts for
LEAST: Final = 0.05  # the minimum income of a member, from other sources, as a share of full income


class Year(NamedTuple):
    """The results of a year, at its end."""

    # the purchasing power of a right that was 1 in the first month, in prices of that month
    right: float
    coverage: float
    premium: float  # its mean, as a share of the wage
    utility: float  # the mean logarithm of the members' incomes, relative to full income


class Account:
    """The account of the welfare of a fund's members."""

    def __init__(self, fund: Fund) -> None:
        """Open an account without years."""
        self.fund = fund
        self.years: list[Year] = []
        self._lived = 0.0

    def right(self) -> float:
        """The purchasing power of a right of 1 from the first month, in prices of that month."""
        return self.fund.company.indexed / self.fund.company.market.price_level

    def close_year(self) -> None:
        """Account for the year that ends now.

        The run time is proportional to the number of clients.
        """
        company, right = self.fund.company, self.right()
        premiums = [client.premium for client in self.fund.clients if client.status == "working"]
        retired = sum(client.status == "retired" for client in self.fund.clients)
        total = sum(log(1 - premium) for premium in premiums) + retired * log(max(right, LEAST))
        utility = total / max(len(premiums) + retired, 1)
        mean = sum(premiums) / max(len(premiums), 1)
        self.years.append(Year(right, company.coverage(), mean, utility))
        self._lived += utility

    def close_for_ever(self, years: float) -> None:
        """Account for years after the fund's end: members live on the minimum income."""
        self._lived += years * log(LEAST)

    def welfare(self) -> float:
        """The utility so far plus the expected utility, in per cent of a year's income."""
        covered = min(self.fund.company.coverage(), 1.0)
        return 100 * (self._lived + AFTER * log(max(self.right() * covered, LEAST)))
