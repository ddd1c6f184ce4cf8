"""Pending decisions in words, and words as actions, by the labels of ``make_step``."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from gymnasium import spaces

from ..core import Decision, pending_view
from ..errors import InvalidActionError, ViewError, short_repr

MOST: int = 200
"""The largest number of parts of an observation that are listed one by one."""


def describe(env_or_decision: Any, *, as_json: bool = False) -> Any:
    """Describe the pending decision: who decides, when, what is observed, which actions are legal, the last reward.

    Args:
        env_or_decision: An environment in mid-episode, with or without wrappers; or a ``Decision``,
            which policies get as ``_decision``.
        as_json: Whether to return a dict for ``json.dumps`` instead of a text. Its keys are
            ``agent``, ``point``, ``number``, ``time``, ``observation``, ``actions`` and ``reward``;
            ``actions`` is a JSON schema of what ``parse`` takes.

    Raises:
        ResetNeededError: No decision is pending.
        ViewError: The actions cannot be described, because their space has no names or numbers.
    """
    if not isinstance(env_or_decision, Decision):
        return pending_view(env_or_decision, "describe").call(_describe_pending, as_json)
    decision = env_or_decision
    observation = labelled(decision.observation, decision.observation_labels)
    if as_json:
        return {
            "agent": decision.agent,
            "point": decision.point,
            "number": decision.number,
            "time": decision.time,
            "observation": observation,
            "actions": action_schema(decision),
            "reward": decision.reward,
        }
    time = "" if decision.time is None else f", time {decision.time:.6g}"
    lines = [f"{decision.agent} decides (decision {decision.number}{time}).", "Observation:"]
    lines += _listed(observation)
    lines += [f"Reward of the previous action: {decision.reward:.6g}", "Legal actions:"]
    return "\n".join([*lines, *_legal_lines(decision)])


def parse(env_or_decision: Any, text: str) -> Any:
    """Return the action that a text names: by its label, by its value, or as JSON such as ``{"action": "open"}``.

    Components of arrays and dicts are a JSON list, or a JSON object with their labels or keys.
    Other text may stand around a JSON object, and around the only label that it names. The action
    is one of the agent whose decision is pending, for ``env.unwrapped``: wrappers may take other
    actions.

    Raises:
        InvalidActionError: The text names no legal action. The error says which are legal.
        ResetNeededError: No decision is pending.
    """
    if not isinstance(env_or_decision, Decision):
        return pending_view(env_or_decision, "parse").call(_parse_pending, text)
    decision, space = env_or_decision, env_or_decision.action_space
    legal = legal_labels(decision)
    for value in _values(
        text, unwrap=not (isinstance(space, spaces.Dict) and "action" in space.spaces)
    ):
        with suppress(InvalidActionError, ValueError, TypeError, LookupError, OverflowError):
            action = (
                _choice(decision, legal, value)
                if legal
                else _action(space, decision.action_labels, value)
            )
            decision.validate(action)
            return action
    words = "|".join(re.escape(label) for label in sorted(legal, key=len, reverse=True))
    named = set(re.findall(rf"(?<![\w.-])(?:{words})(?!\w|\.\d)", text)) if words else set()
    if len(named) == 1:
        return legal[named.pop()]
    listed = "\n".join(_legal_lines(decision))
    raise InvalidActionError(
        f"{short_repr(text)} names no legal action of {decision.agent!r}; these are"
        f" legal:\n{listed}"
    )


def _values(text: str, *, unwrap: bool) -> Iterator[Any]:
    """Yield what a text may mean: itself, as JSON if it is that, and the last JSON object in it."""
    found: list[Any] = [text]
    decoder = json.JSONDecoder()
    starts = [place for place, letter in enumerate(text) if letter == "{"]
    for start in reversed(starts[-MOST:]):
        with suppress(ValueError):
            value, end = decoder.raw_decode(text, start)
            found += [value] if "}" not in text[end:] else []
    with suppress(ValueError):
        found.insert(0, json.loads(text))
    for value in found:
        yield (
            value["action"]
            if unwrap and isinstance(value, Mapping) and set(value) == {"action"}
            else value
        )


def _choice(decision: Decision, legal: Mapping[str, int], value: Any) -> int:
    """Return the action of a ``Discrete`` that a text or number means, by its label or else by its value."""
    said = value if isinstance(value, str) else json.dumps(value)
    if said in legal:
        return legal[said]
    labels: Any = decision.action_labels
    # those of masked actions, too
    every = [*legal.items(), *((label, action) for action, label in labels.items())]
    meant = {action for label, action in every if _normal(label) == _normal(said)}
    if not meant:
        number = float(said)
        return int(number) if number.is_integer() else int(said)
    action: int
    (action,) = meant
    return action


def _normal(text: str) -> str | float:
    """Return what is compared: a number, or the text without quotes around it and in lower case."""
    text = text.strip()
    if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'":
        text = text[1:-1]
    try:
        return float(text)
    except ValueError:
        return text.casefold()


def pending(env: Any) -> Decision:
    """Return the pending decision of an environment of this process."""
    episode = env.unwrapped.episode
    return episode.decision_of(episode.deciding)


def _describe_pending(env: Any, as_json: bool) -> Any:
    return describe(pending(env), as_json=as_json)


def _parse_pending(env: Any, text: str) -> Any:
    return parse(pending(env), text)


# -- what is observed -----------------------------------------------------------------------------


def labelled(value: Any, labels: Any) -> Any:
    """Return an observation as values for JSON, by the labels of its parts."""
    if isinstance(value, Mapping):
        return {
            str((labels or {}).get(key, key)): labelled(part, None) for key, part in value.items()
        }
    if isinstance(value, tuple):
        return [labelled(part, None) for part in value]
    if isinstance(value, (np.ndarray, np.generic)):
        plain = (
            [_plain(number) for number in value.tolist()]
            if np.ndim(value) == 1
            else _plain(value.tolist())
        )
        if isinstance(labels, Sequence) and labels and np.ndim(value) == 1:
            return dict(zip(labels, plain, strict=True))
        value = plain
    if isinstance(labels, Mapping) and not isinstance(value, (list, dict)):
        return labels.get(value, value)  # of a Discrete
    return value


def _plain(value: Any) -> Any:
    """Round numbers of 32 bits to the digits that they have, and return others as they are."""
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return float(f"{value:.7g}") if isinstance(value, float) else value


def _listed(observation: Any) -> list[str]:
    if isinstance(observation, Mapping) and len(observation) <= MOST:
        return [f"- {name}: {_text(part)}" for name, part in observation.items()]
    return [f"- {_text(observation)}"]


def _text(value: Any) -> str:
    return (
        f"{value:.6g}"
        if isinstance(value, float)
        else json.dumps(value, default=str, ensure_ascii=False)
    )


# -- what is legal --------------------------------------------------------------------------------


def legal_labels(decision: Decision) -> dict[str, int]:
    """Return the legal actions of a ``Discrete`` space by label; an empty dict for other spaces."""
    space: Any = decision.action_space
    if not isinstance(space, spaces.Discrete):
        return {}
    mask, start = decision.mask, int(space.start)
    labels: Any = decision.action_labels
    legal = [
        action
        for action in range(start, start + int(space.n))
        if mask is None or mask[action - start]
    ]
    occurrences = Counter(labels[action] for action in legal)
    return {
        labels[action]
        if occurrences[labels[action]] == 1
        else f"{labels[action]} ({action})": action
        for action in legal
    }


def _legal_lines(decision: Decision) -> list[str]:
    labels = legal_labels(decision)
    if labels:
        return [f"- {label}" for label in labels]
    space = decision.action_space
    lines = _parts(space, decision.action_labels)
    if decision.mask is not None:
        lines.append(f"- of these, the mask allows {short_repr(decision.mask)}")
    return lines


def _parts(space: spaces.Space[Any], labels: Any) -> list[str]:
    """Return lines that say what the parts of an action are."""
    if isinstance(space, spaces.Dict):
        return [
            f"- {labels[key] if labels else key}: {_limits(part)}"
            for key, part in space.spaces.items()
        ]
    if isinstance(space, spaces.Tuple):
        return [f"- {place}: {_limits(part)}" for place, part in enumerate(space.spaces)]
    if labels and isinstance(space, spaces.Box) and labels != ("0",):
        limits = zip(labels, space.low.tolist(), space.high.tolist(), strict=True)
        return [f"- {label}: a number from {low:.6g} to {high:.6g}" for label, low, high in limits]
    if labels and isinstance(space, spaces.MultiDiscrete):
        limits = zip(
            labels, space.start.tolist(), (space.start + space.nvec - 1).tolist(), strict=True
        )
        return [f"- {label}: an integer from {low} to {high}" for label, low, high in limits]
    return [f"- {_limits(space)}"]


def _limits(space: spaces.Space[Any]) -> str:
    if isinstance(space, spaces.Discrete):
        return f"an integer from {space.start} to {space.start + space.n - 1}"
    if isinstance(space, spaces.Box) and space.shape in ((), (1,)):
        return f"a number from {space.low.item():.6g} to {space.high.item():.6g}"
    return str(space)


def action_schema(decision: Decision) -> dict[str, Any]:
    """Return the JSON schema of the actions that ``parse`` takes."""
    labels = legal_labels(decision)
    return (
        {"type": "string", "enum": list(labels)}
        if labels
        else _schema(decision.action_space, decision.action_labels)
    )


def _schema(space: spaces.Space[Any], labels: Any) -> dict[str, Any]:
    parts: dict[str, Any] | None = None
    if isinstance(space, spaces.Discrete):
        return {
            "type": "integer",
            "minimum": int(space.start),
            "maximum": int(space.start + space.n - 1),
        }
    if isinstance(space, spaces.Dict):
        parts = {
            labels[key] if labels else str(key): _schema(part, None)
            for key, part in space.spaces.items()
        }
    elif isinstance(space, spaces.Tuple):
        parts = {str(place): _schema(part, None) for place, part in enumerate(space.spaces)}
    elif (
        isinstance(space, (spaces.Box, spaces.MultiDiscrete, spaces.MultiBinary))
        and len(space.shape) < 2
    ):
        numbers = [_bounded(*bounds) for bounds in zip(*_bounds(space), strict=True)]
        names = labels or tuple(map(str, range(len(numbers))))
        if len(numbers) == 1 and isinstance(space, spaces.Box):
            return numbers[0] if names == ("0",) else numbers[0] | {"description": names[0]}
        parts = dict(zip(names, numbers, strict=True))
    if parts is None:
        raise ViewError(f"actions of the space {short_repr(space)} cannot be put into words")
    return {
        "type": "object",
        "properties": parts,
        "required": list(parts),
        "additionalProperties": False,
    }


def _bounds(space: Any) -> tuple[list[Any], list[Any]]:
    """Return the smallest and the largest value of each component."""
    if isinstance(space, spaces.MultiBinary):
        return [0] * space.shape[0], [1] * space.shape[0]
    low, high = (
        (space.start, space.start + space.nvec - 1)
        if hasattr(space, "nvec")
        else (space.low, space.high)
    )
    return low.reshape(-1).tolist(), high.reshape(-1).tolist()


def _bounded(low: Any, high: Any) -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "number" if isinstance(low, float) else "integer"}
    limits = {"minimum": low, "maximum": high}
    return schema | {name: limit for name, limit in limits.items() if np.isfinite(limit)}


# -- what is said ---------------------------------------------------------------------------------


def _action(space: spaces.Space[Any], labels: Any, value: Any) -> Any:
    """Return the action that a value of JSON means, which may be illegal.

    Raise a builtin error if it means none.
    """
    if isinstance(space, spaces.Discrete):
        return int(value)
    if isinstance(space, spaces.Dict):
        keys = {(labels or {}).get(key, key): key for key in space.spaces}
        given = {keys.get(name, name): part for name, part in dict(value).items()}
        return {key: _action(part, None, given[key]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        listed = (
            [value[str(place)] for place in range(len(value))]
            if isinstance(value, Mapping)
            else value
        )
        return tuple(_action(part, None, listed[place]) for place, part in enumerate(space.spaces))
    if isinstance(value, Mapping):
        names = labels or tuple(map(str, range(len(value))))
        if set(value) != set(names):
            raise ValueError("components are missing, or unknown")
        value = [value[name] for name in names]
    if isinstance(value, str):
        value = [float(part) for part in value.replace(",", " ").split()]
    numbers = np.asarray(value, np.float64).reshape(space.shape)
    if (
        space.dtype is not None
        and space.dtype.kind in "iu"
        and (numbers != np.round(numbers)).any()
    ):
        raise ValueError("these must be integers")
    return numbers.astype(space.dtype)
