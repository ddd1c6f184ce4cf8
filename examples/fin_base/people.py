"""The clients of a pension company: their contracts, requests and decisions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .blocks import Contract, Entity, Request, World
from .law import ACCRUAL, DISPOSABLE, EXTRAS, HIGHEST_PREMIUM, LATEST_ENTRY, MINIMUM, TRANSFERABLE

if TYPE_CHECKING:
    from .company import Company


class PremiumContract(Contract):
    """A contract by which a client pays a premium each month.

    Each payment adds to the client's rights.
    """

    __slots__ = ()
    debtor: Client

    def perform(self) -> bool:
        """Pay the premium; accrue rights if the client could pay."""
        paid = super().perform()
        if paid:
            self.debtor.accrue(self.debtor.accrual)
        return paid


class PensionContract(Contract):
    """A contract by which the company pays a pension each month, as far as its money suffices."""

    __slots__ = ()
    debtor: Company

    def perform(self) -> bool:
        """Pay the pension.

        If the money does not suffice for all pensions, pay its share of the money.
        """
        rations = self.debtor.ration()
        if not rations:
            return super().perform()
        self.missed += 1
        self.debtor.world.ledger.move(self.debtor, self.creditor, rations[self.number], self.reason)
        return False


class Admission(Request):
    """A candidate's request to become a client."""

    def objection(self) -> str | None:
        """Deny candidates who are too old or already clients."""
        client = self.applicant
        if client.age >= LATEST_ENTRY:
            return "too old"
        return None if client.contract is None else "a client already"

    def carry_out(self) -> None:
        """Start to work and to pay premiums."""
        self.applicant.enter()


@dataclass
class Contribution(Request):
    """A client's request to pay and accrue a given share more than the standard."""

    extra: float

    def objection(self) -> str | None:
        """Deny clients without work, and increases that are unlawful or exceed their means."""
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
        """Set the extra contribution; the next review sets the premium accordingly."""
        self.applicant.extra = self.extra


class Transfer(Request):
    """A client's request to transfer the value of the accrued rights to another fund."""

    def objection(self) -> str | None:
        """Deny pensioners, transfers at low coverage, and values beyond the company's means."""
        client = self.applicant
        if client.status == "retired":
            return "retired"
        if client.company.policy_coverage() < TRANSFERABLE:
            return "coverage is too low"
        return None if client.value() <= client.company.cents else "the money is lacking"

    def carry_out(self) -> None:
        """Pay the value to the other fund, and remove the client."""
        client = self.applicant
        value = client.value()
        client.vanish(client.world.outside)
        client.world.ledger.move(client.company, client.world.outside, value, "transfer")


@dataclass
class RecoveryPlan(Request):
    """A company's proposal to the regulator in a shortfall: this year's cut of rights."""

    cut: float
    demand: float

    def objection(self) -> str | None:
        """Deny a cut below the regulator's demand."""
        return "cuts too little" if self.cut < self.demand else None

    def carry_out(self) -> None:
        """Cut rights."""
        self.applicant.change_rights(-self.cut)


class Client(Entity):
    """A client of a pension company, or a candidate: accrues a pension and later draws it.

    Attributes:
        born: The month of birth, which may be before the first month.
        wage: The yearly wage of the current or last job, in cents.
        status: "candidate", "working", "away" (in a job without pension, or in none), "retired" or
            "gone".
        accrued: The accrued right to a yearly pension, in cents.
        accrual: The cents that a month's premium adds to it.
        extra: The contribution beyond the standard, as a share of the standard: one of ``EXTRAS``.
        caution: From 0 (trusting) to 1 (cautious).
        disposable: The monthly income after living expenses while working, in cents.
    """

    __slots__ = (
        "accrual", "accrued", "born", "caution", "company", "contract", "disposable", "extra",
        "premium", "status", "wage",
    )  # fmt: skip

    kind = "client"

    def __init__(self, company: Company, age: int, wage: int, caution: float) -> None:
        """Create a candidate of an age in months."""
        super().__init__(company.world)
        self.company, self.born, self.wage, self.caution = (
            company,
            company.world.month - age,
            wage,
            caution,
        )
        self.status, self.accrued, self.accrual, self.extra, self.premium = (
            "candidate",
            0,
            0,
            0.0,
            0.0,
        )
        self.disposable = 0
        self.contract: Contract | None = None

    @property
    def age(self) -> int:
        """Age in months."""
        return self.world.month - self.born

    def choose_to_join(self) -> bool:
        """Decide whether to become a client: coverage must suffice for the candidate's caution."""
        return self.company.policy_coverage() >= 0.75 + 0.3 * self.caution

    def choose_extra(self) -> float:
        """Choose the extra contribution: more from 45 on, with savings in a sound company.

        Less after a default.
        """
        step = EXTRAS.index(self.extra)
        if self.contract is not None and self.contract.missed:
            step = max(0, step - 1)
        elif (
            self.age >= 45 * 12
            and self.cents * 12 > self.wage
            and self.company.policy_coverage() >= MINIMUM
        ):
            step = min(step + 1, len(EXTRAS) - 1)
        return EXTRAS[step]

    def choose_to_leave(self) -> bool:
        """Decide whether to transfer the rights: if small, or at low coverage for the caution."""
        little = self.accrued < 2 * ACCRUAL * self.wage
        return little or self.company.policy_coverage() < 0.85 + 0.3 * self.caution

    def enter(self) -> None:
        """Start to work and to pay premiums, for the first time or again."""
        self.status = "working"
        self.contract = PremiumContract(self, self.company, 0, "premium")
        self.company.review(self)

    def pause(self) -> None:
        """Stop working and paying premiums; accrued rights remain."""
        self.end_contract()
        self.status = "away"

    def come_back(self) -> None:
        """Start a job with pension again, unless the client has retired, died or left meanwhile."""
        if self.status == "away":
            self.enter()
            self.world.counts["came back"] += 1

    def retire(self) -> None:
        """Start to draw the pension."""
        if self.status not in ("working", "away"):
            return
        self.end_contract()
        self.status = "retired"
        self.contract = PensionContract(self.company, self, self.accrued // 12, "pension")
        self.world.counts["retired"] += 1

    def end_contract(self) -> None:
        """Terminate the current contract, if there is one."""
        if self.contract is not None:
            self.contract.terminate()
            self.contract = None

    def accrue(self, cents: int) -> None:
        """Add cents a year to the accrued right; a negative number reduces it."""
        if cents:
            self.accrued += cents
            self.company.book_right(self.born, cents)

    def value(self) -> int:
        """Return the value of the accrued rights, in cents."""
        return round(self.accrued * self.company.factor(self.age))

    def vanish(self, heir: Entity, reason: str = "estate") -> None:
        """Remove the client: after death, a transfer, or a candidate's refusal or denial.

        All rights end.
        """
        self.end_contract()
        self.accrue(-self.accrued)
        self.status = "gone"
        super().vanish(heir, reason)


def clients_of(world: World) -> list[Client]:
    """Return all present clients and candidates of a world."""
    return [entity for entity in world.entities.values() if isinstance(entity, Client)]
