"""Decisions, actions and pictures as JSON, in the words that people read."""

import json
import re
import struct
import zlib
from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import reduce
from itertools import islice
from math import inf, prod
from operator import getitem
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Text
from numpy.typing import NDArray

from ...core import Decision, Labels, Mask, Space, as_json
from ...envs import SimulationAECEnv
from ...errors import describe_error, short_repr
from ...files.values import digest_of
from ...simulation import RULE, Action
from ..answers import MISFITS, to_action
from ..descriptions import (
    JSON,
    components_of,
    label_of_part,
    legal_actions,
    limits_of,
    schema_of,
    situation,
)

Message = dict[str, Any]
"""A message between the page, the server and the game, or a part of one."""

MOST_CANDIDATES: Final = 12
"""The largest number of candidates for a decision."""

MOST_ANSWERS: Final = 200
"""The largest number of answers that are shown one by one."""

MOST_ENTRIES: Final = 64
"""The largest number of entries of a situation, and of fields of an action."""

LONGEST_TEXT: Final = 20_000
"""The largest number of characters of a rendered text on the page."""

NUMBER: Final = re.compile(r"\s*[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
"""The number with which a displayed text may begin, such as "22 °C"."""


def jsonable(value: object) -> Any:
    """Return a value as JSON.

    Arrays become lists. Numbers that are not finite, and objects, become texts.
    """
    text = json.dumps(as_json(value))
    return json.loads(text, parse_constant=lambda name: str(float(name)))


def shown(value: object) -> str:
    """Return a value as a text for people. Fractions have four digits."""
    if isinstance(value, np.generic):
        value = value.item()
    match value:
        case bool():
            return "yes" if value else "no"
        case float() if 1_000 <= abs(value) < 1e15:
            return f"{value:.0f}"
        case float():
            return f"{value + 0.0:.4g}"  # without the sign of -0.0
        case _:
            return str(value)


# -- decisions ------------------------------------------------------------------------------------


def pending_decision(decision: Decision) -> Message:
    """Return a decision as JSON, for the page."""
    return {
        "agent": decision.agent,
        "number": decision.number,
        "time": jsonable(decision.time),
        "question": decision.question,
        "situation": situation_of(decision),
        "displayed": decision.display is not None,
        "form": form_of(decision.action_space, decision.mask, decision.action_labels),
        "seen": digest_of(decision.observation),
        "mask": None if decision.mask is None else digest_of(decision.mask),
    }


def situation_of(decision: Decision) -> list[Message]:
    """Return the first entries of the situation of a decision."""
    return entries_of(situation(decision))


def entries_of(value: JSON) -> list[Message]:
    """Return the first entries of a situation: label, text, and the number or None."""
    return [*islice(_entries(value), MOST_ENTRIES)]


def _entries(value: JSON, name: str = "") -> Iterator[Message]:
    match value:
        case Mapping():
            for key, part in value.items():
                yield from _entries(part, f"{name} {key}".strip())
        case list():
            for place, part in enumerate(value):
                yield from _entries(part, f"{name}[{place}]")
        case _:
            begin = NUMBER.match(str(value))
            number = float(begin[0]) if begin else None
            yield {"label": name or "value", "text": shown(value), "number": number}


# -- answers --------------------------------------------------------------------------------------


def form_of(
    space: Space,
    mask: Mask | None,
    labels: Labels,
) -> Message:
    """Describe the answers to a decision as JSON, for the inputs of the page.

    A ``Discrete`` has ``cards``: its legal actions with their labels. All other spaces have
    ``fields``: their names, and the ``path`` of their values in the JSON of an action. A field has
    ``options``, or it is a JSON schema with a ``hint``, or any ``json``.
    """
    fields = [*_fields(space, mask, labels)]
    is_card = isinstance(space, Discrete) and "options" in fields[0]
    return {"cards": fields[0]["options"]} if is_card else {"fields": fields}


def _fields(
    space: Space,
    mask: Any,
    labels: Labels,
    name: str = "",
    path: tuple[Any, ...] = (),
) -> Iterator[Message]:
    parts = components_of(space, labels)
    if not 0 < prod(space.shape or [len(parts)]) <= MOST_ENTRIES:
        yield {"name": name, "path": [*path], **_input_of(space, mask, labels)}
        return
    for key, label, part in parts:
        if label == str(key) and not isinstance(space, Dict):  # which says no more than a number
            label = f"Part {key + 1}" if len(parts) > 1 else ""
        inner = None if mask is None else mask[key]
        yield from _fields(part, inner, None, f"{name} {label}".strip(), (*path, key))


def _input_of(
    space: Space,
    mask: Any,
    labels: Labels,
) -> Message:
    match space:
        case Discrete() if (space.n if mask is None else np.sum(mask)) <= MOST_ANSWERS:
            legal = legal_actions(space, mask)
            texts = [shown(label_of_part(labels, action)) for action in legal]
            pairs = zip(legal, texts, strict=True)
            return {"options": [{"action": action, "text": text} for action, text in pairs]}
        case Text():
            return {"maxLength": space.max_length, "hint": f"at most {space.max_length} characters"}
        case Discrete() | Box(shape=()) if mask is None:
            schema = schema_of(space, None)
            return schema | {"hint": limits_of(schema)}
    return {"json": short_repr(space)}


def words_of(form: Message, action: Action) -> str:
    """Return an action, given as JSON, in the words of its decision."""
    words = []
    for field in form.get("fields") or [{"name": "", "path": (), "options": form["cards"]}]:
        value = _value_at(action, field["path"])
        options = field.get("options", ())
        texts = [option["text"] for option in options if option["action"] == value]
        words.append(": ".join(filter(None, [field["name"], *(texts or [shown(value)])])))
    return ", ".join(words)


def complaint_about(form: Message, action: Action) -> Message:
    """Say what is wrong with an illegal action, as ``text``. An empty dict: it is not known."""
    if "cards" in form:
        texts = _texts(form["cards"][:MOST_CANDIDATES])
        return {"text": f"Choose one of these answers: {texts} (not {short_repr(action)})."}
    for field in form["fields"]:
        value = _value_at(action, field["path"])
        if not _fits(field, value):
            hint = f"Enter {field['hint']}" if "hint" in field else ""
            problem = hint or f"Choose one of {_texts(field['options'])}"
            given = "" if value in ("", None) else f", not {short_repr(value, 60)}"
            return {"text": f"{problem}{given}."}
    return {}


def _texts(options: list[Message]) -> str:
    return ", ".join(option["text"] for option in options)


def _fits(field: Message, value: Any) -> bool:
    match field:
        case {"options": options}:
            return value in [option["action"] for option in options]
        case {"maxLength": longest}:
            return bool(len(str(value)) <= longest)
        case {"type": kind}:
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not is_number or (kind == "integer" and value % 1):
                return False
            return bool(field.get("minimum", -inf) <= value <= field.get("maximum", inf))
    return True


def _value_at(action: Action, path: Iterable[Any]) -> Any:
    """Return the value of a field in the JSON of an action; None if it has none."""
    with suppress(TypeError, LookupError):
        return reduce(getitem, path, action)
    return None


def candidates_of(
    space: Space,
    form: Message,
) -> list[Action]:
    """Return actions to try out, as JSON.

    These are the legal actions of a ``Discrete``, or five actions of a bounded ``Box`` of one
    number. Other spaces have none.
    """
    if "cards" in form:
        return [card["action"] for card in form["cards"][: MOST_CANDIDATES - 1]]
    if isinstance(space, Box) and space.low.size == 1 and space.is_bounded():
        grid = np.linspace(space.low, space.high, 5).astype(space.dtype)
        return [*np.unique(grid, axis=0).tolist()]
    return []


def action_of(space: Space, value: Action) -> Action:
    """Return the action for its JSON; ``RULE`` for None.

    A value that does not fit is returned as it is, so that the environment refuses it.
    """
    if value is None:
        return RULE
    with suppress(*MISFITS):
        return to_action(space, value)
    return value


# -- pictures -------------------------------------------------------------------------------------


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
