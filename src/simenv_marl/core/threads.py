"""A driver that runs a simulation in a thread of its own, for what cannot live on a greenlet."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import copy_context
from os import getpid
from threading import Lock, Thread, current_thread, get_ident
from time import monotonic
from typing import Any, Final

from ..errors import WrongThreadError, warn_user
from ..simulation import RULE, Sentinel
from .switch import FAILED, FINISHED, RUNNING, STUCK, Bound, Event, Offspring, SimulationExit, Watchful

SECONDS_TO_UNWIND: Final = 5.0
"""How long a simulation that is to be unwound may take to its next decision or to its end."""

_A_WHILE: Final = 1.0
"""For how many seconds the user waits before it looks around: a Ctrl-C just before a wait does not wake from it."""

_NOTHING: Final = Sentinel("NOTHING")
_EXIT: Final = Sentinel("EXIT")


class ThreadDriver(Watchful):
    """Runs a simulation in a thread of its own, which the first ``resume`` starts and ``forget`` joins.

    Only one of the two threads runs at a time: what one hands over to the other lies in ``_reply`` and
    ``_event``, and a lock for each wakes whoever waits for it. What counts is what lies there, and not how often
    a lock was released, so that a wait may be interrupted anywhere (by Ctrl-C, for instance) and nothing gets out
    of step.
    """

    __slots__ = ("_arrived", "_body", "_end", "_event", "_process", "_reply", "_resumed", "_thread")

    caller: Any = None
    """The process may have been forked since, so ``enter`` is always to be called."""

    def __init__(self, run: Callable[[], Any], bindings: Mapping[Any, Bound], offspring: Offspring) -> None:
        """Prepare a thread; the first ``resume`` starts it.

        Args:
            run: The simulation's main loop.
            bindings: The decision points that are handed over; all others run their rule.
            offspring: The threads that the simulation has started or is going to.
        """
        super().__init__(bindings, offspring)
        self._process = getpid()
        self._resumed, self._arrived = Lock(), Lock()
        self._event: Event | None = None
        self._end: Event | None = None
        self._reply: Any = _NOTHING
        # A new thread has an empty context; a model expects the one that its user has set up.
        self._body: Any = (copy_context(), run)
        self._thread: Thread | None = None

    # -- in the simulation's thread ---------------------------------------------------------------

    def _run(self) -> None:
        (context, run), self._body = self._body, None
        thread = get_ident()
        RUNNING[thread] = self.ask
        try:
            self._end = context.run(self._live, run)  # not in this frame too, to which the frames of an error lead back
        except BaseException as error:  # thrown into this thread from elsewhere; without an end its user would wait on
            self._end = FAILED, error, None
        RUNNING.pop(thread, None)
        if isinstance(self._end[1], SimulationExit):
            # Nobody is going to read it, and what its frames hold must go while this thread is there: greenlets of
            # the model's own can unwind nowhere else.
            self._end[1].__traceback__ = self._end[1].__context__ = None
        if self._end[0] is FAILED and self.lost():
            raise self._end[1]  # the model has forked, and in this process there is nobody else to be told
        self._event = self._end
        _wake(self._arrived)

    def ask(self, point: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """In the simulation: decide a call of a decision point.

        Raises:
            WrongThreadError: The simulation has forked its process, and this is the child.
        """
        binding = self._bindings.get(point)
        if binding is None:
            return point.rule(*args, **kwargs)
        if getpid() != self._process:
            raise WrongThreadError(
                f"{point.name} was called in a process that the simulation has forked; the environment's user is in"
                ' another thread, and so has stayed behind in the parent. With driver="greenlet" it comes along'
            )
        thread, deliver = get_ident(), binding.deliver
        del RUNNING[thread]
        self._event = (binding, args, kwargs)
        _wake(self._arrived)
        resumed = self._resumed
        while self._reply is _NOTHING:
            resumed.acquire()
        reply, self._reply = self._reply, _NOTHING
        RUNNING[thread] = self.ask
        if reply is RULE:
            return point.rule(*args, **kwargs) if binding.by_rule is None else binding.by_rule(point, args, kwargs)
        if reply is _EXIT:
            raise SimulationExit
        return reply if deliver is None else deliver(reply, *args, **kwargs)

    # -- in its user's ----------------------------------------------------------------------------

    def resume(self, reply: Any) -> Event:
        """Let the simulation go on with a reply; return the event that comes from it next."""
        if self._thread is None:
            self._start()
        else:
            self._reply = reply
            _wake(self._resumed)
        arrived = self._arrived
        while (event := self._event) is None:
            arrived.acquire(True, _A_WHILE)
        self._event = None
        return event

    def _start(self) -> None:
        self._resumed.acquire()
        self._arrived.acquire()
        self._thread = thread = Thread(target=self._run, name="simulation", daemon=True)
        try:
            thread.start()
        except Exception:  # there are too many threads
            self._thread = None
            raise

    def throw(self) -> Event:
        """Raise ``SimulationExit`` in the suspended simulation; return the event that comes from it next.

        Where it is not suspended, because its user was interrupted while waiting for it, it is raised at its next
        decision.
        """
        self.enter()
        if self._thread is None:
            return FINISHED, None, None
        patience = monotonic() + SECONDS_TO_UNWIND
        self._event = None
        self._reply = _EXIT
        _wake(self._resumed)
        # An end is looked for where it stays, whenever it came.
        while (event := self._end or self._event) is None:
            left = patience - monotonic()
            if left <= 0:
                return STUCK, SECONDS_TO_UNWIND, None
            self._arrived.acquire(timeout=left)
        self._event = None
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

    def forget(self) -> None:
        """Let go of all references to the simulation, which has ended or is lost; wait for its thread to be gone."""
        self._disown()
        thread, self._thread = self._thread, None
        self._body = self._event = self._end = None
        if thread is None or thread is current_thread() or self.lost():
            return
        thread.join(SECONDS_TO_UNWIND)
        if thread.is_alive():
            warn_user(
                f"the thread of a simulation that has ended is still there after {SECONDS_TO_UNWIND} s", ResourceWarning
            )

    def give_up(self) -> None:
        """Leave a simulation that does not unwind where it is; at its next decision it gets another chance."""
        self.offspring.driver = None


def _wake(lock: Any) -> None:
    """Have whoever waits for a lock, or is going to, look again."""
    if lock.locked():
        lock.release()
