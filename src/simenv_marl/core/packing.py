"""Packing for other processes: simulations, decision functions, policies, results and errors.

Objects that can be imported are pickled by reference, all others by value, such as those of a
script or a notebook.
"""

from __future__ import annotations

import io
import os
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

from ..errors import WorkerError, describe_error, error_notes
from ..hooks.hook import Hook, hook_of, made_with, unwrap


def pack(thing: Any) -> bytes:
    """Pickle an object for any other process."""
    buffer = io.BytesIO()
    Pickler(buffer, 5).dump(thing)
    return buffer.getvalue()


def pack_plainly(thing: Any) -> bytes:
    """Pickle an object, faster than ``pack``, for a process that ``multiprocessing`` started from the same script."""
    with suppress(Exception):  # ``pack`` raises the error below
        plain = pickle.dumps(thing, 5)
        # Other processes cannot import what is defined in a notebook or an interactive session.
        if b"__main__" not in plain or hasattr(sys.modules["__main__"], "__file__"):
            return plain
    return pack(thing)


unpack: Final = pickle.loads
"""Unpickles an object that ``pack`` or ``pack_plainly`` has pickled."""


def pack_outcome(pack: Callable[[Any], bytes], function: Callable[..., Any], *args: Any) -> bytes:
    """Call a function, and pack its result by ``pack``, or the error that it or ``pack`` raises."""
    try:
        return pickle.dumps((pack(function(*args)), None), 5)
    except BaseException as error:
        return pickle.dumps((None, pack_error(error)), 5)


def unpack_outcome(parcel: bytes) -> tuple[Any, BaseException | None]:
    """Unpack a result, or None and an error, that ``pack_outcome`` has packed."""
    result, error = pickle.loads(parcel)
    return (unpack(result), None) if error is None else (None, unpack_error(error))


class Pickler(cloudpickle.Pickler):
    """A pickler for what the default pickling would change: errors, hooks, and functions that a patch has wrapped."""

    def reducer_override(self, obj: Any) -> Any:
        """How to pickle a function, a hook, an error or a class."""
        reduced = None
        if isinstance(obj, FunctionType):
            reduced = _reduce_function(obj)
        elif isinstance(obj, BaseException):
            reduced = _reduce_error(obj)
        elif isinstance(obj, Hook):
            make, args, state = obj.__reduce__()
            reduced = *_by_token(obj, make, *args), state
        if reduced is not None:
            return reduced
        reduced = super().reducer_override(obj)
        if not isinstance(obj, type) or not isinstance(reduced, tuple) or len(reduced) < 6:
            return reduced
        make, args, state, *_, restore = reduced  # a class that is pickled by value
        return make, args, (_origin(), restore, state), None, None, _restore_class


# -- errors ---------------------------------------------------------------------------------------


class RemoteTraceback(Exception):
    """The cause of an error from another process.

    Its message is the traceback there, with all causes.
    """


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
        unpack(parcel)  # the class may define pickling that works only in one direction
    except Exception:
        other = WorkerError(
            f"another process raised an error that cannot be pickled: {describe_error(error)}"
        )
        other.__notes__ = error_notes(error)
        parcel = pack(other)
    return pickle.dumps((parcel, text), 5)


def unpack_error(parcel: bytes) -> BaseException:
    """Rebuild an error that ``pack_error`` has packed.

    Its cause becomes the traceback in the other process.
    """
    inner, text = pickle.loads(parcel)
    error: BaseException = unpack(inner)
    # the error's class may be frozen
    BaseException.__setattr__(error, "__cause__", RemoteTraceback(f"\n\n{text}"))
    return error


_IN_PYTHON: Final = 1 << 9
"""The flag of classes that were made at run time, as all classes written in Python are."""


def _reduce_error(error: BaseException) -> tuple[Any, ...] | None:
    """How to rebuild an error without a call of its ``__init__``.

    None if its class itself defines pickling.
    """
    kinds = [
        kind
        for kind in type(error).__mro__
        if kind not in (BaseExceptionGroup, BaseException, object)
    ]
    if any(
        kind.__flags__ & _IN_PYTHON and {"__reduce__", "__reduce_ex__"} & vars(kind).keys()
        for kind in kinds
    ):
        return None
    members = {
        name: getattr(error, name)
        for kind in kinds
        for name, member in vars(kind).items()
        if isinstance(member, (MemberDescriptorType, GetSetDescriptorType))
        and not name.startswith("__")
        # the ``obj`` of an AttributeError may refer to the whole model
        if name != "obj" and hasattr(error, name)
    }
    args = (
        (error.message, error.exceptions) if isinstance(error, BaseExceptionGroup) else error.args
    )
    return _rebuild_error, (
        type(error),
        args,
        members | {"args": args},
        vars(error) | {"__notes__": error_notes(error)},
    )


def _rebuild_error(
    kind: Any, args: tuple[Any, ...], members: dict[str, Any], attributes: dict[str, Any]
) -> Any:
    builtin: Any = next(base for base in kind.__mro__ if not base.__flags__ & _IN_PYTHON)
    error = builtin.__new__(kind, *args)
    for name, value in members.items():
        if value is not None or getattr(error, name, error) is not None:
            BaseException.__setattr__(error, name, value)
    vars(error).update(attributes)
    return error


# -- classes --------------------------------------------------------------------------------------

_HERE: Final = uuid4().hex


def _origin() -> tuple[str, int]:
    """What tells this process from all others, also from those that it has forked."""
    return _HERE, os.getpid()


def _restore_class(made: type, sent: tuple[Any, Any, Any]) -> None:
    """Give a class its attributes, unless it has them: it was never away, or an environment has patched some here."""
    origin, restore, (attributes, slots) = sent
    if origin != _origin():
        patched = {
            name
            for name, value in vars(made).items()
            if getattr(hook_of(value), "owner", None) is made
        }
        restore(
            made,
            ({name: value for name, value in attributes.items() if name not in patched}, slots),
        )


# -- functions ------------------------------------------------------------------------------------

_tokens: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
_known: WeakValueDictionary[str, Any] = WeakValueDictionary()
"""Functions and hooks that were sent or received, by token.

What comes back is identical to what was sent.
"""


def _reduce_function(function: FunctionType) -> tuple[Any, ...] | None:
    """How another process finds or makes a function that its name does not lead to.

    None for all others.
    """
    place = function.__module__, function.__qualname__
    for way in _WAYS:
        if _find(*place, way) is function:
            return None if way == "itself" else (_find, (*place, way))
    hook = hook_of(function)
    return None if hook is None else _by_token(function, hook.make_wrapper, made_with(function))


_WAYS: Final = {
    "itself": lambda found: found,
    "unbound": lambda found: getattr(found, "__func__", found),
    "rule": unwrap,
}
"""The ways from the object with a function's name to the function."""


def _find(module: str | None, path: str, way: str) -> Any:
    """Import the object with a dotted name, and return what a way leads to from there.

    None if there is none.
    """
    if module is None or module == "__main__":
        return None
    try:
        return _WAYS[way](reduce(getattr, path.split("."), import_module(module)))
    except (ImportError, AttributeError):
        return None


def _by_token(thing: Any, make: Callable[..., Any], *args: Any) -> tuple[Any, ...]:
    token = _tokens.setdefault(thing, uuid4().hex)
    _known[token] = thing
    return _make, (token, make, args)


def _make(token: str, make: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    """Make the function or hook that has a token, unless this process has it."""
    if token not in _known:
        made = _known[token] = make(*args)
        _tokens[made] = token
    return _known[token]
