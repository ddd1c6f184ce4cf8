"""Observations of the pension fund for its decisions."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from .company import Company
from .people import Client

OBSERVED: Final = (
    "coverage, at most 10",
    "policy coverage, at most 10",
    "number of yearly measurements in a row below the minimum",
    "share of equities",
    "yield, times 10",
    "inflation, times 10",
    "purchasing power of a right that was 1 in the first month",
)
"""The observation of the company, for the single agents."""

OF_A_CLIENT: Final = (
    "age / 100 years",
    "wage / 100,000, in prices of the first month",
    "rights / wage",
    "contribution beyond the standard",
    "cost of the standard accrual / wage",
    "savings / wage",
)
"""The observation of a client, which follows that of the company."""


def look_at(company: Company) -> tuple[float, ...]:
    """Return the numbers that ``OBSERVED`` lists."""
    market = company.market
    return (
        min(company.coverage(), 10.0),
        min(company.policy_coverage(), 10.0),
        company.measured_short,
        company.manager.equities,
        10 * market.bond_yield,
        10 * market.inflation,
        company.indexed / market.price_level,
    )


def look_at_client(company: Company, client: Client) -> list[float]:
    """Return the numbers that ``OBSERVED`` and ``OF_A_CLIENT`` list."""
    wage = client.wage
    return [
        *look_at(company),
        client.age / 1200,
        wage / 100_000_00 / company.market.price_level,
        client.accrued / wage,
        client.extra,
        company.cost_rate(client),
        client.cents / wage,
    ]


def company_of(*call: Any) -> Company:
    """Find the company in a single agent's call: the last argument itself, or that argument's company."""
    last = call[-1]
    return last if isinstance(last, Company) else last.company


LOW: Final = (0, 0, 0, 0, -3, -3, 0)
HIGH: Final = (10, 10, 100, 1, 3, 3, 3)
CLIENT_HIGH: Final = (1.2, 20, 20, 0.5, 1, 20)

SPACE: Final = Box(np.array(LOW, np.float32), np.array(HIGH, np.float32))
CLIENT_SPACE: Final = Box(
    np.array([*LOW, *[0] * len(OF_A_CLIENT)], np.float32), np.array(HIGH + CLIENT_HIGH, np.float32)
)


def observe(*call: Any) -> NDArray[np.float32]:
    """Observe the company."""
    return np.array(look_at(company_of(*call)), np.float32)


def observe_client(company: Company, client: Client) -> NDArray[np.float32]:
    """Observe the company and one client."""
    return np.array(look_at_client(company, client), np.float32)
