"""A model of a debt collection agency, in steps of a day. It contains no reinforcement learning.

The agency owns debts of consumers. Each debtor owes one amount. Wages, living costs, savings and
the willingness to pay are unknown to the agency. Debtors pay in full, ask for instalments, dispute
the debt, or become insolvent. The agency sends letters, makes calls and goes to court. One step of
the ``World`` is one day here, not one month.

**Decision.** ``Agency.choose_contact(debtor, choices)`` is called for each case that is due on a
working day. It returns one of the ``choices``, which ``Agency.lawful`` lists: what the law, today's
staff and the agency's money allow.

======= =================================== ======================================================
choice  cost                                the case is due again
======= =================================== ======================================================
"leave" none                                after a week
"write" ``POSTAGE``                         after two weeks
"call"  ``CALL`` and one of the day's calls after a week; without an answer, later on the same day
"sue"   ``FEE``                             never: the court decides
======= =================================== ======================================================

**Utility.** ``Agency.profit``: the money collected less all costs, when all cases are closed or
after two years. The agency buys debts in the first half year only, so two years show how their
cases end. The price of the debts is a sunk cost and does not count.

**The law** is that of the United States, simplified: Regulation F of the CFPB (12 CFR part 1006).

- At most seven calls about a debt in seven days, and none within seven days after a conversation,
  whose day is the first of the seven (1006.14(b)(2); more calls are presumed to be a violation).
- The collector sends a notice with the first communication or within five days of it
  (1006.34(a)(1)). Here the first letter is the notice, and the agency does not call before it.
- A consumer who disputes the debt in writing within the validation period stops the collection
  until the debt is verified (1006.38(d)(2)). The period ends 30 days after receipt; the mail may be
  assumed to take five working days (1006.34(b)(5)). Here the agency does not sue before the period
  has ended.
- A consumer can ask in writing for no further communication. The agency can still sue (1006.6(c)).
- No lawsuits for time-barred debts (1006.26(b)). The limit is four years here, as for written
  contracts in California (Code of Civil Procedure, section 337).
- A garnishment takes at most a quarter of the disposable wages (15 U.S.C. 1673).

All other numbers are assumptions: the debtors' wages and debts, their reactions, and the half-life
of the probability of a payment, which is ``HALF_LIFE`` days. The model leaves out interest, taxes
and several debts of one person.

As a script, the module prints the agency's results::

    python -m studies.debt_collection.model --days 720
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import log
from typing import Final

from examples.fin_base.blocks import Contract, Entity, Request, World

POSTAGE, CALL, FEE = 1_00, 3_00, 250_00
COSTS: Final = {"leave": 0, "write": POSTAGE, "call": CALL, "sue": FEE}
"""The cost of each choice, in cents."""

CHOICES: Final = tuple(COSTS)
"""All choices for a case."""

PAUSES: Final = {"leave": 7, "write": 14, "call": 7, "sue": 0}
"""The number of days until a case is due again, by choice."""

CALL_LIMIT, QUIET, VALIDATION, LIMITATION = 7, 7, 37, 4 * 365
"""The law: calls in ``QUIET`` days, quiet after a conversation, validation and limitation."""

VERIFICATION, KEPT, MONTH, HALF_LIFE = 21, 365, 30, 240
"""Days: verification, until a write-off, between wages, half-life of a payment's probability."""

ACTIVE: Final = ("open", "disputed", "plan", "court", "judged")
"""The states of a case that is not closed. The agency decides on cases that are "open"."""


@dataclass(frozen=True)
class Parameters:
    """The parameters of an agency.

    Attributes:
        arrivals: The mean number of debts that it buys per day.
        buying: The number of days on which it buys debts.
        stock: The number of debts on the first day.
        calls: The number of calls that the staff can make on a working day.
        capital: The agency's money on the first day, in cents.
    """

    arrivals: float = 1.0
    buying: int = 180
    stock: int = 60
    calls: int = 4
    capital: int = 50_000_00


class Repayment(Contract):
    """A monthly repayment of a debt: in instalments, or by garnishment after a judgment."""

    __slots__ = ()
    debtor: Debtor

    def perform(self) -> bool:
        """Pay one instalment; the second missed instalment ends a plan."""
        self.cents = min(self.cents, self.debtor.balance)
        paid = super().perform()
        if paid:
            self.debtor.credit(self.cents)
        elif self.missed == 2 and self.debtor.status == "plan":
            self.terminate()
            self.debtor.reopen()
        return paid


class Plan(Request):
    """A debtor's request to pay in instalments."""

    __slots__ = ()
    applicant: Debtor

    def objection(self) -> str | None:
        """Deny a second plan, and plans of more than two years."""
        if self.applicant.contract is not None:
            return "broke a plan"
        return None if self.applicant.offer * 24 >= self.applicant.balance else "takes too long"

    def carry_out(self) -> None:
        """Start the instalments at the next payday."""
        self.applicant.repay("plan", self.applicant.offer)


class Debtor(Entity):
    """A person who owes a debt to the agency.

    Each debtor has two streams of random numbers, so the agency's decisions change neither the
    random events of a debtor's life nor those of other debtors.

    Attributes:
        balance: The amount still owed, in cents.
        since: The day of the default, which may be before the first day.
        arrived: The day on which the agency bought the debt.
        status: One of ``ACTIVE``, or the way in which the case was closed.
        due: The day on which the agency decides on the case again, if it is open.
        letters: The number of letters sent.
        notified: The day of the first letter; None before it.
        attempts: The number of calls made.
        calls: The days of the latest calls, at most ``CALL_LIMIT`` of them.
        contacted: The day of the latest letter or call; None before the first.
        talked: The day of the latest conversation; None before the first.
        ceased: Whether the debtor has asked for no further communication.
        collected: The money that the debtor has paid to the agency, in cents.
        spent: The agency's costs of the case, in cents.
        contract: The latest plan or garnishment.
        wage, living, cushion: Monthly wage and living costs, and the maximum of savings, in cents.
            The agency does not know these, nor the attributes below.
        employed: Whether the debtor earns the wage at present.
        willingness, reach: How likely the debtor is to pay, and to answer a call, from 0 to 1.
        court: The outcome of a lawsuit, from 0 to 1: a low number means wages that can be
            garnished.
        payday: The day of the next wage.
    """

    kind = "debtor"

    def __init__(self, agency: Agency) -> None:
        super().__init__(agency.world)
        world, self.agency = agency.world, agency
        draw = self.draw = world.stream(self.name)
        self.balance = round(draw.lognormvariate(log(600_00), 0.9))
        self.since = world.month - 60 - int(draw.expovariate(1 / 400))
        self.wage = round(draw.lognormvariate(log(2500_00), 0.35))
        self.living = round(self.wage * draw.uniform(0.8, 1.05))
        self.cushion = round(self.wage * draw.uniform(0.0, 1.0))
        self.employed = draw.random() < 0.85
        self.willingness, self.reach = draw.betavariate(1.2, 1.5), draw.uniform(0.1, 0.6)
        self.court, self.life = draw.random(), world.stream(f"{self.name}/life")
        self.arrived = self.due = world.month
        self.payday = world.month + draw.randrange(1, MONTH + 1)
        self.status, self.ceased = "open", False
        self.letters = self.attempts = self.collected = self.spent = 0
        self.notified: int | None = None
        self.contacted: int | None = None
        self.talked: int | None = None
        self.calls: deque[int] = deque(maxlen=CALL_LIMIT)
        self.contract: Repayment | None = None
        agency.cases[self.number] = self
        world.ledger.move(world.outside, self, draw.randrange(self.cushion + 1), "savings")
        world.calendar.at(self.payday, self.live)

    @property
    def age(self) -> int:
        """The age of the debt in days."""
        return self.world.month - self.since

    @property
    def offer(self) -> int:
        """The monthly instalment that the debtor can offer, in cents."""
        return max(1, round(0.8 * (self.wage - self.living))) if self.employed else 1

    def live(self) -> None:
        """Simulate a payday: keep or lose the job, earn, spend, become insolvent, or pay."""
        if self.status not in ACTIVE:
            return
        draw, world, garnished = self.life, self.world, self.status == "judged"
        self.payday += MONTH
        world.calendar.at(self.payday, self.live)
        self.employed = draw.random() < (0.98 if self.employed else 0.2)
        if draw.random() < (0.002 if self.employed else 0.01) * (3 if garnished else 1):
            self.close("insolvent")
            return
        if self.employed:
            world.ledger.move(world.outside, self, self.wage, "wages")
        owed = self.contract.cents if self.contract is not None and self.contract.in_force else 0
        living = round(self.living * draw.uniform(0.9, 1.1)) - (owed if garnished else 0)
        kept = min(max(self.cents - living, 0), self.cushion + owed)
        world.ledger.move(self, world.outside, self.cents - kept, "living")
        self.respond(0.1)

    def receive(self) -> None:
        """Read a letter: dispute the debt after the first letter, or respond.

        A response is less likely to each further letter.
        """
        if self.status == "open" and self.letters == 1 and self.draw.random() < 0.04:
            self.status = "disputed"
            self.world.calendar.at(self.world.month + VERIFICATION, self.verify)
        self.respond(0.4 * 0.7 ** (self.letters - 1))

    def respond(self, strength: float) -> None:
        """Pay in full, ask for instalments, ask for no further communication, or do nothing."""
        if self.status != "open":
            return
        chance = strength * self.willingness * 0.5 ** (self.age / HALF_LIFE)
        number = self.draw.random()
        if number > 0.98:
            self.ceased = self.letters > 0
        elif number < chance and self.cents >= self.balance:
            paid = self.balance
            self.world.ledger.move(self, self.agency, paid, "payment")
            self.credit(paid)
        elif number < chance and self.letters:
            Plan(self).submit()

    def repay(self, status: str, cents: int) -> None:
        """Start monthly repayments at the next payday."""
        self.status = status
        self.contract = Repayment(self, self.agency, cents, status, start=self.payday, every=MONTH)

    def credit(self, cents: int) -> None:
        """Reduce the balance by a payment; close the case once the debt is paid."""
        self.balance -= cents
        self.collected += cents
        if not self.balance:
            self.close("paid")

    def verify(self) -> None:
        """Resolve a dispute: every second debtor was right."""
        if self.status == "disputed":
            self.close("not owed") if self.draw.random() < 0.5 else self.reopen()

    def judge(self) -> None:
        """Apply the court's decision: it garnishes wages, finds none, or dismisses the lawsuit."""
        if self.status == "court" and self.court < 0.4:
            self.repay("judged", self.wage // 4)
        elif self.status == "court":
            self.close("nothing to garnish" if self.court < 0.9 else "dismissed")

    def reopen(self) -> None:
        """Reopen the case for the agency's decisions."""
        self.status, self.due = "open", self.world.month + 1

    def close(self, reason: str) -> None:
        """Close the case; the debtor leaves the world."""
        if self.contract is not None:
            self.contract.terminate()
        self.status = reason
        self.world.counts[reason] += 1
        del self.agency.cases[self.number]
        self.vanish(self.world.outside)


class Agency(Entity):
    """An agency, which buys debts (a Poisson process) and collects them.

    Attributes:
        parameters: The agency's parameters.
        cases: All debtors whose cases are not closed, by number.
        queue: The cases still due today.
        calls_left: The number of calls that the staff can still make today.
        random: The generator for the times of purchases.
    """

    __slots__ = ("calls_left", "cases", "parameters", "queue", "random")

    kind = "agency"

    def __init__(self, seed: int | None = None, parameters: Parameters | None = None) -> None:
        """Create an agency in a world of its own; the seed determines all randomness."""
        super().__init__(World(seed))
        self.parameters = parameters = parameters or Parameters()
        world, self.random, self.calls_left = (
            self.world,
            self.world.stream("purchases"),
            parameters.calls,
        )
        self.cases: dict[int, Debtor] = {}
        self.queue: deque[Debtor] = deque()
        world.ledger.move(world.outside, self, parameters.capital, "capital")
        for number in range(parameters.stock):
            Debtor(self).due = number % 7
        if parameters.arrivals:
            self.buy(0.0)

    def buy(self, time: float) -> None:
        """Buy a debt, except at time 0, and schedule the next purchase."""
        if time:
            Debtor(self)
        time += self.random.expovariate(self.parameters.arrivals)
        if time < self.parameters.buying:
            self.world.calendar.at(int(time), self.buy, time)

    def advance(self) -> None:
        """Simulate one day: the agency's work, the debtors' events, and the payments due."""
        self.work()
        self.world.advance()

    @property
    def profit(self) -> int:
        """The money collected less all costs, in cents."""
        return self.cents - self.parameters.capital

    def lawful(self, debtor: Debtor) -> tuple[str, ...]:
        """List the choices that are lawful for a case now, in the order of ``CHOICES``.

        "leave" always is.
        """
        day, choices = self.world.month, ["leave"]
        if debtor.status != "open":
            return ("leave",)
        if not debtor.ceased:
            choices.append("write")
            quiet = debtor.talked is None or day - debtor.talked >= QUIET
            rare = len(debtor.calls) < CALL_LIMIT or day - debtor.calls[0] >= QUIET
            if debtor.notified is not None and quiet and rare and self.calls_left:
                choices.append("call")
        if (
            debtor.notified is not None
            and day - debtor.notified >= VALIDATION
            and debtor.age < LIMITATION
        ):
            choices.append("sue")
        return tuple(choice for choice in choices if COSTS[choice] <= self.cents)

    def choose_contact(self, debtor: Debtor, choices: Sequence[str]) -> str:
        """Choose what to do about a case.

        Args:
            debtor: The debtor of the case.
            choices: The lawful choices.

        Returns:
            One of the choices, by a dunning sequence: two letters, then up to six calls until there
            is a conversation, then a lawsuit for debts of 500 dollars and more.
        """
        if debtor.letters < 2 and "write" in choices:
            return "write"
        if debtor.talked is None and debtor.attempts < 6 and not debtor.ceased:
            return "call" if "call" in choices else "leave"
        return "sue" if "sue" in choices and debtor.balance >= 500_00 else "leave"

    def work(self) -> None:
        """Decide on all cases that are due, those due longest first.

        There is no work on weekends.
        """
        day = self.world.month
        if day % 7 >= 5:
            return
        self.calls_left = self.parameters.calls
        opened = [
            debtor
            for debtor in self.cases.values()
            if debtor.status == "open" and debtor.due <= day
        ]
        self.queue.extend(sorted(opened, key=lambda debtor: debtor.due))
        while self.queue:
            debtor = self.queue.popleft()
            if day - debtor.arrived >= KEPT:
                debtor.close("written off")
            else:
                choices = self.lawful(debtor)
                choice = self.choose_contact(debtor, choices)
                if choice not in choices:
                    raise ValueError(f"{choice!r} is not lawful for {debtor.name}, only {choices}")
                self.carry_out(choice, debtor)

    def carry_out(self, choice: str, debtor: Debtor) -> None:
        """Pay for a choice, and carry it out."""
        world, day, draw = self.world, self.world.month, debtor.draw
        world.counts[choice] += 1
        world.ledger.move(self, world.outside, COSTS[choice], choice)
        debtor.spent += COSTS[choice]
        debtor.due = day + PAUSES[choice]
        if choice in ("write", "call"):
            debtor.contacted = day
        if choice == "write":
            debtor.letters += 1
            debtor.notified = day if debtor.notified is None else debtor.notified
            world.calendar.at(day + draw.randrange(3, 11), debtor.receive)
        elif choice == "call":
            self.calls_left -= 1
            debtor.attempts += 1
            debtor.calls.append(day)
            if draw.random() < debtor.reach:
                debtor.talked = day
                debtor.respond(0.8)
            else:
                debtor.due = day
                self.queue.append(debtor)
        elif choice == "sue":
            debtor.status = "court"
            world.calendar.at(day + draw.randrange(60, 121), debtor.judge)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run an agency, and print its results."""
    parser = argparse.ArgumentParser(
        description="Run a debt collection agency by its own rule, and print its results."
    )
    parser.add_argument(
        "--days", type=int, default=720, help="how many days to simulate (default: 720)"
    )
    parser.add_argument(
        "--calls", type=int, default=Parameters.calls, help="calls per working day (default: 4)"
    )
    parser.add_argument(
        "--seed", type=int, help="seed of all randomness (default: a new one each time)"
    )
    options = parser.parse_args(arguments)
    agency = Agency(options.seed, Parameters(calls=options.calls))
    print(" day  cases   owed, dollars  profit, dollars")
    for day in range(1, options.days + 1):
        agency.advance()
        if day % 60 == 0 or day == options.days:
            owed = sum(debtor.balance for debtor in agency.cases.values())
            print(f"{day:4} {len(agency.cases):6} {owed / 100:13.2f} {agency.profit / 100:14.2f}")
    agency.world.check()
    for event, count in sorted(agency.world.counts.items()):
        print(f"{count:6} {event}")


if __name__ == "__main__":
    main()
