"""Extensions: handlers before, after and instead of a model's functions, without touching the model (paper).

Handlers are attached to functions, methods, generator and coroutine functions, iterables, and classes whose
instances iterate; for the whole process (``attach_handler``), for a while (``handlers``), or for an environment
alone (the option ``plugins``). What has none costs nothing, or, exposed by ``expose_to_plugins``, one test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from ..errors import HandlerError, SimEnvError
from .attached import Attached, Call, title
from .handlers import Target
from .hook import Hook
from .places import leads_there
from .stacks import LOCK
from .targets import at_hand, expose, find_target

Thing = TypeVar("Thing")

Entry = tuple[Callable[..., Any], Any, str]
"""A handler, its target, and its position."""


def attached_handlers(env: Any = None) -> list[Entry]:
    """The handlers that are attached, by target in the order in which they run.

    Args:
        env: An environment, for the handlers of its option ``plugins``; None: for those of the whole process.

    Returns:
        For each the handler, the dotted name of its target, and its position.
    """
    if env is not None:
        entries: list[Entry] = env.unwrapped.plugins
        return entries
    targets = sorted(Target.all, key=lambda target: target.name)
    return [(a.handler, target.name, a.position) for target in targets for a in target.attached]


def expose_to_plugins(function_or_iterable: Thing) -> Thing:
    """Let handlers be attached to a function or an iterable (paper, section 3.4).

    As a decorator inside the model, over or under ``staticmethod``, ``classmethod`` and ``make_step``, or from
    outside: ``Model.step = expose_to_plugins(Model.step)``. What is importable need not be exposed to have
    handlers attached to it, by its dotted name.

    Args:
        function_or_iterable: A function of any kind, an iterable, or a class whose instances are iterable.

    Returns:
        The exposed function, which keeps its looks, and is one also when it is exposed again; for an iterable
        what behaves like it in all respects; the class itself.

    Raises:
        PatchError: It is none of these, or a method that is bound to one object.
    """
    with LOCK:
        exposed: Thing = expose(function_or_iterable)
    return exposed


# -- handlers -------------------------------------------------------------------------------------


def attach_handler(handler: Callable[..., Any], target: Any, position: str) -> None:
    """Attach a handler to a function, for the whole process (paper, section 3.4).

    Args:
        handler: Called with the arguments of the call as they were passed; ``*_next``: with those of the generator
            function, or the iterable. ``before`` may return ``ChangedArgs``; ``after`` gets the result as
            ``_result`` where it has a parameter of that name, and may return ``ChangedResult``; what ``instead``
            returns is the result. Those of one position run in the order in which they were attached; of several
            ``instead`` the latest alone runs, and then neither ``before`` nor ``after``.
        target: The function, or the dotted name of any importable one, whether it is exposed or not.
        position: "before", "after" or "instead"; for iterables and generator functions also "before_next",
            "after_next" or "instead_next".

    Raises:
        UnknownTargetError: The name leads to nothing.
        HandlerError: There is no such position, or the handler cannot be called like the target.
        PatchError: The target is not exposed, and cannot be patched.
    """
    with LOCK:
        _attach(handler, target, position)


def _attach(handler: Any, target: Any, position: str) -> Attached:
    found = find_target(target)
    attached = Attached(handler, found, position)
    found.add(attached)
    return attached


def remove_handler(target: Any, position: str, handler: Callable[..., Any] | None = None) -> None:
    """Remove what ``attach_handler`` has attached.

    Args:
        target: The function, or its dotted name.
        position: The position.
        handler: The handler, of which the one that was attached last is removed; None: all at this position.

    Raises:
        UnknownTargetError: The name leads to nothing.
        HandlerError: There is no such handler.
    """
    with LOCK:
        found = find_target(target)
        there = [a for a in found.attached if a.position == position and (handler is None or a.handler == handler)]
        if not there:
            what = "no handler" if handler is None else f"{title(handler)} not"
            at = ", ".join(sorted({a.position for a in found.attached})) or "nowhere"
            raise HandlerError(f"{what} attached {position!r} {found.name}; handlers are attached: {at}")
        for attached in there if handler is None else there[-1:]:
            found.remove(attached)


@contextmanager
def handlers(*entries: Entry) -> Iterator[None]:
    """Attach handlers for as long as a block runs.

    Args:
        *entries: For each, what ``attach_handler`` takes: handler, target, position.

    Raises:
        SimEnvError: As ``attach_handler``; none is attached then.
    """
    done: list[Attached] = []
    try:
        with LOCK:
            for entry in entries:
                done.append(_attach(*checked_entry(entry)))
        yield
    finally:
        with LOCK:
            for attached in reversed(done):
                if any(own is attached for own in attached.target.attached):  # not removed meanwhile
                    attached.target.remove(attached)


def checked_entry(entry: Any) -> Entry:
    """What is to be attached where, if it is of that form.

    Raises:
        HandlerError: It is not.
    """
    if not isinstance(entry, (tuple, list)) or len(entry) != 3:
        raise HandlerError(f"handlers are given as (handler, target, position), not {entry!r}")
    handler, target, position = entry
    return handler, target, position


# -- of one environment ---------------------------------------------------------------------------


class Plugins:
    """The handlers of the environments of one plan. Also the key under which targets know them, and an ``Evaluation``.

    Attributes:
        memory: None; what differences remember is known to agents.
    """

    memory: dict[Any, Any] | None = None

    def __init__(self, entries: Iterable[Any]) -> None:
        """Find the targets, and make sure that the handlers fit.

        Raises:
            SimEnvError: As ``attach_handler``.
        """
        self._attached: list[Attached] = []
        self._given: list[Any] = []
        self._users = 0
        with LOCK:
            for entry in entries:
                handler, target, position = checked_entry(entry)
                self._given.append(target)
                self._attached.append(Attached(handler, find_target(target), position))

    @property
    def plugins(self) -> Plugins:
        """Themselves: they take part in what is evaluated for their environment."""
        return self

    @property
    def entries(self) -> list[Entry]:
        """For each the handler, the dotted name of its target, and its position."""
        return [(a.handler, a.target.name, a.position) for a in self._attached]

    @property
    def portable(self) -> list[Entry]:
        """The same as ``entries``, but for targets that are not named the same in another process."""
        return [
            (handler, target if leads_there(target) else given, position)
            for (handler, target, position), given in zip(self.entries, self._given, strict=True)
        ]

    @property
    def stale(self) -> bool:
        """Whether a target has been replaced by something else, while nothing was set there."""
        return any(a.target.stale for a in self._attached)

    @property
    def hooks(self) -> Iterable[Hook]:
        """The hooks of functions that have handlers."""
        return {id(a.target): a.target for a in self._attached if isinstance(a.target, Hook)}.values()

    def hold(self) -> None:
        """Have the handlers attached until as many calls of ``let_go``.

        Raises:
            PatchError: A target cannot be patched.
        """
        with LOCK:
            self._users += 1
            if self._users > 1:
                return
            done = []
            try:
                for attached in self._attached:
                    attached.target.add(attached, self)
                    done.append(attached)
            except BaseException:
                self._users = 0
                for attached in done:
                    attached.target.remove(attached, self)
                raise

    def let_go(self) -> None:
        """Undo one ``hold``."""
        with LOCK:
            self._users -= 1
            if self._users == 0:
                for attached in reversed(self._attached):
                    attached.target.remove(attached, self)


# -- seeing what happens --------------------------------------------------------------------------


@contextmanager
def trace(*targets: Any) -> Iterator[list[Call]]:
    """Record the calls of a model's functions, in the order in which they begin.

    Args:
        *targets: The functions, as ``attach_handler`` takes them; none: all that are exposed or have handlers, and
            all decorated decision points.

    Returns:
        A context manager whose value is the list of calls. An entry has the attributes ``target``, ``arguments``
        and ``result``, which are strings; the result is None until the call ends.

    Raises:
        SimEnvError: As ``attach_handler``.
    """
    calls: list[Call] = []

    def record(target: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Call:
        call = Call.of(target, args, kwargs)
        calls.append(call)
        return call

    done: list[Target] = []
    try:
        with LOCK:
            for target in dict.fromkeys(map(find_target, targets) if targets else _everything()):
                if not isinstance(target, Hook):
                    continue
                target.add(record)
                done.append(target)
        yield calls
    finally:
        with LOCK:
            for target in done:
                target.remove(record)


def _everything() -> Iterator[Target]:
    """All that is exposed or has handlers, and all decorated decision points."""
    for target in list(Target.all):
        if isinstance(target, Hook) and (target.for_good or target.slot):
            with suppress(SimEnvError, ImportError):
                yield at_hand(target)
