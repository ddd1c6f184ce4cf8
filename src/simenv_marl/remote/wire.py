"""The wire between an environment and a simulator in another process: one JSON object, a *frame*, per line, version 1.

It only uses what every language can represent: keys are strings, and numbers that are not finite
are sent as ``{"float": "nan"}``, ``{"float": "inf"}`` and ``{"float": "-inf"}``.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from math import inf, isfinite, nan
from types import NoneType
from typing import Any, Final, NoReturn

import numpy as np

from ..errors import WireError, describe_error, short_repr
from ..simulation import RULE

VERSION: Final = 1

DESCRIPTORS: Final = "SIMENV_MARL_FDS"
"""The environment variable that has the numbers of a simulator's two descriptors, ``"R,W"``."""

LONGEST: Final = 16 << 20
"""The largest number of bytes in a line."""

_CALL: Final = frozenset({"point", "entity", "time", "args"})

KEYS: Final[Mapping[str, frozenset[str]]] = {
    "hello": frozenset({"points", "can"}),
    "decide": _CALL,
    "decided": frozenset({"value"}),
    "expect": frozenset(),
    "update": _CALL,
    "remove": _CALL,
    "end": frozenset(),
    "error": frozenset(),
}
"""The kinds of frames that a simulator sends, and the other keys of each."""

RESERVED: Final = frozenset({"entity", "point", "time"})
"""What a call has besides its arguments. No argument can have such a name."""

_NOT_FINITE: Final = {"nan": nan, "inf": inf, "-inf": -inf}

STOP: Final = b'{"stop":true}\n'


def encode(frame: Mapping[str, Any]) -> bytes:
    """Return the line of a frame.

    Raises:
        WireError: Something in it cannot be sent, or it is too long.
    """
    try:
        line = _ENCODER.encode(_to_json(frame)).encode() + b"\n"
    except WireError:
        raise
    except (ValueError, RecursionError) as error:
        raise WireError(
            f"the message cannot be written as JSON ({describe_error(error)})"
        ) from None
    if len(line) > LONGEST:
        raise WireError(
            f"a line of {len(line):,} bytes is too long to be sent; the limit is {LONGEST:,}"
        )
    return line


def encode_answer(number: int, value: Any) -> bytes:
    """Return the line that answers a call with a decision; ``RULE`` leaves it to the process.

    Raises:
        WireError: As ``encode``.
    """
    if value is RULE:
        return b'{"act":%d,"rule":true}\n' % number
    if type(value) is int:  # most decisions are integers, which need no conversion
        return b'{"act":%d,"value":%d}\n' % (number, value)
    if type(value) is float and value - value == 0.0:
        return b'{"act":%d,"value":%a}\n' % (number, value)
    return encode({"act": number, "value": value})


def _to_json(value: Any, where: str = "") -> Any:
    """Convert a value to JSON data; ``where`` is its path in the frame, for the error."""
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, float):
        return float(value) if isfinite(value) else {"float": repr(float(value))}
    if isinstance(value, (np.ndarray, np.generic)):
        return _to_json(value.tolist(), where)
    if isinstance(value, (list, tuple)):
        return [_to_json(item, f"{where}[{place}]") for place, item in enumerate(value)]
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise WireError(
                    f"{short_repr(key)} cannot be a key in a message to a process; keys must be"
                    f" strings{_at(where)}"
                )
        return {key: _to_json(item, f"{where}[{key!r}]") for key, item in value.items()}
    raise WireError(f"{short_repr(value)} cannot be sent to a process: it is not JSON{_at(where)}")


def _at(where: str) -> str:
    return f" (at {where})" if where else ""


def decode(line: bytes) -> dict[str, Any]:
    """Return the frame of a line.

    Raises:
        WireError: The line is not a JSON object in UTF-8.
    """
    try:
        text = line.decode().strip()
        frame, end = (_WITH_OBJECTS if '"float"' in text else _DECODER).raw_decode(text)
        if end < len(text):
            raise ValueError(f"more follows after {end} characters")
    except (ValueError, RecursionError) as error:
        raise WireError(
            f"a line that is not JSON in UTF-8 ({describe_error(error)}): {short_repr(line)}"
        ) from None
    if not isinstance(frame, dict):
        raise WireError(f"a line that is not a JSON object: {short_repr(line)}")
    return frame


def check_frame(frame: dict[str, Any], points: Collection[str]) -> float | None:
    """Check what is in a frame of a simulator that has these points, but not whether the frame is due.

    Calls, updates and removals get an item "entity", and so do the items of "expect".

    Returns:
        The time that it tells; None if it tells none.

    Raises:
        WireError: It is wrong. The text continues "the process has".
    """
    if len(kinds := KEYS.keys() & frame.keys()) > 1:
        text = f"sent {' and '.join(sorted(kinds))} in one frame, {short_repr(frame)}; each needs a line of its own"
        raise WireError(text)
    if "end" in frame:
        end = frame["end"]
        if not isinstance(end, dict) or type(end.get("truncated", False)) is not bool:
            what = 'it must be an object with "truncated" (true or false) and "result"'
            raise WireError(f"sent the end {short_repr(end)}; {what}")
    elif "expect" in frame:
        items = frame["expect"]
        if not isinstance(items, list) or not all(
            isinstance(item, dict) and item.keys() <= _CALL for item in items
        ):
            what = 'it must be a list of objects with "point", "entity" and "args"'
            raise WireError(f'sent "expect" with {short_repr(items)}; {what}')
        times = [_check_call(item, item.get("entity"), points) for item in items]
        return next((time for time in reversed(times) if time is not None), None)
    elif kinds & {"decide", "update", "remove"}:
        entity = (
            frame.get("entity") if "decide" in frame else frame.get("update", frame.get("remove"))
        )
        return _check_call(frame, entity, points)
    return None


def _check_call(frame: dict[str, Any], entity: Any, points: Collection[str]) -> float | None:
    """Check the point, entity, arguments and time of a frame.

    Note the entity in it, and return the time.
    """
    name, arguments, time = frame.get("point"), frame.get("args"), frame.get("time")
    if not isinstance(name, str) or name not in points:
        raise WireError(f"named the point {short_repr(name)}, which is not in its hello")
    if type(entity) not in (str, int, NoneType):
        raise WireError(
            f"sent the entity {short_repr(entity)} for {name}; an entity must be a string or an"
            " integer"
        )
    if arguments is not None and not isinstance(arguments, dict):
        raise WireError(f"sent args for {name} that are not an object: {short_repr(arguments)}")
    if arguments and not RESERVED.isdisjoint(arguments):
        what = min(RESERVED & arguments.keys())
        raise WireError(
            f"sent an argument {what!r} for {name}; calls have that besides: rename the argument"
        )
    if type(time) is int and abs(time) < 1 << 1000:  # floats are not larger
        time = float(time)
    if time is not None and type(time) is not float:
        raise WireError(f"sent the time {short_repr(time)} for {name}, which is not a number")
    frame["entity"] = entity
    return time


def _number(found: dict[str, Any]) -> Any:
    """Return the non-finite number that an object represents, or the object itself."""
    name = found.get("float")
    return _NOT_FINITE.get(name, found) if len(found) == 1 and isinstance(name, str) else found


def _refuse(constant: str) -> NoReturn:
    raise ValueError(
        f"{constant} is not in JSON; numbers that are not finite travel as {{'float': 'nan'}}"
    )


_ENCODER: Final = json.JSONEncoder(separators=(",", ":"), allow_nan=False, check_circular=False)
_DECODER: Final = json.JSONDecoder(parse_constant=_refuse)
_WITH_OBJECTS: Final = json.JSONDecoder(parse_constant=_refuse, object_hook=_number)
