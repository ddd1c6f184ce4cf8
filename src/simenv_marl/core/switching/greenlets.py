"""The driver that runs a simulation in a greenlet: a separate stack in the user's thread."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import Context
from typing import Final

from greenlet import GreenletExit, getcurrent, greenlet

from ...errors import WrongThreadError
from ...hooks.stacks import STACKS
from ...plugins import Plugins
from ...simulation import Model
from .driver import ENDED, THREAD, Driver, Event
from .exits import SimulationExit
from .loops import NO_LOOP, swap_loop


class GreenletDriver(Driver):
    """A driver that runs a simulation in a greenlet of the thread that begins the first job."""

    __slots__ = ("_body", "_leave", "resume")

    def __init__(self, plugins: Plugins | None = None, earlier: Driver | None = None) -> None:
        """Prepare a greenlet."""
        super().__init__(plugins, earlier)
        self._body: greenlet | None = greenlet(self._serve)
        # Or the ``switch`` of a greenlet of the model that waits for an answer.
        self.resume = self._body.switch
        self._leave: Callable[..., Model] = _no_switch  # switches to the user

    # -- on the user's side -----------------------------------------------------------------------

    def enter(self, *, direct: bool = True) -> None:
        """Prepare to resume the simulation from the current greenlet."""
        body = self._body
        if body is None or self._home() is not THREAD.token:
            raise WrongThreadError(
                "the simulation is suspended in another thread, the one that called reset(); step,"
                " reset and close the environment there, or make it with"
                ' driver="thread", which allows any thread'
            )
        here = getcurrent()
        self._leave = here.switch
        body.parent = here  # control returns here when the stack ends
        # Inside another environment's simulation each step needs ``enter``, to hide that one.
        self.caller = here if direct and here not in STACKS else None

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return its next event."""
        suspended: greenlet = self.resume.__self__  # type: ignore[attr-defined]
        event: Event = suspended.throw(SimulationExit())
        return event

    def end(self) -> None:
        """End the stack. That of a job that did not unwind is left suspended."""
        self._forget_stack()
        body, self._body = self._body, None
        self.caller = None
        if body is None:
            return
        self._leave = _no_switch
        self.resume = _no_switch
        if self.given_up is not None:
            _given_up.append(body)
        elif self.idle and body and self.reachable:
            body.parent = getcurrent()
            body.throw()

    # -- on the simulation's side -----------------------------------------------------------------

    def _serve(self, _: Model) -> None:
        try:
            self._register()
            while not self.ended:
                # Not by ``Context.run``, because that takes a kilobyte of stack.
                self._body.gr_context = self._context  # type: ignore[union-attr]
                self._context = Context()
                self._loop = NO_LOOP  # each job begins without a loop
                self._enter_loop()
                try:
                    self._work()
                finally:
                    if not self.ended:  # else the stack unwinds by itself
                        swap_loop(self._users_loop)
                if not self.ended:
                    self._body.gr_context = None  # type: ignore[union-attr]
                    self.idle = True
                    self._leave(*ENDED)
        except GreenletExit:
            pass
        finally:
            self._forget_stack()

    def _reply_to(self, receiver: greenlet | None) -> None:
        """Let the next reply go to a greenlet of the model. None: to the stack itself."""
        receiver = receiver or self._body
        if receiver is not None:
            self.resume = receiver.switch


def _no_switch(*event: Model) -> Event:
    raise AssertionError("there is no stack to switch to")


_given_up: Final[list[greenlet]] = []
"""The stacks that did not unwind. Freeing a greenlet would resume it, at an arbitrary moment."""
