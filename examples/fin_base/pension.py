"""A model of a pension company and its clients over decades, in monthly steps.

It contains no reinforcement learning. People join, pay premiums, change jobs, retire, transfer
their rights to another fund, and die. A right is an accrued yearly pension, paid for life. The
*coverage* is the ratio of assets to *provisions*, the value of all rights.

**Decisions**, each of them a method with a plausible rule:

============================= ============== ==============================================
``Company.set_premium``       client, yearly the premium, as a share of a client's wage
``Company.choose_indexation`` yearly         the increase of all rights
``Company.choose_cut``        yearly         the cut of all rights in a shortfall
``Manager.choose_mix``        quarterly      the share of the assets in equities
``Regulator.choose_demand``   yearly         the cut below which a recovery plan is denied
``Client.choose_to_join``     once           whether to become a client
``Client.choose_extra``       yearly         the contribution beyond the standard
``Client.choose_to_leave``    with a new job whether to transfer the rights to another fund
============================= ============== ==============================================

``python -m examples.fin_base.pension --clients 10000 --years 40`` prints the fund's results, and
how fast it runs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random
from time import perf_counter

from .blocks import World
from .company import Company
from .economy import OLDEST, Climate, Market, Mortality
from .law import ACCRUAL, RETIREMENT
from .people import (
    Admission,
    Client,
    Contribution,
    PensionContract,
    PremiumContract,
    Transfer,
    clients_of,
)


@dataclass(frozen=True)
class Parameters:
    """The initial state of a fund, and the world around it."""

    clients: int = 10_000
    coverage: float = 1.15  # the ratio of assets to provisions
    climate: Climate = field(default_factory=Climate)
    tables: Mortality = field(default_factory=Mortality)  # the mortality that the company assumes
    mortality: Mortality = field(default_factory=Mortality)  # the actual mortality
    job_change: float = 0.008  # the monthly probability that a worker changes jobs
    # the yearly number of candidates, relative to the initial number of clients
    entry: float = 0.025


class Fund:
    """A pension company, its clients, and the world around them."""

    def __init__(self, seed: int | None = None, parameters: Parameters | None = None) -> None:
        """Create a fund, with clients of all ages who have paid since they were 25.

        Market and people have separate generators, so decisions about people do not change the
        market.
        """
        self.parameters = parameters = parameters or Parameters()
        self.world = world = World(seed)
        self.market = Market(parameters.climate, world.stream("market"))
        self.people: Random = world.stream("people")
        self.company = Company(world, self.market, parameters.tables)
        self._deaths = parameters.mortality.monthly()
        self._candidates = 0.0
        self._populate()
        capital = round(parameters.coverage * self.company.provisions())
        world.ledger.move(world.outside, self.company, capital, "capital")
        self.company.measure()
        for client in clients_of(world):
            if client.status == "working":
                self.company.review(client)
        calendar = world.calendar
        calendar.every(3, self.company.manager.rebalance, start=3)
        calendar.every(12, self.company.conclude_year, start=12)

    def _populate(self) -> None:
        """Create the first clients: survivors, by the mortality, of people who joined at 25."""
        alive, weights = 1.0, []
        for age in range(25 * 12, 100 * 12):
            alive *= 1 - self._deaths[age]
            weights.append(alive)
        ages = self.people.choices(range(25 * 12, 100 * 12), weights, k=self.parameters.clients)
        for age in ages:
            client = self._candidate(age)
            client.accrue(
                round(ACCRUAL * client.wage * (min(age, RETIREMENT) - 25 * 12) / 12 * 0.8)
            )
            if age >= RETIREMENT:
                client.status = "retired"
                client.contract = PensionContract(
                    self.company, client, client.accrued // 12, "pension"
                )
            else:
                client.status = "working"
                client.contract = PremiumContract(client, self.company, 0, "premium")
            self._enter_dates(client)

    def _candidate(self, age: int) -> Client:
        """Create a candidate whose wage depends on the age."""
        draw = self.people
        career = 0.8 + 0.4 * min(1.0, max(0.0, (age / 12 - 25) / 30))
        wage = round(36_000_00 * self.market.price_level * career * draw.lognormvariate(0.0, 0.3))
        return Client(self.company, age, wage, draw.random())

    def _enter_dates(self, client: Client) -> None:
        """Schedule a client's yearly reviews and retirement."""
        calendar, month = self.world.calendar, self.world.month
        calendar.at(month + 12 - client.age % 12, self.review_year, client)
        if client.status != "retired":
            calendar.at(client.born + RETIREMENT, client.retire)

    @property
    def clients(self) -> list[Client]:
        """All present clients."""
        return clients_of(self.world)

    def advance(self) -> None:
        """Simulate one month."""
        self.market.advance()
        self.company.invest()
        self._live()
        self._arrive()
        self.world.advance()
        self.company.measure()

    def _live(self) -> None:
        """Let people earn, change jobs and die.

        One draw per person and month decides between death and a new job.
        """
        world, deaths, change = self.world, self._deaths, self.parameters.job_change
        draw, move, outside, month = (
            self.people.random,
            world.ledger.move,
            world.outside,
            world.month,
        )
        last = OLDEST - 1
        for client in clients_of(world):
            chance = draw()
            age = month - client.born
            death = deaths[age if age < last else last]
            if chance < death:
                client.vanish(outside)
                world.counts["died"] += 1
            elif client.status == "working":
                move(outside, client, client.disposable, "wages")
                if chance < death + change:
                    self._change_job(client)

    def _change_job(self, client: Client) -> None:
        """Change a client's job: to one with pension, to one without, or to none for a while."""
        draw = self.people
        client.wage = round(client.wage * draw.uniform(0.95, 1.15))
        self.world.counts["changed jobs"] += 1
        if draw.random() < 0.6:
            return
        client.pause()
        if client.choose_to_leave() and Transfer(client).submit() is None:
            return
        self.world.calendar.at(self.world.month + draw.randrange(6, 60), client.come_back)

    def _arrive(self) -> None:
        """Let new candidates decide whether to join."""
        draw, world = self.people, self.world
        self._candidates += self.parameters.entry * self.parameters.clients / 12
        while self._candidates >= 1:
            self._candidates -= 1
            age = 22 * 12 + int(draw.triangular(0, 40 * 12, 3 * 12))
            candidate = self._candidate(age)
            if not candidate.choose_to_join():
                world.counts["declined"] += 1
                candidate.vanish(world.outside)
            elif Admission(candidate).submit() is None:
                self._enter_dates(candidate)
            else:
                candidate.vanish(world.outside)

    def review_year(self, client: Client) -> None:
        """Review a client on the birthday: spend surplus savings.

        Workers get a raise and next year's premium.
        """
        if client.status == "gone":
            return
        world = self.world
        world.calendar.at(world.month + 12, self.review_year, client)
        reserve = client.wage // 4
        if client.cents > reserve:
            world.ledger.move(client, world.outside, client.cents - reserve, "spending")
        if client.status != "working":
            return
        career = 0.01 if client.age < 50 * 12 else 0.0
        client.wage = round(client.wage * (1 + max(0.0, self.market.inflation) + career))
        extra = client.choose_extra()
        if extra != client.extra:
            Contribution(client, extra).submit()
        self.company.review(client)

    def run(self, months: int) -> None:
        """Simulate months, and check conservation of money at the end of each year and the run."""
        for _ in range(months):
            self.advance()
            if self.world.month % 12 == 0:
                self.world.check()
        self.world.check()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a fund, and print its results and the speed of the computation."""
    parser = argparse.ArgumentParser(
        description="Run a pension fund by its own rules, and print its results."
    )
    parser.add_argument(
        "--clients", type=int, default=10_000, help="initial number of clients (default: 10000)"
    )
    parser.add_argument(
        "--years", type=int, default=40, help="how many years to simulate (default: 40)"
    )
    parser.add_argument(
        "--seed", type=int, help="seed of all randomness (default: a new one each time)"
    )
    options = parser.parse_args(arguments)
    fund = Fund(options.seed, Parameters(clients=options.clients))
    start = perf_counter()
    print("year clients coverage yield inflation equities rights/prices")
    for year in range(1, options.years + 1):
        fund.run(12)
        company, market = fund.company, fund.market
        if year % 5 == 0 or year == options.years:
            print(
                f"{year:4} {len(clients_of(fund.world)):7} {company.coverage():8.3f}"
                f" {market.bond_yield:5.2%} {market.inflation:9.2%}"
                f" {company.manager.equities:8.0%} {company.indexed / market.price_level:13.2f}"
            )
    for event, count in sorted(fund.world.counts.items()):
        print(f"{count:8} {event}")
    print(f"{options.years / (perf_counter() - start):.1f} years a second")


if __name__ == "__main__":
    main()
