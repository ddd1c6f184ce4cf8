"""What the page gets of a decision: observations, spaces, pictures, and actions to try out."""

from __future__ import annotations

import struct
import zlib
from base64 import b64encode
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from ...core.pending import decision_of
from ...errors import describe_error, short_repr
from ..descriptions import labelled
from ..policies import digest_of
from .recording import jsonable

MOST: Final = 12  # candidates of a decision, and entries of its observation in the history


def pending_decision(env: Any) -> dict[str, Any]:
    """Return the pending decision of an AEC environment as JSON; called in the process where it lives."""
    decision = decision_of(env.episode, env.episode.pending)
    return {
        "agent": decision.agent,
        "number": decision.number,
        "time": jsonable(decision.time),
        "doc": (decision.doc or "").strip().partition("\n")[0],
        "reward": decision.reward,
        "observation": [*_entries(labelled(decision.observation, decision.observation_labels))][:64],
        "space": describe_space(decision.action_space),
        "mask": jsonable(decision.mask),
        "labels": jsonable(decision.action_labels),
        "seen": digest_of(decision.observation),
    }


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
        return {"kind": "box", "low": jsonable(space.low), "high": jsonable(space.high), "whole": whole}
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
        return list(np.unique(np.linspace(space.low, space.high, 5).astype(space.dtype), axis=0).tolist())
    return []


def picture_of(env: Any) -> dict[str, Any] | None:
    """Return what ``render`` returns as JSON: text, or the PNG of an array ``(height, width, 3)``, uint8."""
    try:
        rendered = None if env.render_mode is None else env.render()
    except Exception as error:
        rendered = f"render has failed: {describe_error(error)}"
    if not isinstance(rendered, np.ndarray):
        return None if rendered is None else {"text": str(rendered)[:20_000]}
    if rendered.ndim != 3 or rendered.shape[2] != 3 or rendered.dtype != np.uint8 or not rendered.size:
        return {"text": f"an array of shape {rendered.shape}"}
    height, width, _ = rendered.shape
    lines = np.hstack([np.zeros((height, 1), np.uint8), rendered.reshape(height, -1)])  # 0: an unfiltered line
    header = struct.pack("!IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [b"IHDR" + header, b"IDAT" + zlib.compress(lines.tobytes()), b"IEND"]
    parts = [struct.pack("!I", len(chunk) - 4) + chunk + struct.pack("!I", zlib.crc32(chunk)) for chunk in chunks]
    return {"png": b64encode(b"\x89PNG\r\n\x1a\n" + b"".join(parts)).decode()}
