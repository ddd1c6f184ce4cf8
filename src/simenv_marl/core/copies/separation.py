"""How a forked process is separated from its parent, so that it continues as the parent would.

``fork`` copies the memory, but parent and child share the offsets and contents of open files, and
the sockets of event loops. And Python reseeds its global generator in the child.
"""

from __future__ import annotations

import gc
import os
import random
import re
import shutil
import socket
import stat
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from mmap import mmap
from pathlib import Path
from selectors import BaseSelector
from subprocess import Popen
from threading import Thread
from typing import Any, Final, Protocol

import numpy as np

from ...errors import BranchError
from ..episodes.episode import Episode
from ..switching.awaiting import LOOPS
from ..switching.generators import find_objects
from ..switching.opened import new_epolls
from .forks import CAN_FORK, limited

if CAN_FORK:
    import fcntl

_DESCRIPTORS: Final = "/proc/self/fd"

_FLAGS: Final = os.O_WRONLY | os.O_RDWR | os.O_APPEND
"""The flags with which a file is opened again. The others matter only for its first opening."""


class Loop(Protocol):
    """An event loop of asyncio, with the parts that belong to one process."""

    _csock: socket.socket
    _selector: BaseSelector
    _ssock: socket.socket

    def is_closed(self) -> bool:
        """Whether it is closed."""


@dataclass
class _Opening:
    """An opening of a file: its flags and offset, and the descriptors that share the offset."""

    flags: int
    offset: int
    descriptors: list[int]


_SHARED: Final = re.compile(
    r"(\w+)-(\w+) .w.s \w+ \w+:\w+ \d+ +(/(?!dev/(?!shm/(?!sem\.)|zero)).*)"
)
"""A writable mapping of shared memory: begin, end, path. Devices and semaphores do not count."""

_shares_nothing = False  # since the latest look at the mappings, which takes half a millisecond


def _note_event(event: str, args: tuple[object, ...]) -> None:
    global _shares_nothing
    if event == "mmap.__new__":
        _shares_nothing = False


@cache
def _watch_mappings() -> None:
    """Note from now on that memory is mapped. Nothing can undo this."""
    sys.addaudithook(_note_event)


def _shared_memory(episode: Episode) -> list[str]:
    """Return the paths of the memory that the simulation holds and processes share."""
    global _shares_nothing
    _watch_mappings()
    if _shares_nothing:
        return []
    mappings = _SHARED.findall(Path("/proc/self/maps").read_text(errors="replace"))
    _shares_nothing = not mappings
    if _shares_nothing:
        return []
    simulation = episode.simulation
    module = sys.modules.get(type(simulation).__module__)
    roots = [simulation, {} if module is None else vars(module), *episode.driver.variables()]
    held = [_address_of(memory) for memory in find_objects(roots, (mmap,), set())]
    return [
        path
        for begin, end, path in mappings
        if any(int(begin, 16) <= address < int(end, 16) for address in held)
    ]


def _address_of(memory: Any) -> int:
    """Return the address of a memory map; 0 if it is closed."""
    with suppress(ValueError):
        return np.frombuffer(memory, np.uint8).ctypes.data
    return 0


def separator_of(episode: Episode | None, method: str | None) -> Callable[[], None] | None:
    """Return a function that separates forks of this process from it.

    None if the episode is replayed.

    Raises:
        BranchError: The method is "fork", which is not possible.
    """
    if episode is None or method == "replay" or not CAN_FORK:
        return None
    if episode.plan.options.driver != "greenlet":
        return None
    driver = episode.driver
    if not driver.reachable:
        driver.enter()  # raises the error that names the thread
    held: dict[int, str] = {}
    others: list[str] = []
    for resource in driver.opened or ():
        if isinstance(resource, socket.socket):
            held[resource.fileno()] = "a socket"
        elif isinstance(resource, Thread):
            # A process can continue without tqdm's, which only draws bars that have stood still.
            if resource.is_alive() and type(resource).__name__ != "TMonitor":
                others.append("a thread")
        else:
            code = resource.returncode if isinstance(resource, Popen) else resource.exitcode
            if code is None:
                others.append(f"a child process ({resource.pid})")
    held.pop(-1, None)  # of closed sockets
    held |= dict.fromkeys(new_epolls(), "an epoll object")
    loops = event_loops() if held else []
    for loop in loops:  # forks get others behind the same descriptors
        for part in (loop._ssock, loop._csock, loop._selector):
            if hasattr(part, "fileno"):
                held.pop(part.fileno(), None)
    others += [f"{name} (descriptor {number})" for number, name in sorted(held.items())]
    others += [f"shared memory ({path})" for path in _shared_memory(episode)]
    monkey = sys.modules.get("gevent.monkey")
    if monkey is not None and monkey.is_module_patched("select"):
        others.append("the hub of gevent.monkey")
    if others and method == "fork":
        raise BranchError(
            f"a forked process cannot continue with {', '.join(others)} of this process; use"
            ' method="replay"'
        )
    if others:
        return None
    with limited():
        files = _open_files()
    return partial(_separate, random.getstate(), files, loops)


def _separate(python: tuple[Any, ...], files: list[list[_Opening]], loops: list[Loop]) -> None:
    """In a fork, restore Python's generator, reopen files, and separate loops."""
    random.setstate(python)  # Python reseeds it after a fork
    with limited():
        for openings in files:
            with suppress(FileNotFoundError):  # the garbage collector has closed it since
                _reopen(openings)
    for loop in loops:
        _separate_loop(loop)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)  # because torch would wait for threads that are not here


def event_loops() -> list[Loop]:
    """Return the open asyncio event loops of this process."""
    events = sys.modules.get("asyncio.selector_events")
    if events is None:
        return []
    kind = events.BaseSelectorEventLoop
    # The collector does not list frozen objects, and users may freeze the loop of policies.
    known = [*gc.get_objects(), *LOOPS.values()]
    return [thing for thing in known if isinstance(thing, kind) and not thing.is_closed()]


def _separate_loop(loop: Loop) -> None:
    """Give an event loop a selector and sockets, behind the same descriptors, of this process."""
    for old, new in zip((loop._ssock, loop._csock), socket.socketpair(), strict=True):
        with new:
            new.setblocking(False)
            os.dup2(new.fileno(), old.fileno(), inheritable=False)
    shared = loop._selector
    own = type(shared)()
    for key in shared.get_map().values():
        own.register(key.fileobj, key.events, key.data)
    vars(loop)["_selector"] = own
    shared.close()


# -- files ----------------------------------------------------------------------------------------


def _open_files() -> list[list[_Opening]]:
    """Return the openings of each regular file of this process, but for standard streams."""
    files: dict[tuple[int, int], list[_Opening]] = {}
    standard: set[tuple[int, int]] = set()  # branches share them with their parent
    for number in sorted(map(int, os.listdir(_DESCRIPTORS))):
        with suppress(OSError):  # it is closed, no file, or only stands for a path
            offset = os.lseek(number, 0, os.SEEK_CUR)
            status = os.fstat(number)
            inode = status.st_dev, status.st_ino
            if number < 3:
                standard.add(inode)
            elif stat.S_ISREG(status.st_mode) and inode not in standard:
                flags = fcntl.fcntl(number, fcntl.F_GETFL) & _FLAGS
                openings = files.setdefault(inode, [])
                for opening in openings:
                    is_alike = (opening.flags, opening.offset) == (flags, offset)
                    if is_alike and _share_offset(opening.descriptors[0], number):
                        opening.descriptors.append(number)
                        break
                else:
                    openings.append(_Opening(flags, offset, [number]))
    return list(files.values())


def _share_offset(one: int, other: int) -> bool:
    """Return whether two descriptors with the same offset are duplicates, which share it."""
    offset = os.lseek(one, 1, os.SEEK_CUR)
    try:
        return os.lseek(other, 0, os.SEEK_CUR) == offset
    finally:
        os.lseek(one, -1, os.SEEK_CUR)


def _reopen(openings: list[_Opening]) -> None:
    """Open a file again if it is only read, else a copy that is deleted at its close."""
    path = f"{_DESCRIPTORS}/{openings[0].descriptors[0]}"
    modes = {opening.flags & os.O_ACCMODE for opening in openings}
    if modes == {os.O_RDONLY}:
        _replace(openings, path)
        return
    with tempfile.TemporaryFile() as copied:
        copy = f"{_DESCRIPTORS}/{copied.fileno()}"
        if modes == {os.O_WRONLY}:  # the contents are never read
            copied.truncate(os.stat(path).st_size)
        else:
            shutil.copyfile(path, copy)
        _replace(openings, copy)


def _replace(openings: list[_Opening], path: str) -> None:
    """Put new openings of a path behind the descriptors."""
    for opening in openings:
        again = os.open(path, opening.flags)
        os.lseek(again, opening.offset, os.SEEK_SET)
        for number in opening.descriptors:
            with suppress(OSError):  # the garbage collector has closed it since
                os.dup2(again, number, inheritable=os.get_inheritable(number))
        os.close(again)
