"""The guardian: a shell that ends the simulators of this process when this process has ended.

The guardian works even if this process was killed. A simulator that computes does not notice the
end of its pipe. On Linux, the kernel can signal a process when its parent ends, but then the parent
is the thread that started it, and the signal misses other processes of the simulator. So a shell
waits for the end of this process, and then kills the process groups of its simulators. The shell
runs while there are simulators.
"""

import os
from contextlib import suppress
from subprocess import DEVNULL, PIPE, Popen
from threading import RLock
from typing import Final

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
"""The shell reads process groups from its input, until no process has the other end."""

_lock = RLock()
_groups: Final[set[int]] = set()
_shell: Popen[bytes] | None = None


def guard(group: int) -> None:
    """End a process group when this process has ended."""
    global _shell
    with _lock:
        if _shell is None:
            _shell = Popen(
                ["/bin/sh", "-c", _SCRIPT],
                bufsize=0,
                cwd="/",
                stdin=PIPE,
                stdout=DEVNULL,
                stderr=DEVNULL,
                start_new_session=True,
            )
        _groups.add(group)
        _send(_shell, f"+ {group}\n")


def release(group: int) -> None:
    """Remove a process group that has ended. The shell ends after the last one."""
    global _shell
    with _lock:
        shell = _shell
        if shell is None or group not in _groups:
            return
        _groups.remove(group)
        if _groups:
            _send(shell, f"- {group}\n")
        else:
            _shell = None
            # not by the end of its input: it may be stopped, and a fork may have the pipe
            shell.kill()
            shell.communicate()


def _send(shell: Popen[bytes], line: str) -> None:
    assert shell.stdin is not None
    with suppress(BrokenPipeError):  # the shell was killed
        shell.stdin.write(line.encode())


def _forget() -> None:
    """Close the pipe in a forked process, because its parent owns the simulators."""
    global _shell, _lock
    shell = _shell
    _shell = None
    _lock = RLock()
    _groups.clear()
    if shell is not None:
        # closes the pipe, and does not wait, because the shell is no child of this process
        shell.communicate()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
