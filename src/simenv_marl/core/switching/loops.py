"""Event loops of asyncio: a simulation has a running loop apart from its user's.

Its tasks may wait for replies. When their loop has nothing else to do, they are asked for together.
"""

from __future__ import annotations

import sys
from asyncio import (
    AbstractEventLoop,
    Future,
    Task,
    _get_running_loop,
    _set_running_loop,
    current_task,
    get_running_loop,
)
from collections.abc import Callable, Generator
from types import coroutine
from typing import TYPE_CHECKING, Any, Final

from ...hooks.hook import BOUND
from ...simulation import RULE, Function, Model

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


MOST_ROUNDS: Final = 1000
"""The rounds of a loop that is never idle, because a task polls, until its questions are asked."""


class Question:
    """A reply that comes later: the task that gets it waits.

    Attributes:
        handler: Handles the event of all questions that wait together, and replies to each.
    """

    handler: Any


class Tasks:
    """The tasks of a model that wait for replies."""

    def __init__(self) -> None:
        self._waiting: dict[AbstractEventLoop | None, dict[Future[Model], Question]] = {}

    def clear(self) -> None:
        """Forget the tasks."""
        self._waiting.clear()

    def current(self, loop: AbstractEventLoop | None) -> Task[Model] | None:
        """Return the task in which a loop is suspended, if the task can wait for a reply."""
        return current_task(loop) if hasattr(loop, "_ready") else None

    def questions(self, loop: AbstractEventLoop | None) -> list[Any]:
        """Return the questions whose tasks wait in a loop."""
        waiting = self._waiting.get(loop, {})
        return [question for future, question in waiting.items() if not future.done()]

    @coroutine
    def deliver(
        self,
        sender: Callable[..., Function],
        rule: Function,
        deliver: Function,
        reply: Model,
        *args: Model,
        **kwargs: Model,
    ) -> Generator[Model, Model, Model]:
        """Turn a reply, or a question, into the value of a call, as ``deliver`` does.

        ``sender`` makes the function that sends the event of a handler.
        """
        if isinstance(reply, Question):
            loop = get_running_loop()
            waiting = self._waiting.setdefault(loop, {})
            if not waiting:
                loop.call_soon(self._look, loop, sender(reply.handler), MOST_ROUNDS)
            future = loop.create_future()
            waiting[future] = reply
            reply = yield from future
            if reply is RULE:
                return (yield from rule(*args, **kwargs))
        return (yield from deliver(reply, *args, **kwargs))

    def _look(self, loop: Any, send: Function, rounds: int) -> None:
        """Have the questions answered if the loop has nothing else to do. Else look again later."""
        if loop._ready and rounds:
            loop.call_soon(self._look, loop, send, rounds - 1)
            return
        waiting = self._waiting.pop(loop)
        waiting = {future: each for future, each in waiting.items() if not future.done()}
        if waiting:
            replies = send(([*waiting.values()],), BOUND)
            for future, reply in zip(waiting, replies, strict=True):
                future.set_result(reply)
