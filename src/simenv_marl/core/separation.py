"""What separates a forked process from its parent, so that it continues as the parent would.

``fork`` copies the memory, but parent and child share the offsets and contents of open files, the
events of epoll objects, and the sockets of event loops. And Python reseeds its global generator in
the child.
"""

from __future__ import annotations

import gc
import os
import random
import select
import shutil
import socket
import stat
import sys
import tempfile
from collections.abc import Callable, Container, Iterable
from contextlib import nullcontext, suppress
from subprocess import Popen
from threading import Thread
from typing import Any, Final

from .forks import CAN_FORK, exhausted

if CAN_FORK:
    import fcntl

_DESCRIPTORS: Final = "/proc/self/fd"

_FLAGS: Final = os.O_WRONLY | os.O_RDWR | os.O_APPEND
"""The flags with which a file is opened again.

The others say how it was made, or matter for other kinds of files.
"""

Files = dict[tuple[int, int], list[tuple[int, int, list[int]]]]
"""Open regular files by what identifies them. For each time that one was opened: the flags, the offset, and the
descriptors that share the offset."""


def separator(loops: Iterable[Any] = ()) -> Callable[[], None]:
    """Return a function that separates forked children, in which the event loops continue, from this process."""
    try:
        python, (files, polls) = random.getstate(), _open_files()
    except OSError as error:
        raise exhausted(error) from error

    def separate() -> None:
        random.setstate(python)  # Python reseeds it after a fork
        for inode, openings in files.items():
            # A file may have been closed since: by the garbage collector, or in a thread that does
            # not exist here.
            if all(_inode(number) == inode for _, _, numbers in openings for number in numbers):
                _reopen(openings)
        for loop in loops:
            _separate_loop(loop)
        for number in polls:
            _separate_poll(number)
        torch = sys.modules.get("torch")
        if torch is not None:
            torch.set_num_threads(1)  # its threads do not exist here, and torch would wait for them

    return separate


def open_resources(opened: Iterable[Any] | None) -> dict[Any, str]:
    """Describe each thing that is still alive or open, in a few words.

    Sockets by their descriptor.
    """
    found: dict[Any, str] = {}
    for thing in opened or ():
        if isinstance(thing, socket.socket):
            if thing.fileno() >= 0:
                found[thing.fileno()] = f"a socket (descriptor {thing.fileno()})"
        elif isinstance(thing, Thread):
            if thing.is_alive():
                found[thing] = "a thread"
        elif (thing.returncode if isinstance(thing, Popen) else thing.exitcode) is None:
            found[thing] = f"a child process ({thing.pid})"
    return found


def loops_on(descriptors: Container[int]) -> list[Any]:
    """Return the open asyncio event loops whose wake-up sockets are among the given descriptors."""
    events = sys.modules.get("asyncio.selector_events")
    if events is None:
        return []
    loops = [thing for thing in gc.get_objects() if isinstance(thing, events.BaseSelectorEventLoop)]
    return [loop for loop in loops if not loop.is_closed() and loop._ssock.fileno() in descriptors]


def _separate_loop(loop: Any) -> None:
    """Give an event loop a selector, and sockets behind the same descriptors, that belong to this process only."""
    for old, new in zip((loop._ssock, loop._csock), socket.socketpair(), strict=True):
        with new:
            new.setblocking(False)
            os.dup2(new.fileno(), old.fileno(), inheritable=False)
    shared = loop._selector
    loop._selector = type(shared)()
    for key in shared.get_map().values():
        loop._selector.register(key.fileobj, key.events, key.data)
    shared.close()


def _separate_poll(number: int) -> None:
    """Put an epoll object of this process, which waits for the same events, behind a descriptor."""
    with (
        suppress(OSError),
        select.epoll() as own,
        open(f"/proc/self/fdinfo/{number}", encoding="ascii") as entries,
    ):
        watched = [entry.split() for entry in entries if entry.startswith("tfd:")]
        # Only those of Python have the descriptors as data. C libraries find out themselves that
        # they were forked.
        if all(int(entry[1]) == int(entry[5], 16) for entry in watched):
            for entry in watched:
                own.register(int(entry[1]), int(entry[3], 16))
            os.dup2(own.fileno(), number, inheritable=os.get_inheritable(number))


def _open_files() -> tuple[Files, list[int]]:
    """Return the open regular files of this process, except for standard streams, and its epoll objects."""
    files: Files = {}
    polls: list[int] = []
    standard = [_inode(number) for number in range(3)]  # which branches share with their parent
    for number in sorted(map(int, os.listdir(_DESCRIPTORS))):
        inode = _inode(number)
        if inode is None or inode in standard:
            continue
        if not stat.S_ISREG(os.fstat(number).st_mode):
            with suppress(OSError):
                if os.readlink(f"{_DESCRIPTORS}/{number}") == "anon_inode:[eventpoll]":
                    polls.append(number)
            continue
        with suppress(OSError):  # a descriptor that only stands for a path
            flags, offset = (
                fcntl.fcntl(number, fcntl.F_GETFL) & _FLAGS,
                os.lseek(number, 0, os.SEEK_CUR),
            )
            openings = files.setdefault(inode, [])
            for *opening, numbers in openings:
                if opening == [flags, offset] and _share_offset(numbers[0], number):
                    numbers.append(number)
                    break
            else:
                openings.append((flags, offset, [number]))
    return files, polls


def _inode(number: int) -> tuple[int, int] | None:
    """Return what identifies the file behind a descriptor; None if the descriptor is closed."""
    try:
        status = os.fstat(number)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _share_offset(one: int, other: int) -> bool:
    """Return whether two descriptors with the same offset share it, because one is a duplicate of the other."""
    offset = os.lseek(one, 1, os.SEEK_CUR)
    try:
        return os.lseek(other, 0, os.SEEK_CUR) == offset
    finally:
        os.lseek(one, -1, os.SEEK_CUR)


def _reopen(openings: list[tuple[int, int, list[int]]]) -> None:
    """Open a file again: the same one if it is only read, else a copy that is deleted when it is closed."""
    path = _path(openings[0][2][0])
    modes = {flags & os.O_ACCMODE for flags, _, _ in openings}
    copied: Any
    with nullcontext() if modes == {os.O_RDONLY} else tempfile.TemporaryFile() as copied:
        if modes == {os.O_WRONLY}:  # the contents are never read
            copied.truncate(os.stat(path).st_size)
        elif copied is not None:
            shutil.copyfile(path, _path(copied.fileno()))
        for flags, offset, numbers in openings:
            again = os.open(path if copied is None else _path(copied.fileno()), flags)
            os.lseek(again, offset, os.SEEK_SET)
            for number in numbers:
                os.dup2(again, number, inheritable=os.get_inheritable(number))
            os.close(again)


def _path(number: int) -> str:
    """Return a path by which an open file can be opened again, even if it was deleted."""
    if hasattr(fcntl, "F_GETPATH"):  # on macOS, where opening /dev/fd would share the offset
        return os.fsdecode(fcntl.fcntl(number, fcntl.F_GETPATH, bytes(1024)).partition(b"\0")[0])
    return f"{_DESCRIPTORS}/{number}"
