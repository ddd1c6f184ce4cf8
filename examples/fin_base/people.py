"""The clients of a pension company: what they pay and are paid, ask for, and decide."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .blocks import Contract, Entity, Request, World
from .law import ACCRUAL, DISPOSABLE, EXTRAS, HIGHEST_PREMIUM, LATEST_ENTRY, MINIMUM, TRANSFERABLE

if TYPE_CHECKING:
    from .company import Company


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
        if client.company.policy_coverage() < TRANSFERABLE:
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


def clients_of(world: World) -> list[Client]:
    """All clients and candidates there are."""
    return [entity for entity in world.entities.values() if isinstance(entity, Client)]
