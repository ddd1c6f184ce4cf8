"""The protocol between an environment and a simulator in another process, version 1.

Each line is one JSON object, a *frame*. Frames contain only data that every language can represent:
keys are strings, and numbers that are not finite are sent as ``{"float": "nan"}``,
``{"float": "inf"}`` and ``{"float": "-inf"}``.
"""

import json
from collections.abc import Collection, Mapping
from math import inf, isfinite, nan
from typing import Any, Final, NoReturn, TypeAlias

import numpy as np

from ..errors import WireError, describe_error, short_repr
from ..simulation import RULE, Model

Frame: TypeAlias = dict[str, Any]
"""A JSON object that is sent or was received."""

Entity: TypeAlias = str | int | None
"""The name of an entity in its simulator; None for a call without an entity."""

Json: TypeAlias = "str | int | float | list[Json] | dict[str, Json] | None"

VERSION: Final = 1

DESCRIPTORS: Final = "SIMENV_MARL_FDS"
"""The environment variable with the numbers of a simulator's two descriptors, ``"R,W"``."""

LONGEST: Final = 16 << 20
"""The largest number of bytes in a line."""

_CALL: Final = frozenset({"point", "entity", "time", "args"})
"""The keys of a call, and of an entity's update or removal."""

KEYS: Final = {
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

_RESERVED: Final = _CALL - {"args"}
"""Names that no argument can have, because calls have other attributes of these names."""

_NOT_FINITE: Final = {"nan": nan, "inf": inf, "-inf": -inf}

STOP: Final = b'{"stop":true}\n'


def encode(frame: Mapping[str, Model]) -> bytes:
    """Return the line of a frame.

    Raises:
        WireError: The frame contains a value that is not JSON data, or is too long.
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


def encode_answer(number: int, value: Model) -> bytes:
    """Return the line that answers a call with a decision; ``RULE`` leaves it to the process.

    Raises:
        WireError: As ``encode``.
    """
    if value is RULE:
        return b'{"act":%d,"rule":true}\n' % number
    if type(value) in (int, float) and abs(value) < 1e300:  # most decisions need no conversion
        return b'{"act":%d,"value":%a}\n' % (number, value)
    return encode({"act": number, "value": value})


def _to_json(value: Model, path: str = "") -> Json:
    """Convert a value to JSON data; ``path`` is its place in the frame, for the error."""
    match value:
        case None | str() | int():
            return value
        case float():
            return float(value) if isfinite(value) else {"float": repr(float(value))}
        case np.ndarray() | np.generic():
            return _to_json(value.tolist(), path)
        case list() | tuple():
            return [_to_json(item, f"{path}[{index}]") for index, item in enumerate(value)]
        case Mapping() if all(isinstance(key, str) for key in value):
            return {key: _to_json(item, f"{path}[{key!r}]") for key, item in value.items()}
    place = f" (at {path})" if path else ""
    raise WireError(
        f"{short_repr(value)} cannot be sent to a process: it is not JSON data, or has keys that"
        f" are no strings{place}"
    )


def decode(line: bytes) -> Frame:
    """Return the frame of a line.

    Raises:
        WireError: The line is not a JSON object in UTF-8. The message completes "it has sent ...".
    """
    try:
        frame = _DECODER.decode(line.decode())
    except (ValueError, RecursionError) as error:
        raise WireError(
            f"a line that is not JSON in UTF-8 ({describe_error(error)}): {short_repr(line)}"
        ) from None
    if not isinstance(frame, dict):
        raise WireError(f"a line that is not a JSON object: {short_repr(line)}")
    return frame


def check_frame(frame: Frame, points: Collection[str]) -> float | None:
    """Check a frame of a simulator with these points, but not whether the frame is due.

    Calls, updates and removals get an item "entity", and so do the items of "expect".

    Returns:
        The latest time in the frame; None if there is none.

    Raises:
        WireError: The frame is invalid. The message completes "it has ...".
    """
    kinds = sorted(KEYS.keys() & frame.keys())
    if len(kinds) > 1:
        raise WireError(
            f"sent {' and '.join(kinds)} in one frame, {short_repr(frame)}; each needs a"
            " separate line"
        )
    calls: list[Frame] = []
    match frame:
        case _ if kinds and KEYS[kinds[0]] is _CALL:
            calls = [frame]
        case {"end": {**end}} if isinstance(end.get("truncated", False), bool):
            pass
        case {"end": wrong}:
            raise WireError(
                f'sent the end {short_repr(wrong)}; it must be an object with "truncated" (true or'
                ' false) and "result"'
            )
        case {"expect": [*items]} if all(map(_is_call, items)):
            calls = items
        case {"expect": items}:
            raise WireError(
                f'sent "expect" with {short_repr(items)}; it must be a list of objects with'
                ' "point", "entity" and "args"'
            )
    latest: float | None = None
    for call in calls:
        time = _check_call(call, points)
        latest = latest if time is None else time
    return latest


def _is_call(item: Json) -> bool:
    return isinstance(item, dict) and item.keys() <= _CALL


def _check_call(frame: Frame, points: Collection[str]) -> float | None:
    """Check the point, the entity, the arguments and the time of a frame.

    Set its item "entity", and return its time.
    """
    name = frame.get("point")
    entity = frame.get("update", frame.get("remove", frame.get("entity")))
    arguments = {} if frame.get("args") is None else frame["args"]
    time = frame.get("time")
    if not isinstance(name, str) or name not in points:
        raise WireError(f"named the point {short_repr(name)}, which is not in its hello")
    if entity is not None and type(entity) not in (str, int):
        raise WireError(
            f"sent the entity {short_repr(entity)} for {name}; an entity must be a string or an"
            " integer"
        )
    if not isinstance(arguments, dict):
        raise WireError(f"sent args for {name} that are not an object: {short_repr(arguments)}")
    reserved = _RESERVED & arguments.keys()
    if reserved:
        raise WireError(
            f"sent an argument {min(reserved)!r} for {name}; calls have another attribute of this"
            " name: rename the argument"
        )
    if type(time) is int and abs(time) < 1 << 1000:  # larger ones may exceed floats
        time = float(time)
    if time is not None and type(time) is not float:
        raise WireError(f"sent the time {short_repr(time)} for {name}, which is not a number")
    frame["entity"] = entity
    return time


def is_integer(value: Json, number: int) -> bool:
    """Return whether JSON data is this integer, and neither a boolean nor a float."""
    return type(value) is int and value == number


def _read_object(item: Frame) -> Frame | float:
    """Return the non-finite number that a JSON object represents, or the object itself."""
    name = item.get("float")
    return _NOT_FINITE.get(name, item) if len(item) == 1 and isinstance(name, str) else item


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(
        f"{name} is not in JSON; send numbers that are not finite as {{'float': 'nan'}}"
    )


_ENCODER: Final = json.JSONEncoder(separators=(",", ":"), allow_nan=False, check_circular=False)
_DECODER: Final = json.JSONDecoder(parse_constant=_refuse_constant, object_hook=_read_object)
