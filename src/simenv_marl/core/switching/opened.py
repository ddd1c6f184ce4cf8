"""What simulations open: threads, sockets and processes, which two processes cannot share."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial, wraps
from itertools import starmap
from multiprocessing.process import BaseProcess
from socket import socket
from subprocess import Popen
from threading import Thread
from typing import Final

from greenlet import getcurrent

from ...hooks.stacks import LOCK, STACKS, stack_of

Resource = BaseProcess | Popen[bytes] | Thread | socket

_OPENERS: Final = (
    (Thread, "start"),
    (socket, "__init__"),
    (Popen, "__init__"),
    (BaseProcess, "start"),
)
"""The methods that open something."""

_UNDO: Final[list[Callable[[], None]]] = []
"""The functions that restore the patched methods. Empty while there are no simulations."""


def _epolls() -> set[int]:
    """Return the descriptors of the epoll objects of this process."""
    numbers: set[int] = set()
    with suppress(OSError):  # only Linux has this folder
        for name in os.listdir("/proc/self/fd"):
            with suppress(OSError):  # it was closed meanwhile
                if os.readlink(f"/proc/self/fd/{name}") == "anon_inode:[eventpoll]":
                    numbers.add(int(name))
    return numbers


_EPOLLS_BEFORE: Final = _epolls()
"""The descriptors of the epoll objects that the process had when this module was imported."""


def new_epolls() -> set[int]:
    """Return the descriptors of the epoll objects that the process has made since then."""
    return _epolls() - _EPOLLS_BEFORE


def watch_resources() -> None:
    """Note the resources that simulations open, while there are simulations."""
    if bool(STACKS) == bool(_UNDO):
        return
    with LOCK:
        if not _UNDO:
            _UNDO.extend(starmap(_patch, _OPENERS))
        while _UNDO and not STACKS:
            _UNDO.pop()()


def _patch(owner: type, name: str) -> Callable[[], None]:
    """Let a method note what simulations open by it. Return the function that restores it."""
    method: Callable[..., None] = vars(owner)[name]

    @wraps(method)
    def note(self: Resource, *args: object, **kwargs: object) -> None:
        driver = stack_of(getcurrent()) if STACKS else None
        if driver is not None:
            driver.note_opened(self)
            if isinstance(self, Thread):
                self.run = partial(_run_registered, driver, self.run)  # type: ignore[method-assign]
        method(self, *args, **kwargs)

    def restore() -> None:
        if vars(owner)[name] is note:  # else other code replaced it, and may still call it
            setattr(owner, name, method)

    setattr(owner, name, note)
    return restore


def _run_registered(driver: object, run: Callable[[], None]) -> None:
    """Run a thread that a simulation has started, as a stack of that simulation's driver."""
    # ``getcurrent()`` is in no variable, because tracebacks keep variables, and greenlets crash
    # where the root of a thread outlives the thread.
    STACKS[getcurrent()] = driver
    try:
        run()
    finally:
        STACKS.pop(getcurrent(), None)
