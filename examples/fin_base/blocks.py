"""Building blocks for financial models: entities, money, contracts, requests, a calendar.

Time is an integer number of months, and money an integer number of cents. ``World.advance``
simulates one month.

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
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any, ClassVar


class Shortage(ValueError):
    """An entity does not have the money for a payment."""


class World:
    """The shared state of a model: month, ledger, calendar, entities, contracts in force."""

    def __init__(self, seed: int | None = None) -> None:
        """Make an empty world; without a seed, a new one each time."""
        self.seed = Random().getrandbits(64) if seed is None else seed
        self.month = 0
        self.counts: Counter[str] = Counter()  # how often each kind of event has happened
        self.entities: dict[str, Entity] = {}
        self.contracts: dict[int, Contract] = {}
        self._ids: Counter[str] = Counter()
        self.ledger = Ledger()
        self.calendar = Calendar()
        self.outside = Entity(self)  # the rest of the economy, where all money comes from
        self.outside.may_owe = True

    def stream(self, name: str) -> Random:
        """Make a generator for one purpose, from the world's seed and the purpose's name alone."""
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
        """Check that no cent has appeared or vanished, and that only ``outside`` owes money."""
        total = 0
        for entity in self.entities.values():
            cents = entity.cents
            if cents.__class__ is not int or (cents < 0 and not entity.may_owe):
                raise AssertionError(f"{entity.name} has {cents} cents")
            total += cents
        if total:
            raise AssertionError(f"all money should sum up to 0, and is {total} cents")


class Entity:
    """An entity, which owns money and can be a party to contracts.

    Only the ledger changes its cents.
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
        """Remove the entity from its world; the heir gets the remaining money."""
        if self.cents:
            self.world.ledger.move(self, heir, self.cents, reason)
        del self.world.entities[self.name]


class Ledger:
    """The ledger, which moves money between entities: each received cent is a paid cent.

    Attributes:
        flows: The cents moved so far, by reason.
    """

    __slots__ = ("flows",)

    def __init__(self) -> None:
        self.flows: dict[str, int] = {}

    def move(self, source: Entity, target: Entity, cents: int, reason: str) -> None:
        """Move a non-negative amount, booked under a reason.

        Raises:
            Shortage: The source does not have the amount. Nothing has changed.
        """
        if cents.__class__ is not int:
            raise TypeError(f"money is whole cents, not {cents!r}")
        if cents < 0:
            raise ValueError(f"an amount cannot be negative: {cents} ({reason})")
        if source.cents < cents and not source.may_owe:
            raise Shortage(
                f"{source.name} has {source.cents} cents and cannot pay {cents} ({reason})"
            )
        source.cents -= cents
        target.cents += cents
        flows = self.flows
        flows[reason] = flows.get(reason, 0) + cents


def share(cents: int, weights: Sequence[int]) -> list[int]:
    """Divide money in proportion to weights, by largest remainders: the parts sum to the whole."""
    total = sum(weights)
    if total <= 0 or cents < 0 or min(weights) < 0:
        raise ValueError(f"{cents} cents cannot be divided by weights that sum up to {total}")
    parts = [cents * weight // total for weight in weights]
    remainders = [cents * weight % total for weight in weights]
    order = sorted(range(len(parts)), key=lambda place: -remainders[place])
    for place in order[: cents - sum(parts)]:
        parts[place] += 1
    return parts


@dataclass(slots=True, weakref_slot=True, eq=False)
class Contract:
    """A contract: one party pays another a fixed amount at regular intervals, from start to end."""

    debtor: Entity
    creditor: Entity
    cents: int
    reason: str
    start: int = -1  # the month of the first payment; by default the current one
    end: int | None = None  # the first month in which it is no longer in force
    every: int = 1  # the months between two payments
    # the number of payments for which the debtor did not have the money
    missed: int = field(default=0, init=False)
    number: int = field(init=False)  # its id in the world

    def __post_init__(self) -> None:
        world = self.debtor.world
        if self.every < 1 or self.creditor.world is not world:
            raise ValueError(
                "a contract binds two entities of one world, every month or less often"
            )
        self.start = world.month if self.start < 0 else self.start
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
        """Make one payment; return whether the debtor could pay."""
        try:
            self.debtor.world.ledger.move(self.debtor, self.creditor, self.cents, self.reason)
        except Shortage:
            self.missed += 1
            return False
        return True

    def terminate(self) -> None:
        """End the contract now; a second call does nothing."""
        self.debtor.world.contracts.pop(self.number, None)


@dataclass
class Request:
    """A request of one entity to another.

    Each kind of request is a subclass: ``objection`` says why the request is denied, ``carry_out``
    fulfils it.
    """

    applicant: Any

    def objection(self) -> str | None:
        """Return the reason for a denial; None: the request is granted. This changes nothing."""
        raise NotImplementedError

    def carry_out(self) -> None:
        """Fulfil the request, once it is granted."""
        raise NotImplementedError

    def submit(self) -> str | None:
        """Submit the request: return the reason for its denial, or None once it is carried out.

        The world counts.
        """
        reason = self.objection()
        kind = type(self).__name__
        self.applicant.world.counts[
            f"{kind} granted" if reason is None else f"{kind} denied: {reason}"
        ] += 1
        if reason is None:
            self.carry_out()
        return reason


class Calendar:
    """The schedule of events by month.

    Events of one month happen in the order in which they were scheduled.
    """

    __slots__ = ("_entered", "_events")

    def __init__(self) -> None:
        self._entered = 0
        self._events: list[tuple[int, int, Callable[..., object], tuple[Any, ...]]] = []

    def __len__(self) -> int:
        return len(self._events)

    def at(self, month: int, action: Callable[..., object], *arguments: Any) -> None:
        """Schedule an event: the call of an action."""
        heapq.heappush(self._events, (month, self._entered, action, arguments))
        self._entered += 1

    def every(self, months: int, action: Callable[[], object], *, start: int) -> None:
        """Schedule a recurring event, every so many months from a start."""
        self.at(start, self._recur, months, action, start)

    def _recur(self, months: int, action: Callable[[], object], month: int) -> None:
        """Run a recurring event, and schedule the next.

        No closure, so that copies of a world have their own events.
        """
        self.at(month + months, self._recur, months, action, month + months)
        action()

    def run(self, month: int) -> None:
        """Run all events that are due by this month, including those scheduled meanwhile."""
        events = self._events
        while events and events[0][0] <= month:
            _, _, action, arguments = heapq.heappop(events)
            action(*arguments)
