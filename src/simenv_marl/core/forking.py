"""What makes a forked process continue as its parent would.

``fork`` copies the memory, but parent and child share the offsets and contents of open files and the sockets of event
loops, and Python reseeds its global generator in the child. A function from ``separator`` corrects this in the child.
"""

from __future__ import annotations

import ctypes
import os
import random
import shutil
import signal
import socket
import stat
import sys
import tempfile
from collections.abc import Callable, Container, Iterable
from contextlib import nullcontext, suppress
from gc import get_objects
from typing import Any, Final, NamedTuple

if hasattr(os, "fork"):
    import fcntl

DESCRIPTORS: Final = "/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"

FLAGS: Final = os.O_WRONLY | os.O_RDWR | os.O_APPEND
"""The flags with which a file is opened again. The others say how it was made, or matter for other kinds of files."""


def separator(loops: Iterable[Any] = ()) -> Callable[[], None]:
    """Return a function that separates forked children, in which the event loops continue, from this process."""
    python, files = random.getstate(), _open_files()

    def separate() -> None:
        random.setstate(python)  # Python reseeds it after a fork
        if files:
            _reopen(files)
        for loop in loops:
            _separate_loop(loop)
        torch = sys.modules.get("torch")
        if torch is not None:
            torch.set_num_threads(1)  # its threads do not exist here, and torch would wait for them

    return separate


# -- the end of the parent ------------------------------------------------------------------------

_prctl: Final[Any] = getattr(ctypes.CDLL(None), "prctl", None) if sys.platform == "linux" else None


def end_with(parent: int) -> None:
    """Let this forked process end when its parent ends, for whatever reason. Only Linux supports this."""
    if _prctl is not None:
        _prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:  # the parent has already ended
            os._exit(1)


# -- event loops ----------------------------------------------------------------------------------


def loops_on(descriptors: Container[int]) -> list[Any]:
    """Return the open asyncio event loops whose wake-up sockets are among the given descriptors."""
    events = sys.modules.get("asyncio.selector_events")
    if events is None:
        return []
    loops = [thing for thing in get_objects() if isinstance(thing, events.BaseSelectorEventLoop)]
    return [loop for loop in loops if not loop.is_closed() and loop._ssock.fileno() in descriptors]


def sockets_of(loop: Any) -> set[int]:
    """Return the descriptors of the pair of sockets that wakes an event loop."""
    return {loop._ssock.fileno(), loop._csock.fileno()}


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


# -- open files -----------------------------------------------------------------------------------


class _OpenFile(NamedTuple):
    """A regular file, as it was opened once, and the descriptors that share its offset."""

    inode: tuple[int, int]
    flags: int
    offset: int
    numbers: list[int]


def _open_files() -> list[_OpenFile]:
    """Return the open regular files of this process, except for files that are also standard streams."""
    files: list[_OpenFile] = []
    standard: set[tuple[int, int]] = set()
    for number in sorted(map(int, os.listdir(DESCRIPTORS))):
        with suppress(OSError):  # the descriptor by which ``listdir`` read the list, or one that only stands for a path
            status = os.fstat(number)
            inode = status.st_dev, status.st_ino
            if number < 3:  # a standard stream, which branches share with their parent
                standard.add(inode)
            elif stat.S_ISREG(status.st_mode) and inode not in standard:
                _add(files, number, inode)
    return files


def _inode(number: int) -> tuple[int, int] | None:
    """Return what identifies the file behind a descriptor; None if the descriptor is closed."""
    try:
        status = os.fstat(number)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _add(files: list[_OpenFile], number: int, inode: tuple[int, int]) -> None:
    """Add a descriptor to the opening that it is a duplicate of, or add a new opening."""
    flags, offset = fcntl.fcntl(number, fcntl.F_GETFL) & FLAGS, os.lseek(number, 0, os.SEEK_CUR)
    for file in files:
        if (file.inode, file.flags, file.offset) == (inode, flags, offset) and _share_offset(file.numbers[0], number):
            file.numbers.append(number)
            return
    files.append(_OpenFile(inode, flags, offset, [number]))


def _share_offset(one: int, other: int) -> bool:
    """Return whether two descriptors with the same offset share it, because one is a duplicate of the other."""
    offset = os.lseek(one, 1, os.SEEK_CUR)
    try:
        return os.lseek(other, 0, os.SEEK_CUR) == offset
    finally:
        os.lseek(one, -1, os.SEEK_CUR)


def _reopen(files: list[_OpenFile]) -> None:
    """Open all files again: the same ones if they are only read, else copies that are deleted when they are closed."""
    # A file may have been closed since it was noted: by the garbage collector, or in a thread that does not exist here.
    files = [file for file in files if all(_inode(number) == file.inode for number in file.numbers)]
    for inode in {file.inode for file in files}:
        alike = [file for file in files if file.inode == inode]
        modes = {file.flags & os.O_ACCMODE for file in alike}
        path = _path(alike[0].numbers[0])
        writes = modes != {os.O_RDONLY}
        copy: Any
        with tempfile.TemporaryFile() if writes else nullcontext() as copy:
            if modes == {os.O_WRONLY}:  # the contents are never read
                copy.truncate(os.stat(path).st_size)
            elif writes:
                shutil.copyfile(path, _path(copy.fileno()))
            for file in alike:
                again = os.open(_path(copy.fileno()) if writes else path, file.flags)
                os.lseek(again, file.offset, os.SEEK_SET)
                for number in file.numbers:
                    os.dup2(again, number, inheritable=os.get_inheritable(number))
                os.close(again)


def _path(number: int) -> str:
    """Return a path by which an open file can be opened again, even if it was deleted."""
    if hasattr(fcntl, "F_GETPATH"):  # on macOS, where opening /dev/fd would share the offset
        return os.fsdecode(fcntl.fcntl(number, fcntl.F_GETPATH, bytes(1024)).partition(b"\0")[0])
    return f"{DESCRIPTORS}/{number}"
