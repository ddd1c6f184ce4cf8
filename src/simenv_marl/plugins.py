"""Extensions: handlers before, after and instead of a model's functions, without a change to the model (paper).

Handlers are attached to functions, methods, generator and coroutine functions, iterables, and classes whose instances
are iterable: for the whole process (``attach_handler``), for a block (``handlers``), or for one environment (the option
``plugins``). A function without handlers costs nothing extra or, if ``expose_to_plugins`` exposed it, one test.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from .decision import decision_points
from .errors import HandlerError, name_of, short_repr
from .hooks.finding import expose, exposed_functions, find_target
from .hooks.handlers import Call, ChangedArgs, ChangedResult, Handler, Trace
from .hooks.hook import Hook
from .hooks.patches import Installation
from .hooks.plugins import Attachment, Entry, make_handler
from .hooks.stacks import LOCK
from .hooks.targets import Target

__all__ = [
    "Call",
    "ChangedArgs",
    "ChangedResult",
    "attach_handler",
    "attached_handlers",
    "decision_points",
    "expose_to_plugins",
    "exposed_functions",
    "handlers",
    "remove_handler",
    "trace",
]

Thing = TypeVar("Thing")


def attached_handlers(env: Any = None) -> list[Entry]:
    """Return the attached handlers, by target, in the order in which they run.

    Args:
        env: An environment, for the handlers of its option ``plugins``. None: the handlers of the whole process.

    Returns:
        A list of tuples: the handler, the dotted name of its target, and its position.
    """
    if env is not None:
        entries: list[Entry] = env.unwrapped.plugins
        return entries
    targets = sorted(Target.all.values(), key=lambda target: target.name)
    return [(handler.function, target.name, handler.position) for target in targets for handler in target.handlers]


def expose_to_plugins(function_or_iterable: Thing) -> Thing:
    """Let handlers be attached to a function or an iterable (paper, section 3.4).

    Use it as a decorator in the model, above or below ``staticmethod``, ``classmethod`` and ``make_step``; or from
    outside: ``Model.step = expose_to_plugins(Model.step)``. An importable function need not be exposed: handlers can be
    attached to its dotted name.

    Args:
        function_or_iterable: A function of any kind, an iterable, or a class whose instances are iterable.

    Returns:
        The exposed function, which keeps its name, signature and docstring and may be exposed again; for an iterable, a
        proxy that behaves like it; for a class, the class itself.

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
        handler: A callable. It gets the arguments of the call as they were passed; at ``*_next`` positions, it gets
            those of the generator function, or the iterable. A ``before`` handler may return ``ChangedArgs``. An
            ``after`` handler gets the result if it has a parameter ``_result``, and may return ``ChangedResult``. The
            result of an ``instead`` handler is the result of the call. Handlers of one position run in the order in
            which they were attached. Of several ``instead`` handlers only the latest runs, and then no ``before`` and
            ``after`` handlers.
        target: The function, or the dotted name of any importable function, exposed or not.
        position: "before", "after" or "instead"; for iterables and generator functions also "before_next", "after_next"
            or "instead_next".

    Raises:
        UnknownTargetError: The name does not exist.
        HandlerError: The position does not exist, or the handler cannot be called like the target.
        PatchError: The target is not exposed and cannot be patched.
    """
    with LOCK:
        made = make_handler((handler, target, position))
        made.target.add(made)


def remove_handler(target: Any, position: str, handler: Callable[..., Any] | None = None) -> None:
    """Remove a handler that ``attach_handler`` attached.

    Args:
        target: The function, or its dotted name.
        position: The position.
        handler: The handler; if it was attached several times, the last one is removed. None: all handlers at this
            position.

    Raises:
        UnknownTargetError: The name does not exist.
        HandlerError: There is no such handler.
    """
    with LOCK:
        found = find_target(target)
        present = found.handlers
        chosen = [h for h in present if h.position == position and (handler is None or h.function == handler)]
        if not chosen:
            what = "no handler is" if handler is None else f"{name_of(handler)} is not"
            at = ", ".join(sorted({h.position for h in present})) or "nowhere"
            raise HandlerError(f"{what} attached {short_repr(position)} {found.name}; handlers are attached: {at}")
        for removed in chosen if handler is None else chosen[-1:]:
            found.remove(removed)


@contextmanager
def handlers(*entries: Entry) -> Iterator[None]:
    """Attach handlers for the duration of a ``with`` block.

    Args:
        *entries: Tuples of the arguments of ``attach_handler``: handler, target, position.

    Raises:
        SimEnvError: As ``attach_handler`` raises it; then none of the handlers is attached.
    """
    with LOCK:
        made = [make_handler(entry) for entry in entries]
    with _attached([(handler.target, handler) for handler in made]):
        yield


@contextmanager
def _attached(entries: list[tuple[Target, Handler | Trace]]) -> Iterator[None]:
    """Attach handlers or traces for the duration of a ``with`` block, or until an interrupted block is collected."""
    installation = Installation([Attachment(entries)])
    try:
        yield
    finally:
        installation.uninstall()


# -- seeing what happens --------------------------------------------------------------------------


@contextmanager
def trace(*targets: Any) -> Iterator[list[Call]]:
    """Record the calls of a model's functions, in the order in which they begin.

    Args:
        *targets: The functions, as ``attach_handler`` takes them. Without arguments: all functions that are exposed or
            have handlers, and all decorated decision points.

    Returns:
        A context manager whose value is the list of calls. An entry has the attributes ``target``, ``arguments`` and
        ``result``, which are strings; the result is None until the call ends.

    Raises:
        SimEnvError: As ``attach_handler``.
    """
    recording = Trace()
    with LOCK:
        found = [find_target(target) for target in targets] if targets else list(Target.all.values())
        hooks = [target for target in dict.fromkeys(found) if isinstance(target, Hook)]
    with _attached([(hook, recording) for hook in hooks if targets or hook.permanent or hook.slot]):
        yield recording.calls
