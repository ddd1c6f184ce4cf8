"""The driver that runs a simulation in a greenlet: a separate stack in the user's thread."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from sys import modules
from typing import Any, Final

from greenlet import GreenletExit, getcurrent, greenlet

from ..errors import WrongThreadError
from ..hooks.hook import BOUND, Hook
from ..hooks.stacks import STACKS, Interceptor
from ..simulation import RULE
from .driver import THREAD, Driver, Event, LoopExit, SimulationExit, is_exit


class GreenletDriver(Driver):
    """A driver that runs a simulation in a greenlet of the thread that begins the first job."""

    __slots__ = ("_body", "_leave", "_loop", "_running_loop", "_users_loop", "resume")

    def __init__(self, plugins: Any = None) -> None:
        """Prepare a greenlet."""
        super().__init__(plugins)
        # until it is known that asyncio is imported
        self._running_loop: Callable[[], Any] | None = None
        self._body: Any = greenlet(self._serve)
        self._leave: Any = None
        # or the ``switch`` of a greenlet of the model that waits for an answer
        self.resume: Any = self._body.switch

    # -- on the user's side -----------------------------------------------------------------------

    def enter(self) -> None:
        """Prepare to resume the simulation from the current greenlet."""
        if self._body is None or self._home() is not THREAD.identity:
            raise WrongThreadError(
                "the simulation is suspended in another thread, the one that called reset(); step,"
                " reset and close the"
                ' environment there, or make it with driver="thread", which allows any thread'
            )
        here = getcurrent()
        # control returns here when the stack ends
        self._leave, self._body.parent = here.switch, here
        # Each step needs ``enter`` where there are plugins, and inside another environment's
        # simulation, to hide that.
        self.caller = None if self.plugins is not None or here in STACKS else here

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return its next event."""
        event: Event = self.resume.__self__.throw(SimulationExit())
        return event

    def end(self) -> None:
        """End the stack. That of a job that did not unwind is left suspended."""
        self._forget_stack()
        body, self._body = self._body, None
        self._leave = self.caller = self.resume = None
        if self.given_up is not None and body is not None:
            _given_up.append(body)
        elif self.idle and body and self.reachable:
            body.parent = getcurrent()
            body.throw()

    # -- on the simulation's side -----------------------------------------------------------------

    def _serve(self, _: Any) -> None:
        try:
            self._register()
            while not self.ended:
                self._loop = _NO_LOOP  # each job begins without a loop
                # ``Context.run`` takes a kilobyte of stack
                self._body.gr_context, self._context = self._context, None
                self._enter_loop()
                try:
                    event = self._work()
                finally:
                    if not self.ended:  # once the driver has ended, the stack unwinds by itself
                        _swap_loop(self._users_loop)
                if not self.ended:
                    self._body.gr_context, self.idle = None, True
                    self._leave(*event)
        except GreenletExit:
            pass
        finally:
            self._forget_stack()

    def _decider(self, hook: Hook, rule: Any, event: Any, away: bool) -> Interceptor:
        """Make the function that sends an event for the calls of a hook, and carries out the replies."""
        deliver, bind, driver = event.deliver, hook.bind, self

        def decide(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            bound, named = args, kwargs
            if kwargs is not BOUND:
                call = bind(args, kwargs)
                if call is None:  # a handler has changed the arguments
                    return rule(*args, **kwargs)
                bound, named = call
            if away:
                driver.resume = getcurrent().switch
            leave, running = driver._leave, driver._running_loop
            if running is None and _ASYNCIO in modules:
                running = driver._running_loop = modules[_ASYNCIO]._get_running_loop
            looped = running is not None and (
                running() is not None or driver._users_loop[0] is not None
            )
            if looped:
                driver._loop = _swap_loop(driver._users_loop)
            try:
                reply = leave(event, bound, named)
            except BaseException as error:
                if not driver.ended:  # once the driver has ended, the stack unwinds by itself
                    driver.resume = driver._body.switch
                    driver._enter_loop()
                    if isinstance(error, SimulationExit):
                        raise make_exit() from None
                raise
            if away:
                driver.resume = driver._body.switch
            if looped or (running is not None and running() is not None):
                driver._enter_loop()
            if reply is RULE:
                return rule(*args, **kwargs) if kwargs else rule(*args)
            return reply if deliver is None else deliver(reply, *bound, **named)

        return decide

    def _enter_loop(self) -> None:
        """Switch from the user's event loop to the simulation's, which share a thread."""
        self._users_loop, self._loop = _swap_loop(self._loop), _NO_LOOP


_given_up: Final[list[greenlet]] = []
"""The stacks of simulations that did not unwind.

Freeing a greenlet would resume it, at an arbitrary moment.
"""

_ASYNCIO: Final = "asyncio.events"
"""The module that knows a thread's running event loop, whatever its stack.

If it is not imported, no loop runs.
"""

_NO_LOOP: Final[Any] = (None, (None, None), 0)
"""The state of a thread without a loop: the loop, the hooks of asynchronous generators, and the depth of tracking."""


def _swap_loop(state: Any) -> Any:
    """Return the thread's state, and replace it if one of the two has a loop."""
    events: Any = modules.get(_ASYNCIO)
    loop = None if events is None else events._get_running_loop()
    present = loop, sys.get_asyncgen_hooks(), sys.get_coroutine_origin_tracking_depth()
    if loop is not None or state[0] is not None:
        loop, hooks, depth = state
        events._set_running_loop(loop)
        sys.set_asyncgen_hooks(*hooks)
        sys.set_coroutine_origin_tracking_depth(depth)
    return present


def make_exit() -> SimulationExit:
    """Return the exit to raise here. The loop here will not report it, because no code awaits its tasks any more.

    A ``LoopExit`` ends a loop at once. But where asyncio closes its loop already, it must go on to
    the other tasks.
    """
    hub: Any = getcurrent()
    while hub is not None and hub not in STACKS and not hasattr(hub, "NOT_ERROR"):
        hub = hub.parent
    if hasattr(hub, "NOT_ERROR"):  # of gevent, which has spawned this greenlet
        hub.NOT_ERROR = (*{*hub.NOT_ERROR, SimulationExit},)  # all others are printed
        return LoopExit()
    loop = modules[_ASYNCIO]._get_running_loop() if _ASYNCIO in modules else None
    if loop is None:
        return SimulationExit()
    before = loop.get_exception_handler()
    if not isinstance(before, partial):  # else it was silenced in an earlier episode
        loop.set_exception_handler(
            partial(_report_task, before or type(loop).default_exception_handler)
        )
    frame: Any = sys._getframe()
    while frame is not None and frame.f_code is not modules["asyncio"].Runner.close.__code__:
        frame = frame.f_back
    return LoopExit() if frame is None else SimulationExit()


def _report_task(report: Callable[..., Any], loop: Any, context: dict[str, Any]) -> None:
    """Handle an exception of a loop, unless its task was unwound, or left over when the loop was closed."""
    error = context.get("exception")
    if not is_exit(error) and (error is not None or not loop.is_closed()):
        report(loop, context)
