"""Decisions, actions and pictures as JSON, in the words that people read."""

import re
import struct
import zlib
from base64 import b64encode
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import islice
from math import inf, isfinite
from typing import Any, Final

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Text, Tuple
from numpy.typing import NDArray

from ...core import Decision, Labels, Mask
from ...envs import SimulationAECEnv
from ...errors import describe_error, short_repr
from ...files.values import digest_of
from ...simulation import RULE, Action, Observation
from ..answers import MISFITS, to_action
from ..descriptions import JSON, labelled, legal_actions, situation

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

NUMBER: Final = re.compile(r"\s*[-+]?\d+(\.\d+)?")
"""The number with which a displayed text may begin, such as "22 °C"."""


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


def shown(value: object) -> str:
    """Return a value as a text for people. Fractions have four digits."""
    match value:
        case bool() | np.bool():
            return "yes" if value else "no"
        case str():
            return value
        case float() if isfinite(value) and value != round(value):
            digits = float(f"{value:.4g}")
            return f"{value:.0f}" if abs(value) >= 10_000 else f"{digits:g}"
        case float() if isfinite(value) and abs(value) < 1e15:
            return str(int(value))
        case Mapping():
            return ", ".join(f"{key} {shown(part)}" for key, part in value.items())
        case list() | tuple():
            return ", ".join(map(shown, value))
        case np.ndarray() | np.generic():
            return shown(value.tolist())
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
        "reward": jsonable(decision.reward),
        "situation": situation_of(decision),
        "displayed": decision.display is not None,
        "form": form_of(decision.action_space, decision.mask, decision.action_labels),
        "seen": digest_of(decision.observation),
    }


def situation_of(decision: Decision) -> list[Message]:
    """Return the situation of a decision: its display, or else its observation.

    Each entry has its label, its text, and its number or None.
    """
    return _entries(situation(decision))


def entries_of(
    observation: Observation,
    labels: Labels = None,
) -> list[Message]:
    """Return the first entries of an observation."""
    return _entries(labelled(observation, labels))


def _entries(value: JSON) -> list[Message]:
    return [_entry(label, part) for label, part in islice(_parts(value), MOST_ENTRIES)]


def _parts(value: JSON, name: str = "") -> Iterator[tuple[str, JSON]]:
    match value:
        case Mapping():
            for key, part in value.items():
                yield from _parts(part, f"{name} {key}".strip())
        case list():
            for place, part in enumerate(value):
                yield from _parts(part, f"{name}[{place}]")
        case _:
            yield name or "value", value


def _entry(label: str, value: object) -> Message:
    number: float | None = None
    if isinstance(value, str):
        begin = NUMBER.match(value)
        number = float(begin[0]) if begin else None
    elif isinstance(value, (int, float)) and not isinstance(value, bool) and -inf < value < inf:
        number = value
    return {"label": label, "text": shown(value), "number": number}


# -- answers --------------------------------------------------------------------------------------


def form_of(
    space: Space[Any],
    mask: Mask | None,
    labels: Labels,
) -> Message:
    """Describe the answers to a decision as JSON, for the inputs of the page.

    A ``Discrete`` has ``cards``: its legal actions with their labels. All other spaces have
    ``fields``, and an ``answer``: the JSON of an action, with the index of a field in place of
    each value.
    """
    if isinstance(space, Discrete) and _are_few(space, mask):
        return {"cards": _options(space, mask, labels)}
    fields: list[Message] = []
    return {"answer": _answer(space, mask, labels, "", fields), "fields": fields}


def _are_few(space: Discrete, mask: Mask | None) -> bool:
    """Return whether the legal actions can be shown one by one."""
    number = space.n if mask is None else np.count_nonzero(mask)
    return int(number) <= MOST_ANSWERS


def _options(
    space: Discrete,
    mask: Mask | None,
    labels: Labels,
) -> list[Message]:
    names = labels if isinstance(labels, Mapping) else {}
    return [
        {"action": action, "text": shown(names.get(action, action))}
        for action in legal_actions(space, mask)
    ]


def _answer(
    space: Space[Any],
    mask: Any,
    labels: Any,
    name: str,
    fields: list[Message],
) -> JSON:
    """Add the fields of a space, and return its answer."""

    def part(
        key: Any,
        space: Space[Any],
        label: str,
    ) -> JSON:
        inner = None if mask is None else mask[key]
        return _answer(space, inner, None, f"{name} {label}".strip(), fields)

    match space:
        case Discrete() if _are_few(space, mask):
            return _add(fields, name, options=_options(space, mask, labels))
        case Discrete() if mask is None:
            last = int(space.start + space.n - 1)
            return _add_number(fields, name, int(space.start), last)
        case Box() if 0 < space.low.size <= MOST_ENTRIES:
            names = _names(labels, space.low.size)
            bounds = zip(names, space.low.ravel(), space.high.ravel(), strict=True)
            return [
                _add_number(fields, f"{name} {label}".strip(), low.item(), high.item())
                for label, low, high in bounds
            ]
        case MultiDiscrete(shape=(size,)) if size <= MOST_ENTRIES:
            names = _names(labels, size)
            return [part(place, space[place], names[place]) for place in range(size)]
        case MultiBinary(shape=(size,)) if size <= MOST_ENTRIES:
            names = _names(labels, size)
            return [part(place, Discrete(2), names[place]) for place in range(size)]
        case Dict() if all(isinstance(key, str) for key in space):
            texts = labels if isinstance(labels, Mapping) else {}
            return {key: part(key, inner, texts.get(key, key)) for key, inner in space.items()}
        case Tuple():
            names = _names(labels, len(space))
            return [part(place, space[place], names[place]) for place in range(len(space))]
        case Text():
            return _add(fields, name, longest=space.max_length)
        case _:
            return _add(fields, name, json=short_repr(space))


def _names(labels: Any, size: int) -> list[str]:
    """Return the labels of the parts of an array. Those that say no more than a number go."""
    names = [str(label) for label in labels or range(size)]
    if names == ["0"]:
        return [""]
    return [f"Part {place + 1}" if name == str(place) else name for place, name in enumerate(names)]


def _add(fields: list[Message], name: str, **field: JSON) -> int:
    fields.append({"name": name, **field})
    return len(fields) - 1


def _add_number(
    fields: list[Message],
    name: str,
    low: float,
    high: float,
) -> int:
    whole = isinstance(low, int)
    hint = "a whole number" if whole else "a number"
    ends = [shown(end) for end in (low, high)]
    bounded = isfinite(low), isfinite(high)
    match bounded:
        case True, True:
            hint += f" from {ends[0]} to {ends[1]}"
        case True, False:
            hint += f" of at least {ends[0]}"
        case False, True:
            hint += f" of at most {ends[1]}"
    limits = [end if isfinite(end) else None for end in (low, high)]
    return _add(fields, name, low=limits[0], high=limits[1], whole=whole, hint=hint)


def words_of(form: Message, action: Action) -> str:
    """Return an action, given as JSON, in the words of its decision."""
    for card in form.get("cards", ()):
        if card["action"] == action:
            return str(card["text"])
    words = []
    for field, value in _filled(form, action):
        texts = [each["text"] for each in field.get("options", ()) if each["action"] == value]
        text = texts[0] if texts else shown(value)
        words.append(f"{field['name']}: {text}" if field["name"] else text)
    return ", ".join(words) or short_repr(action)


def complaint_about(form: Message, action: Action) -> Message:
    """Say what is wrong with an illegal action, at its field. An empty dict: it is not known."""
    if "cards" in form:
        texts = ", ".join(card["text"] for card in form["cards"][:MOST_CANDIDATES])
        return {"text": f"Choose one of these answers: {texts} (not {short_repr(action)})."}
    for place, (field, value) in enumerate(_filled(form, action)):
        problem = ""
        if "options" in field and value not in [each["action"] for each in field["options"]]:
            problem = f"Choose one of {', '.join(each['text'] for each in field['options'])}"
        elif "hint" in field and not _fits(field, value):
            problem = f"Enter {field['hint']}"
        elif "longest" in field and len(str(value)) > field["longest"]:
            problem = f"Enter at most {field['longest']} characters"
        if problem:
            given = "" if value in ("", None) else f", not {short_repr(value, 60)}"
            return {"field": place, "text": f"{problem}{given}."}
    return {}


def _fits(field: Message, value: object) -> bool:
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not -inf < value < inf:
        return False
    low, high = field["low"], field["high"]
    is_low = low is not None and value < low
    is_high = high is not None and value > high
    return not (is_low or is_high or (field["whole"] and value != round(value)))


def _filled(form: Message, action: Action) -> list[tuple[Message, Any]]:
    """Return the fields of an action with their values. Without a value, it is None."""
    values = dict(_leaves(form.get("answer"), action))
    return [(field, values.get(place)) for place, field in enumerate(form.get("fields", ()))]


def _leaves(answer: JSON, action: Action) -> Iterator[tuple[int, Any]]:
    match answer, action:
        case Mapping(), Mapping():
            for key, part in answer.items():
                yield from _leaves(part, action.get(key))
        case list(), list() if len(answer) == len(action):
            for inner, value in zip(answer, action, strict=True):
                yield from _leaves(inner, value)
        case list(), _ if len(answer) == 1 and not isinstance(action, (list, Mapping)):
            yield from _leaves(answer[0], action)
        case int(index), _:
            yield index, action


def candidates_of(
    space: Space[Any],
    form: Message,
) -> list[Action]:
    """Return actions to try out, as JSON.

    These are the legal actions of a ``Discrete``, or five actions of a bounded ``Box`` of one
    number. Other spaces have none.
    """
    if "cards" in form:
        return [card["action"] for card in form["cards"][: MOST_CANDIDATES - 1]]
    if isinstance(space, Box) and space.low.size == 1 and space.is_bounded():
        grid = np.linspace(space.low.ravel(), space.high.ravel(), 5)
        actions = np.unique(grid.astype(space.dtype), axis=0)
        return [*actions.tolist()]
    return []


def action_of(space: Space[Any], value: Action) -> Action:
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
