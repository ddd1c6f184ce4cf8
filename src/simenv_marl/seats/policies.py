"""Policies around policies: a fallback for those that are late, fail or answer illegally, and recordings."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Coroutine, Mapping
from hashlib import blake2b
from inspect import isawaitable
from pathlib import Path
from time import monotonic
from typing import Any, Final
from uuid import uuid4

import numpy as np
from gymnasium import spaces

from ..core import COUNTS, Caller, Decision, PolicyWrapper, count, waits, when_answered
from ..errors import InvalidActionError, OptionValueError, describe_error, short_repr, warn_user
from ..simulation import RULE

KINDS: Final = ("asked", "retried", "late", "failed", "illegal", "fallbacks")
"""What a ``FallbackPolicy`` counts."""


class FallbackPolicy(PolicyWrapper):
    """A policy that answers by a fallback where another policy is late, raises an exception, or answers illegally.

    Evaluations show the share of decisions that a fallback has answered. In clones it counts
    nothing, and where the other policy waits or records, the fallback answers.

    Attributes:
        policy, fallback: The two policies.
        last_error: What was wrong with the latest answer that was not used, as text; None if all
            were used.
    """

    counts_fallbacks = True

    def __init__(
        self, policy: Any, fallback: Any = RULE, *, timeout: float | None = None, retries: int = 0
    ) -> None:
        """Wrap a policy.

        Args:
            policy: The policy, as ``simulate`` takes them: a callable, which may be a coroutine
                function.
            fallback: What answers instead: ``RULE``, or a policy.
            timeout: The time that an answer may take, in seconds. A coroutine is cancelled then;
                the time of other functions is measured afterwards. None: there is no limit.
            retries: How often the policy is asked again before the fallback answers.

        Raises:
            OptionValueError: An argument has an invalid value.
        """
        if fallback is not RULE and not callable(fallback):
            raise OptionValueError(f"fallback must be RULE or a policy, not {short_repr(fallback)}")
        self._ask_fallback = None if fallback is RULE else Caller(fallback)
        super().__init__(
            policy, asks=("_decision", *(self._ask_fallback.names if self._ask_fallback else ()))
        )
        if timeout is not None and not (isinstance(timeout, (int, float)) and timeout > 0):
            raise OptionValueError(
                f"timeout must be a number of seconds or None, not {short_repr(timeout)}"
            )
        if isinstance(retries, bool) or not isinstance(retries, int) or retries < 0:
            raise OptionValueError(
                f"retries must be a non-negative integer, not {short_repr(retries)}"
            )
        self.fallback, self.timeout, self.retries = fallback, timeout, retries
        self.waits = self.waits or waits(fallback)
        self.last_error: str | None = None
        self._token = uuid4().hex

    @property
    def counts(self) -> dict[str, int]:
        """How often it was asked and retried, was late, failed or answered illegally, and the fallback answered.

        ``evaluate``, ``run_experiment``, ``simulate_many`` and ``collect_episodes`` add what their
        workers count.
        """
        counted = COUNTS.get(self._token, {})
        return {kind: int(counted.get(kind, 0)) for kind in KINDS}

    def __call__(
        self, observation: Any, info: Any = None, *, _decision: Decision, **asked: Any
    ) -> Any:
        """Answer a decision. Return an awaitable if one of the two policies has to be awaited."""
        answer = self._answer(observation, info, {**asked, "_decision": _decision})
        return answer if self.waits else _finished(answer)

    async def _answer(self, observation: Any, info: Any, asked: Mapping[str, Any]) -> Any:
        decision: Decision = asked["_decision"]
        self._count(decision, "asked")
        for number in range(self.retries + 1):
            if number:
                self._count(decision, "retried")
            began = monotonic()
            try:
                answer = self.ask(observation, info, asked)
                if isawaitable(answer) and self.waits:
                    answer = await asyncio.wait_for(answer, self.timeout)
                if self.timeout is not None and monotonic() - began > self.timeout:
                    raise TimeoutError
                if answer is not RULE:
                    decision.validate(answer)
                return answer
            except OptionValueError:  # the policy was not written or set up well
                raise
            except TimeoutError as error:
                late = TimeoutError(f"the answer took longer than {self.timeout} s")
                self._note(decision, "late", error if str(error) else late)
            except InvalidActionError as error:
                self._note(decision, "illegal", error)
            except Exception as error:
                self._note(decision, "failed", error)
        self._count(decision, "fallbacks")
        decision.count_fallback()
        if self._ask_fallback is None:
            return RULE
        answer = self._ask_fallback(observation, info, asked)
        return await answer if isawaitable(answer) else answer

    def _note(self, decision: Decision, kind: str, error: Exception) -> None:
        self.last_error = describe_error(error)
        self._count(decision, kind)

    def _count(self, decision: Decision, kind: str) -> None:
        if not decision.in_clone:
            count(self._token, **{kind: 1})


def _finished(coroutine: Coroutine[Any, Any, Any]) -> Any:
    """Return the result of a coroutine that awaits nothing."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value
    raise AssertionError("it has nothing to await")


class RecordedPolicy(PolicyWrapper):
    """A policy that records the answers of another one in a file, and repeats them without asking it.

    Each answer is a line of JSON: the seed of the episode, the agent, the number of the decision, a
    digest of the observation, and the answer. An answer is repeated where all of these agree. A
    line is written at once, so that the file can be used after a crash. In clones, the fallback of
    the other policy answers, or the rule.

    Attributes:
        policy: The other policy.
        path: The path of the file.
    """

    def __init__(self, policy: Any, path: str | os.PathLike[str]) -> None:
        """Wrap a policy, as ``simulate`` takes them; it may be a coroutine function.

        The file is created if needed.
        """
        super().__init__(policy, asks=("_decision",))
        self.path, self.records = Path(path), True
        if not self.path.parent.is_dir():
            raise OptionValueError(
                f"{self.path} cannot be written: {self.path.parent} is no folder"
            )
        self.fallback: Any = getattr(policy, "fallback", RULE)
        self._known: dict[tuple[Any, ...], Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_known": None}

    def __call__(
        self, observation: Any, info: Any = None, *, _decision: Decision, **asked: Any
    ) -> Any:
        """Answer a decision.

        Return an awaitable if the answer is not known and the policy has to be awaited.
        """
        known = self._read() if self._known is None else self._known
        key = _decision.seed, _decision.agent, _decision.number, digest_of(observation)
        if key in known:
            answer = known[key]
            return RULE if answer is None else _decision.action_space.from_jsonable(answer)[0]
        asked["_decision"] = _decision
        answer = self.ask(observation, info, asked)
        return when_answered(answer, lambda known: self._record(key, known, _decision))

    def _read(self) -> dict[tuple[Any, ...], Any]:
        """Read the file. A line that is not finished is ended, so that the next one can be read."""
        known: dict[tuple[Any, ...], Any] = {}
        content = self.path.read_bytes() if self.path.exists() else b""
        for number, line in enumerate(content.splitlines(), 1):
            try:
                entry = json.loads(line)
                key = entry["seed"], entry["agent"], entry["number"], entry["observation"]
                known[key] = entry["answer"]
            except (ValueError, TypeError, LookupError):
                if number <= content.count(b"\n"):
                    warn_user(
                        f"line {number} of {self.path} cannot be read, so its decision is asked"
                        " again"
                    )
        if content and not content.endswith(b"\n"):
            self._write(b"\n")
        self._known = known
        return known

    def _record(self, key: tuple[Any, ...], answer: Any, decision: Decision) -> Any:
        """Record an answer, unless it is illegal."""
        recorded = None
        if answer is not RULE:
            try:
                action = decision.validate(answer)
            except InvalidActionError:
                return answer
            recorded = decision.action_space.to_jsonable([_in_form(decision.action_space, action)])
        names = ("seed", "agent", "number", "observation", "answer")
        self._write(json.dumps(dict(zip(names, (*key, recorded), strict=True))).encode() + b"\n")
        assert self._known is not None
        self._known[key] = recorded
        return answer

    def _write(self, line: bytes) -> None:
        with open(self.path, "ab", buffering=0) as file:
            file.write(line)  # as a whole, so that processes can share the file


def _in_form(space: spaces.Space[Any], action: Any) -> Any:
    """Return a legal action in the form that spaces write as JSON: scalars for a ``Box`` as arrays."""
    if isinstance(space, spaces.Dict):
        return {key: _in_form(part, action[key]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_in_form(part, action[place]) for place, part in enumerate(space.spaces))
    return (
        np.asarray(action, space.dtype).reshape(space.shape)
        if isinstance(space, spaces.Box)
        else action
    )


def digest_of(observation: Any) -> str:
    """Return a digest of an observation: of the names, types, shapes and bytes of its parts."""
    digest = blake2b(digest_size=12)

    def add(part: Any) -> None:
        if isinstance(part, Mapping):
            for name in sorted(part, key=str):
                digest.update(str(name).encode())
                add(part[name])
        elif isinstance(part, (tuple, list)):
            for item in part:
                add(item)
        elif isinstance(part, (np.ndarray, np.generic)) and part.dtype != object:
            digest.update(f"{part.dtype.str}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(repr(part).encode())

    add(observation)
    return digest.hexdigest()
