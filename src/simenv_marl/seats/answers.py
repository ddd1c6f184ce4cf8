"""Texts as actions: first what an answer says, then whether that is legal.

An answer is a label or a value, JSON that contains one, or a text around one label. JSON is never
searched as text. If a text can mean two actions, it names none.
"""

import json
import re
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, Final

import numpy as np
from gymnasium.spaces import (
    Box,
    Dict,
    Discrete,
    MultiBinary,
    MultiDiscrete,
    Text,
    Tuple,
)
from numpy.typing import NDArray

from ..core import Decision, Labels, Space
from ..errors import InvalidActionError, short_repr
from ..simulation import Action
from .descriptions import JSON, FreeText, at_decision, label_of_part, legal_lines

MISFITS: Final = (ValueError, TypeError, LookupError, OverflowError, RecursionError)
"""The errors of values that are no actions, with ``InvalidActionError``, a ``ValueError``."""

_REASONING: Final = r"(?is:<{0}(?:think(?:ing)?|thoughts?|reason(?:ing)?|reflection)>|\[{0}think\])"
"""The tags around a model's reasoning; with a slash for its end."""

_NEGATION: Final = (
    r"\b(?:not|never|no|nor|neither|cannot|without|avoid|against|except|instead of|rather than)\b"
    r"|n['\u2019]t\b"
)

_ASCII: Final = {wide: wide - 0xFEE0 for wide in range(0xFF01, 0xFF5F)} | dict.fromkeys(
    (0x2010, 0x2011, 0x2012, 0x2212, 0xFE63), "-"
)
"""Full-width characters and hyphens as ASCII."""


def parse(env_or_decision: object, text: str) -> Action:
    """Return the action that a text names.

    A text names an action by its label, by its value, or as JSON such as ``{"action": "open"}``.
    Components of arrays and dicts are a JSON list, or a JSON object with their labels or keys.
    Other text may stand around a JSON object, which may have further keys, and around the only
    label in the text; labels of masked actions count, too. The action of a ``Text`` or
    ``free_text`` space is the text itself. The action is one of the agent whose decision is
    pending, for ``env.unwrapped``: wrappers may take other actions.

    Raises:
        InvalidActionError: The text names no legal action, or several actions. The error lists the
            legal actions.
        ResetNeededError: No decision is pending.
    """
    return at_decision(env_or_decision, "parse", partial(_parse, text))


def _parse(text: str, decision: Decision) -> Action:
    try:
        return _named(text, decision)
    except MISFITS:
        lines = "\n".join(legal_lines(decision))
        raise InvalidActionError(
            f"{short_repr(text)} names no legal action of {decision.agent!r}; these are"
            f" legal:\n{lines}"
        ) from None


# -- the answer -----------------------------------------------------------------------------------


def _named(text: str, decision: Decision) -> Action:
    """Return the legal action that a text names, or raise one of ``MISFITS``."""
    space = decision.action_space
    labels = decision.action_labels

    def read(value: JSON) -> Action:
        action = to_action(space, value, labels)
        decision.validate(action)
        return action

    text = _without_reasoning(text)
    is_text = isinstance(space, Text)
    if not is_text:
        with suppress(*MISFITS):
            return read(text)
    try:
        value = _DECODER.decode(text)
    except ValueError:
        *_, value = [..., *_objects(text)]
    answers = _at_action(value)
    if is_text and not (answers or isinstance(value, str)):
        # Any other JSON is a text, too. Models put blanks around a text.
        return read(text.strip() if isinstance(space, FreeText) else text)
    if value is ...:
        return read(_label_in(text, labels if isinstance(space, Discrete) else None))
    for answer in (*answers, value):  # an object may be the action itself
        with suppress(*MISFITS):
            return read(answer)
    legal = []
    if isinstance(value, Mapping) and not answers:
        for answer in value.values():
            with suppress(*MISFITS):
                legal.append(read(answer))
    [action] = legal
    return action


def _without_reasoning(text: str) -> str:
    """Remove a model's reasoning from a text, and the fence around the rest.

    Raises:
        ValueError: The reasoning never ends.
    """
    begin = _REASONING.format("")
    end = _REASONING.format("/")
    *_, text = re.split(end, re.sub(f"{begin}(?s:.*?){end}", " ", text))
    if re.search(begin, text):
        raise ValueError("the reasoning never ends")
    return re.sub(r"(?s)^\s*```(?:[\w-]*\n)?(.*?)```\s*$", r"\1", text)


def _objects(text: str) -> Iterator[JSON]:
    """Yield the JSON objects in a text; None for a malformed one."""
    begin = re.compile(r"""\{\s*(["'}]|\w+\s*:)""")
    end = 0
    while start := begin.search(text, end):
        try:
            value, end = _DECODER.raw_decode(text, start.start())
        except json.JSONDecodeError as error:
            value = None
            end = max(start.end(), error.pos)
        yield value


def _merged(pairs: list[tuple[str, JSON]]) -> dict[str, JSON]:
    """Make a JSON object; a key with two values has None."""
    merged: dict[str, JSON] = {}
    for key, value in pairs:
        merged[key] = value if merged.get(key, value) == value else None
    return merged


_DECODER: Final = json.JSONDecoder(object_pairs_hook=_merged)


def _at_action(value: JSON) -> list[JSON]:
    """Return the values of the key ``action`` of an object, in any case."""
    if not isinstance(value, Mapping):
        return []
    return [part for key, part in value.items() if key.strip().casefold() == "action"]


# -- labels ---------------------------------------------------------------------------------------


def _labelled(labels: Mapping[int, str], value: JSON) -> int:
    """Return the action of a ``Discrete`` that a value names, by its label or by its number."""
    text = value if isinstance(value, str) else json.dumps(value)
    sought = _comparable(text)
    forms = {action: _comparable(label) for action, label in labels.items()}
    alike = [action for action, label in labels.items() if label == text]
    if not alike and sought != "":
        alike = [action for action, form in forms.items() if form == sought]
    if not alike and all(form in (action, str(form)) for action, form in forms.items()):
        alike = [action for action in labels if action == sought]  # no label is another number
    [action] = alike
    return action


def _label_in(text: str, labels: Labels) -> str:
    """Return the only label in a text.

    Raises:
        ValueError: There is none, there are several, one is denied, or it is a part of a word.
    """
    if not isinstance(labels, Mapping):
        raise ValueError("there are no labels")
    forms = {_plain(label).casefold(): label for label in labels.values()}
    if len(forms) < len(labels):
        raise ValueError("labels differ in case alone")
    text = _plain(text).casefold()
    longest_first = sorted(filter(None, forms), key=len, reverse=True)
    words = "|".join(map(re.escape, longest_first)).replace(r"\ ", r"\s+")
    pattern = rf"(?:(?<!\w)|(?!\w))(?:{words})(?:(?!\w)|(?<!\w))"
    said = set()
    end = 0
    for match in re.finditer(f"(?=({pattern}))", text):
        start, stop = match.span(1)
        if stop <= end:
            continue  # it is a part of a longer label
        end = stop
        around = f"{text[max(0, start - 9) : start]}\0{text[start]}\0{text[stop : stop + 2]}"
        # It is joined to a word or a number, or a number with a sign.
        if re.search(r"\w[-+.,/'\u2019]?\0.\0|\0.\0[-+.,/'\u2019]?\w|([-+]\s*|\.)\0\d", around):
            raise ValueError(f"{match[1]} is a part of a word")
        said.add(" ".join(match[1].split()))
    for clause in re.split(r"[.,;:!?\n]", re.sub(pattern, "\0", text)):
        if "\0" in clause and re.search(_NEGATION, clause):
            raise ValueError("the label is denied")
    [form] = said
    return forms[form]


def _plain(text: str) -> str:
    """Return a text in one form of its signs and dashes, and without marks of emphasis."""
    text = unicodedata.normalize("NFC", text).translate(_ASCII)
    text = re.sub(r"(?<!\w)[\u2013-\u2015](?=\.?\d)", "-", text)
    text = re.sub(r"((?:^|[^\w\s.!?)\]])\s*)[-\u2013-\u2015]\s+(?=\.?\d)", r"\1-", text)
    text = re.sub(r"[\u2013-\u2015]|--+", " - ", text)
    text = re.sub(r"(?<!\w)_+|_+(?!\w)", "", text)
    return text.strip()


def _comparable(text: str) -> str | float:
    """Return the number that a text is, or else the text in lower case and without quotes."""
    with suppress(ValueError):
        return _number(text)
    return " ".join(_plain(text).strip("\"'`*. ").casefold().split())


def _number(text: str) -> float:
    plain = _plain(text).strip("\"'`*")
    if not re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", plain):
        raise ValueError(f"{text} is no number")
    return float(plain)


# -- values ---------------------------------------------------------------------------------------


def to_action(
    space: Space,
    value: Action,
    labels: Labels = None,
) -> Action:
    """Return the action for its JSON. It may be illegal.

    Args:
        space: The action space.
        value: The JSON. An array may be an object with a key for each component, or a text.
        labels: The labels of the components, which are keys of ``value``.

    Raises:
        ValueError, TypeError, LookupError, OverflowError: The JSON does not fit the space.
    """
    match space:
        case Discrete():
            return _labelled(labels, value) if isinstance(labels, Mapping) else _whole_number(value)
        case Text():
            return value if space.contains(value) else str.strip(value)
        case Dict():
            values = dict(value)
            action = {}
            for key, part in space.items():
                label = label_of_part(labels, key)
                if label not in values:
                    label = key
                action[key] = to_action(part, values[label])
            return action
        case Tuple():
            parts = _listed(value, labels)
            return tuple(to_action(part, item) for part, item in zip(space, parts, strict=True))
        case Box() | MultiDiscrete() | MultiBinary():
            return _to_array(space, _listed(value, labels))
        case _:
            return value


def _listed(value: Action, labels: Labels) -> Action:
    """Return the components of an object or a text as a list, and another value as it is.

    An object may have further keys.
    """
    if isinstance(value, str):
        return _plain(value).replace(",", " ").split()
    if not isinstance(value, Mapping):
        return value
    numbers = range(sum(key.isdigit() for key in value))
    return [value[name] for name in labels or map(str, numbers)]


def _to_array(space: Space, value: Action) -> NDArray[Any]:
    numbers = np.asarray(value)
    if numbers.dtype.kind == "U":
        numbers = np.array([_number(text) for text in numbers.ravel().tolist()])
    numbers = numbers.reshape(space.shape)
    with np.errstate(invalid="ignore"):
        array = numbers.astype(space.dtype)
    if array.dtype.kind in "iu" and not np.array_equal(array, numbers):
        raise ValueError("the components are no integers of this size")
    return array


def _whole_number(value: str | float) -> int:
    number = _number(value) if isinstance(value, str) else value
    if not float(number).is_integer():
        raise ValueError(f"{value} is no integer")
    return int(number)
