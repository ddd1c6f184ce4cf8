"""How a forked process goes on just as the one would from which it was split off.

``fork`` copies the memory, but not what the system keeps for a process: both share the offsets of open files and what
is written to them; Python seeds its global generator anew; directories for a while are deleted by both. ``Standing``
puts that right in the forked process.
"""

from __future__ import annotations

import ctypes
import os
import random
import shutil
import signal
import stat
import sys
import tempfile
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from gc import get_objects
from sys import modules
from typing import Any, Final
from weakref import finalize

if hasattr(os, "fork"):
    import fcntl

DESCRIPTORS: Final = "/proc/self/fd" if os.path.isdir("/proc/self/fd") else "/dev/fd"
STANDARD: Final = 3
"""How many descriptors are the standard streams, which stay what they are."""

LASTING: Final = (
    sum(getattr(os, f"O_{name}", 0) for name in ("APPEND", "NONBLOCK", "DSYNC", "DIRECT", "NOATIME"))
    | os.O_WRONLY
    | os.O_RDWR
)
"""The flags of an open file that say how it is read and written, and not how it is found or made."""

LARGEST: Final = 1 << 24
"""How many bytes a file has at most that is copied into memory: it takes a disk a millisecond to let go of a file."""

Identity = tuple[int, int]
"""Device and inode."""


def _open_now() -> dict[int, os.stat_result]:
    """What this process has open, by descriptor."""
    found = {}
    for name in os.listdir(DESCRIPTORS):
        with suppress(OSError):  # the one by which the list was read
            found[int(name)] = os.fstat(int(name))
    return found


def _identity(status: os.stat_result) -> Identity:
    return status.st_dev, status.st_ino


def _path(number: int) -> str:
    """A path by which an open file can be opened once more, be it deleted or not."""
    if hasattr(fcntl, "F_GETPATH"):  # where /dev/fd gives the same description again
        held = fcntl.fcntl(number, fcntl.F_GETPATH, bytes(1024))
        return os.fsdecode(held.partition(b"\0")[0])
    return f"{DESCRIPTORS}/{number}"


# -- the end of the parent ------------------------------------------------------------------------

_PR_SET_PDEATHSIG: Final = 1

_prctl: Final[Any] = getattr(ctypes.CDLL(None), "prctl", None) if sys.platform == "linux" else None


def end_with(parent: int) -> None:
    """Have this forked process end when its parent does, however that ends; Linux alone knows how."""
    if _prctl is not None:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # it has ended already
            os._exit(1)


# -- event loops ----------------------------------------------------------------------------------


def loops_on(descriptors: Container[int]) -> list[Any]:
    """The open event loops of asyncio whose own sockets are among some."""
    events = modules.get("asyncio.selector_events")
    if events is None:
        return []
    loops = [thing for thing in get_objects() if isinstance(thing, events.BaseSelectorEventLoop)]
    return [loop for loop in loops if not loop.is_closed() and loop._ssock.fileno() in descriptors]


def sockets_of(loop: Any) -> set[int]:
    """The descriptors of the pair of sockets by which a loop is woken."""
    return {loop._ssock.fileno(), loop._csock.fileno()}


def _rebuild(loop: Any) -> None:
    """Give a loop a selector and a pair of sockets of this process's own."""
    before, selector = loop._selector, type(loop._selector)()
    woken_by = loop._csock.fileno()
    for key in before.get_map().values():
        if key.fd != loop._ssock.fileno():
            selector.register(key.fileobj, key.events, key.data)
    before.close()
    loop._selector = selector
    for end in (loop._ssock, loop._csock):
        end.close()
    loop._internal_fds -= 1
    loop._make_self_pipe()
    with suppress(ValueError):  # only a main thread has one
        signals = signal.set_wakeup_fd(-1)
        if signals != -1:
            signal.set_wakeup_fd(loop._csock.fileno() if signals == woken_by else signals)


# -- what goes on ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Opened:
    """A file as it was opened once; descriptors that were duplicated share it, and with it the offset."""

    numbers: tuple[int, ...]
    flags: int
    offset: int


@dataclass(frozen=True)
class _File:
    """A file, and all the ways in which it is open."""

    identity: Identity
    opened: tuple[_Opened, ...]

    @property
    def modes(self) -> set[int]:
        """For what: ``O_RDONLY``, ``O_WRONLY``, ``O_RDWR``."""
        return {opened.flags & os.O_ACCMODE for opened in self.opened}


class Standing:
    """How this process stands, for those that are going to be forked from it before it moves.

    In a forked process ``resume`` is called before anything else.
    """

    def __init__(self, loops: Iterable[Any] = ()) -> None:
        """Note what a fork does not take along.

        Args:
            loops: The event loops that are to go on, too.
        """
        self._python, self._loops = random.getstate(), loops
        self._files = list(_files())
        self._paths = {os.path.realpath(_path(number)) for number in _numbers(self._files)}
        self._folders = list(_temporary_folders())

    def resume(self) -> None:
        """Have this forked process go on by itself.

        Raises:
            OSError: A file cannot be opened once more, or not be copied.
        """
        random.setstate(self._python)  # a fork has seeded it
        for file in self._files:
            _reopen(file)
        for loop in self._loops:
            _rebuild(loop)
        for end, folder in self._folders:
            end.detach()
            folder._rmtree = _delete_nothing
        if self._paths:
            _keep_temporary_files(self._paths)


def _numbers(files: list[_File]) -> Iterator[int]:
    return (number for file in files for opened in file.opened for number in opened.numbers)


def _files() -> Iterator[_File]:
    """The open files and directories that a forked process is to have for itself."""
    by_identity: dict[Identity, list[int]] = {}
    for number, status in sorted(_open_now().items()):
        if stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode):
            by_identity.setdefault(_identity(status), []).append(number)
    for identity, numbers in by_identity.items():
        if numbers[0] >= STANDARD:  # what is a standard stream, too, stays what it is
            left, opened = [number for number in numbers if _has_an_offset(number)], []
            while left:
                alike = [number for number in left if number == left[0] or _share_an_offset(left[0], number)]
                opened.append(_Opened(tuple(alike), _flags(left[0]), os.lseek(left[0], 0, os.SEEK_CUR)))
                left = [number for number in left if number not in alike]
            yield _File(identity, tuple(opened))


def _has_an_offset(number: int) -> bool:
    """Whether anything is read or written by a descriptor."""
    try:
        os.lseek(number, 0, os.SEEK_CUR)
    except OSError:  # it only stands for a path
        return False
    return True


def _flags(number: int) -> int:
    """How a file was opened, as far as that still matters."""
    flags: int = fcntl.fcntl(number, fcntl.F_GETFL)
    return flags & LASTING


def _share_an_offset(one: int, other: int) -> bool:
    """Whether a descriptor is a duplicate of another one."""
    here = os.lseek(one, 0, os.SEEK_CUR)
    if os.lseek(other, 0, os.SEEK_CUR) != here or _flags(one) != _flags(other):
        return False
    try:
        os.lseek(one, here + 1, os.SEEK_SET)
        return os.lseek(other, 0, os.SEEK_CUR) == here + 1
    finally:
        os.lseek(one, here, os.SEEK_SET)


def _is_still(number: int, identity: Identity) -> bool:
    """Whether a file is still open; one that only a thread has held is not, since no thread comes along."""
    try:
        return _identity(os.fstat(number)) == identity
    except OSError:
        return False


def _reopen(file: _File) -> None:
    numbers = [number for number in _numbers([file]) if _is_still(number, file.identity)]
    if not numbers:
        return
    path, copy = _path(numbers[0]), None
    if file.modes != {os.O_RDONLY}:
        copy = _copied(path, os.fstat(numbers[0]).st_size, file)
        path = _path(copy.fileno())
    for opened in file.opened:
        again = os.open(path, opened.flags)
        os.lseek(again, opened.offset, os.SEEK_SET)
        for number in set(opened.numbers) & set(numbers):
            os.dup2(again, number, inheritable=os.get_inheritable(number))
        os.close(again)
    if copy is not None:
        copy.close()


def _copied(path: str, size: int, file: _File) -> Any:
    """A copy of an open file, which is gone when it is closed."""
    direct = any(opened.flags & getattr(os, "O_DIRECT", 0) for opened in file.opened)  # which memory may not know
    in_memory = size <= LARGEST and not direct and hasattr(os, "memfd_create")
    copy: Any = os.fdopen(os.memfd_create("branch"), "wb") if in_memory else tempfile.TemporaryFile()  # noqa: SIM115
    if file.modes == {os.O_WRONLY}:  # what stands in it is read by none
        os.truncate(copy.fileno(), size)
    else:
        shutil.copyfile(path, _path(copy.fileno()))
    return copy


def _temporary_folders() -> Iterator[tuple[Any, Any]]:
    """Directories for a while, which a forked process must not delete, each with what deletes it at its end."""
    for end in list(finalize._registry):  # type: ignore[attr-defined]
        held = end.peek()
        if held is not None and isinstance(held[0], tempfile.TemporaryDirectory):
            yield end, held[0]


def _keep_temporary_files(paths: set[str]) -> None:
    """Delete none of some named files for a while when it is closed."""
    closer: Any = tempfile._TemporaryFileCloser  # type: ignore[attr-defined]
    for name in {"close", "cleanup"} & vars(closer).keys():
        setattr(closer, name, _keeping(getattr(closer, name), paths))


def _keeping(close: Callable[..., Any], paths: set[str]) -> Callable[..., Any]:
    """Have what closes a temporary file not delete it, if it is one of some."""

    def close_only(closer: Any, *args: Any) -> Any:
        if os.path.realpath(closer.name) in paths:
            closer.delete = False
        return close(closer, *args)

    return close_only


def _delete_nothing(*args: Any, **kwargs: Any) -> None:
    """Stands for what deletes a directory that is another process's."""
