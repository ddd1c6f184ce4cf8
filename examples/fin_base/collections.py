"""An agency that collects debts, day by day. Nothing here knows of reinforcement learning.

The agency owns debts of consumers. Each debtor owes one amount, and has wages, living costs, savings and a willingness
to pay that the agency does not know. Debtors pay in full, ask for instalments, dispute the debt, or become insolvent.
The agency sends letters, makes calls and goes to court. One tick of the ``World`` is one day here, not one month.

**Decision.** ``Agency.choose_contact(debtor, choices)`` is called for each case that is due on a working day. It
returns one of the ``choices``, which ``Agency.lawful`` lists: what the law, today's staff and the agency's money allow.

========= ==================================== ============================================================
choice    cost                                 the case is due again
========= ==================================== ============================================================
"leave"   none                                 after a week
"write"   ``POSTAGE``                          after two weeks
"call"    ``CALL`` and one of the day's calls  after a week; without an answer, later on the same day
"sue"     ``FEE``                              never: the court decides
========= ==================================== ============================================================

**Utility.** ``Agency.profit``: the money collected less all costs, when all cases are closed or after two years. The
agency buys debts in the first half year alone, so that two years show what has become of them. What it has paid for the
debts is spent already and does not count.

**The law** is that of the United States, simplified: Regulation F of the CFPB (12 CFR part 1006).

- At most seven calls about a debt in seven days, and none within seven days after a conversation, the day of which is
  the first of the seven (1006.14(b)(2), where exceeding these numbers is presumed to be a violation).
- The collector sends a notice with the first communication or within five days of it (1006.34(a)(1)). Here the first
  letter is the notice, and the agency does not call before it.
- A consumer who disputes the debt in writing within the validation period stops the collection until the debt is
  verified (1006.38(d)(2)). The period ends 30 days after receipt; the mail may be assumed to take five working days
  (1006.34(b)(5)). Here the agency does not sue before that.
- A consumer can ask in writing for no further communication. The agency can still sue (1006.6(c)).
- No lawsuits for time-barred debts (1006.26(b)). The limit is four years here, as for written contracts in California
  (Code of Civil Procedure, section 337).
- A garnishment takes at most a quarter of the disposable wages (15 U.S.C. 1673).

All other numbers are assumptions: what debtors earn and owe, how they react, that the chance of a payment halves as a
debt becomes ``HALF_LIFE`` days older. Interest, taxes and several debts of one person are not modelled.

Run on its own, the module prints how the agency fares::

    python -m examples.fin_base.collections --days 720

Use ``-m`` for all modules of this folder: a script that is run by its path would import this file as the standard
library's ``collections``.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import log
from typing import Final

from .blocks import Contract, Entity, Request, World

POSTAGE, CALL, FEE = 1_00, 3_00, 250_00
COSTS: Final = {"leave": 0, "write": POSTAGE, "call": CALL, "sue": FEE}
"""What each choice costs, in cents."""

CHOICES: Final = tuple(COSTS)
"""All that can be done about a case."""

PAUSES: Final = {"leave": 7, "write": 14, "call": 7, "sue": 0}
"""After how many days a case is due again."""

CALL_LIMIT, QUIET, VALIDATION, LIMITATION = 7, 7, 37, 4 * 365
"""The law: calls in ``QUIET`` days, days without calls after a conversation, the validation period, the time bar."""

VERIFICATION, KEPT, MONTH, HALF_LIFE = 21, 365, 30, 240
"""Days: of a verification, until a case is written off, between two wages, until the chance of a payment has halved."""

ACTIVE: Final = ("open", "disputed", "plan", "court", "judged")
"""The states of a case until it is closed. The agency decides on open ones."""


@dataclass(frozen=True)
class Parameters:
    """What an agency is like.

    Attributes:
        arrivals: The mean number of debts that it buys in a day.
        buying: On how many days it buys debts.
        stock: The number of debts on the first day.
        calls: How many calls the staff can make on a working day.
        capital: The agency's money on the first day, in cents.
    """

    arrivals: float = 1.0
    buying: int = 180
    stock: int = 60
    calls: int = 4
    capital: int = 50_000_00


class Repayment(Contract):
    """A debtor pays off a debt month by month: in instalments, or by garnishment after a judgment."""

    __slots__ = ()
    debtor: Debtor

    def perform(self) -> bool:
        """Pay; a plan ends with the second missed instalment."""
        self.cents = min(self.cents, self.debtor.balance)
        paid = super().perform()
        if paid:
            self.debtor.credit(self.cents)
        elif self.missed == 2 and self.debtor.status == "plan":
            self.terminate()
            self.debtor.reopen()
        return paid


class Plan(Request):
    """A debtor asks to pay in instalments."""

    __slots__ = ()
    applicant: Debtor

    def objection(self) -> str | None:
        """One plan for each debtor, of two years at most."""
        if self.applicant.contract is not None:
            return "broke a plan"
        return None if self.applicant.offer * 24 >= self.applicant.balance else "takes too long"

    def carry_out(self) -> None:
        """Pay from the next payday on."""
        self.applicant.repay("plan", self.applicant.offer)


class Debtor(Entity):
    """A person who owes a debt to the agency.

    Each debtor has two streams of random numbers: what the agency decides changes neither the life of a debtor nor the
    luck of others.

    Attributes:
        balance: What is still owed, in cents.
        since: The day of the default, which may be before the first day.
        arrived: The day on which the agency bought the debt.
        status: One of ``ACTIVE``, or how the case was closed.
        due: The day on which the agency decides on the case again, if it is open.
        letters: How many letters were sent.
        notified: The day of the first one; None before it.
        attempts: How many calls were made.
        calls: The days of the latest calls, up to ``CALL_LIMIT``.
        contacted: The day of the latest letter or call; None before the first.
        talked: The day of the latest conversation; None before the first.
        ceased: Whether the debtor has asked for no further communication.
        collected: What the debtor has paid to the agency, in cents.
        spent: What the agency has spent on the case, in cents.
        contract: The latest plan or garnishment.
        wage, living, cushion: Monthly wage and living costs, and the highest savings, in cents. This and all below is
            hidden from the agency.
        employed: Whether the debtor earns the wage at present.
        willingness, reach: How likely the debtor pays, and answers a call.
        court: What a court would find, from 0 to 1: a low number means wages that can be garnished.
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
        """Go through a payday: keep or lose the job, earn, spend, become insolvent, or pay the debt unasked."""
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
        """Read a letter: dispute the debt after the first one, or respond, less to each further one."""
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
        """Repay month by month from the next payday on."""
        self.status = status
        self.contract = Repayment(self, self.agency, cents, status, start=self.payday, every=MONTH)

    def credit(self, cents: int) -> None:
        """Owe less; a debt that is paid is closed."""
        self.balance -= cents
        self.collected += cents
        if not self.balance:
            self.close("paid")

    def verify(self) -> None:
        """Learn what the agency has found out about a dispute: every second debtor was right."""
        if self.status == "disputed":
            self.close("not owed") if self.draw.random() < 0.5 else self.reopen()

    def judge(self) -> None:
        """Hear the court's decision: wages are garnished, or none are found, or the suit is dismissed."""
        if self.status == "court" and self.court < 0.4:
            self.repay("judged", self.wage // 4)
        elif self.status == "court":
            self.close("nothing to garnish" if self.court < 0.9 else "dismissed")

    def reopen(self) -> None:
        """Be a case for the agency's decisions again."""
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
    """Owns debts, buys others day by day (a Poisson process), and collects them.

    Attributes:
        parameters: What it is like.
        cases: All debtors whose cases are not closed, by number.
        queue: The cases that are still due today.
        calls_left: How many calls the staff can still make today.
        random: Draws when debts are bought.
    """

    __slots__ = ("calls_left", "cases", "parameters", "queue", "random")

    kind = "agency"

    def __init__(self, seed: int | None = None, parameters: Parameters | None = None) -> None:
        """Begin in a world of its own; the seed determines all chance."""
        super().__init__(World(seed))
        self.parameters = parameters = parameters or Parameters()
        world, self.random, self.calls_left = self.world, self.world.stream("purchases"), parameters.calls
        self.cases: dict[int, Debtor] = {}
        self.queue: deque[Debtor] = deque()
        world.ledger.move(world.outside, self, parameters.capital, "capital")
        for number in range(parameters.stock):
            Debtor(self).due = number % 7
        if parameters.arrivals:
            self.buy(0.0)

    def buy(self, time: float) -> None:
        """Buy a debt, unless it is the first moment, and enter the next purchase into the calendar."""
        if time:
            Debtor(self)
        time += self.random.expovariate(self.parameters.arrivals)
        if time < self.parameters.buying:
            self.world.calendar.at(int(time), self.buy, time)

    def advance(self) -> None:
        """Let a day go by: the agency's work, then what happens to debtors, then what is due."""
        self.work()
        self.world.advance()

    @property
    def profit(self) -> int:
        """The money collected less all costs, in cents."""
        return self.cents - self.parameters.capital

    def lawful(self, debtor: Debtor) -> tuple[str, ...]:
        """What may be done about a case now, in the order of ``CHOICES``. To leave it alone is always lawful."""
        day, choices = self.world.month, ["leave"]
        if debtor.status != "open":
            return ("leave",)
        if not debtor.ceased:
            choices.append("write")
            quiet = debtor.talked is None or day - debtor.talked >= QUIET
            rare = len(debtor.calls) < CALL_LIMIT or day - debtor.calls[0] >= QUIET
            if debtor.notified is not None and quiet and rare and self.calls_left:
                choices.append("call")
        if debtor.notified is not None and day - debtor.notified >= VALIDATION and debtor.age < LIMITATION:
            choices.append("sue")
        return tuple(choice for choice in choices if COSTS[choice] <= self.cents)

    def choose_contact(self, debtor: Debtor, choices: Sequence[str]) -> str:
        """Decide what to do about a case.

        Args:
            debtor: Whose case it is.
            choices: What may be done.

        Returns:
            One of the choices, by a dunning ladder: two letters, then up to six calls until there is a conversation,
            then the court for debts of 500 and more.
        """
        if debtor.letters < 2 and "write" in choices:
            return "write"
        if debtor.talked is None and debtor.attempts < 6 and not debtor.ceased:
            return "call" if "call" in choices else "leave"
        return "sue" if "sue" in choices and debtor.balance >= 500_00 else "leave"

    def work(self) -> None:
        """Go through all cases that are due, the longest waiting first; weekends are free."""
        day = self.world.month
        if day % 7 >= 5:
            return
        self.calls_left = self.parameters.calls
        opened = [debtor for debtor in self.cases.values() if debtor.status == "open" and debtor.due <= day]
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
        """Pay for what was decided, and do it."""
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
    """Print how an agency fares."""
    parser = argparse.ArgumentParser(description="Let an agency collect debts by its own rule.")
    parser.add_argument("--days", type=int, default=720, help="for how long (default: 720)")
    parser.add_argument("--calls", type=int, default=Parameters.calls, help="calls a working day (default: 4)")
    parser.add_argument("--seed", type=int, help="of all chance (default: another each time)")
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
