"""Pending decisions as text and as JSON, and texts as actions, by the labels of ``make_step``."""

import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from math import inf, isfinite
from typing import Any, Final, TypeAlias

import numpy as np
from gymnasium.spaces import (
    Box,
    Dict,
    Discrete,
    MultiBinary,
    MultiDiscrete,
    Space,
    Tuple,
)
from numpy.typing import NDArray

from ..core import Decision, Labels, Mask, pending_view
from ..errors import InvalidActionError, ViewError, short_repr
from ..simulation import Action, Observation

MOST: Final = 200
"""The largest number of parts of an observation that are listed one by one."""

Schema = dict[str, Any]
"""A JSON schema."""

JSON: TypeAlias = "Mapping[str, JSON] | Sequence[JSON] | str | float | None"
"""A value that ``json.dumps`` takes."""

MISFITS: Final = (ValueError, TypeError, LookupError, OverflowError)
"""The errors of values that are no actions, with ``InvalidActionError``, a ``ValueError``."""

UNLABELLED_NUMBER: Final = ("0",)
"""The labels of a ``Box`` of one number that the user has not labelled."""


def describe(
    env_or_decision: object,
    *,
    as_json: bool = False,
) -> Any:
    """Describe the pending decision.

    The description has the agent, the time, its observation, its legal actions, and the reward of
    its previous action.

    Args:
        env_or_decision: An environment in mid-episode, with or without wrappers; or the
            ``Decision`` that a policy receives as ``_decision``.
        as_json: Whether to return a dict for ``json.dumps`` instead of a text. Its keys are
            ``agent``, ``point``, ``number``, ``time``, ``observation``, ``actions`` and ``reward``;
            ``actions`` is a JSON schema of the answers that ``parse`` takes.

    Raises:
        ResetNeededError: No decision is pending.
        ViewError: The actions cannot be described, because their space has no names or numbers.
    """
    return at_decision(env_or_decision, "describe", _as_json if as_json else _as_text)


def parse(env_or_decision: object, text: str) -> Action:
    """Return the action that a text names.

    A text names an action by its label, by its value, or as JSON such as ``{"action": "open"}``.
    Components of arrays and dicts are a JSON list, or a JSON object with their labels or keys.
    Other text may stand around a JSON object, and around the only label in the text. The action
    is one of the agent whose decision is pending, for ``env.unwrapped``: wrappers may take other
    actions.

    Raises:
        InvalidActionError: The text names no legal action. The error lists the legal actions.
        ResetNeededError: No decision is pending.
    """
    return at_decision(env_or_decision, "parse", partial(_parse, text))


def at_decision(
    env_or_decision: object,
    user: str,
    function: Callable[[Decision], Any],
) -> Any:
    """Call a function with a decision; for an environment, with its pending one.

    A clone calls the function in its own process, so that a decision is never pickled.

    Args:
        env_or_decision: The environment, or the decision.
        user: The name of the public function, for errors.
        function: The function, which can be pickled.
    """
    if isinstance(env_or_decision, Decision):
        return function(env_or_decision)
    return pending_view(env_or_decision, user).call(_call_in_view, function)


def _call_in_view(env: Any, function: Callable[[Decision], Any]) -> Any:
    episode = env.unwrapped.episode
    return function(episode.decision_of(episode.deciding))


def _as_text(decision: Decision) -> str:
    time = "" if decision.time is None else f", time {decision.time:.6g}"
    return "\n".join(
        [
            f"{decision.agent} decides (decision {decision.number}{time}).",
            "Observation:",
            *_observation_lines(labelled(decision.observation, decision.observation_labels)),
            f"Reward of the previous action: {decision.reward:.6g}",
            "Legal actions:",
            *_legal_lines(decision),
        ]
    )


def _as_json(decision: Decision) -> dict[str, JSON]:
    return {
        "agent": decision.agent,
        "point": decision.point,
        "number": decision.number,
        "time": decision.time,
        "observation": labelled(decision.observation, decision.observation_labels),
        "actions": action_schema(decision),
        "reward": decision.reward,
    }


# -- observations ---------------------------------------------------------------------------------


def labelled(value: Observation, labels: Labels) -> JSON:
    """Return an observation as JSON, with the labels of its parts."""
    match value:
        case Mapping():
            return {str(_label(labels, key)): labelled(part, None) for key, part in value.items()}
        case np.ndarray(shape=(_,)) if labels:
            parts = zip(labels, value.tolist(), strict=True)
            return {label: labelled(part, None) for label, part in parts}
        case np.ndarray() | np.generic():
            return labelled(value.tolist(), labels)
        case tuple() | list():
            return [labelled(part, None) for part in value]
        case float():
            return float(f"{value:.7g}")  # because a float32 has no more digits
        case _:
            return _label(labels, value)


def _label(labels: Labels, key: JSON) -> JSON:
    """Return the label of a part or a ``Discrete`` value; itself if it has none."""
    if isinstance(labels, Mapping):
        return labels.get(key, key)
    return key


def _observation_lines(observation: JSON) -> list[str]:
    if isinstance(observation, Mapping) and len(observation) <= MOST:
        return [f"- {name}: {_value_text(part)}" for name, part in observation.items()]
    return [f"- {_value_text(observation)}"]


def _value_text(value: JSON) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return json.dumps(value, default=str, ensure_ascii=False)


# -- legal actions --------------------------------------------------------------------------------


def legal_actions(space: Discrete, mask: Mask | None) -> list[int]:
    """Return the actions of a ``Discrete`` space that a mask allows; all without a mask."""
    offsets = range(space.n) if mask is None else np.flatnonzero(mask)
    return [int(space.start + offset) for offset in offsets]


def legal_labels(decision: Decision) -> dict[str, int]:
    """Return the legal actions of a ``Discrete`` space by label; an empty dict for other spaces.

    A label that several legal actions have is followed by the number of the action.
    """
    space = decision.action_space
    labels = decision.action_labels
    if not isinstance(space, Discrete) or not isinstance(labels, Mapping):
        return {}
    legal = legal_actions(space, decision.mask)
    occurrences = Counter(labels[action] for action in legal)
    names = {}
    for action in legal:
        label = labels[action]
        if occurrences[label] > 1:
            label = f"{label} ({action})"
        names[label] = action
    return names


def _legal_lines(decision: Decision) -> list[str]:
    try:
        schema = action_schema(decision)
    except ViewError:
        schema = {}
    match schema:
        case {"enum": labels}:
            return [f"- {label}" for label in labels]
        case {"properties": parts}:
            lines = [f"- {name}: {_limits(part)}" for name, part in parts.items()]
        case {"description": label}:
            lines = [f"- {label}: {_limits(schema)}"]
        case {"type": _}:
            lines = [f"- {_limits(schema)}"]
        case _:
            lines = [f"- {decision.action_space}"]
    if decision.mask is not None:
        lines.append(f"- of these, the mask allows {short_repr(decision.mask)}")
    return lines


def _limits(schema: Schema) -> str:
    if "properties" in schema:
        parts = schema["properties"].items()
        texts = [f"{name}: {_limits(part)}" for name, part in parts]
        return f"({', '.join(texts)})"
    noun = "an integer" if schema["type"] == "integer" else "a number"
    low = _value_text(schema.get("minimum", -inf))
    high = _value_text(schema.get("maximum", inf))
    return f"{noun} from {low} to {high}"


def action_schema(decision: Decision) -> Schema:
    """Return the JSON schema of the actions that ``parse`` takes.

    Raises:
        ViewError: The actions of this space have no names or numbers.
    """
    legal = legal_labels(decision)
    if legal:
        return {"type": "string", "enum": list(legal)}
    return _schema(decision.action_space, decision.action_labels)


def _schema(space: Space[Any], labels: Labels) -> Schema:
    parts: Iterable[Schema]
    match space:
        case Discrete():
            return _range(int(space.start), int(space.start + space.n - 1))
        case Box(shape=() | (1,)):
            schema = _range(space.low.item(), space.high.item())
            if labels and labels != UNLABELLED_NUMBER:
                schema["description"] = labels[0]
            return schema
        case Dict():
            labels = [str(_label(labels, key)) for key in space]
            parts = [_schema(part, None) for part in space.values()]
        case Tuple() | MultiDiscrete(shape=(_,)):
            parts = [_schema(space[place], None) for place in range(len(space))]
        case Box(shape=(_,)):
            parts = map(_range, space.low.tolist(), space.high.tolist())
        case MultiBinary(shape=(size,)):
            parts = [_range(0, 1)] * size
        case _:
            raise ViewError(f"actions of the space {short_repr(space)} cannot be put into words")
    parts = list(parts)
    names = labels or list(map(str, range(len(parts))))
    return {
        "type": "object",
        "properties": dict(zip(names, parts, strict=True)),
        "required": list(names),
        "additionalProperties": False,
    }


def _range(low: float, high: float) -> Schema:
    bounds = {"minimum": low, "maximum": high}
    finite = {key: bound for key, bound in bounds.items() if isfinite(bound)}
    return {"type": "number" if isinstance(low, float) else "integer", **finite}


# -- answers --------------------------------------------------------------------------------------


def _parse(text: str, decision: Decision) -> Action:
    space = decision.action_space
    legal = legal_labels(decision)
    has_key = isinstance(space, Dict) and "action" in space.spaces
    for value in _readings(text):
        if isinstance(value, dict) and value.keys() == {"action"} and not has_key:
            value = value["action"]
        with suppress(*MISFITS):
            if legal:
                action = _labelled_action(decision, legal, value)
            else:
                action = to_action(space, value, decision.action_labels)
            decision.validate(action)
            return action
    label = _only_label(text, legal)
    if label is not None:
        return legal[label]
    lines = "\n".join(_legal_lines(decision))
    raise InvalidActionError(
        f"{short_repr(text)} names no legal action of {decision.agent!r}; these are legal:\n{lines}"
    )


def _readings(text: str) -> Iterator[JSON]:
    """Yield the values that a text may mean: its JSON, itself, and the last JSON object in it."""
    with suppress(ValueError):
        yield json.loads(text)
    yield text
    end = text.rfind("}") + 1
    starts = [match.start() for match in re.finditer("{", text[:end])]
    for start in reversed(starts[-MOST:]):
        with suppress(ValueError):
            yield json.loads(text[start:end])


def _labelled_action(
    decision: Decision,
    legal: Mapping[str, int],
    value: JSON,
) -> int:
    """Return the action of a ``Discrete`` that a value names, by its label or by its number.

    Raises:
        ValueError: It names no action, or several.
    """
    text = value if isinstance(value, str) else json.dumps(value)
    if text in legal:
        return legal[text]
    assert isinstance(decision.action_labels, Mapping)
    # Labels of masked actions count, too, so that they are not mistaken for a legal action's.
    names = [(label, action) for action, label in decision.action_labels.items()]
    names += legal.items()
    sought = _comparable(text)
    meanings = {action for label, action in names if _comparable(label) == sought}
    if not meanings:
        return _whole_number(text)
    if len(meanings) > 1:
        raise ValueError(f"{text} names several actions")
    return int(meanings.pop())


def _comparable(text: str) -> str | float:
    """Return the number that a text is, or else the text in lower case and without quotes."""
    text = text.strip()
    if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'":
        text = text[1:-1]
    try:
        return float(text)
    except ValueError:
        return text.casefold()


def _only_label(text: str, labels: Collection[str]) -> str | None:
    """Return the label that stands in a text; None if there is none, or several."""
    if not labels:
        return None
    longest_first = sorted(labels, key=len, reverse=True)
    words = "|".join(map(re.escape, longest_first))
    matches = set(re.findall(rf"(?<![\w.-])(?:{words})(?!\w|\.\d)", text))
    return matches.pop() if len(matches) == 1 else None


def to_action(
    space: Space[Any],
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
            return _whole_number(value)
        case Dict():
            values = dict(value)
            action = {}
            for key, part in space.items():
                label = _label(labels, key)
                if label not in values:
                    label = key
                action[key] = to_action(part, values[label])
            return action
        case Tuple():
            values = _listed(value, labels)
            return tuple(to_action(part, values[place]) for place, part in enumerate(space))
        case Box() | MultiDiscrete() | MultiBinary():
            return _to_array(space, _listed(value, labels))
        case _:
            return value


def _listed(value: Action, labels: Labels) -> Action:
    """Return the components of an object as a list, and another value as it is."""
    if not isinstance(value, Mapping):
        return value
    names = labels or list(map(str, range(len(value))))
    if set(value) != set(names):
        raise ValueError("components are missing, or unknown")
    return [value[name] for name in names]


def _to_array(space: Space[Any], value: Action) -> NDArray[Any]:
    if isinstance(value, str):
        value = value.replace(",", " ").split()
    numbers = np.asarray(value).reshape(space.shape)
    if numbers.dtype.kind == "U":
        numbers = numbers.astype(np.float64)
    with np.errstate(invalid="ignore"):
        array = numbers.astype(space.dtype)
    if array.dtype.kind in "iu" and not np.array_equal(array, numbers):
        raise ValueError("the components are no integers of this size")
    return array


def _whole_number(value: str | float) -> int:
    number = float(value)
    if not number.is_integer():
        raise ValueError(f"{value} is no integer")
    return int(number)
