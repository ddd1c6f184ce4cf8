"""The threads that simulations start, in which decisions are refused: the simulation itself goes on meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from threading import Thread, get_ident
from typing import TYPE_CHECKING, Any

from greenlet import getcurrent, greenlet

from ..hooks.hook import Hook
from ..hooks.stacks import LOCK, STACKS, Taker, stack_of
from .forking import note_what_is_open

if TYPE_CHECKING:
    from .switch import BaseDriver


class ChildThreads:
    """The threads that one simulation has started, over all its episodes.

    Attributes:
        driver: The simulation's; None once its stack has ended, when decision functions run their rule.
    """

    __slots__ = ("driver",)

    def __init__(self) -> None:
        self.driver: BaseDriver | None = None

    def running(self) -> int:
        """How many of them are running."""
        return sum(isinstance(thread, ChildThread) and thread.children is self for thread in STACKS.values())


class ChildThread:
    """Stands in ``STACKS`` for a thread that a simulation has started: decisions are refused there."""

    plugins: Any = None

    def __init__(self, children: ChildThreads) -> None:
        self.children = children
        self._thread = get_ident()

    def taker(self, hook: Hook, here: greenlet) -> Taker | None:
        """What refuses a decision that the environment would have to make."""
        return self.refusal_of(hook, "a thread that the simulation has started")

    def refusal_of(self, hook: Hook, where: str) -> Taker | None:
        """The same, wherever it is asked for."""
        driver = self.children.driver
        return None if driver is None else driver.refusal_of(hook, where)

    def hide(self) -> None:
        """There is nothing to hide: it is entered in no hook."""

    show = forked_worker = hide

    def decides(self, hook: Hook) -> bool:
        """Nothing is decided there."""
        return False

    def forked(self) -> None:
        """The process was forked, and this is the child, in which only one thread is left."""
        if self._thread != get_ident():
            for stack in [stack for stack, thread in STACKS.items() if thread is self]:
                del STACKS[stack]


_start: Any = Thread.start
_watching = False


@wraps(Thread.start)
def _watched_start(self: Thread) -> None:
    stack = stack_of(getcurrent()) if STACKS else None
    if stack is None:
        _start(self)
        return
    disown = _adopt(self, stack.children)
    try:
        _start(self)
    except BaseException:
        disown()
        raise


def watch_threads() -> None:
    """Find out, until ``unwatch_threads``, which threads are started by simulations.

    Threads do not know by whom they were started, and inherit nothing that would tell.
    """
    global _start, _watching
    with LOCK:
        if not _watching:
            note_what_is_open()
            _start, Thread.start = Thread.start, _watched_start  # type: ignore[method-assign]
            _watching = True


def unwatch_threads() -> None:
    """Undo it if there are no simulations any more, unless something else has been set meanwhile."""
    global _watching
    if STACKS:
        return
    with LOCK:
        if not STACKS and Thread.start is _watched_start:  # else what has been set meanwhile may well call it
            Thread.start, _watching = _start, False  # type: ignore[method-assign]


def _adopt(thread: Thread, children: ChildThreads) -> Callable[[], None]:
    """Enter a thread that is about to be started as one of a simulation's. Returns what undoes that."""
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
