"""Switching between a simulation's stack and its user's: who runs, and nothing else.

A driver has three moves. On the user's side ``resume`` hands a reply to the simulation and returns what
the simulation says next; ``throw`` raises ``SimulationExit`` in it instead. On the simulation's side
``suspend`` says something to the user and returns the reply. What is said is the episode's business.

While a simulation runs, ``RUNNING`` holds for its thread the function that decision functions ask. It is
empty whenever no simulation runs behind an environment, so that a decision function which is called
outside any environment finds that out by one test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import copy_context
from threading import get_ident
from typing import Any, Protocol

from greenlet import getcurrent, greenlet

from .errors import WrongThreadError

Ask = Callable[[Any, tuple[Any, ...], dict[str, Any]], Any]
"""Decides a call of a decision point: of the point, and of the call's arguments."""

RUNNING: dict[int, Ask] = {}
"""By thread: whom decision functions ask there. Touched by drivers and ``unattended`` alone."""


class SimulationExit(BaseException):
    """Raised in a suspended simulation to unwind it. Neither an error nor anything to be caught."""


class Driver(Protocol):
    """What an episode needs of a driver."""

    def resume(self, reply: Any) -> Any:
        """Let the simulation go on with a reply; return what it says next."""

    def suspend(self, event: Any) -> Any:
        """In the simulation: say something to the user, wait, and return the reply."""

    def throw(self) -> Any:
        """Raise ``SimulationExit`` in the suspended simulation; return what it says next."""

    def reachable(self) -> bool:
        """Whether the simulation can be resumed from here."""

    def forget(self) -> None:
        """Let go of all references into the episode."""


class GreenletDriver:
    """Runs a simulation on a greenlet of the thread in which it is first resumed."""

    __slots__ = ("_ask", "_body", "_caller", "_inside", "_switch_in", "_switch_out", "_thread")

    def __init__(self, body: Callable[[Any], Any], ask: Ask) -> None:
        """Prepare a greenlet.

        Args:
            body: The simulation's side, called with the first reply; what it returns is the last thing that ``resume`` returns.
            ask: What decision functions ask while the simulation runs.
        """
        self._body = greenlet(body)
        # A new greenlet has an empty context; a model expects the one that its user has set up.
        self._body.gr_context = copy_context()
        self._inside = self._body
        self._switch_in = self._body.switch
        self._ask = ask
        self._caller: Any = getcurrent()
        self._switch_out = self._caller.switch
        self._thread = get_ident()

    def resume(self, reply: Any) -> Any:
        """Let the simulation go on with a reply; return what it says next."""
        if getcurrent() is not self._caller:
            self._called_from_elsewhere()
        thread = self._thread
        RUNNING[thread] = self._ask
        try:
            return self._switch_in(reply)
        finally:
            del RUNNING[thread]

    def throw(self) -> Any:
        """Raise ``SimulationExit`` in the suspended simulation; return what it says next."""
        if getcurrent() is not self._caller:
            self._called_from_elsewhere()
        thread = self._thread
        RUNNING[thread] = self._ask
        try:
            return self._inside.throw(SimulationExit())
        finally:
            del RUNNING[thread]

    def suspend(self, event: Any) -> Any:
        """In the simulation: say something to the user, wait, and return the reply."""
        current = getcurrent()
        if current is not self._inside:
            # The model switches stacks of its own: come back to the one that has asked.
            self._inside = current
            self._switch_in = current.switch
        return self._switch_out(event)

    def reachable(self) -> bool:
        """Whether the simulation can be resumed from here."""
        return self._thread == get_ident()

    def forget(self) -> None:
        """Let go of all references into the episode."""
        del self._ask, self._body, self._caller, self._inside, self._switch_in, self._switch_out

    def _called_from_elsewhere(self) -> None:
        if not self.reachable():
            raise WrongThreadError(
                "a simulation on a greenlet can only be stepped from the thread that has reset it;"
                " step it there, or reset it here"
            )
        self._caller = getcurrent()
        self._switch_out = self._caller.switch
        self._body.parent = self._caller  # where the simulation's end arrives


@contextmanager
def unattended() -> Iterator[None]:
    """Let decision functions run their rule in this thread, whatever simulation runs around us."""
    thread = get_ident()
    outer = RUNNING.pop(thread, None)
    try:
        yield
    finally:
        if outer is not None:
            RUNNING[thread] = outer
