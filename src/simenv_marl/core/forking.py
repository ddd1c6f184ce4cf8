"""What makes a forked process continue exactly as its parent would.

``fork`` copies the memory, but not all of the state that the operating system and Python keep for a process. Parent and
child share the offsets and contents of open files. Python reseeds its global generator in the child. Both processes
delete the same temporary directories. ``Standing`` corrects this in the forked process.
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
"""The number of standard streams. Their descriptors are left unchanged."""

LASTING: Final = (
    sum(getattr(os, f"O_{name}", 0) for name in ("APPEND", "NONBLOCK", "DSYNC", "DIRECT", "NOATIME"))
    | os.O_WRONLY
    | os.O_RDWR
)
"""The flags of an open file that say how it is read and written, without those that say how it is opened or made."""

LARGEST: Final = 1 << 24
"""The largest size, in bytes, of a file that is copied into memory. On a disk, deleting a file takes a millisecond."""

Identity = tuple[int, int]
"""Device and inode."""


def _open_now() -> dict[int, os.stat_result]:
    """The open files of this process, by descriptor."""
    found = {}
    for name in os.listdir(DESCRIPTORS):
        with suppress(OSError):  # the descriptor by which ``listdir`` read the list is closed by now
            found[int(name)] = os.fstat(int(name))
    return found


def _identity(status: os.stat_result) -> Identity:
    return status.st_dev, status.st_ino


def _path(number: int) -> str:
    """A path by which an open file can be opened again, even if it was deleted."""
    if hasattr(fcntl, "F_GETPATH"):  # on macOS, where opening /dev/fd would share the offset
        held = fcntl.fcntl(number, fcntl.F_GETPATH, bytes(1024))
        return os.fsdecode(held.partition(b"\0")[0])
    return f"{DESCRIPTORS}/{number}"


# -- the end of the parent ------------------------------------------------------------------------

_PR_SET_PDEATHSIG: Final = 1

_prctl: Final[Any] = getattr(ctypes.CDLL(None), "prctl", None) if sys.platform == "linux" else None


def end_with(parent: int) -> None:
    """Let this forked process end when its parent ends, for whatever reason. Only Linux supports this."""
    if _prctl is not None:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # the parent has already ended
            os._exit(1)


# -- event loops ----------------------------------------------------------------------------------


def loops_on(descriptors: Container[int]) -> list[Any]:
    """The open asyncio event loops whose wake-up sockets are among the given descriptors."""
    events = modules.get("asyncio.selector_events")
    if events is None:
        return []
    loops = [thing for thing in get_objects() if isinstance(thing, events.BaseSelectorEventLoop)]
    return [loop for loop in loops if not loop.is_closed() and loop._ssock.fileno() in descriptors]


def sockets_of(loop: Any) -> set[int]:
    """The descriptors of the pair of sockets that wakes an event loop."""
    return {loop._ssock.fileno(), loop._csock.fileno()}


def _rebuild(loop: Any) -> None:
    """Give an event loop a selector and a pair of sockets that belong to this process only."""
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
    with suppress(ValueError):  # only the main thread may set it
        signals = signal.set_wakeup_fd(-1)
        if signals != -1:
            signal.set_wakeup_fd(loop._csock.fileno() if signals == woken_by else signals)


# -- open files -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Opened:
    """One opening of a file. Duplicated descriptors share it, and so they share its offset."""

    numbers: tuple[int, ...]
    flags: int
    offset: int


@dataclass(frozen=True)
class _File:
    """A file and all its openings."""

    identity: Identity
    opened: tuple[_Opened, ...]

    @property
    def modes(self) -> set[int]:
        """The access modes: ``O_RDONLY``, ``O_WRONLY``, ``O_RDWR``."""
        return {opened.flags & os.O_ACCMODE for opened in self.opened}


class Standing:
    """The state of this process, for the children that are forked before the process continues.

    Each child must call ``resume`` before anything else.
    """

    def __init__(self, loops: Iterable[Any] = ()) -> None:
        """Note the state that a fork does not copy.

        Args:
            loops: The event loops that must also continue in the child.
        """
        self._python, self._loops = random.getstate(), loops
        self._files = list(_files())
        self._paths = {os.path.realpath(_path(number)) for number in _numbers(self._files)}
        self._folders = list(_temporary_folders())

    def resume(self) -> None:
        """Separate this forked process from its parent.

        Raises:
            OSError: A file cannot be opened again, or cannot be copied.
        """
        random.setstate(self._python)  # Python reseeds it after a fork
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
    """The open files and directories of which a forked process gets its own openings."""
    by_identity: dict[Identity, list[int]] = {}
    for number, status in sorted(_open_now().items()):
        if stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode):
            by_identity.setdefault(_identity(status), []).append(number)
    for identity, numbers in by_identity.items():
        if numbers[0] >= STANDARD:  # a file that is also a standard stream is left unchanged
            left, opened = [number for number in numbers if _has_an_offset(number)], []
            while left:
                alike = [number for number in left if number == left[0] or _share_an_offset(left[0], number)]
                opened.append(_Opened(tuple(alike), _flags(left[0]), os.lseek(left[0], 0, os.SEEK_CUR)))
                left = [number for number in left if number not in alike]
            yield _File(identity, tuple(opened))


def _has_an_offset(number: int) -> bool:
    """Whether a descriptor can be read or written."""
    try:
        os.lseek(number, 0, os.SEEK_CUR)
    except OSError:  # the descriptor only stands for a path (O_PATH)
        return False
    return True


def _flags(number: int) -> int:
    """The flags of an open file that still matter."""
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
    """Whether a file is still open. A file that only a lost thread held is closed, because threads do not survive."""
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
    """Copy an open file. The copy is deleted when it is closed."""
    direct = any(opened.flags & getattr(os, "O_DIRECT", 0) for opened in file.opened)  # memory may not support it
    in_memory = size <= LARGEST and not direct and hasattr(os, "memfd_create")
    copy: Any = os.fdopen(os.memfd_create("branch"), "wb") if in_memory else tempfile.TemporaryFile()  # noqa: SIM115
    if file.modes == {os.O_WRONLY}:  # the contents are never read
        os.truncate(copy.fileno(), size)
    else:
        shutil.copyfile(path, _path(copy.fileno()))
    return copy


def _temporary_folders() -> Iterator[tuple[Any, Any]]:
    """Temporary directories, which a forked process must not delete, each with its finalizer."""
    for end in list(finalize._registry):  # type: ignore[attr-defined]
        held = end.peek()
        if held is not None and isinstance(held[0], tempfile.TemporaryDirectory):
            yield end, held[0]


def _keep_temporary_files(paths: set[str]) -> None:
    """Prevent the named temporary files with these paths from being deleted when they are closed."""
    closer: Any = tempfile._TemporaryFileCloser  # type: ignore[attr-defined]
    for name in {"close", "cleanup"} & vars(closer).keys():
        setattr(closer, name, _keeping(getattr(closer, name), paths))


def _keeping(close: Callable[..., Any], paths: set[str]) -> Callable[..., Any]:
    """Wrap the function that closes a temporary file, so that it does not delete a file with one of these paths."""

    def close_only(closer: Any, *args: Any) -> Any:
        if os.path.realpath(closer.name) in paths:
            closer.delete = False
        return close(closer, *args)

    return close_only


def _delete_nothing(*args: Any, **kwargs: Any) -> None:
    """Do nothing, instead of deleting a directory of the parent process."""
