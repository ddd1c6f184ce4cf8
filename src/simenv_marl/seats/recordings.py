"""Recordings: files with a line of JSON for each answer of a policy."""

import json
import os
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final, NamedTuple
from uuid import uuid4

import numpy as np
from gymnasium.spaces import Dict, Graph, OneOf, Sequence, Space, Tuple

from ..core import Decision, PolicyWrapper, split_extras
from ..errors import OptionValueError, warn_user
from ..simulation import RULE, Action, Observation

_ADDRESS: Final = re.compile(r" at 0x[0-9a-f]+")
"""The part of an object's text that differs from run to run."""


# -- files ----------------------------------------------------------------------------------------


def read_lines(path: Path) -> Iterator[tuple[int, Any]]:
    """Yield the lines of a file that are JSON, with their numbers from 1.

    A last line that a crash has left unfinished is left out, and ended, so that the next line is
    whole. Other lines that are no JSON are left out with a warning.
    """
    content = path.read_bytes() if path.exists() else b""
    whole = content.count(b"\n")
    if not content.endswith(b"\n") and content:
        append_line(path, b"")
    for number, line in enumerate(content.splitlines(), 1):
        try:
            yield number, json.loads(line)
        except ValueError:
            if line and number <= whole:
                warn_user(f"line {number} of {path} is no JSON, and is left out")


def append_line(path: Path, line: bytes) -> None:
    """Append a line to a file, in one call, so that processes can share the file."""
    with open(path, "ab", buffering=0) as file:
        file.write(line + b"\n")


# -- answers --------------------------------------------------------------------------------------


class Question(NamedTuple):
    """A decision, as recordings identify it."""

    seed: int
    agent: str
    number: int
    observation: str
    """The digest of the observation."""
    legal: str | None = None
    """The digest of the legal actions. None: any; older recordings do not have it."""
    policy: Mapping[str, str] = {}
    """The identity of the policy, such as a language model's name and the digest of its prompt."""


class Outcome(NamedTuple):
    """The answer to a decision."""

    action: Action
    """The action as ``action_space_mapping`` receives it, or ``RULE``."""
    extras: Mapping[str, Any] = {}
    """The extras of the answer, for data sets."""
    by: str = "policy"
    """Who has answered: "policy" or "fallback"."""
    why: str = ""
    """The latest fault of the policy in this decision."""
    counts: Mapping[str, int] = {}
    """The numbers that a ``FallbackPolicy`` has counted in this decision."""

    @property
    def answer(self) -> Action:
        """The answer, as policies give it."""
        return (self.action, self.extras) if self.extras else self.action


class _Sample(NamedTuple):
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
        unused = [line for place, line in enumerate(lines) if place not in given]
        for line in unused:
            asked = line.question
            is_same = asked.observation == question.observation
            if is_same and asked.legal in (None, question.legal):
                self._check_policy(question, asked)
                given.add(lines.index(line))
                return _decoded(line.outcome, decision.action_space)
        others = [line.question for line in unused if line.run != self._run]
        if others:
            raise self._refusal(question, others)
        return None

    def write(self, question: Question, outcome: Outcome, decision: Decision) -> None:
        """Append the outcome of a decision."""
        action = None if outcome.action is RULE else encode(decision.action_space, outcome.action)
        extras = {name: _encode_part(part) for name, part in outcome.extras.items()}
        outcome = outcome._replace(action=action, extras=extras)
        parts = question._asdict() | outcome._asdict() | {"run": self._run}
        entry = {name: part for name, part in parts.items() if part not in ("", {})}
        append_line(self.path, json.dumps(entry, ensure_ascii=False).encode())
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
            for number, entry in read_lines(self.path):
                try:
                    line = _line_of(entry)
                except (TypeError, LookupError):
                    warn_user(f"line {number} of {self.path} is no answer, and is left out")
                    continue
                self._lines[line.question[:2]].append(line)
        return self._lines[question[:2]]

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


def outcome_of(answer: Action, decision: Decision) -> Outcome:
    """Return the outcome of a policy's answer.

    Raises:
        InvalidActionError: The answer is not legal.
    """
    action, extras = split_extras(answer, decision.action_space)
    if action is not RULE:
        action = decision.validate(action)
    return Outcome(action, extras)


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
    question = Question(**{name: entry[name] for name in Question._fields if name in entry})
    if "answer" in entry:  # an older version
        sample = entry["answer"]
        return _Line(question, Outcome(None if sample is None else _Sample(sample)), None)
    outcome = Outcome(**{name: entry[name] for name in Outcome._fields if name in entry})
    return _Line(question, outcome, entry["run"])


def _decoded(outcome: Outcome, space: Space[Any]) -> Outcome:
    action = outcome.action
    extras = {name: _decode_part(part) for name, part in outcome.extras.items()}
    outcome = outcome._replace(extras=extras)
    if action is None:
        return outcome._replace(action=RULE)
    if isinstance(action, _Sample):
        return outcome._replace(action=space.from_jsonable(action.json)[0])
    return outcome._replace(action=decode(space, action))


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
    return _encode_part(action)


def decode(space: Space[Any], value: Any) -> Action:
    """Return an action from its JSON."""
    match space:
        case Dict():
            return {name: decode(space[name], part) for name, part in value.items()}
        case Tuple():
            return tuple(decode(*pair) for pair in zip(space.spaces, value, strict=True))
        case Sequence() | Graph() | OneOf():
            return space.from_jsonable(value)[0]
    return np.array(value, space.dtype) if isinstance(value, list) else _decode_part(value)


def _encode_part(part: Any) -> Any:
    """Return an array or a number as JSON, with its dtype."""
    match part:
        case np.ndarray():
            return {"array": part.tolist(), "dtype": part.dtype.str}
        case np.generic():
            return {"scalar": part.item(), "dtype": part.dtype.str}
    return part


def _decode_part(value: Any) -> Any:
    match value:
        case {"array": numbers, "dtype": dtype}:
            return np.array(numbers, dtype)
        case {"scalar": number, "dtype": dtype}:
            return np.dtype(dtype).type(number)
    return value


def digest_of(observation: Observation) -> str:
    """Return a digest of an observation: of the names, types, shapes and bytes of its parts."""
    digest = blake2b(digest_size=12)

    def add(part: Observation) -> None:
        match part:
            case Mapping():
                for name in sorted(part, key=str):
                    digest.update(str(name).encode())
                    add(part[name])
            case tuple() | list():
                for item in part:
                    add(item)
            case np.ndarray() | np.generic() if part.dtype != object:
                digest.update(f"{part.dtype.str}{part.shape}".encode())
                digest.update(np.ascontiguousarray(part).tobytes())
            case _:
                digest.update(repr(part).encode())

    add(observation)
    return digest.hexdigest()
