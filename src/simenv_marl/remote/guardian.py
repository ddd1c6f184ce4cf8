"""The guardian of a process's simulators: it ends them when the process has ended, also if that was killed.

A simulator that computes does not notice the end of its pipe. On Linux, the kernel can signal a
process when its parent ends, but means the thread that started it, and no further processes of the
simulator. So a shell waits for the end of this process instead, and then kills the groups of its
simulators. It runs while there are simulators.
"""

from __future__ import annotations

import os
from contextlib import suppress
from subprocess import DEVNULL, PIPE, Popen
from threading import RLock
from typing import Any, Final

_SCRIPT: Final = """
groups=
while read -r sign group; do
    case $sign in
        +) groups="$groups $group " ;;
        -) groups="${groups%% $group *}${groups#* $group }" ;;
    esac
done
for group in $groups; do kill -s KILL -- "-$group"; done
"""
"""Its input ends when no process has the other end of the pipe any more."""

_lock = RLock()
_groups: Final[set[int]] = set()
_shell: Popen[bytes] | None = None


def guard(group: int) -> None:
    """Let a process group end with this process."""
    global _shell
    with _lock:
        if _shell is None:
            command = ["/bin/sh", "-c", _SCRIPT]
            _shell = Popen(
                command,
                bufsize=0,
                cwd="/",
                stdin=PIPE,
                stdout=DEVNULL,
                stderr=DEVNULL,
                start_new_session=True,
            )
        _groups.add(group)
        _tell(_shell, f"+ {group}\n")


def release(group: int) -> None:
    """Leave a process group alone, because it has ended. After the last one, the shell ends."""
    global _shell
    with _lock:
        if group not in _groups:
            return
        assert _shell is not None  # as long as there are groups
        _groups.remove(group)
        if _groups:
            _tell(_shell, f"- {group}\n")
        else:
            shell, _shell = _shell, None
            shell.kill()  # it may have been stopped, and other processes may have the pipe
            shell.communicate()


def _tell(shell: Popen[Any], line: str) -> None:
    assert shell.stdin is not None
    with suppress(BrokenPipeError):  # it was killed
        shell.stdin.write(line.encode())


def _forget() -> None:
    """In a forked process: close its copy of the pipe, because its simulators are those of its parent."""
    global _shell, _lock
    shell, _shell, _lock = _shell, None, RLock()
    _groups.clear()
    if shell is not None:
        assert shell.stdin is not None
        shell.stdin.close()
        shell.returncode = 0  # only its owner waits for it


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
