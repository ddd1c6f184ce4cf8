"""The driver that runs a simulation in a greenlet: a separate stack in the user's thread."""

from __future__ import annotations

from collections.abc import Callable
from sys import modules
from typing import Final

from greenlet import GreenletExit, getcurrent, greenlet

from ...errors import WrongThreadError
from ...hooks.hook import BOUND, Hook
from ...hooks.stacks import STACKS, Interceptor
from ...plugins import Plugins
from ...simulation import RULE, Model
from .driver import ENDED, THREAD, AnyHandler, Args, Driver, Event, Kwargs
from .exits import ASYNCIO, SimulationExit, make_exit
from .loops import NO_LOOP, swap_loop


class GreenletDriver(Driver):
    """A driver that runs a simulation in a greenlet of the thread that begins the first job."""

    __slots__ = ("_body", "_leave", "_loop", "_running_loop", "_users_loop", "resume")

    def __init__(self, plugins: Plugins | None = None, earlier: Driver | None = None) -> None:
        """Prepare a greenlet."""
        super().__init__(plugins, earlier)
        self._running_loop: Callable[[], object] | None = None  # None until asyncio is imported
        self._body: greenlet | None = greenlet(self._serve)
        # Or the ``switch`` of a greenlet of the model that waits for an answer.
        self.resume = self._body.switch
        self._leave: Callable[..., Model] = _no_switch  # switches to the user
        self._loop = NO_LOOP
        self._users_loop = NO_LOOP

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
                self._loop = NO_LOOP  # each job begins without a loop
                # Not by ``Context.run``, because that takes a kilobyte of stack.
                self._body.gr_context = self._context  # type: ignore[union-attr]
                self._context = None
                self._users_loop = swap_loop(self._loop)
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

    def _resume_here(self) -> None:
        """Let the next reply go to this greenlet of the model."""
        self.resume = getcurrent().switch

    def _resume_body(self) -> None:
        """Let the next reply go to the stack itself, after a greenlet of the model has got one."""
        if self._body is not None:
            self.resume = self._body.switch

    def _decider(
        self, hook: Hook, rule: Callable[..., Model], handler: AnyHandler, away: bool
    ) -> Interceptor:
        """Make the function that sends an event for each call of a hook, and returns its value."""
        deliver = handler.deliver
        bind = hook.bind
        driver = self

        def decide(args: Args, kwargs: Kwargs) -> Model:
            bound = args
            named = kwargs
            if kwargs is not BOUND:
                call = bind(args, kwargs)
                if call is None:  # a handler has changed the arguments
                    return rule(*args, **kwargs)
                bound, named = call
            if away:
                driver._resume_here()
            running = driver._running_loop
            if running is None and ASYNCIO in modules:
                running = driver._running_loop = modules[ASYNCIO]._get_running_loop
            looped = running is not None and (
                running() is not None or driver._users_loop[0] is not None
            )
            if looped:
                driver._loop = swap_loop(driver._users_loop)
            leave = driver._leave
            try:
                reply = leave(handler, bound, named)
            except BaseException as error:
                if not driver.ended:  # else the stack unwinds by itself
                    driver._resume_body()
                    driver._enter_loop()
                    if isinstance(error, SimulationExit):
                        raise make_exit() from None
                raise
            if away:
                driver._resume_body()
            if looped or (running is not None and running() is not None):
                driver._enter_loop()
            if reply is RULE:
                return rule(*args, **kwargs) if kwargs else rule(*args)
            return reply if deliver is None else deliver(reply, *bound, **named)

        return decide

    def _enter_loop(self) -> None:
        """Switch from the user's event loop to the simulation's."""
        self._users_loop = swap_loop(self._loop)
        self._loop = NO_LOOP


def _no_switch(*event: Model) -> Event:
    raise AssertionError("there is no stack to switch to")


_given_up: Final[list[greenlet]] = []
"""The stacks that did not unwind. Freeing a greenlet would resume it, at an arbitrary moment."""
