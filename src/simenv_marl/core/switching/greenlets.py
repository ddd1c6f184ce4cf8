"""The driver that runs a simulation in a greenlet: a separate stack in the user's thread."""

from __future__ import annotations

from contextvars import Context
from typing import Final

from greenlet import GreenletExit, getcurrent, greenlet

from ...errors import WrongThreadError
from ...hooks.stacks import STACKS
from ...simulation import Model
from .driver import ENDED, THREAD, Driver, Event
from .exits import SimulationExit
from .loops import NO_LOOP, swap_loop


class GreenletDriver(Driver):
    """A driver that runs a simulation in a greenlet of the thread that begins the first job."""

    __slots__ = ("_leave", "resume")

    # -- on the user's side -----------------------------------------------------------------------

    def _make_stack(self) -> None:
        if self._stack is None:
            stack = greenlet(self._serve)
            # Or the ``switch`` of a greenlet of the model that waits for an answer.
            self.resume = stack.switch
            self._stack = stack  # last, because an interrupt may come before

    def enter(self, *, direct: bool = True) -> None:
        """Prepare to resume the simulation from the current greenlet."""
        if self._home() is not THREAD.token:
            raise WrongThreadError(
                "the simulation is suspended in another thread, the one that called reset(); step,"
                " reset and close the environment there, or make it with"
                ' driver="thread", which allows any thread'
            )
        here = getcurrent()
        self._leave = here.switch
        stack = self._stack
        if stack is not None:
            stack.parent = here  # control returns here when the stack ends
        # Inside another environment's simulation each step needs ``enter``, to hide that one.
        self.caller = here if direct and here not in STACKS else None

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return its next event."""
        suspended: greenlet = self.resume.__self__  # type: ignore[attr-defined]
        event: Event = suspended.throw(SimulationExit())
        return event

    def end(self) -> None:
        """End the stack. That of a job that did not unwind is left suspended."""
        stack = self._stack
        self._forget_stack()
        self.caller = None
        self._leave = _no_switch
        self.resume = _no_switch
        if not stack:  # it has not begun, or has ended
            return
        if self.given_up is not None:
            _given_up.append(stack)
        elif self.idle and self.reachable:
            stack.parent = getcurrent()
            stack.throw()

    # -- on the simulation's side -----------------------------------------------------------------

    def _serve(self, _: Model) -> None:
        try:
            self._register()
            while not self.ended:
                # Not by ``Context.run``, because that takes a kilobyte of stack.
                self._stack.gr_context = self._context  # type: ignore[union-attr]
                self._context = Context()
                self._loop = NO_LOOP  # each job begins without a loop
                self._enter_loop()
                try:
                    self._work()
                finally:
                    if not self.ended:  # else the stack unwinds by itself
                        swap_loop(self._users_loop)
                if not self.ended:
                    self._stack.gr_context = None  # type: ignore[union-attr]
                    self.idle = True
                    self._leave(*ENDED)
        except GreenletExit:
            pass
        finally:
            self._forget_stack()

    def _reply_to(self, receiver: greenlet | None) -> None:
        """Let the next reply go to a greenlet of the model. None: to the stack itself."""
        receiver = receiver or self._stack
        if receiver is not None:
            self.resume = receiver.switch


def _no_switch(*event: Model) -> Event:
    raise AssertionError("there is no stack to switch to")


_given_up: Final[list[greenlet]] = []
"""The stacks that did not unwind. Freeing a greenlet would resume it, at an arbitrary moment."""
