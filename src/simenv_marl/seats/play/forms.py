"""What goes between the game, the page and the recording: decisions, spaces, pictures and actions as JSON."""

from __future__ import annotations

import json
import struct
import zlib
from base64 import b64encode
from collections.abc import Iterator, Mapping
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from ...errors import describe_error, short_repr
from ..descriptions import labelled, pending
from ..policies import digest_of

MOST: Final = 12  # candidates of a decision, and entries of its observation in the history


def jsonable(value: Any) -> Any:
    """Return a value as JSON has it: arrays as lists, numbers that are not finite and other things as text."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): jsonable(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(part) for part in value]
    if isinstance(value, float) and not isfinite(value):
        return str(value)
    return value if value is None or isinstance(value, (str, int, float)) else short_repr(value)


def pending_decision(env: Any) -> dict[str, Any]:
    """Return the pending decision of an AEC environment as JSON.

    Called in the process where it lives.
    """
    decision = pending(env)
    return {
        "agent": decision.agent,
        "number": decision.number,
        "time": jsonable(decision.time),
        "doc": (decision.doc or "").strip().partition("\n")[0],
        "reward": decision.reward,
        "observation": entries_of(decision.observation, decision.observation_labels),
        "space": describe_space(decision.action_space),
        "mask": jsonable(decision.mask),
        "labels": jsonable(decision.action_labels),
        "seen": digest_of(decision.observation),
    }


def entries_of(observation: Any, labels: Any = None) -> list[tuple[str, Any]]:
    """Return the first entries of an observation: name, and number or text."""
    return [*_entries(labelled(observation, labels))][:64]


def _entries(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the entries of an observation: name, and number or text."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _entries(part, f"{name} {key}".strip())
    elif isinstance(value, (list, tuple)):
        for place, part in enumerate(value):
            yield from _entries(part, f"{name}[{place}]")
    else:
        yield name or "value", jsonable(value)


def describe_space(space: spaces.Space[Any]) -> dict[str, Any]:
    """Describe an action space to the page."""
    if isinstance(space, spaces.Discrete):
        return {"kind": "discrete", "start": int(space.start), "n": int(space.n)}
    if isinstance(space, spaces.Box):
        whole = space.dtype is not None and space.dtype.kind in "iu"
        return {
            "kind": "box",
            "low": jsonable(space.low),
            "high": jsonable(space.high),
            "whole": whole,
        }
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1:
        return {"kind": "grid", "sizes": space.nvec.tolist(), "starts": space.start.tolist()}
    if isinstance(space, spaces.MultiBinary) and isinstance(space.n, int):
        return {"kind": "grid", "sizes": [2] * space.n, "starts": [0] * space.n}
    return {"kind": "other", "text": short_repr(space)}


def candidates_of(space: spaces.Space[Any], mask: Any) -> list[Any]:
    """Return actions to try out, as JSON: the legal ones of a ``Discrete``, five of a bounded ``Box`` of one number."""
    if isinstance(space, spaces.Discrete):
        legal = np.arange(space.n) if mask is None else np.flatnonzero(mask)
        return [int(space.start) + int(place) for place in legal[: MOST - 1]]
    if isinstance(space, spaces.Box) and space.low.size == 1 and space.is_bounded():
        found: list[Any] = np.unique(
            np.linspace(space.low, space.high, 5).astype(space.dtype), axis=0
        ).tolist()
        return found
    return []


def picture_of(env: Any) -> dict[str, Any] | None:
    """Return what ``render`` returns as JSON: text, or the PNG of an array ``(height, width, 3)``, uint8."""
    try:
        rendered = None if env.render_mode is None else env.render()
    except Exception as error:
        rendered = f"render has failed: {describe_error(error)}"
    if not isinstance(rendered, np.ndarray):
        return None if rendered is None else {"text": str(rendered)[:20_000]}
    if (
        rendered.ndim != 3
        or rendered.shape[2] != 3
        or rendered.dtype != np.uint8
        or not rendered.size
    ):
        return {"text": f"an array of shape {rendered.shape}"}
    height, width, _ = rendered.shape
    # 0: an unfiltered line
    lines = np.hstack([np.zeros((height, 1), np.uint8), rendered.reshape(height, -1)])
    header = struct.pack("!IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [b"IHDR" + header, b"IDAT" + zlib.compress(lines.tobytes()), b"IEND"]
    parts = [
        struct.pack("!I", len(chunk) - 4) + chunk + struct.pack("!I", zlib.crc32(chunk))
        for chunk in chunks
    ]
    return {"png": b64encode(b"\x89PNG\r\n\x1a\n" + b"".join(parts)).decode()}


def action_of(space: spaces.Space[Any], value: Any) -> Any:
    """Return the action for its JSON.

    What does not fit stays as it is, and the environment refuses it.
    """
    if isinstance(space, (spaces.MultiDiscrete, spaces.MultiBinary)):
        with suppress(ValueError, OverflowError):
            array = np.asarray(value)
            return array.astype(space.dtype) if array.dtype.kind == "i" else value
    if (
        isinstance(space, spaces.Dict)
        and isinstance(value, dict)
        and value.keys() == space.spaces.keys()
    ):
        return {key: action_of(part, value[key]) for key, part in space.spaces.items()}
    if (
        isinstance(space, spaces.Tuple)
        and isinstance(value, list)
        and len(value) == len(space.spaces)
    ):
        return tuple(map(action_of, space.spaces, value))
    return value


def write(path: Path | None, line: Mapping[str, Any]) -> str:
    """Append a line, if there is a path; return what is wrong.

    It is open only meanwhile: clones need not copy it.
    """
    try:
        if path is not None:
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(jsonable(line)) + "\n")
    except OSError as error:
        return f"The recording {path} cannot be written: {error}"
    return ""
