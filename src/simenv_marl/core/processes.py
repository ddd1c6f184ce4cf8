"""Pickling for other processes: simulations, decision points, policies, results and errors.

Things that can be imported are pickled by reference, all others by value, such as those of a script or a notebook.
Functions need special care: a patch may take the place of a function while an environment is in use, and a decision
function must ask the environments of the process in which it is called.
"""

from __future__ import annotations

import io
import pickle
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from types import FunctionType, GetSetDescriptorType, MemberDescriptorType
from typing import Any, Final, NamedTuple
from uuid import uuid4
from weakref import WeakKeyDictionary, WeakValueDictionary

import cloudpickle

from ..decision import DecisionPoint, Definition, point_of, unwrapped
from ..errors import WorkerError, annotate, describe_error, error_notes
from ..hooks.hook import Hook, hook_of, made_with


def pack(thing: Any) -> bytes:
    """Pickle an object for another process.

    Raises:
        Exception: Any error of pickling.
    """
    buffer = io.BytesIO()
    _Pickler(buffer, 5).dump(thing)
    return buffer.getvalue()


def pack_plainly(thing: Any) -> bytes:
    """Pickle an object, faster than ``pack``, for a process that ``multiprocessing`` started from the same script.

    Raises:
        Exception: Any error of pickling.
    """
    with suppress(Exception):  # ``pack`` raises the error below
        plain = pickle.dumps(thing, 5)
        # Other processes cannot import what is defined in a notebook or an interactive session.
        if b"__main__" not in plain or hasattr(sys.modules["__main__"], "__file__"):
            return plain
    return pack(thing)


def unpack(parcel: bytes) -> Any:
    """Unpickle an object that ``pack`` or ``pack_plainly`` has pickled."""
    return pickle.loads(parcel)


# -- errors ---------------------------------------------------------------------------------------

_PICKLED_BY: Final = {"__reduce__", "__reduce_ex__", "__getstate__", "__setstate__"}

_LEFT_OUT: Final = vars(AttributeError)["obj"]
"""An attribute that may refer to the whole model. ``pickle`` leaves it out, too."""

_IN_PYTHON: Final = 1 << 9
"""The flag of types that are created at run time, as all classes written in Python are."""


class _Packed(NamedTuple):
    """The packed parts of one error.

    Attributes:
        parts: The pickled parts from which the error is rebuilt. None if they cannot be pickled.
        message: The message.
        notes: The notes.
        members: The numbers of the errors in an exception group.
        cause: The number of the error that a traceback shows as the cause. None if there is none.
        direct: Whether the error was raised ``from`` that cause.
    """

    parts: bytes | None
    message: str
    notes: list[str]
    members: list[int]
    cause: int | None
    direct: bool


class RemoteTraceback(Exception):
    """The first cause of an error from another process. Its message is the traceback in that process."""

    def __str__(self) -> str:
        return f"\n\n{self.args[0]}"


def pack_error(error: BaseException) -> bytes:
    """Pickle an error and its causes for another process, so that they can be rebuilt or at least described there."""
    try:
        text = "".join(traceback.format_exception(error))
    except Exception:  # formatting runs code of the error's class, which may fail
        text = describe_error(error)
    errors, numbers = [error], {id(error): 0}
    for known in errors:  # the loop appends to the list
        for other in (_cause_of(known), *_members_of(known)):
            if other is not None and id(other) not in numbers:
                numbers[id(other)] = len(errors)
                errors.append(other)
    packed = [
        _Packed(
            parts=_packed(known),
            message=describe_error(known),
            notes=error_notes(known),
            members=[numbers[id(member)] for member in _members_of(known)],
            cause=numbers.get(id(_cause_of(known))),
            direct=known.__cause__ is not None,
        )
        for known in errors
    ]
    return pickle.dumps((packed, text), 5)


def unpack_error(parcel: bytes) -> BaseException:
    """Rebuild a packed error with its causes. Its remote traceback becomes the first cause.

    An error that cannot be rebuilt becomes a ``WorkerError``.
    """
    packed, text = pickle.loads(parcel)
    errors: dict[int, BaseException] = {}
    for number in range(len(packed)):
        _rebuild(number, packed, errors)
    for number, known in enumerate(packed):
        if known.cause is not None:
            # The error's class may be a frozen dataclass.
            name = "__cause__" if known.direct else "__context__"
            BaseException.__setattr__(errors[number], name, errors[known.cause])
    first, seen = 0, {0}
    while (cause := packed[first].cause) is not None and cause not in seen:  # causes may be cyclic
        first = cause
        seen.add(cause)
    BaseException.__setattr__(errors[first], "__cause__", RemoteTraceback(text))
    return errors[0]


def _cause_of(error: BaseException) -> BaseException | None:
    """The error that a traceback shows as the cause of an error."""
    return error.__cause__ if error.__cause__ is not None or error.__suppress_context__ else error.__context__


def _members_of(error: BaseException) -> tuple[BaseException, ...]:
    return error.exceptions if isinstance(error, BaseExceptionGroup) else ()


def _packed(error: BaseException) -> bytes | None:
    """Pickle an error's parts, or the error itself if its class defines pickling; None if neither can be pickled."""
    kinds = [kind for kind in type(error).__mro__ if kind.__flags__ & _IN_PYTHON]
    itself = any(_PICKLED_BY & vars(kind).keys() for kind in kinds)
    for whole in (itself, not itself):
        with suppress(Exception):
            parcel = pack_plainly(error if whole else _parts(error))
            _made_again(parcel, _members_of(error))
            return parcel
    return None


def _parts(error: BaseException) -> tuple[Any, ...]:
    """The parts of an error, without the members of an exception group."""
    state = {name: value for name, value in vars(error).items() if name != "__notes__"}
    slots = {}
    for kind in set(type(error).__mro__) - {BaseException, BaseExceptionGroup, object}:
        for name, slot in vars(kind).items():
            if isinstance(slot, (MemberDescriptorType, GetSetDescriptorType)) and slot is not _LEFT_OUT:
                with suppress(AttributeError):  # the slot was never set
                    slots[name] = slot.__get__(error)
    for name in slots.keys() & {"__dict__", "__weakref__"}:
        del slots[name]
    args = (error.message,) if isinstance(error, BaseExceptionGroup) else error.args
    return type(error), args, slots, state


def _made_again(parcel: bytes, members: Sequence[BaseException]) -> BaseException:
    """Rebuild an error from its pickled parts and the members of its group."""
    thing = pickle.loads(parcel)
    if isinstance(thing, BaseException):
        return thing
    kind, args, slots, state = thing
    # The class's own ``__init__`` and ``__new__`` are not called, because their arguments may differ from ``args``.
    native = next(base for base in kind.__mro__ if not base.__flags__ & _IN_PYTHON)
    if members:
        args = *args, list(members)
    error: BaseException = native.__new__(kind, *(args if members else ()))
    for name, value in {**slots, "args": args}.items():
        if value is not None or getattr(error, name, error) is not None:
            getattr(kind, name).__set__(error, value)
    vars(error).update(state)
    return error


def _rebuild(number: int, packed: list[_Packed], errors: dict[int, BaseException]) -> BaseException:
    """Rebuild an error, after the members of its group, unless it is already rebuilt."""
    if number not in errors:
        parts, message, notes, numbers, *_ = packed[number]
        error: BaseException = WorkerError(f"another process raised an error that cannot be pickled: {message}")
        members = [_rebuild(member, packed, errors) for member in numbers]
        if parts is not None:
            with suppress(Exception):
                error = _made_again(parts, members)
        for note in notes:
            if note not in error_notes(error):
                annotate(error, note)
        errors[number] = error
    return errors[number]


# -- functions ------------------------------------------------------------------------------------


class _Pickler(cloudpickle.Pickler):
    """A pickler that lets the receiving process find functions, or make them anew."""

    def reducer_override(self, obj: Any) -> Any:
        reduced = _reduced(obj)
        return super().reducer_override(obj) if reduced is None else reduced


def _reduced(thing: Any) -> tuple[Any, ...] | None:
    """The reduction of an object for which the default pickling is wrong; None for all other objects."""
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
    return None if hook is None else (_restore_wrapper, (_token(thing), hook, made_with(thing)))


def _found_at(module: str, path: str, *, bound: bool = False) -> Any:
    """Import the object with a dotted name from a module; None if there is none. A method comes unbound by default."""
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
"""Objects that were sent or received, by token. An object that comes back is identical to the one that was sent."""


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


def _restore_wrapper(token: str, hook: Hook, definition: Definition | None) -> Any:
    return _restored(token, lambda: hook.make_wrapper(definition))
