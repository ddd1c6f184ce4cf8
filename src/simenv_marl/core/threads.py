"""A driver that runs a simulation in a thread of its own, for what cannot live on a greenlet."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import Context, copy_context
from os import getpid
from threading import Lock, Thread, current_thread, get_ident
from time import monotonic
from typing import Any, Final

from ..errors import WrongThreadError, warn_user
from ..hooks.hook import Hook
from ..hooks.stacks import Taker
from ..simulation import RULE, Sentinel
from .events import FAILED, STALLED
from .loops import hush
from .switch import SECONDS_TO_UNWIND, BaseDriver, Crossing, Event, SimulationExit, nothing_to_end

_A_WHILE: Final = 1.0
"""For how many seconds the user waits before it looks around: a Ctrl-C just before a wait does not wake from it."""

SIMULATION: Final = "simulation"
"""The name of a simulation's thread."""

_NOTHING: Final = Sentinel("NOTHING")
_EXIT: Final = Sentinel("EXIT")
_JOB: Final = Sentinel("JOB")
_END: Final = Sentinel("END")


class ThreadDriver(BaseDriver):
    """Runs a simulation in a thread of its own, which the first ``start`` starts and ``end`` joins.

    Only one of the two threads runs at a time: what one hands over to the other lies in ``_reply`` and
    ``_event``, and a lock for each wakes the thread that waits for it. What counts is what lies there, and not how
    often a lock was released, so that a wait may be interrupted anywhere (by Ctrl-C, for instance) and nothing gets
    out of step.
    """

    __slots__ = ("_arrived", "_end", "_event", "_ident", "_process", "_reply", "_resumed", "_thread")

    def __init__(self, *, plugins: Any = None, before: BaseDriver | None = None, direct: bool = True) -> None:
        """Prepare a thread, as ``BaseDriver`` does; ``caller`` is always None."""
        super().__init__(plugins=plugins, before=before)
        self._process = getpid()
        self._resumed, self._arrived = Lock(), Lock()
        self._event: Event | None = None
        self._end: Event | None = None
        self._reply: Any = _NOTHING
        self._thread: Thread | None = None
        self._ident: int | None = None

    # -- in the simulation's thread ---------------------------------------------------------------

    def _serve(self) -> None:
        self._ident = get_ident()
        self._begin()
        try:
            while not self._ended and (reply := self._wait()) is not _END:
                if reply is _JOB:
                    self._do()
                reply = None
        finally:
            self._forget_stack()

    def _do(self) -> None:
        context: Any = self._context
        self._context = None
        try:
            end: Event = context.run(self._work)
        except BaseException as error:  # thrown into this thread from elsewhere; without an end its user would wait on
            end = FAILED, [error], None
        context = None
        if isinstance(end[1][0], SimulationExit):
            # It is not going to be read, and what its frames hold must go while this thread is there: greenlets of
            # the model's own can unwind nowhere else.
            end[1][0].__traceback__ = end[1][0].__context__ = None
        if self.lost():
            self._ended = True
            if end[0] is FAILED:
                raise end[1].pop()  # the model has forked, and in this process its user is not there to be told
            return
        self._idle = True
        self._event = self._end = end
        _wake(self._arrived)

    def _wait(self) -> Any:
        resumed = self._resumed
        while self._reply is _NOTHING:
            resumed.acquire()
        reply, self._reply = self._reply, _NOTHING
        return reply

    def _decider(self, hook: Hook, event: Crossing, away: bool = False) -> Taker:
        rule, deliver = self._rule_of(hook, event, away), event.deliver

        def decide(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            self._event = (event, args, kwargs)
            _wake(self._arrived)
            reply = self._wait()
            if reply is RULE:
                return rule(*args, **kwargs)
            if reply is _EXIT:
                hush()
                raise SimulationExit
            return reply if deliver is None else deliver(reply, *args, **kwargs)

        return decide

    # -- in its user's ----------------------------------------------------------------------------

    def prepare(
        self, job: Callable[[], Any], decisions: Mapping[Hook, Crossing] | None = None, context: Context | None = None
    ) -> None:
        """Have the next ``resume`` begin to run something on the stack."""
        self.enter()
        self._prepare(job, decisions, copy_context() if context is None else context)
        self._event = self._end = None
        if self._thread is None:
            self._start()

    def _start(self) -> None:
        self._resumed.acquire()
        self._arrived.acquire()
        self._thread = thread = Thread(target=self._serve, name=SIMULATION, daemon=True)
        try:
            thread.start()
        except Exception:  # there are too many threads
            self._thread = None
            self._resumed.release()
            self._arrived.release()
            raise

    def resume(self, reply: Any) -> Event:
        """Let the simulation go on with a reply; return the event that comes from it next."""
        self._reply = reply if self._job is None else _JOB
        _wake(self._resumed)
        arrived = self._arrived
        while (event := self._event) is None:
            arrived.acquire(True, _A_WHILE)
        self._event = self._end = None
        return event

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return the event that comes from it next.

        Where it is not suspended, because its user was interrupted while waiting for it, it is raised at its next
        decision.
        """
        self.enter()
        if self._thread is None or (self._idle and self._end is None and self._reply is not _JOB):
            return nothing_to_end()
        patience = monotonic() + SECONDS_TO_UNWIND
        self._exiting = True
        self._event = None
        if not (self._idle and self._reply is _JOB):  # else the job begins, and is told at its first decision
            self._reply = _EXIT
            _wake(self._resumed)
        # An end is looked for where it stays, whenever it came.
        while (event := self._end or self._event) is None:
            left = patience - monotonic()
            if left <= 0:
                return STALLED, [], SECONDS_TO_UNWIND
            self._arrived.acquire(timeout=left)
        self._event = self._end = None
        return event

    def enter(self) -> None:
        """Make ready to be resumed from here.

        Raises:
            WrongThreadError: This process was forked, and the simulation's thread stayed behind.
        """
        if self.lost():
            raise WrongThreadError(
                "this process was forked in mid-episode, and the thread in which the simulation is suspended has"
                ' stayed behind in the parent; call reset(), or use driver="greenlet"'
            )

    def reachable(self) -> bool:
        """Whether the simulation can be resumed from here."""
        return not self.lost()

    def lost(self) -> bool:
        """Whether this process was forked, which no other thread survives."""
        return getpid() != self._process

    def end(self) -> None:
        """End the stack, whose job has ended or is lost; wait for its thread to be gone.

        Where this is interrupted, it can be called again.
        """
        if self._ended and not self._idle:
            return
        thread = self._thread
        self._event = self._end = None
        if self._idle and thread is not None and thread is not current_thread() and not self.lost():
            self._reply = _END
            _wake(self._resumed)
            if thread.ident is not None:  # else it was interrupted before it started
                thread.join(SECONDS_TO_UNWIND)
            if thread.is_alive():
                warn_user(
                    f"the thread of a simulation that has ended is still there after {SECONDS_TO_UNWIND} s",
                    ResourceWarning,
                )
        self._forget_stack()
        self._thread = None

    def give_up(self) -> None:
        """Leave a job that does not unwind where it is; at its next decision it gets another chance."""
        self._ended = True
        self.children.driver = None  # threads that it has started run their rule

    def forked(self) -> None:
        """The process was forked, and this is the child: in the simulation's own thread, or without it."""
        if self._ident == get_ident():
            self._go_astray(
                "a process that the simulation has forked, while the environment's user is in another thread and has"
                ' stayed behind in the parent (with driver="greenlet" it comes along)'
            )
        else:
            self._stay_behind()


def _wake(lock: Any) -> None:
    """Have the thread that waits for a lock, or is going to, look again."""
    if lock.locked():
        lock.release()
