"""The threads, processes and sockets that simulations open.

A decision in a thread that the simulation started is refused, because the simulation itself runs on meanwhile. None of
these things work on in a forked process. They are noted by patches that are in place only while simulations live:
Python has no event for the start of a thread, and its audit hooks cannot be removed.
"""

from __future__ import annotations

from functools import wraps
from multiprocessing.process import BaseProcess
from socket import socket
from subprocess import Popen
from threading import Thread
from typing import Any, Final
from weakref import ref

from greenlet import getcurrent

from ..hooks.stacks import LOCK, STACKS, stack_of

_METHODS: Final = ((Thread, "start"), (socket, "__init__"), (Popen, "__init__"), (BaseProcess, "start"))

_PATCHES: Final[dict[tuple[type, str], tuple[Any, Any]]] = {}
"""The patched methods: what was there before, and the patch."""


def watch_resources(on: bool) -> None:
    """Note what simulations open from now on, or stop noting it."""
    if on and _PATCHES:
        return
    with LOCK:
        for owner, name in _METHODS:
            if on and (owner, name) not in _PATCHES:
                before = vars(owner)[name]
                _PATCHES[owner, name] = before, _noting(before)
                setattr(owner, name, _PATCHES[owner, name][1])
            elif not on and not STACKS and (owner, name) in _PATCHES:
                before, patch = _PATCHES[owner, name]
                if vars(owner)[name] is patch:  # else other code has replaced the patch, and may still call it
                    setattr(owner, name, before)
                    del _PATCHES[owner, name]


class StartedThread:
    """The entry in ``STACKS`` for a thread that a simulation has started. Decisions are refused there."""

    plugins = None
    own_thread = True
    where = "a thread that the simulation has started"

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def interceptor(self, hook: Any) -> Any:
        """Return the interceptor that refuses a decision; None for other calls, and after the simulation's end."""
        if not self.driver.decides(hook):
            return None
        return self.driver.refuse(hook, self.where)

    def hide(self) -> None:
        """Do nothing: no hook has an entry for this thread."""

    show = hide

    def refuse_all(self, where: str) -> None:
        """Refuse decisions in this process, which the thread has forked."""
        self.where = where


def _noting(method: Any) -> Any:
    @wraps(method)
    def note(self: Any, *args: Any, **kwargs: Any) -> None:
        stack = stack_of(getcurrent()) if STACKS else None
        if stack is None:
            method(self, *args, **kwargs)
            return
        driver = stack.driver if isinstance(stack, StartedThread) else stack
        if isinstance(self, Thread):
            self.run = _registered(self.run, driver)  # type: ignore[method-assign]
            driver.has_started_threads = True
            driver.show()
        method(self, *args, **kwargs)
        driver.opened.append(ref(self))

    return note


def _registered(run: Any, driver: Any) -> Any:
    """Wrap the ``run`` of a thread to register the thread while it runs."""

    def registered() -> None:
        here = getcurrent()
        STACKS[here] = StartedThread(driver)
        try:
            run()
        finally:
            STACKS.pop(here, None)

    return registered


def open_resources(opened: list[Any]) -> dict[Any, str]:
    """Describe each thing that is still alive or open, in a few words.

    Args:
        opened: Weak references to what a simulation has opened. Those of things that are gone are removed.

    Returns:
        The descriptions, by thing; by descriptor for sockets.
    """
    found: dict[Any, str] = {}
    opened[:] = [reference for reference in opened if reference() is not None]
    for reference in opened:
        thing = reference()
        if isinstance(thing, socket):
            if thing.fileno() >= 0:
                found[thing.fileno()] = f"a socket (descriptor {thing.fileno()})"
        elif isinstance(thing, Thread):
            if thing.is_alive():
                found[thing] = "a thread"
        elif thing is not None and (thing.returncode if isinstance(thing, Popen) else thing.exitcode) is None:
            found[thing] = f"a child process ({thing.pid})"
    return found
