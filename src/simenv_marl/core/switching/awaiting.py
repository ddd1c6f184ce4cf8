"""Coroutines of policies. They run in one thread with one event loop, as long as the process lives.

Simulations stay in their own threads, because greenlets cannot change threads. The loop lasts, so
that clients keep their connections. A forked process makes another loop.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from concurrent.futures import Future
from inspect import isawaitable
from queue import Empty, SimpleQueue
from threading import Thread, current_thread
from typing import Any, Final

from ...errors import ReentrancyError, short_repr, warn_user
from ...simulation import Action

SECONDS_TO_CANCEL: Final = 10.0
"""The seconds that coroutines may take to end after they were cancelled."""

THREAD: Final = "simenv_marl policies"
"""The name of the thread."""

LOOPS: Final[dict[int, asyncio.AbstractEventLoop]] = {}
"""The event loops of policies, by process. A forked process inherits the entry of its parent."""


def _loop() -> asyncio.AbstractEventLoop:
    """Return the event loop of this process."""
    process = os.getpid()
    if process not in LOOPS:
        loop = asyncio.new_event_loop()
        Thread(target=loop.run_forever, name=THREAD, daemon=True).start()
        LOOPS[process] = loop
    return LOOPS[process]


class Answer:
    """The answer of a policy. It may be on its way."""

    def __init__(self, value: Action, report: Callable[[Answer], None]) -> None:
        """Await an answer in the thread of the event loop.

        Args:
            value: The answer, or an awaitable of it.
            report: Called with this object when the answer has come, in that thread; at once for an
                answer that is not awaitable.
        """
        self._value = value
        self._error: BaseException | None = None
        self._future: Future[None] | None = None
        if isawaitable(value):
            self._future = asyncio.run_coroutine_threadsafe(self._await(report), _loop())
        else:
            report(self)

    async def _await(self, report: Callable[[Answer], None]) -> None:
        try:
            self._value = await self._value
        except BaseException as error:  # also an exit, because it would end the loop
            self._error = error
        report(self)

    def cancel(self) -> None:
        """Cancel an answer that is on its way. It is reported when its coroutine has ended."""
        if self._future is not None:
            # The loop cancels in its next round, because a task that has not begun never reports.
            loop = _loop()
            loop.call_soon_threadsafe(loop.call_soon, self._future.cancel)

    def result(self) -> Action:
        """Return the answer that was reported, or raise its error."""
        if self._error is not None:
            try:
                raise self._error
            finally:
                self._error = None  # its traceback refers to this object
        return self._value


class Answers:
    """Answers that are on their way, each with a key.

    Not thread-safe: one thread adds and takes them.
    """

    def __init__(self) -> None:
        self._keys: dict[Answer, Any] = {}
        self._reported: SimpleQueue[Answer] = SimpleQueue()

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def ready(self) -> bool:
        """Whether an answer has come."""
        return not self._reported.empty()

    def add(self, key: Any, value: Action) -> None:
        """Add an answer, or an awaitable of it.

        Raises:
            ReentrancyError: This is a coroutine of a policy itself: it would wait for its own
                thread.
        """
        if isawaitable(value) and current_thread().name == THREAD:
            getattr(value, "close", int)()
            raise ReentrancyError(
                "a coroutine of a policy runs simulations whose policies are coroutines; run them"
                " in another thread: await asyncio.to_thread(simulate, ...)"
            )
        self._keys[Answer(value, self._reported.put)] = key

    def take(self) -> tuple[Any, Answer]:
        """Wait for the next answer, and return its key and the answer."""
        answer = self._reported.get()
        return self._keys.pop(answer), answer

    def cancel(self) -> None:
        """Cancel all answers that are on their way, and wait until their coroutines have ended."""
        for answer in self._keys:
            answer.cancel()
        while self._keys:
            try:
                self._keys.pop(self._reported.get(timeout=SECONDS_TO_CANCEL))
            except Empty:
                warn_user(
                    f"{len(self._keys)} coroutines of policies have not ended {SECONDS_TO_CANCEL}"
                    f" s after they were cancelled: {short_repr(list(self._keys.values()))}",
                    ResourceWarning,
                )
                return


def wait_for(answer: Action) -> Action:
    """Return an answer, after waiting for it if it is awaitable. An interrupt cancels it first."""
    if not isawaitable(answer):
        return answer
    answers = Answers()
    try:
        answers.add(None, answer)
        return answers.take()[1].result()
    finally:
        answers.cancel()
