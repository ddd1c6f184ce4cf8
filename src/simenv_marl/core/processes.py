"""What crosses from one process to another: simulations, points, policies, results, errors.

They cross by reference where they can be imported, and by value where not, as in a script or a notebook. Functions are
a matter of their own: others may stand in their places for as long as an environment is in use, and decision
functions have to ask the environments of the process in which they are called.
"""

from __future__ import annotations

import io
import pickle
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from types import FunctionType
from typing import Any
from uuid import uuid4
from weakref import WeakKeyDictionary, WeakValueDictionary

import cloudpickle

from ..decision import DecisionPoint, Definition, point_of, unwrapped
from ..errors import WorkerError, annotate
from ..hooks.hook import Hook, hook_of, made_with


def pack(thing: Any) -> bytes:
    """Pickle something for another process.

    Raises:
        Exception: What pickling it raises.
    """
    buffer = io.BytesIO()
    _Pickler(buffer, 5).dump(thing)
    return buffer.getvalue()


def pack_plainly(thing: Any) -> bytes:
    """The same, and faster, for a process that ``multiprocessing`` has started from the same script.

    Raises:
        Exception: What pickling it raises.
    """
    with suppress(Exception):  # what is wrong will be said below
        plain = pickle.dumps(thing, 5)
        # What stands in a notebook or in an interactive session is found in no other process.
        if b"__main__" not in plain or hasattr(sys.modules["__main__"], "__file__"):
            return plain
    return pack(thing)


def unpack(parcel: bytes) -> Any:
    """What was packed."""
    return pickle.loads(parcel)


# -- errors ---------------------------------------------------------------------------------------


class RemoteTraceback(Exception):
    """The cause of an error that was raised in another process: its traceback there, as text."""

    def __str__(self) -> str:
        return f"\n\n{self.args[0]}"


def pack_error(error: BaseException) -> bytes:
    """Pickle an error for another process, so that it can be rebuilt there, or at least be told of."""
    text = "".join(traceback.format_exception(error))
    parts = None
    with suppress(Exception):
        parts = pack_plainly((type(error), error.args, vars(error)))
        _rebuilt(parts)
    return pickle.dumps((parts, f"{type(error).__name__}: {error}", getattr(error, "__notes__", ()), text), 5)


def unpack_error(parcel: bytes) -> BaseException:
    """The error that was packed, with its traceback as its cause; a ``WorkerError`` if it cannot be rebuilt."""
    parts, message, notes, text = pickle.loads(parcel)
    try:
        error = _rebuilt(parts)
    except Exception:
        error = WorkerError(f"another process has raised what cannot be pickled: {message}")
        for note in notes:
            annotate(error, note)
    error.__cause__ = RemoteTraceback(text)
    return error


def _rebuilt(parts: bytes) -> BaseException:
    kind, args, state = pickle.loads(parts)
    error: BaseException = kind.__new__(kind, *args)  # not called: its arguments may be others than its ``args``
    error.args = args
    vars(error).update(state)
    return error


# -- functions ------------------------------------------------------------------------------------


class _Pickler(cloudpickle.Pickler):
    """Packs functions so that they are found or made anew where they arrive."""

    def reducer_override(self, obj: Any) -> Any:
        reduced = _reduced(obj)
        return super().reducer_override(obj) if reduced is None else reduced


def _reduced(thing: Any) -> tuple[Any, ...] | None:
    """How a thing crosses that would not be itself on the other side; None for all others."""
    if isinstance(thing, DecisionPoint):
        there = _found_at(thing.rule.__module__, thing.rule.__qualname__)
        known = point_of(there)
        if known is not None and known[0] is thing:
            return _point_at, (thing.rule.__module__, thing.rule.__qualname__)
        return None
    if not isinstance(thing, FunctionType):
        return None
    there = _found_at(thing.__module__, thing.__qualname__, bound=True)
    if there is thing:
        return None
    there = _found_at(thing.__module__, thing.__qualname__)
    if there is thing:
        return _found_at, (thing.__module__, thing.__qualname__)
    if there is not None and unwrapped(there) is thing:
        return _rule_at, (thing.__module__, thing.__qualname__)
    hook = hook_of(thing)
    return None if hook is None else (_restore_stand_in, (_token(thing), hook, made_with(thing)))


def _found_at(module: str, path: str, *, bound: bool = False) -> Any:
    """What a module has under a dotted name, without its binding unless told otherwise; None where that is nothing."""
    if module == "__main__" or module is None:
        return None
    try:
        thing = import_module(module)
        for name in path.split("."):
            thing = getattr(thing, name)
    except (ImportError, AttributeError):
        return None
    return thing if bound else getattr(thing, "__func__", thing)


def _rule_at(module: str, path: str) -> Any:
    return unwrapped(_found_at(module, path))


def _point_at(module: str, path: str) -> Any:
    return point_of(_found_at(module, path))[0]  # type: ignore[index]


_tokens: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
_known: WeakValueDictionary[str, Any] = WeakValueDictionary()
"""What has crossed, in either direction: coming back, it is what it was."""


def _token(thing: Any) -> str:
    token = _tokens.get(thing)
    if token is None:
        token = _tokens[thing] = uuid4().hex
        _known[token] = thing
    return token


def _restored(token: str, make: Callable[[], Any]) -> Any:
    thing = _known.get(token)
    if thing is None:
        thing = _known[token] = make()
        _tokens[thing] = token
    return thing


def _restore_stand_in(token: str, hook: Hook, definition: Definition | None) -> Any:
    return _restored(token, lambda: hook.stand_in(definition))
