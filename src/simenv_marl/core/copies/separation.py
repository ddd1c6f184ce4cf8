"""How a forked process is separated from its parent, so that it continues as the parent would.

``fork`` copies the memory, but parent and child share the offsets and contents of open files, and
the sockets of event loops. And Python reseeds its global generator in the child.
"""

from __future__ import annotations

import gc
import os
import random
import shutil
import socket
import stat
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from selectors import BaseSelector
from subprocess import Popen
from threading import Thread
from typing import Final, Protocol

from ..switching.awaiting import LOOPS
from ..switching.opened import Resource, new_epolls
from .forks import CAN_FORK, exhausted

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


_Inode = tuple[int, int]
"""The device and the number of a file."""


@dataclass
class _Opening:
    """An opening of a file: its flags and offset, and the descriptors that share the offset."""

    flags: int
    offset: int
    descriptors: list[int]


def separator(loops: Iterable[Loop] = ()) -> Callable[[], None]:
    """Return a function that separates forked children, and their loops, from this process."""
    try:
        python = random.getstate()
        files = _open_files()
    except OSError as error:
        raise exhausted(error) from error

    def separate() -> None:
        random.setstate(python)  # Python reseeds it after a fork
        for inode, openings in files.items():
            descriptors = [number for opening in openings for number in opening.descriptors]
            # The garbage collector, or a thread that is not here, may have closed it since.
            if all(_inode(number) == inode for number in descriptors):
                _reopen(openings)
        for loop in loops:
            _separate_loop(loop)
        torch = sys.modules.get("torch")
        if torch is not None:
            torch.set_num_threads(1)  # because torch would wait for threads that are not here

    return separate


# -- obstacles ------------------------------------------------------------------------------------


def obstacles_of(opened: Iterable[Resource] | None) -> tuple[list[str], list[Loop]]:
    """Return what keeps a simulation from going on in a fork, and the loops that can go on there.

    Args:
        opened: The resources that the simulation has opened.
    """
    sockets: dict[int, str] = {}
    others: list[str] = []
    for resource in opened or ():
        if isinstance(resource, socket.socket):
            number = resource.fileno()
            if number >= 0:
                sockets[number] = f"a socket (descriptor {number})"
        elif isinstance(resource, Thread):
            if resource.is_alive():
                others.append("a thread")
        else:
            code = resource.returncode if isinstance(resource, Popen) else resource.exitcode
            if code is None:
                others.append(f"a child process ({resource.pid})")
    epolls = new_epolls()
    loops = event_loops() if sockets or epolls else []
    continued = [loop for loop in loops if loop._ssock.fileno() in sockets]
    for loop in continued:  # their sockets are made anew
        sockets.pop(loop._ssock.fileno(), None)
        sockets.pop(loop._csock.fileno(), None)
    selectors = {loop._selector.fileno() for loop in loops if hasattr(loop._selector, "fileno")}
    for number in sorted(epolls - selectors):
        others.append(f"an epoll object (descriptor {number})")
    return [*sockets.values(), *others], continued


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


def _open_files() -> Mapping[_Inode, list[_Opening]]:
    """Return the openings of the regular files of this process, but for standard streams."""
    files: dict[_Inode, list[_Opening]] = {}
    standard = [_inode(number) for number in range(3)]  # branches share them with their parent
    for number in sorted(map(int, os.listdir(_DESCRIPTORS))):
        inode = _inode(number)
        if inode is None or inode in standard or not stat.S_ISREG(os.fstat(number).st_mode):
            continue
        with suppress(OSError):  # a descriptor that only stands for a path
            flags = fcntl.fcntl(number, fcntl.F_GETFL) & _FLAGS
            offset = os.lseek(number, 0, os.SEEK_CUR)
            _add_opening(files.setdefault(inode, []), number, flags, offset)
    return files


def _add_opening(openings: list[_Opening], number: int, flags: int, offset: int) -> None:
    for opening in openings:
        is_equal = opening.flags == flags and opening.offset == offset
        if is_equal and _share_offset(opening.descriptors[0], number):
            opening.descriptors.append(number)
            return
    openings.append(_Opening(flags, offset, [number]))


def _inode(number: int) -> _Inode | None:
    """Return what identifies the file behind a descriptor. None if the descriptor is closed."""
    try:
        status = os.fstat(number)
    except OSError:
        return None
    return status.st_dev, status.st_ino


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
            os.dup2(again, number, inheritable=os.get_inheritable(number))
        os.close(again)
