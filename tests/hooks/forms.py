"""Targets of handlers and points: undecorated functions of all forms."""

import asyncio
import statistics

from simenv_marl.hooks.places import resolve
from tests.foreign import market, shop
from tests.foreign.market import Broker, Cautious, Dealer, Junior, Trader

MARKET = "tests.foreign.market"
BID = f"{MARKET}.Trader.bid"

PLACES = (market, shop, Trader, Broker, Junior, Dealer, Cautious)
"""The modules and classes that are to hold after a test what they held before."""


def exhaust(generator):
    try:
        next(generator)
        generator.send(1)
    except StopIteration as stop:
        return stop.value


FORMS = {
    "method": (BID, lambda: Trader().bid("tea"), 5),
    "method of a subclass": (BID, lambda: Broker().bid("tea", limit=6), 6),
    "overridden": (BID, lambda: Cautious().bid("tea") + 1, 5),
    "inherited": (f"{MARKET}.Broker.bid", lambda: Broker().bid("tea"), 5),
    "private": (f"{MARKET}.Trader.__hidden", lambda: Trader().look(), 7),
    "static": (f"{MARKET}.Trader.rounded", lambda: Trader.rounded(2.5), 2),
    "inherited static": (f"{MARKET}.Broker.rounded", lambda: Junior().rounded(2.5), 2),
    "of a subclass": (f"{MARKET}.Trader.opening", lambda: Junior().opening(), 3),
    "of a class": (f"{MARKET}.Trader.opening", lambda: Trader.opening(), 1),
    "inherited of a class": (f"{MARKET}.Broker.opening", lambda: Junior.opening(), 3),
    "generator": (f"{MARKET}.Trader.haggle", lambda: exhaust(Trader().haggle("tea")), 51),
    "inherited generator": (f"{MARKET}.Broker.haggle", lambda: exhaust(Broker().haggle("tea")), 51),
    "coroutine": (f"{MARKET}.Trader.wire", lambda: asyncio.run(Trader().wire(8)), 8),
    "inherited coroutine": (f"{MARKET}.Broker.wire", lambda: asyncio.run(Broker().wire(8)), 8),
    "function": (f"{MARKET}.price", lambda: market.price("tea", rebate=2), 8),
    "imported by name": (f"{MARKET}.price", lambda: shop.total("tea"), 10),
    "imported under another name": (f"{MARKET}.price", lambda: shop.total_cost("tea"), 9),
    "standard library": ("statistics.mean", lambda: statistics.mean([1, 2, 3]), 2),
}
"""By form: the dotted name of a function, a call of it, and what that returns."""


def found(name, how):
    """A dotted name, or what it leads to."""
    if how == "by name":
        return name
    owner, attribute = resolve(name)
    return getattr(owner, attribute)
