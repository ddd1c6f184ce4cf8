"""The decisions of a pension company, its asset manager and its regulator."""

from __future__ import annotations

from collections import deque
from operator import mul

from .blocks import Entity, World, share
from .economy import OLDEST, Market, Mortality, annuity_factors
from .law import (
    ACCRUAL,
    CRITICAL,
    DISPOSABLE,
    HIGHEST_PREMIUM,
    INDEXING,
    MEASUREMENTS,
    MINIMUM,
    REQUIRED,
    RETIREMENT,
    SPREAD,
    TRANSFERABLE,
)
from .people import Client, PensionContract, RecoveryPlan, clients_of


class Manager(Entity):
    """The asset manager of a company, which decides on the share of its assets in equities.

    The rest is in bonds.
    """

    kind = "manager"

    def __init__(self, company: Company, equities: float = 0.4) -> None:
        super().__init__(company.world)
        self.company, self.equities = company, equities

    def lawful_mix(self) -> float:
        """The highest lawful share of equities: in a shortfall, this is the current share."""
        return self.equities if self.company.policy_coverage() < MINIMUM else 1.0

    def choose_mix(self) -> float:
        """Choose the lawful share of equities: 40 %, or 30 % while coverage is below 100 %."""
        return min(
            0.4 if self.company.policy_coverage() >= TRANSFERABLE else 0.3, self.lawful_mix()
        )

    def rebalance(self) -> None:
        """Buy and sell to reach the chosen mix, within what is lawful."""
        self.equities = min(max(self.choose_mix(), 0.0), self.lawful_mix())


class Regulator(Entity):
    """The regulator, which decides what recovery plans must contain."""

    kind = "regulator"

    def choose_demand(self, company: Company) -> float:
        """Choose the cut of rights to demand: a tenth of a critical or long shortfall, or none."""
        due = company.policy_coverage() < CRITICAL or company.measured_short >= MEASUREMENTS
        return company.shortfall() / SPREAD if due else 0.0


class Company(Entity):
    """A pension company, which promises pensions and holds assets to pay them.

    Attributes:
        tables: The mortality that it assumes.
        measured_short: The number of yearly measurements in a row at which its policy coverage was
            below the minimum.
        rations: The cents paid by each pension contract in the last month, if the money did not
            suffice for all.
        indexed: The current amount of a right that was 1 in the first month, after indexation and
            cuts.
    """

    kind = "company"

    def __init__(self, world: World, market: Market, tables: Mortality) -> None:
        """Found a company without clients."""
        super().__init__(world)
        self.market, self.tables = market, tables
        self.manager, self.regulator = Manager(self), Regulator(world)
        self.measured_short, self.indexed = 0, 1.0
        self.rations: dict[int, int] = {}
        self._rationed = -1
        # by month of birth; the first is OLDEST - 1 months before month 0
        self._rights = [0] * OLDEST
        self._history: deque[float] = deque(maxlen=12)
        self._policy_coverage = 1.0
        self._factors = annuity_factors(tables, market.yield_steps, RETIREMENT)
        self._provisions: float | None = None

    def factor(self, age: int) -> float:
        """The value of a pension of 1 a year at an age in months, at the current yield."""
        return self._factors[OLDEST - 1 - age]

    def provisions(self) -> float:
        """The value of all rights, in cents: sums of rights by month of birth, times factors."""
        if self._provisions is None:
            youngest = self.world.month
            self._provisions = sum(
                map(mul, self._rights[youngest : youngest + OLDEST], self._factors)
            )
        return self._provisions

    def coverage(self) -> float:
        """The current ratio of assets to provisions; 2 without provisions."""
        provisions = self.provisions()
        return self.cents / provisions if provisions > 0 else 2.0

    def policy_coverage(self) -> float:
        """The mean coverage over the last twelve months, by which the company is judged."""
        return self._policy_coverage

    def shortfall(self) -> float:
        """The share by which all rights would have to be cut to reach the minimum."""
        return max(0.0, 1 - self.policy_coverage() / MINIMUM)

    def cost_rate(self, client: Client) -> float:
        """The cost of a client's standard accrual, as a share of the wage."""
        return ACCRUAL * self.factor(client.age)

    def lawful_premium(self, client: Client) -> tuple[float, float]:
        """The lowest and the highest lawful premium for a client, as shares of the wage."""
        cost = min(self.cost_rate(client) * (1 + client.extra), HIGHEST_PREMIUM)
        return cost * (0.8 if self.policy_coverage() >= REQUIRED else 1.0), min(
            1.3 * cost, HIGHEST_PREMIUM
        )

    def repair(self) -> float:
        """The lawful growth of rights beyond inflation: a fifth of the gap, at enough coverage."""
        behind = self.market.price_level / max(self.indexed, 1e-9) - 1
        return max(0.0, behind) / 5 if self.policy_coverage() >= REQUIRED else 0.0

    def lawful_indexation(self) -> float:
        """The highest lawful indexation: inflation plus repair, if coverage is high enough."""
        return (
            max(0.0, self.market.inflation) + self.repair()
            if self.policy_coverage() >= INDEXING
            else 0.0
        )

    def set_premium(self, client: Client) -> float:
        """Choose a premium, as a share of the wage: the accrual's cost and a solvency surcharge.

        The surcharge is 5 % of the cost, 15 % in a shortfall, and -10 % at a high coverage.
        """
        coverage = self.policy_coverage()
        surcharge = 1.15 if coverage < MINIMUM else 0.9 if coverage > REQUIRED + 0.15 else 1.05
        return surcharge * self.cost_rate(client) * (1 + client.extra)

    def choose_indexation(self) -> float:
        """Choose the indexation of rights: linear from 0 at 110 % to the legal maximum at 130 %."""
        step = (self.policy_coverage() - INDEXING) / 0.2
        return self.lawful_indexation() * min(max(step, 0.0), 1.0)

    def choose_cut(self) -> float:
        """Choose the cut of rights: a tenth of the shortfall, from the third measurement on."""
        return self.shortfall() / SPREAD if self.measured_short >= 3 else 0.0

    def book_right(self, born: int, cents: int) -> None:
        """Record a change in the rights of those born in a month."""
        place = born + OLDEST - 1
        rights = self._rights
        if place >= len(rights):
            rights += [0] * (place + 1 - len(rights))
        rights[place] += cents
        self._provisions = None

    def review(self, client: Client) -> None:
        """Set premium and accrual for a client's next year.

        Extra contributions end where they are too dear.
        """
        if self.cost_rate(client) * (1 + client.extra) > HIGHEST_PREMIUM:
            client.extra = 0.0
        lowest, highest = self.lawful_premium(client)
        client.premium = min(max(self.set_premium(client), lowest), highest)
        client.accrual = round(ACCRUAL * (1 + client.extra) * client.wage / 12)
        client.disposable = round(DISPOSABLE * client.wage / 12)
        assert client.contract is not None
        client.contract.cents = round(client.premium * client.wage / 12)
        client.contract.missed = 0

    def change_rights(self, by: float) -> None:
        """Increase or cut all rights by a share of them."""
        for client in clients_of(self.world):
            if client.accrued:
                client.accrue(round(client.accrued * by))
                if client.status == "retired" and client.contract is not None:
                    client.contract.cents = client.accrued // 12
        self.indexed *= 1 + by

    def invest(self) -> None:
        """Book a month's gains or losses on the assets, and revalue the rights."""
        share_of_equities, market = self.manager.equities, self.market
        rate = (
            share_of_equities * market.equity_return + (1 - share_of_equities) * market.bond_return
        )
        change = round(self.cents * rate)
        outside, ledger = self.world.outside, self.world.ledger
        if change >= 0:
            ledger.move(outside, self, change, "returns")
        else:
            ledger.move(self, outside, -change, "losses")
        self._factors = annuity_factors(self.tables, market.yield_steps, RETIREMENT)
        self._provisions = None

    def ration(self) -> dict[int, int]:
        """Return the cents of each pension contract if the money does not suffice for all.

        Checked once a month.
        """
        month, contracts = self.world.month, self.world.contracts.items()
        if self._rationed == month:
            return self.rations
        self._rationed = month
        due = {
            number: contract.cents
            for number, contract in contracts
            if isinstance(contract, PensionContract)
        }
        short = self.cents < sum(due.values())
        self.rations = (
            dict(zip(due, share(self.cents, list(due.values())), strict=True)) if short else {}
        )
        self.world.counts["pensions rationed"] += short
        return self.rations

    def measure(self) -> None:
        """Record the coverage of the month."""
        history = self._history
        history.append(self.coverage())
        self._policy_coverage = sum(history) / len(history)

    def conclude_year(self) -> None:
        """Measure the coverage, then index rights.

        Or cut them, after the regulator has reviewed the recovery plan.
        """
        counts = self.world.counts
        if self.policy_coverage() >= MINIMUM:
            self.measured_short = 0
            indexation = min(max(self.choose_indexation(), 0.0), self.lawful_indexation())
            if indexation > 0:
                self.change_rights(indexation)
                counts["indexed"] += 1
            return
        self.measured_short += 1
        counts["short"] += 1
        most = self.shortfall()
        demand = min(max(self.regulator.choose_demand(self), 0.0), most)
        cut = min(max(self.choose_cut(), 0.0), most)
        if RecoveryPlan(self, cut, demand).submit() is not None:
            cut = demand
            self.change_rights(-cut)
        if cut > 0:
            counts["cut"] += 1
