"""Pickles for other processes: simulations, decision functions, policies, results and errors.

Objects that can be imported are pickled by reference, all others by value, such as those of a
script or a notebook.
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
from types import FunctionType, GetSetDescriptorType, MemberDescriptorType
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


def pack_outcome(
    pack_result: Callable[[Any], bytes], function: Callable[..., object], *args: object
) -> bytes:
    """Call a function, and pack its result, or the error that it raises."""
    try:
        return pickle.dumps((pack_result(function(*args)), None), 5)
    except BaseException as error:
        return pickle.dumps((None, pack_error(error)), 5)


def unpack_outcome(parcel: bytes) -> tuple[Any, BaseException | None]:
    """Unpack a result, or None and an error, that ``pack_outcome`` has packed."""
    result, error = pickle.loads(parcel)
    return (unpack(result), None) if error is None else (None, unpack_error(error))


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


def pack_error(error: BaseException) -> bytes:
    """Pickle an error with its traceback.

    An error that cannot be pickled becomes a ``WorkerError``.
    """
    try:
        text = "".join(traceback.format_exception(error))
    except Exception:  # formatting runs code of the error's class, which may fail
        text = describe_error(error)
    try:
        parcel = pack(error)
        unpack(parcel)  # because a class may define pickling that works only in one direction
    except Exception:
        other = WorkerError(
            f"another process raised an error that cannot be pickled: {describe_error(error)}"
        )
        other.__notes__ = error_notes(error)
        parcel = pack(other)
    return pickle.dumps((parcel, text), 5)


def unpack_error(parcel: bytes) -> BaseException:
    """Rebuild an error. Its cause becomes the traceback in the other process."""
    inner, text = pickle.loads(parcel)
    error: BaseException = unpack(inner)
    # Not by an assignment, because the error's class may be frozen.
    BaseException.__setattr__(error, "__cause__", RemoteTraceback(f"\n\n{text}"))
    return error


_IN_PYTHON: Final = 1 << 9
"""The flag of classes that were made at run time, as all classes written in Python are."""


def _reduce_error(error: BaseException) -> Reduced | None:
    """Return how to rebuild an error without ``__init__``. None if its class defines pickling."""
    roots = (BaseExceptionGroup, BaseException, object)
    kinds = [kind for kind in type(error).__mro__ if kind not in roots]
    for kind in kinds:
        if kind.__flags__ & _IN_PYTHON and {"__reduce__", "__reduce_ex__"} & vars(kind).keys():
            return None
    args = error.args
    if isinstance(error, BaseExceptionGroup):
        args = (error.message, error.exceptions)
    members = {name: getattr(error, name) for kind in kinds for name in _members(kind, error)}
    attributes = vars(error) | {"__notes__": error_notes(error)}
    return _rebuild_error, (type(error), args, members | {"args": args}, attributes)


def _members(kind: type, error: BaseException) -> list[str]:
    """Return the names of the slots of an error's class that have a value."""
    return [
        name
        for name, member in vars(kind).items()
        if isinstance(member, (MemberDescriptorType, GetSetDescriptorType))
        and not name.startswith("__")
        # The ``obj`` of an AttributeError may refer to the whole model.
        and name != "obj"
        and hasattr(error, name)
    ]


def _rebuild_error(
    kind: type, args: tuple[Any, ...], members: dict[str, Any], attributes: dict[str, Any]
) -> BaseException:
    builtin: Any = next(base for base in kind.__mro__ if not base.__flags__ & _IN_PYTHON)
    error: BaseException = builtin.__new__(kind, *args)
    for name, value in members.items():
        if value is not None or getattr(error, name, error) is not None:
            BaseException.__setattr__(error, name, value)
    vars(error).update(attributes)
    return error


# -- functions ------------------------------------------------------------------------------------

_tokens: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
_known: WeakValueDictionary[str, Any] = WeakValueDictionary()
"""Functions and hooks that were sent or received, by token. They come back as themselves."""


def _reduce_function(function: FunctionType) -> Reduced | None:
    """Return how another process finds or makes a function to which its name does not lead."""
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
