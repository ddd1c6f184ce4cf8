"""The driver that runs a simulation in a greenlet: a separate stack in the user's thread."""

from __future__ import annotations

import ctypes
import mmap
import struct
from collections.abc import Callable
from contextvars import Context
from functools import cache
from platform import machine
from sys import modules, platform
from typing import Final, NoReturn

from greenlet import GreenletExit, getcurrent, greenlet

from ...errors import StepTimeoutError, WrongThreadError, warn_user
from ...hooks.hook import BOUND
from ...hooks.limits import StepAlarm
from ...hooks.locks import watch_locks
from ...hooks.stacks import STACKS, Args, Kwargs
from ...simulation import Model
from .driver import ENDED, THREAD, Driver, Event, Observer, Receiver
from .exits import SimulationExit
from .loops import NO_LOOP, swap_loop


class _Late(Observer):
    """Raises the error of a step whose time is over."""

    def __init__(self, error: StepTimeoutError) -> None:
        self._error = error

    def handle(self, episode: Receiver, args: Args, kwargs: Kwargs) -> NoReturn:
        raise self._error


class GreenletDriver(Driver):
    """A driver that runs a simulation in a greenlet of the thread that begins the first job."""

    __slots__ = ("_leave", "resume")

    # -- on the user's side -----------------------------------------------------------------------

    def _make_stack(self) -> None:
        watch_locks(self._stack)
        if self._stack is None:
            stack = greenlet(begin_stack(self._serve))
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

    def limit(self, seconds: float) -> StepAlarm:
        """Return a context that ends a step by a signal."""
        return StepAlarm(seconds)

    def throw(self) -> Event | None:
        """Raise ``SimulationExit`` in the suspended simulation; return its next event."""
        suspended: greenlet = self.resume.__self__  # type: ignore[attr-defined]
        event: Event | None = suspended.throw(SimulationExit())
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

    def interrupt(self, error: StepTimeoutError, again: bool) -> None:
        """Let the simulation wait wherever it is, and raise an error on the user's side.

        Then it unwinds. If it still does so when it is interrupted ``again``, it is given up.
        """
        if self._exiting:
            if again:
                self._leave(None)
            return
        if not self.events:  # it is reset or closed
            raise error
        hook = next(iter(self.events))  # which one makes no difference
        self._decider(hook, hook.rule, _Late(error), None, away=True)((), BOUND)

    def _serve(self) -> None:
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


# -- the begin of a stack -------------------------------------------------------------------------

# Some libraries read the native stack of their caller: torch does so for the message of each error.
# They follow return addresses to the begin of the stack. A greenlet has no begin: above it lies the
# stack of its starter, which has changed since, and reading that kills the process. So the stack of
# a simulation begins with a function in machine code, for which no unwind table exists. There
# native stack traces end.

_CODES: Final = {
    # endbr64; push rbp; xor ebp, ebp; mov rax, ADDRESS; call rax; pop rbp; ret
    "x86_64": ("f3 0f 1e fa 55 31 ed 48 b8", "ff d0 5d c3"),
}
"""By processor: the code before and after the address of a function.

It calls that function with its own first argument, and returns the result.
"""

_METH_O: Final = 0x0008  # a method of one argument


_MAKE: Final = ctypes.PYFUNCTYPE(
    ctypes.py_object, ctypes.c_void_p, ctypes.py_object, ctypes.c_void_p
)(("PyCFunction_NewEx", ctypes.pythonapi))
"""Makes a function from a ``PyMethodDef``, its ``self`` and its module."""


class _MethodDef(ctypes.Structure):
    """A ``PyMethodDef``, as C functions of Python are declared."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("function", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    )


_TRACERS: Final = ("torch",)
"""Libraries that read the native stack at each error."""


@cache
def _definition() -> _MethodDef | None:
    """Return a method that calls its ``self``. None on systems where it cannot be made."""
    code = _CODES.get(machine()) if platform == "linux" else None
    if code is None:
        return None
    call = ctypes.cast(ctypes.pythonapi.PyObject_CallNoArgs, ctypes.c_void_p).value
    memory = mmap.mmap(-1, mmap.PAGESIZE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    memory.write(bytes.fromhex(code[0]) + struct.pack("<Q", call) + bytes.fromhex(code[1]))
    page = ctypes.c_char.from_buffer(memory)
    address = ctypes.addressof(page)
    refused = ctypes.CDLL(None).mprotect(
        ctypes.c_void_p(address), ctypes.c_size_t(mmap.PAGESIZE), mmap.PROT_READ | mmap.PROT_EXEC
    )
    if refused:  # the system is hardened
        return None
    _PAGES.append(page)
    return _MethodDef(b"begin", address, _METH_O, None)


_PAGES: Final[list[ctypes.c_char]] = []
"""The page of the code, which must stay."""


def begin_stack(function: Callable[[], Model]) -> Callable[..., Model]:
    """Return a function of one ignored argument that begins a stack, and calls a function there.

    Where that is not possible, the result is a plain function. Then the user is warned of libraries
    that read native stacks.
    """
    definition = _definition()
    if definition is None:
        warn_of_native_traces()
        return lambda _: function()
    made: Callable[..., Model] = _MAKE(ctypes.addressof(definition), function, None)
    return made


def traced_by() -> list[str]:
    """Return the imported libraries whose errors would kill the process in a greenlet here."""
    return [] if _definition() else [name for name in _TRACERS if name in modules]


@cache
def warn_of_native_traces() -> None:
    """Warn once of imported libraries that read native stacks."""
    if names := traced_by():
        warn_user(
            f"on this system an error of {', '.join(names)} inside the model kills the process"
            ' with the greenlet driver, also an error that the model handles; use driver="thread"'
        )
