"""Event loops of asyncio: a simulation in a greenlet has a running loop apart from its user's."""

from __future__ import annotations

import sys
from asyncio import AbstractEventLoop, _get_running_loop, _set_running_loop
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from sys import _asyncgen_hooks

LoopState = tuple[AbstractEventLoop | None, "_asyncgen_hooks | tuple[None, None]", int]
"""The running loop of a thread, its hooks of asynchronous generators, and its tracking depth."""

NO_LOOP: Final[LoopState] = (None, (None, None), 0)
"""The state of a thread without a loop."""


def swap_loop(state: LoopState) -> LoopState:
    """Return the state of this thread. Set another state if one of the two has a loop."""
    loop = _get_running_loop()
    present = loop, sys.get_asyncgen_hooks(), sys.get_coroutine_origin_tracking_depth()
    if loop is None and state[0] is None:
        _set_running_loop(None)  # Python finds it faster from now on
        return present
    wanted, hooks, depth = state
    _set_running_loop(wanted)
    sys.set_asyncgen_hooks(*hooks)
    sys.set_coroutine_origin_tracking_depth(depth)
    return present
