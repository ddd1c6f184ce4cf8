"""The threads, processes and sockets that simulations open.

A decision in a thread that the simulation started is refused, because the simulation itself runs on meanwhile. None of
these things continue to work in a forked process.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from multiprocessing.process import BaseProcess
from socket import socket
from subprocess import Popen
from threading import Thread, get_ident
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakSet

from greenlet import getcurrent, greenlet

from ..hooks.hook import Hook
from ..hooks.stacks import LOCK, STACKS, Taker, stack_of

if TYPE_CHECKING:
    from .switch import BaseDriver


class Children:
    """The threads, processes and sockets that one simulation has opened, over all its episodes.

    Attributes:
        driver: The simulation's driver. None once its stack has ended; from then on decision functions run their rule.
    """

    __slots__ = ("_opened", "driver")

    def __init__(self, driver: BaseDriver | None) -> None:
        self.driver = driver
        self._opened: WeakSet[Any] = WeakSet()

    def note(self, thing: Any) -> None:
        """Note a thing that the simulation has opened."""
        self._opened.add(thing)

    def alive(self) -> dict[Any, str]:
        """Describe each thing that is still alive or open, in a few words. The keys of sockets are descriptors."""
        found: dict[Any, str] = {}
        for thread in STACKS.values():
            if isinstance(thread, ChildThread) and thread.children is self:
                found[thread] = "a thread"
        for thing in list(self._opened):
            if isinstance(thing, socket):
                if thing.fileno() >= 0:
                    found[thing.fileno()] = f"a socket (descriptor {thing.fileno()})"
            elif (thing.returncode if isinstance(thing, Popen) else thing.exitcode) is None:
                found[thing] = f"a child process ({thing.pid})"
        return found


class ChildThread:
    """The entry in ``STACKS`` for a thread that a simulation started. Decisions are refused there."""

    plugins: Any = None

    def __init__(self, children: Children) -> None:
        self.children = children
        self._thread = get_ident()

    def taker(self, hook: Hook, here: greenlet) -> Taker | None:
        """The function that refuses a call which the environment would have to decide; None for other calls."""
        return self.refusal_of(hook, "a thread that the simulation has started")

    def refusal_of(self, hook: Hook, where: str) -> Taker | None:
        """The same, with a description of the place of the call for the error message."""
        driver = self.children.driver
        return None if driver is None else driver.refusal_of(hook, where)

    def hide(self) -> None:
        """Do nothing: no hook has an entry for this thread."""

    show = forked_worker = hide

    def decides(self, hook: Hook) -> bool:
        """Return False: nothing is decided in this thread."""
        return False

    def forked(self) -> None:
        """Remove the entries of a thread that does not exist in this process, the child of a fork."""
        if self._thread != get_ident():
            for stack in [stack for stack, thread in STACKS.items() if thread is self]:
                del STACKS[stack]


def _starting(start: Any) -> Any:
    @wraps(start)
    def watched(self: Thread) -> None:
        stack = stack_of(getcurrent()) if STACKS else None
        if stack is None:
            start(self)
            return
        disown = _adopt(self, stack.children)
        try:
            start(self)
        except BaseException:
            disown()
            raise

    return watched


def _opening(open_it: Any) -> Any:
    @wraps(open_it)
    def watched(self: Any, *args: Any, **kwargs: Any) -> None:
        open_it(self, *args, **kwargs)
        stack = stack_of(getcurrent()) if STACKS else None
        if stack is not None:
            stack.children.note(self)

    return watched


class _Watch:
    """A patch of a method of a class that notes, while there are simulations, what they open."""

    def __init__(self, owner: type, name: str, watching: Callable[[Any], Any]) -> None:
        self._owner, self._name, self._watching = owner, name, watching
        self._before: Any = None
        self._set: Any = None

    def set(self) -> None:
        """Set the patch, unless it is set."""
        if self._set is None:
            self._before = vars(self._owner)[self._name]
            self._set = self._watching(self._before)
            setattr(self._owner, self._name, self._set)

    def put_back(self) -> None:
        """Restore the method, unless other code has replaced the patch meanwhile, and may still call it."""
        if self._set is not None and vars(self._owner)[self._name] is self._set:
            setattr(self._owner, self._name, self._before)
            self._before = self._set = None


_WATCHES: Final = (
    _Watch(Thread, "start", _starting),
    _Watch(socket, "__init__", _opening),
    _Watch(Popen, "__init__", _opening),
    _Watch(BaseProcess, "start", _opening),
)


def watch() -> None:
    """Note what simulations start and open, until ``unwatch``.

    This takes patches, because a thread does not know which thread started it.
    """
    with LOCK:
        for watched in _WATCHES:
            watched.set()


def unwatch() -> None:
    """Remove the patches if there are no simulations any more."""
    if STACKS:
        return
    with LOCK:
        if not STACKS:
            for watched in _WATCHES:
                watched.put_back()


def _adopt(thread: Thread, children: Children) -> Callable[[], None]:
    """Register a thread that is about to start as one of a simulation's. Return the function that undoes this."""
    run, own = thread.run, vars(thread).get("run")

    def adopted() -> None:
        disown()
        stack = getcurrent()
        STACKS[stack] = ChildThread(children)
        try:
            run()
        finally:
            STACKS.pop(stack, None)

    def disown() -> None:
        if vars(thread).get("run") is adopted:
            del thread.run
            if own is not None:
                thread.run = own  # type: ignore[method-assign]

    thread.run = adopted  # type: ignore[method-assign]
    return disown
