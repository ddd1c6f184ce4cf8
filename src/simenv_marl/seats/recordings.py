"""Recordings: files with a line of JSON for each answer of a policy."""

import os
import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final, NamedTuple
from uuid import uuid4

import numpy as np
from gymnasium.spaces import Dict, Graph, OneOf, Sequence, Space, Tuple

from ..core import Decision, PolicyWrapper, split_extras
from ..errors import OptionValueError, warn_user
from ..files.lines import Lines
from ..files.values import decode_value, digest_of, encode_value
from ..simulation import RULE, Action

_ADDRESS: Final = re.compile(r" at 0x[0-9a-f]+")
"""The part of an object's text that differs from run to run."""


# -- answers --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Question:
    """A decision, as recordings identify it."""

    seed: int
    agent: str
    number: int
    observation: str
    """The digest of the observation."""
    legal: str | None = None
    """The digest of the legal actions. None: any; older recordings do not have it."""
    policy: Mapping[str, str] = field(default_factory=dict)
    """The identity of the policy, such as a language model's name and the digest of its prompt."""


@dataclass(frozen=True)
class Outcome:
    """The answer to a decision."""

    action: Action
    """The action as ``action_space_mapping`` receives it, or ``RULE``."""
    extras: Mapping[str, Any] = field(default_factory=dict)
    """The extras of the answer, for data sets."""
    by: str = "policy"
    """Who has answered: "policy" or "fallback"."""
    why: str = ""
    """The latest fault of the policy in this decision."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """The numbers that a ``FallbackPolicy`` has counted in this decision."""

    @property
    def answer(self) -> Action:
        """The answer, as policies give it."""
        return (self.action, self.extras) if self.extras else self.action


@dataclass(frozen=True)
class _Sample:
    """An action as JSON in a recording of an older version."""

    json: Any


class _Line(NamedTuple):
    """A line of a recording; the action of its outcome is JSON."""

    question: Question
    outcome: Outcome
    run: str | None
    """The recording that has written the line."""


class Recording:
    """The answers in a file.

    They are found by seed, agent, observation and legal actions. Equal ones are given in the order
    of the lines. Copies of a recording, also in other processes, are one.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Name the file. The first answer creates it.

        Raises:
            OptionValueError: The folder of the file does not exist.
        """
        self.path = Path(path)
        if not self.path.parent.is_dir():
            raise OptionValueError(
                f"{self.path} cannot be written: {self.path.parent} is no folder"
            )
        self._file = Lines(path)
        self._run = uuid4().hex[:12]
        self._lines: dict[tuple[int, str], list[_Line]] | None = None

    def __getstate__(self) -> dict[str, object]:
        """Return the state without the lines, because the file has them, too."""
        return {**vars(self), "_lines": None}

    def find(self, question: Question, decision: Decision) -> Outcome | None:
        """Return the recorded outcome of a decision. None: it has to be decided.

        Raises:
            OptionValueError: Another policy has answered it, or the file has only answers to other
                decisions of this agent in this episode.
        """
        lines = self._lines_of(question)
        given = self._given(decision)
        others = []
        for place, line in enumerate(lines):
            if place in given:
                continue
            asked = line.question
            is_same = asked.observation == question.observation
            if is_same and asked.legal in (None, question.legal):
                self._check_policy(question, asked)
                given.add(place)
                return _decoded(line.outcome, decision.action_space)
            if line.run != self._run:
                others.append(asked)
        if others:
            raise self._refusal(question, others)
        return None

    def write(self, question: Question, outcome: Outcome, decision: Decision) -> None:
        """Append the outcome of a decision."""
        action = None if outcome.action is RULE else encode(decision.action_space, outcome.action)
        extras = {name: encode_value(part) for name, part in outcome.extras.items()}
        outcome = replace(outcome, action=action, extras=extras)
        entry = vars(question) | vars(outcome) | {"run": self._run}
        empty = [name for name in ("policy", "extras", "why", "counts") if not entry[name]]
        self._file.append({name: entry[name] for name in entry if name not in empty})
        lines = self._lines_of(question)
        self._given(decision).add(len(lines))
        lines.append(_Line(question, outcome, self._run))

    def _given(self, decision: Decision) -> set[int]:
        """Return the places of the lines that this agent has been given in this episode."""
        given: set[int] = decision.memory.setdefault(self._run, set())
        return given

    def _lines_of(self, question: Question) -> list[_Line]:
        """Return the lines of the agent and the seed of a decision."""
        if self._lines is None:
            self._lines = defaultdict(list)
            for number, entry in self._file.read() if self.path.exists() else ():
                try:
                    line = _line_of(entry)
                except (TypeError, LookupError):
                    warn_user(f"line {number} of {self.path} is no answer, and is left out")
                    continue
                self._lines[line.question.seed, line.question.agent].append(line)
        return self._lines[question.seed, question.agent]

    def _check_policy(self, question: Question, asked: Question) -> None:
        differing = [
            name for name in asked.policy if asked.policy[name] != question.policy.get(name)
        ]
        for name in differing:
            raise OptionValueError(
                f"{self.path} has the answers of another policy: its {name} is"
                f" {asked.policy[name]!r}, and now {question.policy.get(name)!r}; record in another"
                " file"
            )

    def _refusal(self, question: Question, others: list[Question]) -> OptionValueError:
        """Return the error that says how a decision differs from the recorded ones."""
        problem = "its observation"
        if question.observation in [other.observation for other in others]:
            problem = "its legal actions"
        return OptionValueError(
            f"{self.path} has no answer to decision {question.number} of {question.agent!r} in the"
            f" episode of seed {question.seed}, but {len(others)} to others that are not asked:"
            f" {problem} and the recorded ones differ; use the model, the policies and the options"
            " of the recording, or record in another file"
        )


def outcome_of(answer: Action, decision: Decision, **parts: Any) -> Outcome:
    """Return the outcome of a policy's answer, with its other parts.

    Raises:
        InvalidActionError: The answer is not legal.
    """
    action, extras = split_extras(answer, decision.action_space)
    if action is not RULE:
        action = decision.validate(action)
    return Outcome(action, extras, **parts)


def question_of(decision: Decision, policy: object) -> Question:
    """Return a decision as recordings identify it, for the policy that answers it."""
    while isinstance(policy, PolicyWrapper):
        policy = policy.policy
    labels = decision.action_labels
    texts = labels.items() if isinstance(labels, Mapping) else labels
    legal = digest_of((decision.mask, _ADDRESS.sub("", repr(texts and [*texts]))))
    identify = getattr(policy, "identify", None)
    return Question(
        decision.seed,
        decision.agent,
        decision.number,
        digest_of(decision.observation),
        legal,
        {} if identify is None else identify(decision),
    )


def _line_of(entry: Mapping[str, Any]) -> _Line:
    """Return the line of an entry, also of one of an older version."""
    question = Question(**_parts(entry, Question))
    if "answer" in entry:  # an older version
        sample = entry["answer"]
        return _Line(question, Outcome(None if sample is None else _Sample(sample)), None)
    outcome = Outcome(**_parts(entry, Outcome))
    return _Line(question, outcome, entry["run"])


def _parts(entry: Mapping[str, Any], kind: type[Question | Outcome]) -> dict[str, Any]:
    return {part.name: entry[part.name] for part in fields(kind) if part.name in entry}


def _decoded(outcome: Outcome, space: Space[Any]) -> Outcome:
    action = outcome.action
    extras = {name: decode_value(part) for name, part in outcome.extras.items()}
    outcome = replace(outcome, extras=extras)
    if action is None:
        return replace(outcome, action=RULE)
    if isinstance(action, _Sample):
        return replace(outcome, action=space.from_jsonable(action.json)[0])
    return replace(outcome, action=decode(space, action))


# -- actions as JSON ------------------------------------------------------------------------------


def encode(space: Space[Any], action: Action) -> Any:
    """Return a legal action as JSON. ``decode`` returns the same action, of the same types."""
    match space:
        case Dict():
            return {name: encode(space[name], part) for name, part in action.items()}
        case Tuple():
            return [encode(*pair) for pair in zip(space.spaces, action, strict=True)]
        case Sequence() | Graph() | OneOf():
            return space.to_jsonable([action])
    if isinstance(action, np.ndarray) and action.ndim and action.dtype == space.dtype:
        return action.tolist()
    return encode_value(action)


def decode(space: Space[Any], value: Any) -> Action:
    """Return an action from its JSON."""
    match space:
        case Dict():
            return {name: decode(space[name], part) for name, part in value.items()}
        case Tuple():
            return tuple(decode(*pair) for pair in zip(space.spaces, value, strict=True))
        case Sequence() | Graph() | OneOf():
            return space.from_jsonable(value)[0]
    return np.array(value, space.dtype) if isinstance(value, list) else decode_value(value)
