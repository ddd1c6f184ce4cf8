"""The wire between an environment and a simulator in another process: one JSON object per line, version 1.

It only uses what every language can represent: keys are strings, and numbers that are not finite are sent as
``{"float": "nan"}``, ``{"float": "inf"}`` and ``{"float": "-inf"}``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import inf, isfinite, nan
from typing import Any, Final, NoReturn

import numpy as np

from ..errors import WireError, describe_error, short_repr
from ..simulation import RULE

VERSION: Final = 1

DESCRIPTORS: Final = "SIMENV_MARL_FDS"
"""The environment variable that has the numbers of a simulator's two descriptors, ``"R,W"``."""

LONGEST: Final = 16 << 20
"""The largest number of bytes in a line."""

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
        raise WireError(f"the message cannot be written as JSON ({describe_error(error)})") from None
    if len(line) > LONGEST:
        raise WireError(f"a line of {len(line):,} bytes is too long to be sent; the limit is {LONGEST:,}")
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
                    f"{short_repr(key)} cannot be a key in a message to a process; keys must be strings{_at(where)}"
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
        raise WireError(f"a line that is not JSON in UTF-8 ({describe_error(error)}): {short_repr(line)}") from None
    if not isinstance(frame, dict):
        raise WireError(f"a line that is not a JSON object: {short_repr(line)}")
    return frame


def _number(found: dict[str, Any]) -> Any:
    """Return the non-finite number that an object represents, or the object itself."""
    name = found.get("float")
    return _NOT_FINITE.get(name, found) if len(found) == 1 and isinstance(name, str) else found


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not in JSON; numbers that are not finite travel as {{'float': 'nan'}}")


_ENCODER: Final = json.JSONEncoder(separators=(",", ":"), allow_nan=False, check_circular=False)
_DECODER: Final = json.JSONDecoder(parse_constant=_refuse)
_WITH_OBJECTS: Final = json.JSONDecoder(parse_constant=_refuse, object_hook=_number)
