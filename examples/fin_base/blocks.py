"""Building blocks for models of financial entities: entities, money, contracts, requests, a calendar.

- ``World``: the shared state of a model: month, ids, seed, ledger, calendar, contracts.
- ``Entity``: an owner of money and a party to contracts.
- ``Ledger``: moves money, in whole cents, from one entity to another. No cent appears or vanishes.
- ``share``: divides an amount of cents in proportion to weights, without losing a cent.
- ``Contract``: one party pays another a fixed amount at regular intervals, from a start to an end.
- ``Request``: one entity asks another for something, which is granted, or denied with a reason.
- ``Calendar``: the schedule of events by month.

Time is an integer number of months. ``World.advance`` simulates one month.

>>> world = World(seed=1)
>>> landlord, tenant = Entity(world), Entity(world)
>>> world.ledger.move(world.outside, tenant, 250_00, "wages")
>>> rent = Contract(debtor=tenant, creditor=landlord, cents=100_00, reason="rent", end=12)
>>> for month in range(4):
...     world.advance()
>>> tenant.cents, landlord.cents, world.ledger.flows["rent"]
(5000, 20000, 20000)
>>> rent.missed  # the tenant could not pay 100 in the third month, nor in the fourth
2
>>> world.check()

As a script, the module runs random payments between entities, and checks that no cent is lost::

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
    """An entity does not have the money for a payment."""


class World:
    """The shared state of a model.

    Attributes:
        seed: The seed of all randomness in the model.
        random: The generator for everything that has no ``stream`` of its own.
        month: The current month; the first is 0.
        ledger: The ledger, which moves money.
        calendar: The scheduled events.
        contracts: The contracts in force, by number.
        entities: The existing entities, by name.
        outside: The rest of the economy. All money comes from it, so it is the one entity that may owe money.
        counts: How often each kind of event has happened.
    """

    def __init__(self, seed: int | None = None) -> None:
        """Make an empty world.

        Args:
            seed: The seed of all randomness; None: a new one each time.
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
        """Make a random number generator for one purpose, which draws for other purposes do not affect.

        Args:
            name: The name of the purpose.

        Returns:
            A generator that depends on the world's seed and the name alone.
        """
        return Random(f"{self.seed}/{name}")

    def next_id(self, kind: str) -> int:
        """Return the next free number of a kind; the first of a kind in this world is 0."""
        number = self._ids[kind]
        self._ids[kind] = number + 1
        return number

    def advance(self) -> None:
        """Simulate one month: the events of the calendar, then the payments of the contracts."""
        self.calendar.run(self.month)
        self.perform_contracts()
        self.month += 1

    def perform_contracts(self) -> None:
        """Make all payments that are due this month, and end the contracts that have expired."""
        month = self.month
        for contract in list(self.contracts.values()):
            if contract.end is not None and month >= contract.end:
                contract.terminate()
            elif contract.is_due(month):
                contract.perform()

    def check(self) -> None:
        """Check that no cent has appeared or vanished; this takes some nanoseconds per entity.

        Raises:
            AssertionError: Money is not conserved, or an entity other than ``outside`` has a negative balance.
        """
        self.ledger.check()


class Entity:
    """An entity, which owns money and can be a party to contracts.

    Attributes:
        world: The world of the entity.
        number: Its id among the entities of its kind in this world.
        name: Its name, unique in its world.
        cents: The money that it owns, in cents. Only the ledger changes it.
        may_owe: Whether its balance may become negative.
    """

    __slots__ = ("__weakref__", "cents", "may_owe", "name", "number", "world")

    kind: ClassVar[str] = "entity"

    def __init__(self, world: World) -> None:
        """Create the entity, without money."""
        self.world = world
        self.number = world.next_id(self.kind)
        self.name = f"{self.kind}_{self.number}"
        self.cents = 0
        self.may_owe = False
        world.entities[self.name] = self

    def vanish(self, heir: Entity, reason: str = "estate") -> None:
        """Remove the entity from its world.

        Args:
            heir: The entity that gets the remaining money.
            reason: The reason under which the ledger books this payment.
        """
        if self.cents:
            self.world.ledger.move(self, heir, self.cents, reason)
        del self.world.entities[self.name]


class Ledger:
    """The ledger, which moves money between entities: each cent that one entity receives, another one has paid.

    Attributes:
        flows: The cents moved so far, by reason.

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
            source: The payer.
            target: The payee.
            cents: The amount: a non-negative integer.
            reason: The reason under which the payment is booked.

        Raises:
            Shortage: The payer does not have the amount. Nothing has changed.
            TypeError: The amount is not an integer.
            ValueError: The amount is negative.
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
        """Check that all balances sum to zero: the debt of ``outside`` equals the money of all other entities.

        Raises:
            AssertionError: The sum is not zero, or an entity has a negative balance without ``may_owe``.
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
    """Divide money in proportion to weights, by the largest remainder method: the parts sum to the whole.

    Args:
        cents: The amount to divide; not negative.
        weights: One weight for each part; not negative, not all of them 0.

    Returns:
        The parts, in cents. Each differs from its exact proportion by less than a cent. Where remainders are equal,
        the first parts get the cents.

    Raises:
        ValueError: The amount is negative, a weight is negative, or all weights are 0.

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
    """A contract: one party pays another a fixed amount at regular intervals, from a start to an end.

    Attributes:
        debtor: The party that pays.
        creditor: The party that is paid.
        cents: The amount of each payment; it may be amended at any time.
        reason: The reason under which the ledger books the payments.
        start: The month of the first payment.
        end: The first month in which the contract is no longer in force; None: it runs until it is terminated.
        every: The interval between two payments, in months.
        missed: The number of payments for which the debtor did not have the money.
        number: The contract's id in its world.
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
        """Conclude the contract. ``start=None`` means the current month; the other arguments are the attributes."""
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
        """Whether the contract has not ended yet."""
        return self.number in self.debtor.world.contracts

    def is_due(self, month: int) -> bool:
        """Tell whether a payment is due in a month, provided that the contract is in force."""
        passed = month - self.start
        return passed >= 0 and (self.every == 1 or passed % self.every == 0)

    def perform(self) -> bool:
        """Make one payment.

        Returns:
            Whether the debtor could pay.
        """
        try:
            self.debtor.world.ledger.move(self.debtor, self.creditor, self.cents, self.reason)
        except Shortage:
            self.missed += 1
            return False
        return True

    def terminate(self) -> None:
        """End the contract now; a second call does nothing."""
        self.debtor.world.contracts.pop(self.number, None)


class Request:
    """A request of one entity to another.

    Each kind of request is a subclass: ``objection`` says why the request is denied, ``carry_out`` fulfils it.

    Attributes:
        applicant: The entity that makes the request.

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
        """Return the reason for a denial; None: the request is granted. This changes nothing."""
        raise NotImplementedError

    def carry_out(self) -> None:
        """Fulfil the request, once it is granted."""
        raise NotImplementedError

    def submit(self) -> str | None:
        """Submit the request: it is granted and carried out, or denied. The world counts the outcomes.

        Returns:
            None, or the reason for the denial. A denied request has changed nothing.
        """
        reason = self.objection()
        kind = type(self).__name__
        self.applicant.world.counts[f"{kind} granted" if reason is None else f"{kind} denied: {reason}"] += 1
        if reason is None:
            self.carry_out()
        return reason


class Calendar:
    """The schedule of events by month; events of one month happen in the order in which they were scheduled.

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
        """Schedule an event.

        Args:
            month: The month of the event.
            action: The function that the event calls.
            *arguments: The arguments of the action.
        """
        heapq.heappush(self._events, (month, self._entered, action, arguments))
        self._entered += 1

    def every(self, months: int, action: Callable[[], object], *, start: int) -> None:
        """Schedule a recurring event.

        Args:
            months: The interval between two occurrences, in months.
            action: The function that the event calls.
            start: The month of the first occurrence.
        """
        self.at(start, self._recur, months, action, start)

    def _recur(self, months: int, action: Callable[[], object], month: int) -> None:
        """Run a recurring event, and schedule the next. No closure, so that copies of a world have their own events."""
        self.at(month + months, self._recur, months, action, month + months)
        action()

    def run(self, month: int) -> None:
        """Run all events that are due by this month, including those scheduled meanwhile."""
        events = self._events
        while events and events[0][0] <= month:
            _, _, action, arguments = heapq.heappop(events)
            action(*arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run random payments between entities, and check every month that money is conserved."""
    parser = argparse.ArgumentParser(description="Run random payments; check that no cent is lost.")
    parser.add_argument("--months", type=int, default=120, help="how many months to simulate (default: 120)")
    parser.add_argument("--seed", type=int, help="seed of all randomness (default: a new one each time)")
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
