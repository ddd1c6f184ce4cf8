"""Extensions: handlers around a model's functions, without a change to the model (paper).

Handlers are attached to functions, methods, generator and coroutine functions, and iterables: for
the whole process (``attach_handler``), for a block (``handlers``), or for one environment (the
option ``plugins``). A function without handlers costs nothing extra; or one test, if
``expose_to_plugins`` exposed it.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from types import FunctionType, MethodType
from typing import Any, Final, TypeVar

from .decision import decision_points
from .errors import (
    HandlerError,
    PatchError,
    UnknownPointError,
    UnknownTargetError,
    name_of,
    short_repr,
)
from .hooks.handlers import (
    CALLS,
    TRACE,
    Call,
    ChangedArgs,
    ChangedResult,
    Handler,
    Installation,
    recorder,
)
from .hooks.hook import Hook, hook_of, hooks
from .hooks.places import (
    decorate,
    find_hook,
    split_binding,
    target_of,
)
from .hooks.stacks import LOCK
from .simulation import Function

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

Entry = tuple[Function, Any, str]
"""A handler, its target, and its position."""

_FUNCTIONS: Final = (staticmethod, classmethod, FunctionType, MethodType)


# -- lists of targets and handlers ----------------------------------------------------------------


def exposed_functions() -> list[str]:
    """Return the names of all targets that are exposed to plugins or have handlers."""
    return sorted({target.name for target in hooks() if target.exposed or target.slot})


def attached_handlers(env: Any = None) -> list[Entry]:
    """Return the attached handlers, by target, in the order of their calls.

    Args:
        env: An environment, for the handlers of its option ``plugins``. None: the handlers of the
            whole process.

    Returns:
        A list of tuples: the handler, the dotted name of its target, and its position.
    """
    if env is not None:
        return list(env.unwrapped.plugins)
    targets = sorted(hooks(), key=lambda target: target.name)
    return [_entry(handler) for target in targets for handler in _process_handlers(target)]


def _entry(handler: Handler) -> Entry:
    return handler.function, handler.target.name, handler.position


def _process_handlers(target: Hook) -> list[Handler]:
    """Return the handlers of a target that users have attached for the whole process."""
    return [
        handler
        for handler in target.handlers
        if handler.owner is None and handler.position is not TRACE
    ]


# -- targets --------------------------------------------------------------------------------------


def expose_to_plugins(function_or_iterable: Thing) -> Thing:
    """Let handlers be attached to a function or an iterable (paper, section 3.4).

    Use it as a decorator in the model, above or below ``staticmethod``, ``classmethod`` and
    ``make_step``; or from outside: ``Model.step = expose_to_plugins(Model.step)``. An importable
    function need not be exposed: handlers can be attached to its dotted name.

    Args:
        function_or_iterable: A function of any kind, or an iterable.

    Returns:
        The exposed function, which keeps its name, signature and docstring and may be exposed
        again; for an iterable, a proxy that behaves like it.

    Raises:
        PatchError: It is neither of these, or a method that is bound to one object.
    """
    exposed: Thing = _expose(function_or_iterable)
    return exposed


def _expose(thing: Any) -> Any:
    if target_of(thing) is not None:
        return thing
    if isinstance(thing, _FUNCTIONS):
        return _expose_function(thing)
    if isinstance(thing, type):
        raise PatchError(
            f"the class {name_of(thing)} cannot be exposed to plugins: expose one of its"
            " functions, such as __init__ or an __iter__ that is a generator function"
        )
    is_sequence = hasattr(type(thing), "__getitem__") and hasattr(type(thing), "__len__")
    if is_sequence or isinstance(thing, Iterable):
        # Imported here, because its dependency imports asyncio, which slows down decisions.
        from .hooks.iterables import expose

        return expose(thing)
    if callable(thing):
        module = getattr(thing, "__module__", None) or "?"
        return Hook(thing, f"{module}.{name_of(thing)}", exposed=True).make_wrapper()
    raise PatchError(
        f"{short_repr(thing)} cannot be exposed to plugins: it is neither a function nor an"
        " iterable"
    )


def _expose_function(function: Any) -> Any:
    wrapper, binding = split_binding(function)
    hook = hook_of(wrapper)
    if hook is None or not hook.permanent:
        return decorate(function, exposed=True)
    hook.make_permanent(None, exposed=True)  # it is decorated or exposed already
    if isinstance(function, (staticmethod, classmethod)):
        return function
    return binding(wrapper)


def _find_target(target: Any) -> Hook:
    """Find the hook of a function, an exposed iterable, or a name for one of these."""
    try:
        return find_hook(target)
    except (UnknownPointError, PatchError) as error:
        # A function that was exposed inside another function: the latest of this name.
        for hook in reversed(hooks()):
            if hook.exposed and hook.name == target:
                return hook
        if isinstance(error, UnknownPointError):
            raise UnknownTargetError(*error.args) from None
        raise


# -- handlers -------------------------------------------------------------------------------------


def attach_handler(
    handler: Function,
    target: Any,
    position: str,
) -> None:
    """Attach a handler to a function, for the whole process (paper, section 3.4).

    Args:
        handler: A callable. It gets the arguments of the call as they were passed; at ``*_next``
            positions, it gets those of the generator function, or the iterable. A ``before``
            handler may return ``ChangedArgs``. An ``after`` handler gets the result if it has a
            parameter ``_result``, and may return ``ChangedResult``. The result of an ``instead``
            handler is the result of the call. Handlers of one position run in the order in which
            they were attached. Of several ``instead`` handlers only the latest runs, and then no
            ``before`` and ``after`` handlers.
        target: The function, or the dotted name of any importable function, exposed or not.
        position: "before", "after" or "instead"; for iterables and generator functions also
            "before_next", "after_next" or "instead_next".

    Raises:
        UnknownTargetError: The name does not exist.
        HandlerError: The position does not exist, or the handler cannot be called like the target.
        PatchError: The target is not exposed and cannot be patched.
    """
    with LOCK:
        hook = _find_target(target)
        hook.install(None, Handler(handler, hook, position))


def remove_handler(
    target: Any,
    position: str,
    handler: Function | None = None,
) -> None:
    """Remove a handler that ``attach_handler`` attached.

    Args:
        target: The function, or its dotted name.
        position: The position.
        handler: The handler; if it was attached several times, the last one is removed. None: all
            handlers at this position.

    Raises:
        UnknownTargetError: The name does not exist.
        HandlerError: There is no such handler.
    """
    with LOCK:
        hook = _find_target(target)
        present = _process_handlers(hook)
        matches = [
            other
            for other in present
            if other.position == position and handler in (None, other.function)
        ]
        if not matches:
            absent = "no handler is" if handler is None else f"{name_of(handler)} is not"
            positions = sorted({other.position for other in present})
            raise HandlerError(
                f"{absent} attached {short_repr(position)} {hook.name}; handlers are attached:"
                f" {', '.join(positions) or 'nowhere'}"
            )
        if handler is not None:
            matches = matches[-1:]
        for match in matches:
            hook.uninstall(None, match)


@contextmanager
def handlers(*entries: Entry) -> Iterator[None]:
    """Attach handlers for the duration of a ``with`` block.

    Args:
        *entries: Tuples of the arguments of ``attach_handler``: handler, target, position.

    Raises:
        SimEnvError: As ``attach_handler`` raises it; then none of the handlers is new_handlers.
    """
    with LOCK:
        new_handlers = [_make_handler(entry, {}) for entry in entries]
    installation = Installation([(handler.target, handler) for handler in new_handlers])
    try:
        yield
    finally:
        installation.uninstall()


@contextmanager
def trace(*functions: Any) -> Iterator[list[Call]]:
    """Record the calls of a model's functions, in the order of their beginnings.

    Args:
        *functions: The functions, as ``attach_handler`` takes them. If none is given: all functions
            that are exposed or have handlers, and all decorated decision points.

    Returns:
        A context manager whose value is the list of calls. An entry has the attributes ``target``,
        ``arguments`` and ``result``, which are strings; the result is None until the call ends.

    Raises:
        SimEnvError: As ``attach_handler``.
    """
    calls: list[Call] = []
    with LOCK:
        if functions:
            targets = {_find_target(function) for function in functions}
        else:
            targets = {hook for hook in hooks() if hook.permanent or hook.slot}
    record = partial(recorder, calls)
    installation = Installation(
        [
            (target, Handler(record, target, TRACE))
            for target in targets
            if CALLS[0] in target.positions
        ]
    )
    try:
        yield calls
    finally:
        installation.uninstall()


def _make_handler(
    entry: Entry,
    named: Mapping[str, Hook],
    owner: Hashable = None,
) -> Handler:
    """Return a handler for an entry.

    ``named`` has names that take precedence over importable names.
    """
    if not isinstance(entry, (tuple, list)) or len(entry) != 3:
        raise HandlerError(
            f"handlers are given as (handler, target, position), not {short_repr(entry)}"
        )
    function, target, position = entry
    hook = named.get(target) if isinstance(target, str) else None
    return Handler(function, hook or _find_target(target), position, owner)


class Plugins:
    """The handlers of the environments of one plan, attached while one of these is in use.

    It is the owner of these handlers, and an ``Evaluation``.

    Attributes:
        handlers: The handlers.
        hooks: Their targets, each once.
        entries: The handlers as ``attached_handlers`` returns them.
        portable: The entries for another process: with the given target instead of a name that
            does not lead to the target there.
        memory: None, because only agents remember values of differences.
    """

    memory: dict[Any, Any] | None = None

    def __init__(self, entries: Iterable[Entry], named: Mapping[str, Hook]) -> None:
        """Find the targets, and check that the handlers fit.

        ``named`` has the names that the simulation defines.
        """
        self.handlers: list[Handler] = []
        self.portable: list[Entry] = []
        with LOCK:
            for entry in entries:
                handler = _make_handler(entry, named, self)
                self.handlers.append(handler)
                is_found = "<" not in handler.target.name  # by its name, in any process
                self.portable.append(_entry(handler) if is_found else entry)
        self.entries = [_entry(handler) for handler in self.handlers]
        self.hooks = {handler.target for handler in self.handlers}

    @property
    def plugins(self) -> Plugins:
        """This object: its handlers take part in evaluations for its environment."""
        return self
