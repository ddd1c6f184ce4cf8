"""Policies around policies: fallbacks for failing policies, and recordings of answers."""

import asyncio
import json
import os
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from hashlib import blake2b
from inspect import isawaitable
from pathlib import Path
from time import monotonic
from typing import Any, Final, NamedTuple
from uuid import uuid4

import numpy as np

from ..core import (
    COUNTS,
    Caller,
    Decision,
    Info,
    PolicyWrapper,
    count,
    split_extras,
    waits,
    when_answered,
)
from ..errors import (
    InvalidActionError,
    LanguageModelError,
    OptionValueError,
    describe_error,
    short_repr,
    warn_user,
)
from ..simulation import RULE, Action, Observation, Sentinel, check_count, check_seconds
from .answers import to_action

KINDS: Final = (*("asked", "retried", "late", "refused", "http", "failed", "illegal", "fallbacks"),)
"""The events that a ``FallbackPolicy`` counts."""

Outcome = tuple[Action, BaseException | None]
"""An answer, or an error."""

LEFT: Final[set[asyncio.Future[Outcome]]] = set()
"""The late answers that have not ended yet. An event loop does not keep its tasks alive."""

Policy = Callable[..., Action | Awaitable[Action]]
"""A policy, as ``simulate`` takes them. It may be a coroutine function."""


class FallbackPolicy(PolicyWrapper):
    """A policy that answers by a fallback where another policy is late, fails or answers illegally.

    Evaluations show the share of decisions that a fallback has answered. In clones nothing is
    counted, and the fallback answers for a policy that waits or records.

    Attributes:
        policy, fallback: The two policies.
        last_error: The text of the latest error, delay or illegal answer; None if there was none.
    """

    counts_fallbacks = True

    def __init__(
        self,
        policy: Policy,
        fallback: Policy | Sentinel = RULE,
        *,
        timeout: float | None = None,
        retries: int = 0,
    ) -> None:
        """Wrap a policy.

        Args:
            policy: The policy, as ``simulate`` takes them. It may be a coroutine function.
            fallback: ``RULE``, or the policy that answers instead.
            timeout: The time that an answer may take, in seconds. A coroutine is cancelled then,
                and left behind if it does not end; the time of other functions is measured
                afterwards. None: there is no limit.
            retries: How often the policy is asked again before the fallback answers.

        Raises:
            OptionValueError: An argument has an invalid value.
        """
        if fallback is not RULE and not callable(fallback):
            raise OptionValueError(f"fallback must be RULE or a policy, not {short_repr(fallback)}")
        self._ask_fallback = Caller(fallback if callable(fallback) else _leave_to_rule)
        super().__init__(policy, asks=("_decision", *self._ask_fallback.names))
        self.fallback = fallback
        self.timeout = None if timeout is None else check_seconds(timeout, "timeout")
        self.retries = check_count(retries, "retries")
        self.waits = self.waits or waits(fallback)
        self.last_error: str | None = None
        self._token = uuid4().hex

    @property
    def counts(self) -> dict[str, int]:
        """The numbers of decisions, retries, faults and fallbacks.

        The keys are ``asked`` (decisions), ``retried``, ``late``, ``refused`` (by a language
        model), ``http`` (errors of an endpoint), ``failed`` (other errors), ``illegal`` and
        ``fallbacks``. ``evaluate``, ``run_experiment``, ``simulate_many`` and ``collect_episodes``
        add the counts of their workers.
        """
        counts = COUNTS.get(self._token, {})
        return {kind: int(counts.get(kind, 0)) for kind in KINDS}

    def __call__(
        self,
        observation: Observation,
        info: Info | None = None,
        *,
        _decision: Decision,
        **context: object,
    ) -> Action | Awaitable[Action]:
        """Answer a decision. Return an awaitable if one of the two policies has to be awaited."""
        context["_decision"] = _decision
        answer = self._answer(_decision, observation, info, context)
        if self.waits:
            return answer
        return _run_without_waiting(answer)

    async def _answer(self, decision: Decision, *arguments: Any) -> Action:
        """Answer with the arguments of a ``Caller``."""
        self._count(decision, "asked")
        for attempt in range(self.retries + 1):
            if attempt:
                self._count(decision, "retried")
            try:
                answer = await self._ask_in_time(*arguments)
                action, _ = split_extras(answer, decision.action_space)
                if action is not RULE:
                    decision.validate(action)
                return answer
            except OptionValueError:  # a mistake in the program, which no fallback should hide
                raise
            except Exception as error:
                self.last_error = describe_error(error)
                self._count(decision, kind_of(error))
        self._count(decision, "fallbacks")
        answer = self._ask_fallback(*arguments)
        if isawaitable(answer):
            return await answer
        return answer

    async def _ask_in_time(self, *arguments: Any) -> Action:
        """Ask the policy; raise a ``TimeoutError`` if its answer takes too long."""
        problem = f"the answer took longer than {self.timeout} s"
        start = monotonic()
        try:
            try:
                answer = self.ask(*arguments)
            except asyncio.CancelledError as error:
                raise RuntimeError("the policy has cancelled itself") from error
            if isawaitable(answer) and self.waits:
                answer = await _within(self.timeout, answer)
        except TimeoutError as error:
            raise TimeoutError(str(error) or problem) from error
        if self.timeout is not None and monotonic() - start > self.timeout:
            raise TimeoutError(problem)
        return answer

    def _count(self, decision: Decision, kind: str) -> None:
        if not decision.in_clone:
            count(self._token, **{kind: 1})
            decision.count(**{kind: 1})


async def _within(timeout: float | None, answer: Awaitable[Action]) -> Action:
    """Await an answer for some seconds. Then cancel it, without waiting for its end.

    Raises:
        TimeoutError: The time is up.
        RuntimeError: The answer has cancelled itself.
    """
    task = asyncio.ensure_future(_outcome(answer))
    try:
        await asyncio.wait({task}, timeout=timeout)
    except asyncio.CancelledError:  # of the decision, not of the answer
        task.cancel()
        await asyncio.wait({task})
        raise
    if not task.done():
        LEFT.add(task)
        task.add_done_callback(LEFT.discard)
        task.cancel()
        raise TimeoutError
    value, error = task.result()
    if isinstance(error, asyncio.CancelledError):
        raise RuntimeError("the policy has cancelled itself") from error
    if error is not None:
        raise error
    return value


async def _outcome(answer: Awaitable[Action]) -> Outcome:
    try:
        return await answer, None
    except BaseException as error:  # also an exit, because it would end the event loop
        return None, error


def kind_of(error: Exception) -> str:
    """Return the count to which an error of a policy adds."""
    match error:
        case InvalidActionError():
            return "illegal"
        case LanguageModelError():
            return error.kind
    if hasattr(error, "status_code"):
        return "http"
    is_late = isinstance(error, TimeoutError) or "Timeout" in type(error).__name__
    return "late" if is_late else "failed"


def _leave_to_rule(observation: Observation) -> Action:
    return RULE


def _run_without_waiting(coroutine: Coroutine[None, None, Action]) -> Action:
    """Return the result of a coroutine that awaits nothing."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value
    raise AssertionError("the coroutine waits")


class DecisionKey(NamedTuple):
    """The fields of a recorded line that identify its decision."""

    seed: int
    agent: str
    number: int
    observation: str
    """The digest of the observation."""


class RecordedPolicy(PolicyWrapper):
    """A policy that records the answers of another one in a file, and repeats them.

    Each answer is a line of JSON: the seed of the episode, the agent, the number of the decision, a
    digest of the observation, and the answer. An answer is repeated without asking the other policy
    where all of these agree. A line is written at once, so that the file can be used after a crash.
    In clones, the fallback of the other policy answers, or the rule.

    Attributes:
        policy: The other policy.
        path: The path of the file.
    """

    def __init__(self, policy: Policy, path: str | os.PathLike[str]) -> None:
        """Wrap a policy, as ``simulate`` takes them; it may be a coroutine function.

        The file is created if needed.

        Raises:
            OptionValueError: The folder of the file does not exist.
        """
        super().__init__(policy, asks=("_decision",))
        self.path = Path(path)
        self.records = True
        if not self.path.parent.is_dir():
            raise OptionValueError(
                f"{self.path} cannot be written: {self.path.parent} is no folder"
            )
        self.fallback: Policy | Sentinel = getattr(policy, "fallback", RULE)
        self._answers: dict[DecisionKey, Action] | None = None

    def __getstate__(self) -> dict[str, object]:
        """Return the state without the answers, because the file has them, too."""
        return {**vars(self), "_answers": None}

    def __call__(
        self,
        observation: Observation,
        info: Info | None = None,
        *,
        _decision: Decision,
        **context: object,
    ) -> Action | Awaitable[Action]:
        """Answer a decision.

        Return an awaitable if the answer is not recorded and the policy has to be awaited.
        """
        if self._answers is None:
            self._answers = self._read()
        key = DecisionKey(
            _decision.seed,
            _decision.agent,
            _decision.number,
            digest_of(observation),
        )
        if key in self._answers:
            recorded = self._answers[key]
            if recorded is None:
                return RULE
            return _decision.action_space.from_jsonable(recorded)[0]
        context["_decision"] = _decision
        answer = self.ask(observation, info, context)
        return when_answered(answer, lambda answer: self._record(key, answer, _decision))

    def _read(self) -> dict[DecisionKey, Action]:
        """Read the file, and end a line that a crash has left unfinished."""
        answers: dict[DecisionKey, Action] = {}
        content = self.path.read_bytes() if self.path.exists() else b""
        for number, line in enumerate(content.splitlines(), 1):
            try:
                entry = json.loads(line)
                key = DecisionKey(*(entry[field] for field in DecisionKey._fields))
                answers[key] = entry["answer"]
            except (ValueError, TypeError, LookupError):
                if number <= content.count(b"\n"):
                    warn_user(
                        f"line {number} of {self.path} cannot be read, so its decision is asked"
                        " again"
                    )
        if content and not content.endswith(b"\n"):
            self._write(b"\n")
        return answers

    def _record(
        self,
        key: DecisionKey,
        answer: Action,
        decision: Decision,
    ) -> Action:
        """Record an answer, unless it is illegal, and return it without extras."""
        recorded = None
        answer, _ = split_extras(answer, decision.action_space)
        if answer is not RULE:
            try:
                action = decision.validate(answer)
            except InvalidActionError:
                return answer
            space = decision.action_space
            # A legal action for a Box of one number may be a scalar, but to_jsonable needs arrays.
            recorded = space.to_jsonable([to_action(space, action)])
        line = json.dumps(key._asdict() | {"answer": recorded})
        self._write(line.encode() + b"\n")
        assert self._answers is not None
        self._answers[key] = recorded
        return answer

    def _write(self, line: bytes) -> None:
        with open(self.path, "ab", buffering=0) as file:
            file.write(line)  # in one call, so that processes can share the file


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
