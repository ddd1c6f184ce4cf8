"""Pickles for other processes: simulations, decision functions, policies, results and errors.

Objects that can be imported are pickled by reference, all others by value, such as the objects of
a script or a notebook.
"""

from __future__ import annotations

import io
import pickle
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import reduce
from importlib import import_module
from types import FunctionType
from typing import Any, Final
from uuid import uuid4
from weakref import WeakKeyDictionary, WeakValueDictionary

import cloudpickle

from ...errors import WorkerError, describe_error, error_notes
from ...hooks.hook import Hook, hook_of, made_with, unwrap

Reduced = tuple[Any, ...]
"""How to pickle an object, as ``object.__reduce__`` returns it."""


def pack(thing: object) -> bytes:
    """Pickle an object for any other process."""
    buffer = io.BytesIO()
    Pickler(buffer, 5).dump(thing)
    return buffer.getvalue()


def pack_plainly(thing: object) -> bytes:
    """Pickle an object, faster than ``pack``, for a process of ``multiprocessing`` or a fork."""
    with suppress(Exception):  # because ``pack`` raises the error below
        plain = pickle.dumps(thing, 5)
        # Other processes cannot import objects of a notebook or an interactive session.
        if b"__main__" not in plain or hasattr(sys.modules["__main__"], "__file__"):
            return plain
    return pack(thing)


unpack: Final = pickle.loads
"""Unpickles an object that ``pack`` or ``pack_plainly`` has pickled."""


def pack_checked(thing: object) -> bytes:
    """Pickle an object as ``pack_plainly`` does. Raise an error if it cannot be unpickled."""
    packed = pack_plainly(thing)
    unpack(packed)
    return packed


def pack_outcome(function: Callable[..., object], *args: object) -> bytes:
    """Call a function, and pack its result, or the error that it raises."""
    try:
        return pack_plainly((function(*args), None))
    except BaseException as error:
        return pack_plainly((None, pack_error(error)))


def unpack_outcome(parcel: bytes) -> tuple[Any, BaseException | None]:
    """Unpack a result, or None and an error, that ``pack_outcome`` has packed."""
    result, error = unpack(parcel)
    return result, None if error is None else unpack_error(error)


class Pickler(cloudpickle.Pickler):
    """A pickler of errors, of hooks, and of functions that a patch has wrapped."""

    def reducer_override(self, obj: object) -> Any:
        """Return how to pickle an object."""
        reduced: Reduced | None = None
        if isinstance(obj, FunctionType):
            reduced = _reduce_function(obj)
        elif isinstance(obj, BaseException):
            reduced = _reduce_error(obj)
        elif isinstance(obj, Hook):
            make, args, state = obj.__reduce__()
            reduced = *_by_token(obj, make, *args), state
        return super().reducer_override(obj) if reduced is None else reduced


# -- errors ---------------------------------------------------------------------------------------


class RemoteTraceback(Exception):
    """The cause of an error from another process. Its message is the traceback there."""


def pack_error(error: BaseException) -> tuple[bytes, str]:
    """Pickle an error, and format its traceback.

    An error that cannot be pickled becomes a ``WorkerError``.
    """
    told = describe_error(error)
    try:
        text = "".join(traceback.format_exception(error))
    except Exception:  # formatting runs code of the error's class, which may fail
        text = told
    try:
        parcel = pack(error)
        # A class may define pickling that works in one direction only, or have slots.
        is_whole = describe_error(unpack(parcel)) == told
    except Exception:
        is_whole = False
    if not is_whole:
        other = WorkerError(f"another process raised an error that cannot be pickled: {told}")
        other.__notes__ = error_notes(error)
        parcel = pack(other)
    return parcel, text


def unpack_error(packed: tuple[bytes, str]) -> BaseException:
    """Rebuild an error. Its cause becomes the traceback in the other process."""
    parcel, text = packed
    error: BaseException = unpack(parcel)
    # Not by an assignment, because the error's class may be frozen.
    BaseException.__setattr__(error, "__cause__", RemoteTraceback(f"\n\n{text}"))
    return error


def _builtin(kind: type) -> Any:
    """Return the first base of an error's class that is not written in Python."""
    in_python = 1 << 9  # the flag of classes that are made at run time
    return next(base for base in kind.__mro__ if not base.__flags__ & in_python)


def _reduce_error(error: BaseException) -> Reduced | None:
    """Return how to rebuild an error without ``__init__``. None if its class defines pickling."""
    kind: Any = type(error)
    builtin = _builtin(kind)
    if (kind.__reduce__, kind.__reduce_ex__) != (builtin.__reduce__, builtin.__reduce_ex__):
        return None
    _, args, *state = builtin.__reduce__(error)
    attributes: dict[str, Any] = {**state[0]} if state else {}
    attributes.pop("obj", None)  # it may be the whole model, in an AttributeError
    return _rebuild_error, (kind, args, attributes | {"__notes__": error_notes(error)})


def _rebuild_error(kind: type, args: tuple[Any, ...], attributes: dict[str, Any]) -> BaseException:
    builtin = _builtin(kind)
    error: BaseException = builtin.__new__(kind, *args)
    builtin.__init__(error, *args)
    for name, value in attributes.items():
        BaseException.__setattr__(error, name, value)
    return error


# -- functions ------------------------------------------------------------------------------------

_tokens: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
_known: WeakValueDictionary[str, Any] = WeakValueDictionary()
"""Functions and hooks that were sent or received, by token. They come back as themselves."""


def _reduce_function(function: FunctionType) -> Reduced | None:
    """Return how another process finds or makes a function that its name does not find."""
    place = function.__module__, function.__qualname__
    named = _import(*place)
    if named is function:
        return None
    if getattr(named, "__func__", None) is function:
        return _function_at, (*place, False)
    if named is not None and unwrap(named) is function:  # a patch has wrapped it
        return _function_at, (*place, True)
    hook = hook_of(function)
    return None if hook is None else _by_token(function, hook.make_wrapper, made_with(function))


def _import(module: str | None, path: str) -> Any:
    """Import the object with a dotted name. None if there is none."""
    if module is None or module == "__main__":
        return None
    try:
        return reduce(getattr, path.split("."), import_module(module))
    except (ImportError, AttributeError):
        return None


def _function_at(module: str, path: str, is_wrapped: bool) -> Any:
    """Return the function of the method, or behind the wrapper, with a dotted name."""
    named = _import(module, path)
    return unwrap(named) if is_wrapped else named.__func__


def _by_token(thing: FunctionType | Hook, make: Callable[..., Any], *args: object) -> Reduced:
    token = _tokens.setdefault(thing, uuid4().hex)
    _known[token] = thing
    return _make, (token, make, args)


def _make(token: str, make: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    """Make the function or hook that has a token, unless this process has it."""
    if token not in _known:
        made = _known[token] = make(*args)
        _tokens[made] = token
    return _known[token]
