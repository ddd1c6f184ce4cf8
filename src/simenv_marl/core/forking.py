"""How a forked process goes on just as the one would from which it was split off.

``fork`` copies the memory, but not what the system keeps for a process: both share the offsets of open files and what
is written to them; Python seeds its global generator anew; directories for a while are deleted by both. ``Standing``
puts that right in the forked process. What it cannot put right, ``obstacles`` names.
"""

from __future__ import annotations

import gc
import os
import random
import re
import shutil
import signal
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
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

BOOT: Final = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC if hasattr(time, "CLOCK_MONOTONIC") else 0)
"""The clock by which the system says when a process has started."""

SHARED: Final = re.compile(rb"^\S+ rw.s \S+ (.*)$", re.MULTILINE)
"""A line of ``/proc/self/maps``: what is shared, and can be written."""

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


# -- what cannot go on ----------------------------------------------------------------------------


class _Before:
    """What was there before there was any simulation, and so is the user's own."""

    open: dict[int, Identity]
    ticks: float
    shared: set[str]

    def __init__(self, shared: set[str] | None = None) -> None:
        self.open = {number: _identity(status) for number, status in _open_now().items()}
        self.ticks = time.clock_gettime(BOOT) * os.sysconf("SC_CLK_TCK") - 1
        # Found out only once, for it takes ten times as long as all else.
        self.shared = _shared_memory() if shared is None else shared


_before: _Before | None = None


def note_what_is_open() -> None:
    """Take all that this process has open for the user's own. Called before the first of the simulations is made."""
    global _before
    if hasattr(os, "fork"):
        _before = _Before(None if _before is None else _before.shared)


def obstacles() -> list[str]:
    """What simulations have opened that a forked process could not go on with: each in some words.

    What was opened since the first simulation of those that live was made is taken to be a simulation's.
    """
    before, opened = _before or _Before(), _opened_since()
    found = {number: what for number, status in opened.items() if (what := _shared(number, status))}
    for loop in _loops(opened):
        for number in _descriptors_of(loop):
            found.pop(number, None)
    processes = _child_processes(before.ticks)
    return [
        *(f"{what} (descriptor {number})" for number, what in found.items()),
        *(f"a child process ({number})" for number in processes),
        *(f"shared memory ({path})" for path in sorted(_shared_memory() - before.shared)),
    ]


def _opened_since() -> dict[int, os.stat_result]:
    """What simulations have opened, by descriptor."""
    before = {} if _before is None else _before.open
    return {
        number: status
        for number, status in _open_now().items()
        if number >= STANDARD and before.get(number) != _identity(status)
    }


def _shared(number: int, status: os.stat_result) -> str | None:
    """What a descriptor is, where two processes cannot each have it for itself."""
    if stat.S_ISSOCK(status.st_mode):
        return "a socket"
    if stat.S_ISFIFO(status.st_mode):
        return "a pipe"
    if stat.S_IFMT(status.st_mode) == 0:  # has no kind: what the kernel makes for a process, such as an epoll
        with suppress(OSError):
            return f"an {os.readlink(f'{DESCRIPTORS}/{number}').removeprefix('anon_inode:').strip('[]')}"
    return None


def _child_processes(since: float) -> list[int]:
    """The child processes that have started since a number of the system's ticks."""
    found: list[int] = []
    with suppress(OSError):  # not everywhere
        for thread in os.listdir("/proc/self/task"):
            with suppress(OSError), open(f"/proc/self/task/{thread}/children", encoding="ascii") as children:
                found += map(int, children.read().split())
    return [process for process in sorted(found) if _started(process) >= since]


def _started(process: int) -> int:
    try:
        with open(f"/proc/{process}/stat", "rb") as file:
            return int(file.read().rpartition(b")")[2].split()[19])
    except OSError:  # it has just ended
        return 0


def _shared_memory() -> set[str]:
    """The files that are mapped to memory that processes share, and can be written: device, inode and path."""
    try:
        with open("/proc/self/maps", "rb") as maps:
            return {os.fsdecode(line) for line in SHARED.findall(maps.read())}
    except OSError:  # not everywhere
        return set()


# -- event loops ----------------------------------------------------------------------------------


def _loops(opened: dict[int, os.stat_result]) -> list[Any]:
    """The event loops of asyncio that simulations have opened; a loop has sockets."""
    events = sys.modules.get("asyncio.selector_events")
    if events is None or not any(stat.S_ISSOCK(status.st_mode) for status in opened.values()):
        return []
    kind = events.BaseSelectorEventLoop
    loops = [thing for thing in gc.get_objects() if isinstance(thing, kind) and not thing.is_closed()]
    return [loop for loop in loops if opened.keys() >= _descriptors_of(loop)]


def _descriptors_of(loop: Any) -> set[int]:
    """A loop's own descriptors: its selector, and the pair of sockets by which it is woken."""
    own = {loop._ssock.fileno(), loop._csock.fileno()}
    if hasattr(loop._selector, "fileno"):
        own.add(loop._selector.fileno())
    return own


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

    opened: tuple[_Opened, ...]

    @property
    def written(self) -> bool:
        return any(opened.flags & os.O_ACCMODE != os.O_RDONLY for opened in self.opened)


class Standing:
    """How this process stands, for those that are going to be forked from it before it moves.

    In a forked process ``resume`` is called before anything else.
    """

    def __init__(self) -> None:
        """Note what a fork does not take along."""
        self._python, self._open = random.getstate(), set(_open_now())
        self._files = list(_files())
        self._paths = {os.path.realpath(_path(number)) for number in _numbers(self._files)}
        self._loops = _loops(_opened_since())

    def resume(self) -> None:
        """Have this forked process go on by itself.

        Raises:
            OSError: A file cannot be opened once more, or not be copied.
        """
        random.setstate(self._python)  # a fork has seeded it
        for file in self._files:
            _reopen(file)
        if _before is not None:  # by what was opened meanwhile its parent waits for this process
            new = {number: _identity(status) for number, status in _open_now().items() if number not in self._open}
            _before.open.update(new)
        for loop in self._loops:
            _rebuild(loop)
        _keep_temporary(self._paths)


def _numbers(files: list[_File]) -> Iterator[int]:
    return (number for file in files for opened in file.opened for number in opened.numbers)


def _files() -> Iterator[_File]:
    """The open files and directories that a forked process is to have for itself."""
    by_identity: dict[Identity, list[int]] = {}
    for number, status in sorted(_open_now().items()):
        if stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode):
            by_identity.setdefault(_identity(status), []).append(number)
    for numbers in by_identity.values():
        if numbers[0] >= STANDARD:  # what is a standard stream, too, stays what it is
            left, opened = [number for number in numbers if _has_an_offset(number)], []
            while left:
                alike = [number for number in left if number == left[0] or _share_an_offset(left[0], number)]
                opened.append(_Opened(tuple(alike), _flags(left[0]), os.lseek(left[0], 0, os.SEEK_CUR)))
                left = [number for number in left if number not in alike]
            yield _File(tuple(opened))


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


def _reopen(file: _File) -> None:
    path, copy = _path(file.opened[0].numbers[0]), None
    if file.written:
        copy = tempfile.TemporaryFile()  # noqa: SIM115 - the descriptors below keep it
        shutil.copyfile(path, _path(copy.fileno()))
        path = _path(copy.fileno())
    for opened in file.opened:
        again = os.open(path, opened.flags)
        os.lseek(again, opened.offset, os.SEEK_SET)
        for number in opened.numbers:
            os.dup2(again, number, inheritable=os.get_inheritable(number))
        os.close(again)
    if copy is not None:
        copy.close()


def _keep_temporary(paths: set[str]) -> None:
    """Delete nothing at its end that the parent still has: directories and named files for a while."""
    for end in list(finalize._registry):  # type: ignore[attr-defined]
        held = end.peek()
        if held is not None and isinstance(held[0], tempfile.TemporaryDirectory):
            end.detach()
            held[0]._rmtree = _delete_nothing  # type: ignore[attr-defined]
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
