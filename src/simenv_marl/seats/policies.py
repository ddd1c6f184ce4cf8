"""Policies around policies: fallbacks for failing policies, and recordings of answers."""

import asyncio
import os
from collections import Counter
from collections.abc import Awaitable, Coroutine
from inspect import isawaitable
from time import monotonic
from typing import Any, Final
from uuid import uuid4

from ..core import (
    COUNTS,
    Caller,
    Decision,
    Info,
    Policy,
    PolicyWrapper,
    count,
    waits,
)
from ..errors import (
    InvalidActionError,
    LanguageModelError,
    OptionValueError,
    describe_error,
    short_repr,
)
from ..simulation import RULE, Action, Observation, check_count, check_seconds
from .recordings import Outcome, Recording, outcome_of, question_of

KINDS: Final = (
    "asked",
    "retried",
    "late",
    "refused",
    "http",
    "failed",
    "illegal",
    "fallbacks",
)
"""The events that a ``FallbackPolicy`` counts."""

Settled = tuple[Action, BaseException | None]
"""An answer, or an error."""

LEFT: Final[set[asyncio.Future[Settled]]] = set()
"""The late answers that have not ended yet. An event loop does not keep its tasks alive."""


class RecordablePolicy(PolicyWrapper):
    """A policy around another one, whose answers can be recorded."""

    recording: Recording | None = None

    def __call__(
        self,
        observation: Observation,
        info: Info | None = None,
        *,
        _decision: Decision,
        **context: object,
    ) -> Action | Awaitable[Action]:
        """Answer a decision. Return an awaitable if a policy has to be awaited."""
        context["_decision"] = _decision
        answer = self.answer(self.recording, _decision, observation, info, context)
        return answer if self.waits else _run_without_waiting(answer)

    async def answer(
        self,
        recording: Recording | None,
        decision: Decision,
        *arguments: Any,
    ) -> Action:
        """Answer with the arguments of a ``Caller``, or as recorded."""
        if recording is None:
            return (await self.decide(decision, *arguments)).answer
        question = question_of(decision, self)
        outcome = recording.find(question, decision)
        if outcome is None:
            outcome = await self.decide(decision, *arguments)
            recording.write(question, outcome, decision)
        else:
            self.repeat(decision, outcome)
        return outcome.answer

    async def decide(self, decision: Decision, *arguments: Any) -> Outcome:
        """Decide, by the policy."""
        answer = self.ask(*arguments)
        if self.waits and isawaitable(answer):
            answer = await answer
        return outcome_of(answer, decision)

    def repeat(self, decision: Decision, outcome: Outcome) -> None:
        """Note an outcome that was recorded."""


class FallbackPolicy(RecordablePolicy):
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
        fallback: Policy = RULE,
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
        if isinstance(policy, RecordedPolicy):  # this policy records instead, also its fallback
            self.recording = policy.recording
            self.ask = policy.ask
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

    async def decide(self, decision: Decision, *arguments: Any) -> Outcome:
        """Decide, by the policy or the fallback."""
        counts: Counter[str] = Counter()
        why = ""

        def note(kind: str) -> None:
            counts[kind] += 1
            self._count(decision, kind)

        note("asked")
        for attempt in range(self.retries + 1):
            if attempt:
                note("retried")
            try:
                answer = await self._ask_in_time(*arguments)
                return outcome_of(answer, decision, why=why, counts=counts)
            except OptionValueError:  # a mistake in the program, which no fallback should hide
                raise
            except Exception as error:
                self.last_error = why = describe_error(error)
                note(kind_of(error))
        note("fallbacks")
        answer = self._ask_fallback(*arguments)
        if isawaitable(answer):
            answer = await answer
        return outcome_of(answer, decision, by="fallback", why=why, counts=counts)

    def repeat(self, decision: Decision, outcome: Outcome) -> None:
        """Count what was counted when an outcome was recorded."""
        self.last_error = outcome.why or self.last_error
        for kind, number in outcome.counts.items():
            self._count(decision, kind, number)

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

    def _count(self, decision: Decision, kind: str, number: int = 1) -> None:
        if not decision.in_clone:
            count(self._token, **{kind: number})
            decision.count(**{kind: number})


async def _within(timeout: float | None, answer: Awaitable[Action]) -> Action:
    """Await an answer for some seconds. Then cancel it, without waiting for its end.

    Raises:
        TimeoutError: The time is up.
        RuntimeError: The answer has cancelled itself.
    """
    task = asyncio.ensure_future(_settled(answer))
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


async def _settled(answer: Awaitable[Action]) -> Settled:
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


class RecordedPolicy(RecordablePolicy):
    """A policy that records the answers of another one in a file, and repeats them.

    Each answer is a line of JSON: seed, agent and number of the decision, digests of observation
    and legal actions, the action in the form that reaches the mapping, who has answered (the policy
    or its fallback) and why. The answer is given again, without asking, where seed, agent,
    observation and legal actions agree. An episode with other decisions than the recorded ones is
    refused; a longer one is continued. A line is written at once, so that the file can be used
    after a crash. In clones, the fallback of the other policy answers, or the rule.

    A policy may have a method ``identify(decision)`` that returns a dict of texts, such as the name
    of a language model and the digest of its prompt. The answers of another policy are refused.

    Attributes:
        policy: The other policy.
        recording: The file.
    """

    def __init__(self, policy: Policy, path: str | os.PathLike[str]) -> None:
        """Wrap a policy, as ``simulate`` takes them; it may be a coroutine function.

        The file is created if needed. A ``FallbackPolicy`` may be inside or outside: file and
        counts are the same.

        Raises:
            OptionValueError: The folder of the file does not exist.
        """
        super().__init__(policy, asks=("_decision",))
        self.recording = Recording(path)
        self.records = True
        self.fallback = getattr(policy, "fallback", RULE)

    async def decide(self, decision: Decision, *arguments: Any) -> Outcome:
        """Decide, by the policy, which may have a fallback."""
        if isinstance(self.policy, FallbackPolicy):
            return await self.policy.decide(decision, *arguments)
        return await super().decide(decision, *arguments)

    def repeat(self, decision: Decision, outcome: Outcome) -> None:
        """Let a policy with a fallback count what it has counted before."""
        if isinstance(self.policy, FallbackPolicy):
            self.policy.repeat(decision, outcome)
