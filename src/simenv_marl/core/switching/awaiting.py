"""Coroutines of policies. They run in one thread with one event loop, for as long as the process.

Simulations stay in their own threads, because greenlets cannot change threads. The loop lasts, so
that clients keep their connections. A forked process makes a loop for itself.
"""

from __future__ import annotations

import asyncio
import inspect
import os
from collections.abc import Awaitable, Callable
from queue import Empty, SimpleQueue
from threading import Thread, current_thread
from typing import Any, Final

from ...errors import ReentrancyError, short_repr, warn_user

SECONDS_TO_CANCEL: Final = 10.0
"""The seconds that coroutines may take to end after they were cancelled."""

THREAD: Final = "simenv_marl policies"
"""The name of the thread."""

_loops: Final[dict[int, asyncio.AbstractEventLoop]] = {}
"""The loop, by the process that it belongs to."""


def _loop() -> asyncio.AbstractEventLoop:
    """Return the loop of this process."""
    loop = _loops.get(os.getpid())
    if loop is None:
        made = asyncio.new_event_loop()
        loop = _loops.setdefault(os.getpid(), made)
        if loop is made:
            Thread(target=loop.run_forever, name=THREAD, daemon=True).start()
        else:  # another thread was faster
            made.close()
    return loop


def policy_loops() -> list[asyncio.AbstractEventLoop]:
    """Return the loops in which policies are awaited."""
    return list(_loops.values())


class Answer:
    """An answer that is on its way. ``value`` and ``error`` hold it when it has been reported."""

    def __init__(self, value: Any, report: Callable[[Answer], None]) -> None:
        """Report a value at once; something awaitable in the loop's thread, when it has ended."""
        self.value: Any = value
        self.error: BaseException | None = None
        if not inspect.isawaitable(value):
            report(self)
            return
        self._loop = loop = _loop()
        self._task: asyncio.Task[None] | None = None

        def begin() -> None:
            self._task = loop.create_task(self._await(value))
            self._task.add_done_callback(end)

        def end(task: asyncio.Task[None]) -> None:
            if task.cancelled():
                self.error = asyncio.CancelledError()
                getattr(value, "close", int)()  # a coroutine that was cancelled before it began
            report(self)

        loop.call_soon_threadsafe(begin)

    async def _await(self, awaitable: Awaitable[Any]) -> None:
        try:
            self.value = await awaitable
        except asyncio.CancelledError:
            raise
        except BaseException as error:  # an exit, too: it would end the loop
            self.error = error

    def cancel(self) -> None:
        """Cancel it. It is reported when it has ended."""
        self._loop.call_soon_threadsafe(lambda: self._task is None or self._task.cancel())

    def result(self) -> Any:
        """Return the answer that was reported, or raise its error."""
        if self.error is not None:
            try:
                raise self.error
            finally:
                self.error = None  # its traceback refers to this object
        return self.value


class Answers:
    """Answers that are on their way, each with a key.

    Not thread-safe: one thread asks for them and takes them.
    """

    def __init__(self) -> None:
        self._keys: dict[Answer, Any] = {}
        self._ended: SimpleQueue[Answer] = SimpleQueue()

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def ready(self) -> bool:
        """Whether an answer has come."""
        return not self._ended.empty()

    def add(self, key: Any, value: Any) -> None:
        """Await something. What is not awaitable is an answer.

        Raises:
            ReentrancyError: This is a coroutine of a policy itself: it would wait for its own
                thread.
        """
        if inspect.isawaitable(value) and current_thread().name == THREAD:
            getattr(value, "close", int)()
            raise ReentrancyError(
                "a coroutine of a policy runs simulations whose policies are coroutines; run them"
                " in another thread: await asyncio.to_thread(simulate, ...)"
            )
        self._keys[Answer(value, self._ended.put)] = key

    def take(self) -> tuple[Any, Answer]:
        """Wait for the next answer, and return its key and the answer."""
        answer = self._ended.get()
        return self._keys.pop(answer), answer

    def cancel(self) -> None:
        """Cancel those that are on their way, and wait until they have ended."""
        for answer in self._keys:
            answer.cancel()
        while self._keys:
            try:
                self._keys.pop(self._ended.get(timeout=SECONDS_TO_CANCEL))
            except Empty:
                warn_user(
                    f"{len(self._keys)} coroutines of policies have not ended {SECONDS_TO_CANCEL}"
                    " s after they were"
                    f" cancelled: {short_repr(list(self._keys.values()))}",
                    ResourceWarning,
                )
                return


def wait_for(answer: Any) -> Any:
    """Return an answer; one that is awaitable when it has come. An interrupt cancels it first."""
    if not inspect.isawaitable(answer):
        return answer
    answers = Answers()
    try:
        answers.add(None, answer)
        return answers.take()[1].result()
    finally:
        answers.cancel()
