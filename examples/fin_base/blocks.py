"""Blocks of which models of financial entities are built: entities, money, contracts, requests, a calendar.

- ``World``: what all entities of a model share: the month, the ids, the seed, the ledger, the calendar, the contracts.
- ``Entity``: who can own money and be a party to contracts.
- ``Ledger``: moves money, which is whole cents, from one entity to another. No cent appears or vanishes.
- ``share``: divides cents by weights, and loses none.
- ``Contract``: one party owes another an amount every so many months, from a start to an end.
- ``Request``: what one entity wants of another, and is granted or denied with the reason.
- ``Calendar``: what is to happen in which month.

Time is counted in months, as integers. ``World.advance`` goes through one of them.

>>> world = World(seed=1)
>>> landlord, tenant = Entity(world), Entity(world)
>>> world.ledger.move(world.outside, tenant, 250_00, "wages")
>>> rent = Contract(debtor=tenant, creditor=landlord, cents=100_00, reason="rent", end=12)
>>> for month in range(4):
...     world.advance()
>>> tenant.cents, landlord.cents, world.ledger.flows["rent"]
(5000, 20000, 20000)
>>> rent.missed  # there were no hundred left in the third month, nor in the fourth
2
>>> world.check()

Run on its own, it plays with these blocks at random, and checks that no cent is lost::

    python -m examples.fin_base.blocks
"""

from __future__ import annotations

import argparse
import heapq
from collections import Counter
from collections.abc import Callable, Sequence
from random import Random
from typing import Any, ClassVar


class Shortage(ValueError):
    """An entity does not have the money that it should pay."""


class World:
    """What all entities of a model share.

    Attributes:
        seed: Determines all chance in the model.
        random: Draws what no ``stream`` is there for.
        month: The present month; the first is 0.
        ledger: Moves money.
        calendar: What is to happen in which month.
        contracts: Those in force by their numbers.
        entities: Those that exist by their names.
        outside: The rest of the economy: the one entity that may owe money, as all money comes from there.
        counts: How often what has happened.
    """

    def __init__(self, seed: int | None = None) -> None:
        """Make an empty world.

        Args:
            seed: Determines all chance; None: another each time.
        """
        self.seed = Random().getrandbits(64) if seed is None else seed
        self.random = Random(self.seed)
        self.month = 0
        self.counts: Counter[str] = Counter()
        self.entities: dict[str, Entity] = {}
        self.contracts: dict[int, Contract] = {}
        self._ids: Counter[str] = Counter()
        self.ledger = Ledger(self)
        self.calendar = Calendar()
        self.outside = Entity(self)
        self.outside.may_owe = True

    def stream(self, name: str) -> Random:
        """A generator of its own for one concern, so that more draws for another do not change this one's.

        Args:
            name: Of the concern.

        Returns:
            A generator that the world's seed and the name determine.
        """
        return Random(f"{self.seed}/{name}")

    def next_id(self, kind: str) -> int:
        """Count on: the first of a kind in this world is number 0."""
        number = self._ids[kind]
        self._ids[kind] = number + 1
        return number

    def advance(self) -> None:
        """Go through one month: what the calendar has, then what contracts oblige to."""
        self.calendar.run(self.month)
        self.perform_contracts()
        self.month += 1

    def perform_contracts(self) -> None:
        """Have all debtors pay what they owe this month, and end contracts whose time is over."""
        month = self.month
        for contract in list(self.contracts.values()):
            if contract.end is not None and month >= contract.end:
                contract.terminate()
            elif contract.is_due(month):
                contract.perform()

    def check(self) -> None:
        """Check that no cent has appeared or vanished; it takes some nanoseconds for each entity.

        Raises:
            AssertionError: Money is not conserved, or an entity other than the outside owes some.
        """
        self.ledger.check()


class Entity:
    """Who can own money and be a party to contracts.

    Attributes:
        world: Where it exists.
        number: Its id among those of its kind in this world.
        name: Its name, which is unique in its world.
        cents: The money that it owns. Only the ledger changes it.
    """

    __slots__ = ("__weakref__", "cents", "may_owe", "name", "number", "world")

    kind: ClassVar[str] = "entity"

    def __init__(self, world: World) -> None:
        """Come into existence, without money."""
        self.world = world
        self.number = world.next_id(self.kind)
        self.name = f"{self.kind}_{self.number}"
        self.cents = 0
        self.may_owe = False
        world.entities[self.name] = self

    def vanish(self, heir: Entity, reason: str = "estate") -> None:
        """Cease to exist.

        Args:
            heir: Who gets the money that is left.
            reason: Under which the ledger books that.
        """
        if self.cents:
            self.world.ledger.move(self, heir, self.cents, reason)
        del self.world.entities[self.name]


class Ledger:
    """Moves money between entities: each cent that one of them gets is one that another of them has given.

    Attributes:
        flows: How many cents have been moved so far, by reason.

    >>> world = World()
    >>> company = Entity(world)
    >>> world.ledger.move(world.outside, company, 500, "capital")
    >>> company.cents, world.outside.cents
    (500, -500)
    >>> world.ledger.move(company, world.outside, 501, "rent")
    Traceback (most recent call last):
    ...
    examples.fin_base.blocks.Shortage: entity_1 has 500 cents and cannot pay 501 (rent)
    >>> company.cents += 1
    >>> world.check()
    Traceback (most recent call last):
    ...
    AssertionError: all money should sum up to 0, and is 1 cents
    """

    __slots__ = ("_world", "flows")

    def __init__(self, world: World) -> None:
        """Open the books of a world."""
        self._world = world
        self.flows: dict[str, int] = {}

    def move(self, source: Entity, target: Entity, cents: int, reason: str) -> None:
        """Move money.

        Args:
            source: Who pays.
            target: Who is paid.
            cents: How much: an integer that is not negative.
            reason: Under which it is booked.

        Raises:
            Shortage: The source does not have it. Nothing has changed.
            TypeError: The amount is no integer.
            ValueError: It is negative.
        """
        if cents.__class__ is not int:
            raise TypeError(f"money is whole cents, not {cents!r}")
        if cents < 0:
            raise ValueError(f"an amount cannot be negative: {cents} ({reason})")
        if source.cents < cents and not source.may_owe:
            raise Shortage(f"{source.name} has {source.cents} cents and cannot pay {cents} ({reason})")
        source.cents -= cents
        target.cents += cents
        flows = self.flows
        flows[reason] = flows.get(reason, 0) + cents

    def check(self) -> None:
        """Check that all money sums up to nothing, the outside's debt being all that the others own.

        Raises:
            AssertionError: It does not, or an entity owes that may not.
        """
        total = 0
        for entity in self._world.entities.values():
            cents = entity.cents
            if cents.__class__ is not int or (cents < 0 and not entity.may_owe):
                raise AssertionError(f"{entity.name} has {cents} cents")
            total += cents
        if total:
            raise AssertionError(f"all money should sum up to 0, and is {total} cents")


def share(cents: int, weights: Sequence[int]) -> list[int]:
    """Divide money in proportion to weights, by largest remainders: the parts sum up to the whole.

    Args:
        cents: What is divided: not negative.
        weights: One for each part; not negative, not all of them 0.

    Returns:
        The parts. Each is less than a cent away from its proportion; of equal remainders, the first get the cents.

    Raises:
        ValueError: Nothing can be divided like this.

    >>> share(100, [1, 1, 1])
    [34, 33, 33]
    """
    total = sum(weights)
    if total <= 0 or cents < 0 or min(weights) < 0:
        raise ValueError(f"{cents} cents cannot be divided by weights that sum up to {total}")
    parts = [cents * weight // total for weight in weights]
    remainders = [cents * weight % total for weight in weights]
    order = sorted(range(len(parts)), key=lambda place: -remainders[place])
    for place in order[: cents - sum(parts)]:
        parts[place] += 1
    return parts


class Contract:
    """One party owes another an amount, every so many months, from a start to an end.

    Attributes:
        debtor: Who pays.
        creditor: Who is paid.
        cents: How much, each time; it may be amended at any time.
        reason: Under which the ledger books it.
        start: The first month in which it is due.
        end: The first month in which it is in force no more; None: it has to be terminated.
        every: How many months lie between two payments.
        missed: How often the debtor did not have the money.
        number: Its id in its world.
    """

    __slots__ = ("__weakref__", "cents", "creditor", "debtor", "end", "every", "missed", "number", "reason", "start")

    def __init__(
        self,
        debtor: Entity,
        creditor: Entity,
        cents: int,
        reason: str,
        *,
        start: int | None = None,
        end: int | None = None,
        every: int = 1,
    ) -> None:
        """Conclude it; ``start=None`` is the present month, the rest as the attributes are."""
        world = debtor.world
        if every < 1 or creditor.world is not world:
            raise ValueError("a contract binds two entities of one world, every month or less often")
        self.debtor, self.creditor, self.cents, self.reason = debtor, creditor, cents, reason
        self.start = world.month if start is None else start
        self.end, self.every, self.missed = end, every, 0
        self.number = world.next_id("contract")
        world.contracts[self.number] = self

    @property
    def in_force(self) -> bool:
        """Whether it has not ended."""
        return self.number in self.debtor.world.contracts

    def is_due(self, month: int) -> bool:
        """Whether a payment is due in a month, as long as it is in force."""
        passed = month - self.start
        return passed >= 0 and (self.every == 1 or passed % self.every == 0)

    def perform(self) -> bool:
        """Pay once.

        Returns:
            Whether the debtor could.
        """
        try:
            self.debtor.world.ledger.move(self.debtor, self.creditor, self.cents, self.reason)
        except Shortage:
            self.missed += 1
            return False
        return True

    def terminate(self) -> None:
        """End it now; ending it twice does no harm."""
        self.debtor.world.contracts.pop(self.number, None)


class Request:
    """What one entity wants of another.

    A kind of request is a subclass: ``objection`` says why it is denied, ``carry_out`` does what was asked for.

    Attributes:
        applicant: Who wants something.

    >>> class Loan(Request):
    ...     def __init__(self, applicant, bank, cents):
    ...         super().__init__(applicant)
    ...         self.bank, self.cents = bank, cents
    ...     def objection(self):
    ...         return "the bank has not enough" if self.bank.cents < self.cents else None
    ...     def carry_out(self):
    ...         self.applicant.world.ledger.move(self.bank, self.applicant, self.cents, "loan")
    >>> world = World()
    >>> print(Loan(Entity(world), Entity(world), 100).submit())
    the bank has not enough
    >>> world.counts
    Counter({'Loan denied: the bank has not enough': 1})
    """

    __slots__ = ("applicant",)

    def __init__(self, applicant: Entity) -> None:
        self.applicant = applicant

    def objection(self) -> str | None:
        """Why it is denied; None: it is granted. It changes nothing."""
        raise NotImplementedError

    def carry_out(self) -> None:
        """Do what was asked for, once it is granted."""
        raise NotImplementedError

    def submit(self) -> str | None:
        """Have it granted and carried out, or denied; the world counts which.

        Returns:
            None, or the reason why it was denied. A request that was denied has changed nothing.
        """
        reason = self.objection()
        kind = type(self).__name__
        self.applicant.world.counts[f"{kind} granted" if reason is None else f"{kind} denied: {reason}"] += 1
        if reason is None:
            self.carry_out()
        return reason


class Calendar:
    """What is to happen in which month; within a month, in the order in which it was entered.

    >>> calendar = Calendar()
    >>> calendar.at(3, print, "later")
    >>> calendar.at(2, print, "first")
    >>> calendar.at(3, print, "latest")
    >>> calendar.run(3)
    first
    later
    latest
    """

    __slots__ = ("_entered", "_events")

    def __init__(self) -> None:
        self._entered = 0
        self._events: list[tuple[int, int, Callable[..., object], tuple[Any, ...]]] = []

    def __len__(self) -> int:
        return len(self._events)

    def at(self, month: int, action: Callable[..., object], *arguments: Any) -> None:
        """Enter an event.

        Args:
            month: When it happens.
            action: What happens.
            *arguments: Of the action.
        """
        heapq.heappush(self._events, (month, self._entered, action, arguments))
        self._entered += 1

    def every(self, months: int, action: Callable[[], object], *, start: int) -> None:
        """Enter an event that recurs.

        Args:
            months: How many lie between two of them.
            action: What happens.
            start: When it happens first.
        """
        self.at(start, self._recur, months, action, start)

    def _recur(self, months: int, action: Callable[[], object], month: int) -> None:
        """Let an event happen that recurs. No closure, so that a copy of a world has events of its own."""
        self.at(month + months, self._recur, months, action, month + months)
        action()

    def run(self, month: int) -> None:
        """Let all happen that is due up to this month, including what is entered meanwhile."""
        events = self._events
        while events and events[0][0] <= month:
            _, _, action, arguments = heapq.heappop(events)
            action(*arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """Let entities pay each other at random, and check the money in every month."""
    parser = argparse.ArgumentParser(description="Play with the blocks at random.")
    parser.add_argument("--months", type=int, default=120, help="for how long (default: 120)")
    parser.add_argument("--seed", type=int, help="of all chance (default: another each time)")
    options = parser.parse_args(arguments)
    world = World(options.seed)
    people = [Entity(world) for _ in range(50)]
    draw = world.random
    for person in people:
        world.ledger.move(world.outside, person, draw.randrange(1000_00), "savings")
    for _ in range(options.months):
        debtor, creditor = draw.sample(people, 2)
        Contract(debtor, creditor, draw.randrange(100_00), "instalment", end=world.month + draw.randrange(1, 24))
        world.advance()
        world.check()
    missed = sum(contract.missed for contract in world.contracts.values())
    paid = world.ledger.flows["instalment"]
    print(f"{options.months} months: {paid} cents paid, {missed} payments missed, no cent appeared or vanished")


if __name__ == "__main__":
    main()
