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

from ..hooks.stacks import LOCK, STACKS, THREADS, stack_of

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


def _noting(method: Any) -> Any:
    @wraps(method)
    def note(self: Any, *args: Any, **kwargs: Any) -> None:
        driver = stack_of(getcurrent()) if STACKS else None
        if driver is not None and isinstance(self, Thread):
            for thread in [thread for thread in THREADS if thread.ident is not None and not thread.is_alive()]:
                THREADS.pop(thread, None)
            THREADS[self] = driver  # before it starts, since it may decide at once
            driver.show()
        method(self, *args, **kwargs)
        if driver is not None:
            driver.opened.append(ref(self))

    return note


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
