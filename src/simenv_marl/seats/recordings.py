"""Recordings: files with a line of JSON for each answer of a policy."""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Final
from uuid import uuid4

import numpy as np
from gymnasium.spaces import Tuple

from ..core import Decision, PolicyWrapper, Space, split_extras
from ..errors import OptionValueError, warn_user
from ..files.lines import Lines
from ..files.values import decode_value, digest_of, encode_value
from ..simulation import RULE, Action

_ADDRESS: Final = re.compile(r" at 0x[0-9a-f]+")
"""The part of an object's text that differs from run to run."""


# -- answers --------------------------------------------------------------------------------------


Entry = dict[str, Any]
"""A line of a recording, or its question, without an outcome.

The question is the ``seed``, the ``agent``, the ``number`` of the decision, digests of its
``observation`` and of its ``legal`` actions (older recordings have none), and the identity of the
``policy``, such as a language model's name and the digest of its prompt. The outcome is an
``Outcome`` as JSON. ``run`` is the recording that has written the line.
"""

Asked = tuple[str, str | None]
"""The digests of an observation and of the legal actions, which older recordings do not have."""

Answers = dict[Asked, list[Entry]]
"""The entries of an agent and a seed, in the order of the lines."""


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


class Recording(Lines):
    """The answers in a file.

    They are found by seed, agent, observation and legal actions. Equal ones are given in the order
    of the lines. Copies of a recording, also in other processes, are one.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Name the file. The first answer creates it.

        Raises:
            OptionValueError: The folder of the file does not exist.
        """
        super().__init__(path)
        if not self.path.parent.is_dir():
            raise OptionValueError(
                f"{self.path} cannot be written: {self.path.parent} is no folder"
            )
        self._run = uuid4().hex[:12]
        self._entries: dict[tuple[int, str], Answers] | None = None

    def __getstate__(self) -> dict[str, object]:
        """Return the state without the entries, because the file has them, too."""
        return {**vars(self), "_entries": None}

    def find(self, question: Entry, decision: Decision) -> Outcome | None:
        """Return the recorded outcome of a decision. None: it has to be decided.

        Raises:
            OptionValueError: Another policy has answered it, or the file has only answers to other
                decisions of this agent in this episode.
        """
        answers = self._entries_of(question)
        given = self._given(decision)
        seen = question["observation"]
        for key in ((seen, question["legal"]), (seen, None)):  # older versions have no second part
            if given[key] < len(answers[key]):
                entry = answers[key][given[key]]
                self._check_policy(question, entry)
                given[key] += 1
                return _outcome_in(entry, decision.action_space)
        left = chain.from_iterable(entries[given[key] :] for key, entries in answers.items())
        others = [entry["observation"] for entry in left if entry.get("run") != self._run]
        if others:
            is_seen = seen in others
            problem = "its legal actions" if is_seen else "its observation"
            raise OptionValueError(
                f"{self.path} has no answer to decision {question['number']} of"
                f" {question['agent']!r} in the episode of seed {question['seed']}, but"
                f" {len(others)} to others that are not asked: {problem} and the recorded ones"
                " differ; use the model, the policies and the options of the recording, or record"
                " in another file"
            )
        return None

    def write(self, question: Entry, outcome: Outcome, decision: Decision) -> None:
        """Append the outcome of a decision."""
        entry = question | vars(outcome) | {"run": self._run}
        entry["action"] = None if outcome.action is RULE else encode_value(outcome.action)
        entry["extras"] = {name: encode_value(part) for name, part in outcome.extras.items()}
        optional = ("policy", "extras", "why", "counts")
        entry = {name: part for name, part in entry.items() if part or name not in optional}
        self.append(entry)
        key = question["observation"], question["legal"]
        entries = self._entries_of(question)[key]
        entries.append(entry)
        self._given(decision)[key] = len(entries)

    def _given(self, decision: Decision) -> Counter[Asked]:
        """Return how many entries of each kind this agent has been given in this episode."""
        given: Counter[Asked] = decision.memory.setdefault(self._run, Counter())
        return given

    def _entries_of(self, question: Entry) -> Answers:
        """Return the entries of the agent and the seed of a decision."""
        if self._entries is None:
            self._entries = defaultdict(lambda: defaultdict(list))
            for number, entry in self.read() if self.path.exists() else ():
                try:
                    seed, agent, seen = (entry[name] for name in ("seed", "agent", "observation"))
                    self._entries[seed, agent][seen, entry.get("legal")].append(entry)
                except (TypeError, LookupError):
                    warn_user(f"line {number} of {self.path} is no answer, and is left out")
        return self._entries[question["seed"], question["agent"]]

    def _check_policy(self, question: Entry, entry: Entry) -> None:
        for name, recorded in entry.get("policy", {}).items():
            present = question["policy"].get(name)
            if recorded != present:
                raise OptionValueError(
                    f"{self.path} has the answers of another policy: its {name} is {recorded!r},"
                    f" and now {present!r}; record in another file"
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


def question_of(decision: Decision, policy: object) -> Entry:
    """Return a decision as recordings identify it, for the policy that answers it."""
    while isinstance(policy, PolicyWrapper):
        policy = policy.policy
    labels = decision.action_labels
    texts = labels.items() if isinstance(labels, Mapping) else labels
    identify = getattr(policy, "identify", None)
    return {
        "seed": decision.seed,
        "agent": decision.agent,
        "number": decision.number,
        "observation": digest_of(decision.observation),
        "legal": digest_of((decision.mask, _ADDRESS.sub("", repr(texts and [*texts])))),
        "policy": {} if identify is None else identify(decision),
    }


def _outcome_in(entry: Entry, space: Space) -> Outcome:
    """Return the outcome of an entry, also of one of an older version."""
    if "answer" in entry:
        sample = entry["answer"]
        return Outcome(RULE if sample is None else space.from_jsonable(sample)[0])
    action = RULE if entry["action"] is None else decode_value(entry["action"])
    if type(action) is list:  # older recordings have no types
        action = tuple(action) if isinstance(space, Tuple) else np.array(action, space.dtype)
    extras = {name: decode_value(part) for name, part in entry.get("extras", {}).items()}
    others = {name: entry[name] for name in ("by", "why", "counts") if name in entry}
    return Outcome(action, extras, **others)
