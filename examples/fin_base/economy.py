"""The economy and the mortality around a pension fund: prices, yields, returns and lifetimes.

**Mortality** has the parameters of the Standard Ultimate Survival Model (Dickson, Hardy and Waters,
Actuarial Mathematics for Life Contingent Risks; also behind the Life Table of the Society of
Actuaries' FAM-L exam).

**The market** has three correlated variables in monthly steps. Inflation and the bond yield are
first-order autoregressive, as inflation is in Wilkie's model (A stochastic investment model for
actuarial use, Transactions of the Faculty of Actuaries 39, 1986; a yearly coefficient of 0.58, from
his revision of 1995) and the interest rate in Vasicek's model (An equilibrium characterization of
the term structure, Journal of Financial Economics 5, 1977). Equity returns are lognormal. The
levels are round numbers of our own, in the range of what regulators assume; they are not fitted to
data: see ``Climate``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import exp, log, sqrt
from random import Random

OLDEST = 120 * 12
"""The maximum age in months, which no person survives."""

STEP = 0.0025
"""The rounding of the yield that values provisions: each step has a table of annuity factors."""


@dataclass(frozen=True)
class Mortality:
    """Makeham's law of mortality: at age x, the force of mortality is A + B c^x."""

    a: float = 0.00022
    b: float = 2.7e-6
    c: float = 1.124
    factor: float = 1.0  # of the whole force; below 1, people live longer than the tables say

    def monthly(self) -> list[float]:
        """Compute the probability of death within a month, by age in months up to ``OLDEST``."""
        growth = (self.c ** (1 / 12) - 1) / log(self.c)
        hazards = [
            self.factor * (self.a / 12 + self.b * self.c ** (age / 12) * growth)
            for age in range(OLDEST)
        ]
        return [1 - exp(-hazard) for hazard in hazards[:-1]] + [1.0]


@lru_cache(maxsize=256)
def annuity_factors(mortality: Mortality, steps: int, retirement: int) -> tuple[float, ...]:
    """Compute the value of a lifelong pension of 1 a year, paid monthly from retirement on.

    The yield is ``steps`` times ``STEP``. The values are by age in months, from ``OLDEST - 1``
    *down to* 0, that is, in the order of birth.
    """
    discount = (1 + STEP * steps) ** (-1 / 12)
    value, values = 0.0, []
    for age, probability in reversed(list(enumerate(mortality.monthly()))):
        value = (1 / 12 if age >= retirement else 0.0) + discount * (1 - probability) * value
        values.append(value)
    return tuple(values)


@dataclass(frozen=True)
class Climate:
    """The parameters of the market.

    Rates are annual, and standard deviations those of the long run.
    """

    inflation: float = 0.02  # its mean: the European Central Bank's target
    inflation_sd: float = 0.015
    # the share of a deviation from the mean that remains after a year
    inflation_memory: float = 0.58
    bond_yield: float = 0.025
    yield_sd: float = 0.012
    yield_memory: float = 0.85
    # the excess of the mean log return of equities over the mean yield
    equity_premium: float = 0.03
    equity_sd: float = 0.18
    # inflation and yield, and equities; yield and equities
    correlations: tuple[float, float, float] = (0.4, -0.1, 0.1)


class Market:
    """The market in monthly steps: annual inflation and yield, price level, monthly returns."""

    DURATION = 12.0  # of bonds, in years

    def __init__(self, climate: Climate, random: Random) -> None:
        """Create a market, with inflation and yield at their long-run means."""
        self.climate, self.random = climate, random
        self.inflation, self.bond_yield, self.price_level = (
            climate.inflation,
            climate.bond_yield,
            1.0,
        )
        self.equity_return = self.bond_return = 0.0
        self._roots = _cholesky(climate.correlations)

    @property
    def yield_steps(self) -> int:
        """The yield in units of ``STEP``, between -0.5 % and 8 %."""
        return min(max(round(self.bond_yield / STEP), -2), 32)

    def advance(self) -> None:
        """Simulate one month."""
        climate, draw = self.climate, self.random.gauss
        first, second, third = draw(0, 1), draw(0, 1), draw(0, 1)
        shocks = [row[0] * first + row[1] * second + row[2] * third for row in self._roots]
        self.inflation = _revert(self.inflation, climate.inflation, climate.inflation_memory) + (
            _monthly_sd(climate.inflation_sd, climate.inflation_memory) * shocks[0]
        )
        before = self.bond_yield
        self.bond_yield = _revert(before, climate.bond_yield, climate.yield_memory) + (
            _monthly_sd(climate.yield_sd, climate.yield_memory) * shocks[1]
        )
        self.bond_return = max(before / 12 - self.DURATION * (self.bond_yield - before), -0.5)
        mean = (climate.bond_yield + climate.equity_premium) / 12
        self.equity_return = exp(mean + climate.equity_sd / sqrt(12) * shocks[2]) - 1
        self.price_level *= 1 + self.inflation / 12


def _revert(value: float, mean: float, memory: float) -> float:
    """Return the expected value a month later."""
    return mean + exp(log(memory) / 12) * (value - mean)


def _monthly_sd(long_run: float, memory: float) -> float:
    """Return the standard deviation of monthly shocks, given the process's in the long run."""
    return long_run * sqrt(1 - memory ** (1 / 6))


def _cholesky(correlations: Sequence[float]) -> tuple[tuple[float, float, float], ...]:
    """Return the Cholesky factor, which makes three independent shocks correlated."""
    one, two, three = correlations
    middle = sqrt(1 - one * one)
    cross = (three - one * two) / middle
    return (1.0, 0.0, 0.0), (one, middle, 0.0), (two, cross, sqrt(1 - two * two - cross * cross))
