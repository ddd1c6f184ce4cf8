"""Extensions: handlers before, after and instead of a model's functions, without a change to the model (paper).

Handlers are attached to functions, methods, generator and coroutine functions, and iterables: for
the whole process (``attach_handler``), for a block (``handlers``), or for one environment (the
option ``plugins``). A function without handlers costs nothing extra or, if ``expose_to_plugins``
exposed it, one test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from types import FunctionType, MappingProxyType, MethodType
from typing import Any, Final, TypeVar, cast

from .decision import decision_points
from .errors import HandlerError, PatchError, UnknownTargetError, name_of, short_repr
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
    find_hook,
    hook_at,
    is_importable,
    permanent_hook,
    raw_attribute,
    resolve,
    split_binding,
)
from .hooks.stacks import LOCK

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

Entry = tuple[Callable[..., Any], Any, str]
"""A handler, its target, and its position."""

_FUNCTIONS: Final = (staticmethod, classmethod, FunctionType, MethodType)


# -- what exists ----------------------------------------------------------------------------------


def exposed_functions() -> list[str]:
    """Return the names of all targets that are exposed to plugins or have handlers."""
    return sorted({target.name for target in hooks() if target.exposed or target.slot})


def attached_handlers(env: Any = None) -> list[Entry]:
    """Return the attached handlers, by target, in the order in which they run.

    Args:
        env: An environment, for the handlers of its option ``plugins``. None: the handlers of the
            whole process.

    Returns:
        A list of tuples: the handler, the dotted name of its target, and its position.
    """
    if env is not None:
        entries: list[Entry] = env.unwrapped.plugins
        return entries
    found = sorted(hooks(), key=lambda target: target.name)
    return [
        (handler.function, target.name, handler.position)
        for target in found
        for handler in _general(target)
    ]


def _general(target: Hook) -> list[Handler]:
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
    thing: Any = function_or_iterable
    if _proxied(thing) is not None:
        return function_or_iterable
    if isinstance(thing, _FUNCTIONS):
        wrapper, binding = split_binding(thing)
        known = hook_of(wrapper)
        if known is None or not known.permanent:  # else it is decorated or exposed already
            known, _ = permanent_hook(thing)
            wrapper = known.make_wrapper()
        known.exposed = True
        if isinstance(thing, (staticmethod, classmethod)) and thing.__func__ is wrapper:
            return function_or_iterable
        return cast("Thing", wrapper if binding is None else binding(wrapper))
    if isinstance(thing, type):
        raise PatchError(
            f"the class {name_of(thing)} cannot be exposed to plugins: expose one of its"
            " functions, such as __init__ or an __iter__ that is a generator function"
        )
    if isinstance(thing, Iterable) or (
        hasattr(type(thing), "__getitem__") and hasattr(type(thing), "__len__")
    ):
        # its dependency imports asyncio, which slows down decisions
        from .hooks.iterables import expose

        return cast("Thing", expose(thing))
    if callable(thing):
        hook = Hook(thing, f"{getattr(thing, '__module__', None) or '?'}.{name_of(thing)}")
        hook.exposed = True
        return cast("Thing", hook.make_wrapper())
    raise PatchError(
        f"{short_repr(thing)} cannot be exposed to plugins: it is neither a function nor an"
        " iterable"
    )


def _proxied(thing: Any) -> Hook | None:
    """Return the target of an exposed iterable; None for anything else."""
    return thing._self_target if hasattr(type(thing), "_self_next") else None


def _find_target(target: Any) -> Hook:
    """Find the target for handlers: a function, an exposed iterable, or the dotted name of one of these."""
    if isinstance(target, str):
        try:
            owner, attribute = resolve(target, UnknownTargetError)
        except (UnknownTargetError, PatchError):
            named = [other for other in hooks() if other.name == target and other.exposed]
            if not named:
                raise
            return named[-1]  # exposed inside a function, under the latest's name
        return _proxied(raw_attribute(owner, attribute)) or hook_at(
            target, owner, attribute, UnknownTargetError
        )
    found = _proxied(target)
    if found is None and not isinstance(target, _FUNCTIONS):
        raise PatchError(
            f"no handlers can be attached to {short_repr(target)}: pass what expose_to_plugins"
            " returns for it, or the dotted name of a function"
        )
    return found or find_hook(target, UnknownTargetError)


# -- handlers -------------------------------------------------------------------------------------


def attach_handler(handler: Callable[..., Any], target: Any, position: str) -> None:
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
        made = _make_handler((handler, target, position))
        made.target.install(None, made)


def remove_handler(target: Any, position: str, handler: Callable[..., Any] | None = None) -> None:
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
        found = _find_target(target)
        present = _general(found)
        chosen = [
            h
            for h in present
            if h.position == position and (handler is None or h.function == handler)
        ]
        if not chosen:
            what = "no handler is" if handler is None else f"{name_of(handler)} is not"
            at = ", ".join(sorted({h.position for h in present})) or "nowhere"
            raise HandlerError(
                f"{what} attached {short_repr(position)} {found.name}; handlers are attached: {at}"
            )
        for removed in chosen if handler is None else chosen[-1:]:
            found.uninstall(None, removed)


@contextmanager
def handlers(*entries: Entry) -> Iterator[None]:
    """Attach handlers for the duration of a ``with`` block.

    Args:
        *entries: Tuples of the arguments of ``attach_handler``: handler, target, position.

    Raises:
        SimEnvError: As ``attach_handler`` raises it; then none of the handlers is attached.
    """
    with LOCK:
        made = [_make_handler(entry) for entry in entries]
    installation = Installation([(handler.target, handler) for handler in made])
    try:
        yield
    finally:
        installation.uninstall()


@contextmanager
def trace(*functions: Any) -> Iterator[list[Call]]:
    """Record the calls of a model's functions, in the order in which they begin.

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
    record = partial(recorder, calls)
    with LOCK:
        found = [_find_target(target) for target in functions] if functions else hooks()
        traced = [target for target in dict.fromkeys(found) if CALLS[0] in target.positions]
    installation = Installation(
        [
            (hook, Handler(record, hook, TRACE))
            for hook in traced
            if functions or hook.permanent or hook.slot
        ]
    )
    try:
        yield calls
    finally:
        installation.uninstall()


def _make_handler(
    entry: Any, named: Mapping[str, Hook] = MappingProxyType({}), owner: Any = None
) -> Handler:
    """Return a handler, checked to fit its target.

    ``named`` has names that take precedence over importable names.
    """
    if not isinstance(entry, (tuple, list)) or len(entry) != 3:
        raise HandlerError(
            f"handlers are given as (handler, target, position), not {short_repr(entry)}"
        )
    function, target, position = entry
    known = named.get(target) if isinstance(target, str) else None
    return Handler(function, _find_target(target) if known is None else known, position, owner)


class Plugins:
    """The handlers of the environments of one plan, attached while one of these is in use.

    It is also the key under which targets know them, and an entry in ``EVALUATING``; agents have
    the memory.
    """

    memory: dict[Any, Any] | None = None

    def __init__(self, entries: Any, named: Mapping[str, Hook] = MappingProxyType({})) -> None:
        """Find the targets, and check that the handlers fit.

        ``named`` has the names that the simulation defines.
        """
        with LOCK:
            self.handlers = [_make_handler(entry, named, self) for entry in entries]
        self.hooks = dict.fromkeys(handler.target for handler in self.handlers)
        self.entries: list[Entry] = [
            (own.function, own.target.name, own.position) for own in self.handlers
        ]
        # With the given target where its name would not lead to it in another process.
        pairs = zip(self.entries, entries, strict=True)
        self.portable: list[Entry] = [
            entry if is_importable(entry[1]) else own for entry, own in pairs
        ]

    @property
    def plugins(self) -> Plugins:
        """This object: its handlers take part in evaluations for its environment."""
        return self
