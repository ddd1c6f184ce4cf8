"""Observations and actions as JSON, and their digests."""

from collections.abc import Callable, Mapping
from hashlib import blake2b
from typing import Any, Final

import numpy as np
from gymnasium.spaces import GraphInstance

from ..errors import EpisodeFileError, short_repr
from ..simulation import RULE, Observation

_TAGS: Final = {"array", "scalar", "rule", "tuple", "graph", "dict", "name", "call", "open"}
"""The first keys of objects that stand for other values than dicts."""


def refuse(value: object) -> Any:
    """Raise the error for a value that has no JSON."""
    raise EpisodeFileError(f"{short_repr(value)} cannot be written as JSON")


def encode_value(value: Any, other: Callable[[Any], Any] = refuse) -> Any:
    """Return a value as JSON, from which ``decode_value`` makes the same value, of the same types.

    ``other`` returns the JSON of values that are neither data nor made of data.
    """
    kind = type(value)
    if kind in (int, str, float, bool) or value is None:
        return value
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "biuf":
        numbers = value.tolist()
        if isinstance(value, np.generic):
            return {"scalar": numbers, "dtype": value.dtype.str}
        encoded: dict[str, Any] = {"array": numbers, "dtype": value.dtype.str}
        return encoded if value.size else encoded | {"shape": list(value.shape)}
    if kind is list:
        return [encode_value(part, other) for part in value]
    if kind is tuple:
        return {"tuple": [encode_value(part, other) for part in value]}
    if isinstance(value, GraphInstance):
        return {"graph": [encode_value(part, other) for part in value]}
    if value is RULE:
        return {"rule": True}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        parts = {key: encode_value(part, other) for key, part in value.items()}
        return {"dict": parts} if _TAGS & parts.keys() else parts
    return other(value)


def decode_value(value: Any, other: Callable[[Any], Any] = refuse) -> Any:
    """Return the value of its JSON. ``other`` returns the values of its own JSON."""
    if type(value) is list:
        return [decode_value(part, other) for part in value]
    if type(value) is not dict:
        return value
    match value:
        case {"array": numbers, "dtype": dtype}:
            return np.array(numbers, _numeric(dtype)).reshape(value.get("shape", np.shape(numbers)))
        case {"scalar": number, "dtype": dtype}:
            return _numeric(dtype).type(number)
        case {"rule": _}:
            return RULE
        case {"tuple": parts}:
            return tuple(decode_value(part, other) for part in parts)
        case {"graph": parts}:
            return GraphInstance(*(decode_value(part, other) for part in parts))
        case {"dict": parts}:
            return {key: decode_value(part, other) for key, part in parts.items()}
    if _TAGS & value.keys():
        return other(value)
    return {key: decode_value(part, other) for key, part in value.items()}


def _numeric(name: str) -> np.dtype[Any]:
    """Return the dtype of numbers with a name."""
    dtype = np.dtype(name)
    return dtype if dtype.kind in "biuf" else refuse(name)


def digest_of(observation: Observation) -> str:
    """Return a digest of an observation: of the names, types, shapes and bytes of its parts."""
    if type(observation) is np.ndarray and observation.dtype != object:
        head = f"{observation.dtype.str}{observation.shape}".encode()
        return blake2b(head + observation.tobytes(), digest_size=12).hexdigest()
    digest = blake2b(digest_size=12)

    def add(part: Observation) -> None:
        match part:
            case Mapping():
                for name in sorted(part, key=str):
                    digest.update(str(name).encode())
                    add(part[name])
            case tuple() | list():
                for item in part:
                    add(item)
            case np.ndarray() | np.generic() if part.dtype != object:
                digest.update(f"{part.dtype.str}{part.shape}".encode())
                digest.update(np.ascontiguousarray(part).tobytes())
            case _:
                digest.update(repr(part).encode())

    add(observation)
    return digest.hexdigest()
