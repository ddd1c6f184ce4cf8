"""Decisions, action spaces, pictures and actions as JSON, for the page and for recordings."""

import struct
import zlib
from base64 import b64encode
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import islice
from math import isfinite
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Space
from numpy.typing import NDArray

from ...core import Decision, Labels, Mask
from ...envs import SimulationAECEnv
from ...errors import describe_error, short_repr
from ...simulation import RULE, Action, Observation
from ..answers import MISFITS, to_action
from ..descriptions import JSON, labelled, legal_actions
from ..recordings import digest_of

Message = dict[str, Any]
"""A message between the page, the server and the game, or a part of one."""

MOST_CANDIDATES: Final = 12
"""The largest number of candidates for a decision."""

MOST_ENTRIES: Final = 64
"""The largest number of entries of an observation on the page."""

LONGEST_TEXT: Final = 20_000
"""The largest number of characters of a rendered text on the page."""


def jsonable(value: object) -> JSON:
    """Return a value as JSON.

    Arrays become lists. Numbers that are not finite, and objects, become texts.
    """
    match value:
        case np.ndarray() | np.generic():
            return jsonable(value.tolist())
        case Mapping():
            return {str(key): jsonable(part) for key, part in value.items()}
        case list() | tuple():
            return [jsonable(part) for part in value]
        case float() if not isfinite(value):
            return str(value)
        case str() | int() | float() | None:
            return value
        case _:
            return short_repr(value)


def pending_decision(decision: Decision) -> Message:
    """Return a decision as JSON, for the page."""
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


def entries_of(
    observation: Observation,
    labels: Labels = None,
) -> list[tuple[str, Any]]:
    """Return the first entries of an observation, each as its name and its number or text."""
    return [*islice(_entries(labelled(observation, labels)), MOST_ENTRIES)]


def _entries(value: JSON, name: str = "") -> Iterator[tuple[str, JSON]]:
    match value:
        case Mapping():
            for key, part in value.items():
                yield from _entries(part, f"{name} {key}".strip())
        case list():
            for place, part in enumerate(value):
                yield from _entries(part, f"{name}[{place}]")
        case _:
            yield name or "value", jsonable(value)


def describe_space(space: Space[Any]) -> Message:
    """Describe an action space as JSON, for the inputs of the page."""
    match space:
        case Discrete():
            return {"kind": "discrete", "start": int(space.start), "n": int(space.n)}
        case Box():
            return {
                "kind": "box",
                "low": jsonable(space.low),
                "high": jsonable(space.high),
                "whole": space.low.dtype.kind in "iu",
            }
        case MultiDiscrete(shape=(_,)):
            return {"kind": "grid", "sizes": space.nvec.tolist(), "starts": space.start.tolist()}
        case MultiBinary(shape=(size,)):
            return {"kind": "grid", "sizes": [2] * size, "starts": [0] * size}
        case _:
            return {"kind": "other", "text": short_repr(space)}


def candidates_of(
    space: Space[Any],
    mask: Mask | None,
) -> list[Action]:
    """Return actions to try out, as JSON.

    These are the legal actions of a ``Discrete``, or five actions of a bounded ``Box`` of one
    number. Other spaces have none.
    """
    match space:
        case Discrete():
            return legal_actions(space, mask)[: MOST_CANDIDATES - 1]
        case Box() if space.low.size == 1 and space.is_bounded():
            grid = np.linspace(space.low, space.high, 5)
            actions = np.unique(grid.astype(space.dtype), axis=0)
            return [*actions.tolist()]
        case _:
            return []


def picture_of(env: SimulationAECEnv) -> Message | None:
    """Return the rendered image as JSON: a text, or the PNG of an array ``(height, width, 3)``."""
    try:
        rendered = None if env.render_mode is None else env.render()
    except Exception as error:
        rendered = f"render has failed: {describe_error(error)}"
    match rendered:
        case None:
            return None
        case np.ndarray(dtype=np.uint8, shape=(_, _, 3)) if rendered.size:
            return {"png": b64encode(_png(rendered)).decode()}
        case np.ndarray():
            return {"text": f"an array of shape {rendered.shape}"}
        case _:
            return {"text": str(rendered)[:LONGEST_TEXT]}


def _png(image: NDArray[np.uint8]) -> bytes:
    """Return the PNG of an array of shape ``(height, width, 3)``."""
    height, width, _ = image.shape
    lines = np.insert(image.reshape(height, -1), 0, 0, axis=1)  # 0: the line is unfiltered
    header = struct.pack("!IIBBBBB", width, height, 8, 2, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n"
    for chunk in (b"IHDR" + header, b"IDAT" + zlib.compress(lines.tobytes()), b"IEND"):
        png += struct.pack("!I", len(chunk) - 4)  # without the type
        png += chunk
        png += struct.pack("!I", zlib.crc32(chunk))
    return png


def action_of(space: Space[Any], value: Action) -> Action:
    """Return the action for its JSON; ``RULE`` for None.

    A value that does not fit is returned as it is, so that the environment refuses it.
    """
    if value is None:
        return RULE
    with suppress(*MISFITS):
        return to_action(space, value)
    return value
