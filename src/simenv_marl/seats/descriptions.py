"""Pending decisions as text and as JSON, and texts as actions, by the labels of ``make_step``."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from string import printable
from typing import Any, Final, TypeAlias

import numpy as np
from gymnasium.spaces import (
    Box,
    Dict,
    Discrete,
    MultiBinary,
    MultiDiscrete,
    Text,
    Tuple,
    flatten_space,
)
from numpy.typing import NDArray

from ..core import Decision, Labels, Mask, Space, pending_view
from ..errors import ViewError, short_repr
from ..simulation import Observation, check_count

MOST: Final = 200
"""The largest number of parts of an observation that are listed one by one."""

Schema = dict[str, Any]
"""A JSON schema."""

JSON: TypeAlias = "Mapping[str, JSON] | Sequence[JSON] | str | float | None"
"""A value that ``json.dumps`` takes."""

UNLABELLED_NUMBER: Final = ("0",)
"""The labels of a ``Box`` of one number that the user has not labelled."""


class FreeText(Text):
    """A space of any text up to a length. Its samples are of ASCII characters."""

    is_np_flattenable = False

    def __init__(self, longest: int) -> None:
        """Make a space of texts of at most ``longest`` characters."""
        super().__init__(longest, min_length=0, charset=printable)

    def contains(self, x: object) -> bool:
        """Return whether a value is a text that is not too long."""
        return isinstance(x, str) and len(x) <= self.max_length

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FreeText) and self.max_length == other.max_length

    def __repr__(self) -> str:
        return f"free_text({self.max_length})"


flatten_space.register(FreeText, lambda space: space)  # because it has no list of characters


def free_text(n: int) -> Space:
    """Make the space of any text of at most ``n`` characters, for actions and observations.

    Gymnasium's ``Text`` is for texts of a given set of characters.

    Raises:
        OptionValueError: ``n`` is no positive integer.
    """
    return FreeText(check_count(n, "n", 1))


def describe(
    env_or_decision: object,
    *,
    as_json: bool = False,
) -> Any:
    """Describe the pending decision.

    The description has the agent, the time, the question, the situation, the legal actions, and the
    reward of the previous action. The situation is the observation, or the ``display_mapping`` of
    ``make_step`` where there is one.

    Args:
        env_or_decision: An environment in mid-episode, with or without wrappers; or the
            ``Decision`` that a policy receives as ``_decision``.
        as_json: Whether to return a dict for ``json.dumps`` instead of a text. Its keys are
            ``agent``, ``point``, ``number``, ``time``, ``question``, ``observation``, ``actions``
            and ``reward``; ``observation`` is the situation, and ``actions`` a JSON schema of the
            answers that ``parse`` takes.

    Raises:
        ResetNeededError: No decision is pending.
        ViewError: The actions cannot be described, because their space has no names or numbers.
    """
    return at_decision(env_or_decision, "describe", _as_json if as_json else _as_text)


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
    time = "" if decision.time is None else f", time {_value_text(decision.time)}"
    return "\n".join(
        [
            f"{decision.agent} decides (decision {decision.number}{time}).",
            *filter(None, [decision.question]),
            "Observation:",
            *_observation_lines(situation(decision)),
            f"Reward of the previous action: {_value_text(decision.reward)}",
            "Legal actions:",
            *legal_lines(decision),
        ]
    )


def _as_json(decision: Decision) -> dict[str, JSON]:
    return {
        "agent": decision.agent,
        "point": decision.point,
        "number": decision.number,
        "time": decision.time,
        "question": decision.question,
        "observation": situation(decision),
        "actions": action_schema(decision),
        "reward": decision.reward,
    }


# -- observations ---------------------------------------------------------------------------------


def situation(decision: Decision) -> JSON:
    """Return the display of a decision, or else its observation, as JSON with labels."""
    if decision.display is None:
        return labelled(decision.observation, decision.observation_labels)
    return {label: labelled(value) for label, value in decision.display.items()}


def labelled(value: Observation, labels: Labels = None) -> JSON:
    """Return an observation as JSON, with the labels of its parts."""
    match value:
        case Mapping():
            return {
                str(label_of_part(labels, key)): labelled(part, None) for key, part in value.items()
            }
        case np.ndarray(shape=(_,)) if labels:
            parts = zip(labels, _numbers(value), strict=True)
            return dict(parts)
        case np.ndarray() | np.generic():
            return labelled(_numbers(value), labels)
        case tuple() | list():
            return [*map(labelled, value)]
        case _:
            return label_of_part(labels, value)


def _numbers(value: NDArray[Any] | np.generic) -> Any:
    """Return numbers of NumPy as Python's, with the digits that their type has."""
    if value.dtype.kind == "f" and value.dtype.itemsize < np.float64().itemsize:
        value = value.astype(str).astype(np.float64)  # the shortest form of each
    return value.tolist()


def label_of_part(labels: Labels, key: JSON) -> JSON:
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
        return repr(value).removesuffix(".0")
    if isinstance(value, str):
        return value
    return json.dumps(value, default=str, ensure_ascii=False)


# -- legal actions --------------------------------------------------------------------------------


def legal_actions(space: Discrete, mask: Mask | None) -> list[int]:
    """Return the actions of a ``Discrete`` space that a mask allows; all without a mask."""
    offsets = range(space.n) if mask is None else np.flatnonzero(mask)
    return [int(space.start + offset) for offset in offsets]


def legal_lines(decision: Decision) -> list[str]:
    """Return a line for each legal action of a ``Discrete``, or for each component of others."""
    try:
        schema = action_schema(decision)
    except ViewError:
        schema = {}
    match schema:
        case {"enum": labels}:
            return [f"- {label}" for label in labels]
        case {"properties": parts}:
            lines = [f"- {name}: {limits_of(part)}" for name, part in parts.items()]
        case {"description": label}:
            lines = [f"- {label}: {limits_of(schema)}"]
        case {"type": _}:
            lines = [f"- {limits_of(schema)}"]
        case _:
            lines = [f"- {decision.action_space}"]
    if decision.mask is not None:
        lines.append(f"- of these, the mask allows {short_repr(decision.mask)}")
    return lines


def limits_of(schema: Schema) -> str:
    """Return the values that a JSON schema allows, in words."""
    noun = "a whole number" if schema.get("type") == "integer" else "a number"
    match schema:
        case {"properties": parts}:
            texts = [f"{name}: {limits_of(part)}" for name, part in parts.items()]
            return f"({', '.join(texts)})"
        case {"minLength": least, "maxLength": most, "pattern": pattern}:
            return f"{least} to {most} characters of {pattern[2:-3]}"
        case {"maxLength": most}:
            return f"any text of at most {most} characters"
        case {"minimum": low, "maximum": high}:
            return f"{noun} from {_value_text(low)} to {_value_text(high)}"
        case {"minimum": low}:
            return f"{noun} of at least {_value_text(low)}"
        case {"maximum": high}:
            return f"{noun} of at most {_value_text(high)}"
    return noun


def action_schema(decision: Decision) -> Schema:
    """Return the JSON schema of the actions that ``parse`` takes.

    Raises:
        ViewError: The actions of this space have no names or numbers.
    """
    space = decision.action_space
    labels = decision.action_labels
    if isinstance(space, Discrete) and isinstance(labels, Mapping):
        legal = [labels[action] for action in legal_actions(space, decision.mask)]
        return {"type": "string", "enum": legal}
    return schema_of(space, labels)


def schema_of(space: Space, labels: Labels) -> Schema:
    """Return the JSON schema of a space, with the labels of its components.

    Raises:
        ViewError: A part of the space has no names or numbers.
    """
    match space:
        case Discrete():
            return _range(int(space.start), int(space.start + space.n - 1))
        case FreeText():
            return {"type": "string", "maxLength": space.max_length}
        case Text():
            characters = re.sub(r"([]\\^-])", r"\\\1", space.characters)
            return {
                "type": "string",
                "minLength": space.min_length,
                "maxLength": space.max_length,
                "pattern": f"^[{characters}]*$",
            }
        case Box(shape=() | (1,)):
            [low], [high] = _numbers(space.low.ravel()), _numbers(space.high.ravel())
            schema = _range(low, high)
            if labels and labels != UNLABELLED_NUMBER:
                schema["description"] = labels[0]
            return schema
        case Box(shape=(_, _, *_)):
            parts = []  # JSON has no names for the components of matrices
        case _:
            parts = components_of(space, labels)
    if not parts:
        raise ViewError(f"actions of the space {short_repr(space)} cannot be put into words")
    properties = {label: schema_of(part, None) for _, label, part in parts}
    return {
        "type": "object",
        "properties": properties,
        "required": [*properties],
        "additionalProperties": False,
    }


def components_of(space: Space, labels: Labels) -> list[tuple[Any, str, Space]]:
    """Return the components of a space: key, label and space of each. Other spaces have none."""
    parts: Sequence[Space]
    match space:
        case Dict():
            return [(key, str(label_of_part(labels, key)), part) for key, part in space.items()]
        case Tuple():
            parts = space.spaces
        case MultiDiscrete(shape=(size,)):
            parts = [space[place] for place in range(size)]
        case MultiBinary(shape=(size,)):
            parts = [Discrete(2)] * size
        case Box(shape=(_, *shape)):
            bounds = zip(space.low, space.high, strict=True)
            parts = [Box(low, high, shape, space.dtype) for low, high in bounds]
        case _:
            return []
    numbers = range(len(parts))
    return [*zip(numbers, labels or map(str, numbers), parts, strict=True)]


def _range(low: float, high: float) -> Schema:
    bounds = {"minimum": low, "maximum": high}
    finite = {key: bound for key, bound in bounds.items() if isfinite(bound)}
    return {"type": "number" if isinstance(low, float) else "integer", **finite}
