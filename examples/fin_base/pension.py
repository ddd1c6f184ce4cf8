"""A pension company and its clients, over decades, month by month. Nothing here knows of reinforcement learning.

People join, pay premiums, change jobs, retire, draw a pension, leave with the value of what they have accrued, and
die. What they have accrued is a right: so many cents a year from retirement on, for life. The company holds assets
against these rights; its *coverage* is its assets by its *provisions*, what all rights are worth at present yields.

**Decisions**, each of them a method with a sensible rule:

========================= ==================== =====================================================================
``Company.set_premium``    client, yearly       which share of the wage a client pays
``Company.choose_indexation``       yearly      by how much rights grow
``Company.choose_cut``              yearly      by how much rights are cut, while there is a shortfall
``Manager.choose_mix``              quarterly   which share of the assets is in equities
``Regulator.choose_demand``         yearly      the cut below which a recovery plan is denied
``Client.choose_to_join``  once                 whether to become a client
``Client.choose_extra``    yearly               whether to pay, and accrue, more or less
``Client.choose_to_leave`` with a new job       whether to take the value along
========================= ==================== =====================================================================

**The law** is after the Dutch financial assessment framework (FTK, in force from 2015), simplified:

- Premiums cover the cost of what they buy; a discount takes a coverage well above what is required (Pensions Act,
  articles 128 and 129; the discount of a fifth from 125 % on is our round number).
- Coverage is judged by its mean over twelve months, the *policy* coverage. Below 110 % there is no indexation. Above
  what is required in the long run (125 % here), missed indexation may be repaired (a fifth of it a year: our number).
- The minimum is 104.3 %. A fund that is below it at six yearly measurements in a row has to cut rights; so has,
  at once, one that cannot recover otherwise within ten years, for which 90 % stands here. Cuts may be spread over
  ten years.
- The risk of the assets may not be raised in a shortfall. Values are not transferred while coverage is below 100 %.

Sources: Pensioenfederatie, The Financial Assessment Framework; De Brauw, Pension funds with >90 % cover ratio do not
have to cut pensions (2019: the sixth measurement, 104.3 %); IPE, Implications of FTK (2014: policy coverage) and Dutch
government considers extending pension fund recovery periods (2016: ten years, the critical level of 90 to 95 %). What
is not modelled: partners' pensions, tax, the state's pension, costs, the yield curve.

Run on its own, it tells how the fund fares, and how fast it was computed::

    python -m examples.fin_base.pension --clients 10000 --years 40
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import mul
from random import Random
from time import perf_counter
from typing import Final

from .blocks import Contract, Entity, Request, World, share
from .economy import OLDEST, Climate, Market, Mortality, annuity_factors

RETIREMENT: Final = 67 * 12
"""Age in months from which pensions are paid."""

LATEST_ENTRY: Final = 60 * 12
"""Age in months from which nobody is admitted."""

ACCRUAL: Final = 0.0175
"""The share of a yearly wage that a year of membership adds to the yearly pension."""

MINIMUM, INDEXING, REQUIRED, CRITICAL, TRANSFERABLE = 1.043, 1.10, 1.25, 0.90, 1.0
"""Coverage: the minimum, that of indexation, that required in the long run, the critical one, that of transfers."""

MEASUREMENTS: Final = 6
"""How many yearly measurements below the minimum in a row make a cut compulsory."""

SPREAD: Final = 10
"""Over how many years a cut is spread."""

HIGHEST_PREMIUM: Final = 0.35
"""The share of a wage that a client can be asked to pay."""

EXTRAS: Final = (0.0, 0.25, 0.5)
"""How much more than the standard a client can pay and accrue."""

DISPOSABLE: Final = 0.3
"""The share of a wage that is not spent on living."""


@dataclass(frozen=True)
class Parameters:
    """What a fund is like in the beginning, and the world around it.

    Attributes:
        clients: How many clients there are.
        coverage: What the company's assets are by its provisions.
        climate: What the market is like.
        tables: The mortality that the company reckons with.
        mortality: The mortality by which people die.
        job_change: The probability that a worker changes jobs in a month.
        entry: How many candidates there are a year, by the number of clients in the beginning.
    """

    clients: int = 10_000
    coverage: float = 1.15
    climate: Climate = field(default_factory=Climate)
    tables: Mortality = field(default_factory=Mortality)
    mortality: Mortality = field(default_factory=Mortality)
    job_change: float = 0.008
    entry: float = 0.025


# -- contracts and requests -----------------------------------------------------------------------


class PremiumContract(Contract):
    """A client pays a premium each month; each one that is paid adds to the client's rights."""

    __slots__ = ()
    debtor: Client

    def perform(self) -> bool:
        """Pay, and accrue if that was possible."""
        paid = super().perform()
        if paid:
            self.debtor.accrue(self.debtor.accrual)
        return paid


class PensionContract(Contract):
    """The company pays a pension each month: as much of it as it can."""

    __slots__ = ()
    debtor: Company

    def perform(self) -> bool:
        """Pay the pension or, where the money does not suffice for all pensions, its share of what there is."""
        rations = self.debtor.ration()
        if not rations:
            return super().perform()
        self.missed += 1
        self.debtor.world.ledger.move(self.debtor, self.creditor, rations[self.number], self.reason)
        return False


class Admission(Request):
    """A candidate asks the company to become a client."""

    __slots__ = ("company",)
    applicant: Client

    def __init__(self, candidate: Client, company: Company) -> None:
        super().__init__(candidate)
        self.company = company

    def objection(self) -> str | None:
        """Candidates who are too old, or clients already, are not admitted."""
        client = self.applicant
        if client.age >= LATEST_ENTRY:
            return "too old"
        return None if client.contract is None else "a client already"

    def carry_out(self) -> None:
        """Begin to work and to pay."""
        client = self.applicant
        client.enter()


class Contribution(Request):
    """A client asks to pay, and accrue, so and so much more than the standard."""

    __slots__ = ("extra",)
    applicant: Client

    def __init__(self, client: Client, extra: float) -> None:
        super().__init__(client)
        self.extra = extra

    def objection(self) -> str | None:
        """Only who works can, and more only as far as it is lawful and can be afforded."""
        client = self.applicant
        if client.status != "working":
            return "not working"
        if self.extra <= client.extra:
            return None
        rate = client.company.cost_rate(client) * (1 + self.extra)
        if rate > HIGHEST_PREMIUM:
            return "above the highest premium"
        return "cannot be afforded" if rate > DISPOSABLE else None

    def carry_out(self) -> None:
        """Agree on it; the premium follows from it."""
        client = self.applicant
        client.extra = self.extra


class Transfer(Request):
    """A client asks to take the value of what was accrued to another fund."""

    __slots__ = ()
    applicant: Client

    def objection(self) -> str | None:
        """Not while coverage is too low, nor once a pension is drawn, nor where the money is lacking."""
        client = self.applicant
        if client.status == "retired":
            return "retired"
        if client.company.coverage() < TRANSFERABLE:
            return "coverage is too low"
        return None if client.value() <= client.company.cents else "the money is lacking"

    def carry_out(self) -> None:
        """Pay the value to the other fund, and part."""
        client = self.applicant
        value = client.value()
        client.vanish(client.world.outside)
        client.world.ledger.move(client.company, client.world.outside, value, "transfer")


class RecoveryPlan(Request):
    """The company in a shortfall proposes to the regulator by how much it cuts rights this year."""

    __slots__ = ("cut", "demand")
    applicant: Company

    def __init__(self, company: Company, cut: float, demand: float) -> None:
        super().__init__(company)
        self.cut, self.demand = cut, demand

    def objection(self) -> str | None:
        """It has to cut as much as the regulator demands."""
        return "cuts too little" if self.cut < self.demand else None

    def carry_out(self) -> None:
        """Cut rights."""
        company = self.applicant
        company.change_rights(-self.cut)


# -- who decides ----------------------------------------------------------------------------------


class Client(Entity):
    """Who accrues a pension, and draws it.

    Attributes:
        company: Whose client it is, or thinks of becoming.
        born: The month of birth, which may be before the first month.
        wage: Cents a year, of the last job.
        status: "candidate", "working", "away" (in a job without pension, or in none), "retired" or "gone".
        accrued: Cents of pension a year to which it has a right.
        accrual: Cents by which a month's premium adds to that.
        extra: How much more than the standard it pays and accrues: one of ``EXTRAS``.
        premium: The share of the wage that it pays.
        contract: By which it pays, or is paid.
        caution: From 0, trusting, to 1.
    """

    __slots__ = (
        "accrual",
        "accrued",
        "born",
        "caution",
        "company",
        "contract",
        "disposable",
        "extra",
        "premium",
        "status",
        "wage",
    )

    kind = "client"

    def __init__(self, company: Company, age: int, wage: int, caution: float) -> None:
        """Become a candidate of an age in months."""
        super().__init__(company.world)
        self.company, self.born, self.wage, self.caution = company, company.world.month - age, wage, caution
        self.status, self.accrued, self.accrual, self.extra, self.premium = "candidate", 0, 0, 0.0, 0.0
        self.disposable = 0
        self.contract: Contract | None = None

    @property
    def age(self) -> int:
        """Age in months."""
        return self.world.month - self.born

    @property
    def works(self) -> bool:
        """Whether it pays premiums at present."""
        return self.status == "working"

    # decisions

    def choose_to_join(self) -> bool:
        """Decide whether to become a client: if the company seems sound enough."""
        return self.company.policy_coverage() >= 0.75 + 0.3 * self.caution

    def choose_extra(self) -> float:
        """Decide how much more to pay and accrue.

        Returns:
            One of ``EXTRAS``: from 45 on a step more if there are savings and the company is sound; a step less where
            a premium could not be paid.
        """
        step = EXTRAS.index(self.extra)
        if self.contract is not None and self.contract.missed:
            step = max(0, step - 1)
        elif self.age >= 45 * 12 and self.cents * 12 > self.wage and self.company.policy_coverage() >= MINIMUM:
            step = min(step + 1, len(EXTRAS) - 1)
        return EXTRAS[step]

    def choose_to_leave(self) -> bool:
        """Decide whether to take the value along: if it is little, or the company does not seem sound enough."""
        little = self.accrued < 2 * ACCRUAL * self.wage
        return little or self.company.policy_coverage() < 0.85 + 0.3 * self.caution

    # what becomes of it

    def enter(self) -> None:
        """Begin to work and pay, for the first time or again."""
        self.status = "working"
        self.contract = PremiumContract(self, self.company, 0, "premium")
        self.company.review(self)

    def pause(self) -> None:
        """Stop working and paying; what was accrued stays."""
        self.end_contract()
        self.status = "away"

    def come_back(self) -> None:
        """Have a job with pension again, unless life has gone on otherwise meanwhile."""
        if self.status == "away":
            self.enter()
            self.world.counts["came back"] += 1

    def retire(self) -> None:
        """Draw the pension from now on."""
        if self.status not in ("working", "away"):
            return
        self.end_contract()
        self.status = "retired"
        self.contract = PensionContract(self.company, self, self.accrued // 12, "pension")
        self.world.counts["retired"] += 1

    def end_contract(self) -> None:
        """Pay, or be paid, no more."""
        if self.contract is not None:
            self.contract.terminate()
            self.contract = None

    def accrue(self, cents: int) -> None:
        """Have a right to so many more cents a year, or fewer."""
        if cents:
            self.accrued += cents
            self.company.book_right(self.born, cents)

    def value(self) -> int:
        """What its rights are worth, in cents."""
        return round(self.accrued * self.company.factor(self.age))

    def vanish(self, heir: Entity, reason: str = "estate") -> None:
        """Be a client no more: for death, for another fund, or never having joined. All rights end."""
        self.end_contract()
        self.accrue(-self.accrued)
        self.status = "gone"
        super().vanish(heir, reason)


class Manager(Entity):
    """Manages the company's assets.

    Attributes:
        company: Whose assets it manages.
        equities: The share of them that is in equities; the rest is in bonds.
    """

    __slots__ = ("company", "equities")

    kind = "manager"

    def __init__(self, company: Company, equities: float = 0.4) -> None:
        super().__init__(company.world)
        self.company, self.equities = company, equities

    def lawful_mix(self) -> float:
        """The highest share of equities that is lawful: in a shortfall the present one."""
        return self.equities if self.company.policy_coverage() < MINIMUM else 1.0

    def choose_mix(self) -> float:
        """Decide on the share of equities: 40 % where that is lawful, and 30 % while coverage is below 100 %."""
        return min(0.4 if self.company.policy_coverage() >= TRANSFERABLE else 0.3, self.lawful_mix())

    def rebalance(self) -> None:
        """Buy and sell, within what is lawful."""
        self.equities = min(max(self.choose_mix(), 0.0), self.lawful_mix())


class Regulator(Entity):
    """Decides what recovery plans have to contain."""

    __slots__ = ()

    kind = "regulator"

    def choose_demand(self, company: Company) -> float:
        """Decide which cut of rights to demand this year.

        Returns:
            A tenth of the shortfall if coverage is critical or has been below the minimum too often; 0 otherwise.
        """
        due = company.policy_coverage() < CRITICAL or company.measured_short >= MEASUREMENTS
        return company.shortfall() / SPREAD if due else 0.0


class Company(Entity):
    """Promises pensions, and holds assets for them.

    Attributes:
        market: Where its assets are.
        tables: The mortality that it reckons with.
        manager: Who manages the assets.
        regulator: Who supervises it.
        measured_short: At how many yearly measurements in a row its policy coverage was below the minimum.
        rations: What each pension contract got in the last month, if there was not enough for all.
        indexed: What a right of 1 from the first month has become by indexation and cuts.
    """

    __slots__ = (
        "_factors",
        "_history",
        "_policy_coverage",
        "_provisions",
        "_rationed",
        "_rights",
        "indexed",
        "manager",
        "market",
        "measured_short",
        "rations",
        "regulator",
        "tables",
    )

    kind = "company"

    def __init__(self, world: World, market: Market, tables: Mortality) -> None:
        """Found a company without clients."""
        super().__init__(world)
        self.market, self.tables = market, tables
        self.manager, self.regulator = Manager(self), Regulator(world)
        self.measured_short, self.indexed = 0, 1.0
        self.rations: dict[int, int] = {}
        self._rationed = -1
        self._rights = [0] * OLDEST  # by month of birth: the first is OLDEST - 1 months before the first month
        self._history: deque[float] = deque(maxlen=12)
        self._policy_coverage = 1.0
        self._factors = annuity_factors(tables, market.yield_steps, RETIREMENT)
        self._provisions: float | None = None

    # what it knows at any time

    def factor(self, age: int) -> float:
        """What a pension of 1 a year is worth at an age in months, at the present yield."""
        return self._factors[OLDEST - 1 - age]

    def provisions(self) -> float:
        """What all rights are worth, in cents.

        Rights are kept as sums by month of birth, which do not change with time: each change of a right is one
        addition, and each valuation one product of sums and factors, whatever the number of clients.
        """
        if self._provisions is None:
            youngest = self.world.month
            self._provisions = sum(map(mul, self._rights[youngest : youngest + OLDEST], self._factors))
        return self._provisions

    def coverage(self) -> float:
        """Assets by provisions, at present; without provisions it is 2."""
        provisions = self.provisions()
        return self.cents / provisions if provisions > 0 else 2.0

    def policy_coverage(self) -> float:
        """The mean of the coverage over the last twelve months, by which it is judged."""
        return self._policy_coverage

    def shortfall(self) -> float:
        """The share of all rights that would have to be cut to reach the minimum."""
        return max(0.0, 1 - self.policy_coverage() / MINIMUM)

    def cost_rate(self, client: Client) -> float:
        """The share of the wage that a client's standard accrual costs."""
        return ACCRUAL * self.factor(client.age)

    def lawful_premium(self, client: Client) -> tuple[float, float]:
        """The lowest and the highest premium that is lawful for a client, as shares of the wage."""
        cost = min(self.cost_rate(client) * (1 + client.extra), HIGHEST_PREMIUM)
        return cost * (0.8 if self.policy_coverage() >= REQUIRED else 1.0), min(1.3 * cost, HIGHEST_PREMIUM)

    def repair(self) -> float:
        """By how much rights may grow beyond inflation, where coverage is as high as required in the long run.

        Returns:
            A fifth of what they are behind prices.
        """
        behind = self.market.price_level / max(self.indexed, 1e-9) - 1
        return max(0.0, behind) / 5 if self.policy_coverage() >= REQUIRED else 0.0

    def lawful_indexation(self) -> float:
        """The highest indexation that is lawful: inflation and repair, if coverage is high enough."""
        return max(0.0, self.market.inflation) + self.repair() if self.policy_coverage() >= INDEXING else 0.0

    # decisions

    def set_premium(self, client: Client) -> float:
        """Decide which share of the wage a client pays for a year.

        Returns:
            What the accrual costs and 5 % of it for solvency; 15 % in a shortfall; less a tenth where coverage is
            well above what is required.
        """
        coverage = self.policy_coverage()
        surcharge = 1.15 if coverage < MINIMUM else 0.9 if coverage > REQUIRED + 0.15 else 1.05
        return surcharge * self.cost_rate(client) * (1 + client.extra)

    def choose_indexation(self) -> float:
        """Decide by how much rights grow: the policy ladder, from nothing at 110 % to all that is lawful at 130 %."""
        step = (self.policy_coverage() - INDEXING) / 0.2
        return self.lawful_indexation() * min(max(step, 0.0), 1.0)

    def choose_cut(self) -> float:
        """Decide by how much rights are cut in a shortfall: a tenth of it, from the third measurement on."""
        return self.shortfall() / SPREAD if self.measured_short >= 3 else 0.0

    # what it does

    def book_right(self, born: int, cents: int) -> None:
        """Note that rights of those born in a month have changed."""
        place = born + OLDEST - 1
        rights = self._rights
        if place >= len(rights):
            rights += [0] * (place + 1 - len(rights))
        rights[place] += cents
        self._provisions = None

    def review(self, client: Client) -> None:
        """Set premium and accrual for a client's next year, and amend the contract.

        What is paid and accrued beyond the standard ends where it costs more than can be asked for.
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
        """Let all rights grow or shrink by a share of them."""
        for client in clients_of(self.world):
            if client.accrued:
                client.accrue(round(client.accrued * by))
                if client.status == "retired" and client.contract is not None:
                    client.contract.cents = client.accrued // 12
        self.indexed *= 1 + by

    def invest(self) -> None:
        """Earn, or lose, what the market has done to the assets in a month, and value rights anew."""
        share_of_equities, market = self.manager.equities, self.market
        rate = share_of_equities * market.equity_return + (1 - share_of_equities) * market.bond_return
        change = round(self.cents * rate)
        outside, ledger = self.world.outside, self.world.ledger
        if change >= 0:
            ledger.move(outside, self, change, "returns")
        else:
            ledger.move(self, outside, -change, "losses")
        self._factors = annuity_factors(self.tables, market.yield_steps, RETIREMENT)
        self._provisions = None

    def ration(self) -> dict[int, int]:
        """See, once a month, whether there is enough for the pensions; if not, divide what there is.

        Returns:
            Cents by the number of the contract; nothing, where there is enough.
        """
        month, contracts = self.world.month, self.world.contracts.items()
        if self._rationed == month:
            return self.rations
        self._rationed = month
        due = {number: contract.cents for number, contract in contracts if isinstance(contract, PensionContract)}
        short = self.cents < sum(due.values())
        self.rations = dict(zip(due, share(self.cents, list(due.values())), strict=True)) if short else {}
        self.world.counts["pensions rationed"] += short
        return self.rations

    def measure(self) -> None:
        """Note the coverage of the month."""
        history = self._history
        history.append(self.coverage())
        self._policy_coverage = sum(history) / len(history)

    def conclude_year(self) -> None:
        """Measure, index rights or cut them, after the regulator has looked at the plan."""
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


def clients_of(world: World) -> list[Client]:
    """All clients and candidates there are."""
    return [entity for entity in world.entities.values() if isinstance(entity, Client)]


# -- the fund -------------------------------------------------------------------------------------


class Fund:
    """A pension company, its clients, and the world around them.

    Attributes:
        parameters: What it was like in the beginning.
        world: The blocks' world: month, ledger, calendar, contracts.
        market: Inflation, yields and returns.
        company: The pension company.
    """

    def __init__(self, seed: int | None = None, parameters: Parameters | None = None) -> None:
        """Found it, with clients of all ages who have paid since they were 25.

        Args:
            seed: Determines all chance. Market and people have generators of their own: what is decided about people
                does not change the market.
            parameters: What it is like; None: as the defaults are.
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
        """Make the first clients: as many of each age as one would be who joined at 25 and was mortal since."""
        alive, weights = 1.0, []
        for age in range(25 * 12, 100 * 12):
            alive *= 1 - self._deaths[age]
            weights.append(alive)
        ages = self.people.choices(range(25 * 12, 100 * 12), weights, k=self.parameters.clients)
        for age in ages:
            client = self._candidate(age)
            client.accrue(round(ACCRUAL * client.wage * (min(age, RETIREMENT) - 25 * 12) / 12 * 0.8))
            if age >= RETIREMENT:
                client.status = "retired"
                client.contract = PensionContract(self.company, client, client.accrued // 12, "pension")
            else:
                client.status = "working"
                client.contract = PremiumContract(client, self.company, 0, "premium")
            self._enter_dates(client)

    def _candidate(self, age: int) -> Client:
        """Make a candidate with a wage that fits the age."""
        draw = self.people
        career = 0.8 + 0.4 * min(1.0, max(0.0, (age / 12 - 25) / 30))
        wage = round(36_000_00 * self.market.price_level * career * draw.lognormvariate(0.0, 0.3))
        return Client(self.company, age, wage, draw.random())

    def _enter_dates(self, client: Client) -> None:
        """Enter into the calendar what has a date: yearly reviews, and retirement."""
        calendar, month = self.world.calendar, self.world.month
        calendar.at(month + 12 - client.age % 12, self.review_year, client)
        if client.status != "retired":
            calendar.at(client.born + RETIREMENT, client.retire)

    @property
    def clients(self) -> list[Client]:
        """All clients there are."""
        return clients_of(self.world)

    def advance(self) -> None:
        """Let a month go by."""
        self.market.advance()
        self.company.invest()
        self._live()
        self._arrive()
        self.world.advance()
        self.company.measure()

    def _live(self) -> None:
        """Have people earn, change jobs, and die: one draw for each, as a month has room for one of these."""
        world, deaths, change = self.world, self._deaths, self.parameters.job_change
        draw, move, outside, month = self.people.random, world.ledger.move, world.outside, world.month
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
        """Find a new job: with pension, without, or none for a while."""
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
        """Have candidates decide whether to join."""
        draw, world = self.people, self.world
        self._candidates += self.parameters.entry * self.parameters.clients / 12
        while self._candidates >= 1:
            self._candidates -= 1
            age = 22 * 12 + int(draw.triangular(0, 40 * 12, 3 * 12))
            candidate = self._candidate(age)
            if not candidate.choose_to_join():
                world.counts["declined"] += 1
                candidate.vanish(world.outside)
            elif Admission(candidate, self.company).submit() is None:
                self._enter_dates(candidate)
            else:
                candidate.vanish(world.outside)

    def review_year(self, client: Client) -> None:
        """Have a birthday: spend what is not needed; who works gets a rise, and agrees on the next year's premium."""
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
        """Let months go by, and check the money in the end of each year, and of the run.

        Args:
            months: How many.
        """
        for _ in range(months):
            self.advance()
            if self.world.month % 12 == 0:
                self.world.check()
        self.world.check()


def main(arguments: Sequence[str] | None = None) -> None:
    """Print how the fund fares, and how fast that was computed."""
    parser = argparse.ArgumentParser(description="Let a pension fund be run by its own rules.")
    parser.add_argument("--clients", type=int, default=10_000, help="in the beginning (default: 10000)")
    parser.add_argument("--years", type=int, default=40, help="for how long (default: 40)")
    parser.add_argument("--seed", type=int, help="of all chance (default: another each time)")
    options = parser.parse_args(arguments)
    fund = Fund(options.seed, Parameters(clients=options.clients))
    taken = 0.0
    print("year clients coverage yield inflation equities rights/prices")
    for year in range(1, options.years + 1):
        start = perf_counter()
        fund.run(12)
        taken += perf_counter() - start
        company, market = fund.company, fund.market
        if year % 5 == 0 or year == options.years:
            print(
                f"{year:4} {len(clients_of(fund.world)):7} {company.coverage():8.3f} {market.bond_yield:5.2%} "
                f"{market.inflation:9.2%} {company.manager.equities:8.0%} {company.indexed / market.price_level:13.2f}"
            )
    for event, count in sorted(fund.world.counts.items()):
        print(f"{count:8} {event}")
    print(f"{options.years / taken:.1f} years a second")


if __name__ == "__main__":
    main()
