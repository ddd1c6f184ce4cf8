"""What is said of errors and differences, in plain words."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from ..errors import (
    AgentError,
    MaskError,
    NoDecisionError,
    ObservationError,
    RewardError,
)
from .fingerprint import alike, shown
from .report import (
    compressed,
    short_names,
)
from .runs import (
    Step,
    culprit,
)

OF_ANY_ERROR: Final = "The error comes from the model itself, or from one of its mappings."

OF_PLAIN_ERRORS: Final = "The error comes from the model itself: no environment was around it."

OF_ERRORS_OF_ACTIONS: Final = (
    "Every action that is in the action space and not masked is one that learning code will try, and that the model"
    " must be able to take. If it is an action that fails: narrow the space, or say by action_mask_mapping which"
    " actions are legal. If it is only a later episode that fails: reset() must bring back everything that run()"
    " changes."
)

OF_REVIVAL: Final = (
    "removed_by says that the agent's episode has ended, and then the agent of that name decides again. Let removed_by"
    " name what really ends an entity, and agent= give each entity a name that no other ever had."
)

OF_ERRORS: Final[tuple[tuple[type[BaseException], str, str], ...]] = (
    (
        ObservationError,
        "An observation does not fit its space",
        "The observation_space_mapping returned something of another shape or kind than the observation_space holds."
        " Change one of the two.",
    ),
    (
        RewardError,
        "A reward is not one finite number",
        "The reward_mapping must return one number that is neither infinite nor NaN. Look for a division by zero, and"
        " for values that were never set.",
    ),
    (
        MaskError,
        "The legal actions do not fit the action space",
        "A mask needs a 0 or 1 for each action of the space, and at least one 1; choices must be 1 to as many as the"
        " space holds. See action_mask_mapping and choices of make_step.",
    ),
    (
        NoDecisionError,
        "An episode ends before any decision",
        "With some seeds or actions run() returns before it calls a decision function. Environments need at least one"
        " decision in each episode.",
    ),
    (AgentError, "The names of agents do not fit", "See what it says of agent= and possible_agents=."),
)


def first_lines(text: str, most: int = 300) -> str:
    """The first lines of a text, which may go on for long."""
    text = " ".join(text.split())
    return text if len(text) <= most else f"{text[: most - 4]} ..."


def at(error: BaseException) -> str:
    """Where an error was raised, in brackets; nothing where that is not known."""
    place = culprit(error)
    return f" ({place})" if place else ""


def seeds_in_words(seeds: Iterable[int]) -> str:
    """Some seeds, in words."""
    return ", ".join(map(str, seeds))


def first_difference(one: list[list[Any]], other: list[list[Any]], here: str = "first", there: str = "then") -> str:
    """Where two sequences of decisions differ first, in words; empty where they do not."""
    for number, (left, right) in enumerate(zip(one, other, strict=False), 1):
        if left[0] != right[0]:
            return f"decision {number} is {here} of {left[0]}, {there} of {right[0]}"
        if not alike(left[1], right[1]):
            return f"decision {number}, of {left[0]}, is {here} {shown(left[1])}, {there} {shown(right[1])}"
    if len(one) != len(other):
        return f"there are {here} {len(one)} decisions, {there} {len(other)}"
    return ""


def step_difference(one: list[Step], other: list[Step], error: BaseException | None) -> str:
    """Where two episodes differ first, in words; empty where they do not."""
    names = ("observation", "reward", "terminated", "truncated", "info")
    for number, (left, right) in enumerate(zip(one, other, strict=False), 1):
        if left.agent != right.agent:
            return f"step {number} is first of {left.agent}, then of {right.agent}"
        for name, here, there in zip(names, left.told, right.told, strict=True):
            if not alike(here, there):
                return f"at step {number} the {name} of {left.agent} is first {shown(here)}, then {shown(there)}"
        if left != right:
            return f"at step {number} the action of {left.agent} differs"
    if error is not None:
        return f"the second one raises {type(error).__name__}: {first_lines(str(error))}{at(error)}"
    if len(one) != len(other):
        return f"there are first {len(one)} steps, then {len(other)}"
    return ""


def parts_in_words(parts: list[tuple[str, Any, Any]], here: str = "first", there: str = "then") -> str:
    """What differs, in words."""
    listed = [f"{path} is {here} {shown(left)}, {there} {shown(right)}" for path, left, right in parts[:3]]
    more = f"; {len(parts) - 3} more" if len(parts) > 3 else ""
    return "; ".join(listed) + more


def order_of(decisions: list[list[Any]]) -> str:
    """The order in which points were called, compressed."""
    names = [name for name, _ in decisions]
    short = short_names(list(dict.fromkeys(names)))
    return compressed(short[name] for name in names)
