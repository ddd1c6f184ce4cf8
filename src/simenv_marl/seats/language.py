"""A policy that asks a language model, over an endpoint that speaks OpenAI's chat completions."""

from __future__ import annotations

import asyncio
import json
import os
from collections import deque
from collections.abc import Callable
from inspect import cleandoc
from itertools import chain
from time import perf_counter
from typing import Any, Final
from uuid import uuid4
from weakref import finalize

from ..core import COUNTS, Answer, Decision, count
from ..errors import (
    InvalidActionError,
    LanguageModelError,
    OptionValueError,
    describe_error,
    short_repr,
)
from ..many.parallel import import_extra
from .descriptions import action_schema, describe, parse, pending

LONGEST_WAIT: Final = 30.0
"""The longest time before a request is repeated, in seconds."""


class LanguageModelPolicy:
    """A coroutine policy that asks a language model for each decision.

    The model gets the decision as ``describe`` puts it, and the JSON schema of the legal actions;
    endpoints without structured output are asked without it, and an answer in plain text is parsed.
    An answer is checked here, and where it is wrong, or the endpoint fails for a time, the model is
    asked again. If it gives no legal answer, the policy raises an error, which a ``FallbackPolicy``
    catches. In clones, the rule decides.

    Attributes:
        model: The name of the model.
        structured: Whether requests ask for structured output. It becomes False when the endpoint
            refuses that.
    """

    def __init__(
        self,
        model: str,
        *,
        base_url: str | None = None,
        api_key: str | None = None,
        instructions: str = "",
        describe: Callable[[Decision], str] | None = None,
        history: int = 0,
        retries: int = 1,
        timeout: float = 60.0,
        structured: bool = True,
        client: Any = None,
        **request: Any,
    ) -> None:
        """Define a policy. The extra ``language`` is needed from the first decision on, unless there is a ``client``.

        Args:
            model: The name of the model, as the endpoint knows it.
            base_url: The address of the endpoint, such as ``http://localhost:11434/v1``. None:
                OpenAI's, or that of the environment variable ``OPENAI_BASE_URL``.
            api_key: The key of the endpoint. None: that of the environment variable
                ``OPENAI_API_KEY``.
            instructions: What the model is told besides, at the beginning.
            describe: A callable of the ``Decision`` that puts it into words. None:
                ``simenv_marl.seats.describe``.
            history: How many of the latest decisions of the same agent, with their answers, each
                request contains.
            retries: How often the model is asked again for a decision.
            timeout: The time limit of a request, in seconds.
            structured: Whether to ask for structured output.
            client: An ``openai.AsyncOpenAI``, or an object like it, to use instead of another one.
                It must not be used in another event loop.
            **request: Further arguments of each request, such as ``temperature=0.0``.

        Raises:
            OptionValueError: An argument has an invalid value.
        """
        for name, value in (("history", history), ("retries", retries)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise OptionValueError(
                    f"{name} must be a non-negative integer, not {short_repr(value)}"
                )
        if describe is not None and not callable(describe):
            raise OptionValueError(
                f"describe must be a callable of a Decision, or None, not {short_repr(describe)}"
            )
        self.model, self.structured = model, structured
        self._base_url, self._api_key, self._instructions = base_url, api_key, instructions
        self._describe, self._most_turns, self._retries = describe, history, retries
        self._request = {"timeout": timeout, **request}
        self._client, self._own_client = client, None
        self._token = uuid4().hex

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_own_client": None}

    @property
    def usage(self) -> dict[str, float]:
        """The numbers of ``requests``, ``prompt_tokens`` and ``completion_tokens``, and the ``seconds`` they took."""
        counted = COUNTS.get(self._token, {})
        return {
            name: counted.get(name, 0)
            for name in ("requests", "prompt_tokens", "completion_tokens", "seconds")
        }

    def prompt(self, env_or_decision: Any) -> str:
        """Return what the model is told about the pending decision of an environment: instructions and description.

        Raises:
            ResetNeededError: No decision is pending.
        """
        is_decision = isinstance(env_or_decision, Decision)
        decision = env_or_decision if is_decision else env_or_decision.unwrapped.call(pending)
        return f"{self._system(decision)}\n\n{self._words(decision)}"

    async def __call__(self, observation: Any, info: Any = None, *, _decision: Decision) -> Any:
        """Ask the model for an action.

        Raises:
            InvalidActionError: Its last answer was not legal.
            LanguageModelError: The last request failed, or brought no answer.
            MissingExtraError: The package ``openai`` is missing.
        """
        history = self._history(_decision)
        asked = {"role": "user", "content": self._words(_decision)}
        messages = [
            {"role": "system", "content": self._system(_decision)},
            *chain.from_iterable(history),
            asked,
        ]
        tries = 0
        while True:
            error: Exception
            try:
                text = await self._ask(messages, _decision)
                action = parse(_decision, text)
                history.append([asked, {"role": "assistant", "content": text}])
                return action
            except InvalidActionError as problem:
                error = problem
                messages += [
                    {"role": "assistant", "content": text},
                    {"role": "user", "content": str(problem)},
                ]
            except _PassingError as problem:
                error = LanguageModelError(f"{self.model} gave no answer: {problem}")
                if tries < self._retries:
                    await asyncio.sleep(min(LONGEST_WAIT, max(problem.seconds, 0.5 * 2**tries)))
            tries += 1
            if tries > self._retries:
                raise error

    # -- what the model is told -------------------------------------------------------------------

    def _system(self, decision: Decision) -> str:
        parts = [f"You decide for {decision.agent!r} in a running simulation."]
        if decision.doc:
            parts.append(f"What it decides: {cleandoc(decision.doc)}")
        schema = json.dumps(self._answer_schema(decision), ensure_ascii=False)
        parts.append(
            f"Answer with one JSON object that fits this JSON schema, and nothing else: {schema}"
        )
        return "\n".join([*parts, self._instructions] if self._instructions else parts)

    def _words(self, decision: Decision) -> str:
        return describe(decision) if self._describe is None else self._describe(decision)

    @staticmethod
    def _answer_schema(decision: Decision) -> dict[str, Any]:
        return {
            "type": "object",
            "properties": {"action": action_schema(decision)},
            "required": ["action"],
            "additionalProperties": False,
        }

    def _history(self, decision: Decision) -> deque[list[dict[str, str]]]:
        """Return the latest decisions of an agent in an episode, each as a question and an answer."""
        history: deque[list[dict[str, str]]] = decision.memory.setdefault(
            self._token, deque(maxlen=self._most_turns)
        )
        return history

    # -- requests ---------------------------------------------------------------------------------

    async def _ask(self, messages: list[dict[str, str]], decision: Decision) -> str:
        """Send a request; return the text of the answer."""
        openai = import_extra("openai", "LanguageModelPolicy") if self._client is None else None
        request: dict[str, Any] = {"model": self.model, "messages": messages, **self._request}
        if self.structured:
            schema = {"name": "decision", "schema": self._answer_schema(decision), "strict": True}
            request["response_format"] = {"type": "json_schema", "json_schema": schema}
        began = perf_counter()
        try:
            client = self._client or self._made_client(openai)
            response = await client.chat.completions.create(**request)
        except asyncio.CancelledError:
            raise
        except Exception as error:
            status = getattr(error, "status_code", None)
            if status in (400, 404, 422) and self.structured and "response_format" in str(error):
                self.structured = False
                return await self._ask(messages, decision)
            if status is None and type(error).__name__ not in (
                "APIConnectionError",
                "APITimeoutError",
            ):
                raise LanguageModelError(
                    f"{self.model} cannot be asked: {describe_error(error)}"
                ) from error
            if status is not None and status not in (408, 409, 429) and status < 500:
                raise LanguageModelError(
                    f"the endpoint refuses to ask {self.model}: {describe_error(error)}"
                ) from error
            raise _PassingError(describe_error(error), _seconds_to_wait(error)) from error
        finally:
            count(self._token, requests=1, seconds=perf_counter() - began)
        usage = getattr(response, "usage", None)
        count(
            self._token,
            prompt_tokens=getattr(usage, "prompt_tokens", 0) or 0,
            completion_tokens=getattr(usage, "completion_tokens", 0) or 0,
        )
        try:
            message = response.choices[0].message
        except (AttributeError, LookupError, TypeError):
            raise _PassingError(
                f"the endpoint returned no chat completion but {short_repr(response)}"
            ) from None
        if not isinstance(message.content, str) or not message.content.strip():
            raise _PassingError(f"it refused: {short_repr(getattr(message, 'refusal', None))}")
        return message.content

    def _made_client(self, openai: Any) -> Any:
        if self._own_client is None:
            made = openai.AsyncOpenAI(base_url=self._base_url, api_key=self._api_key, max_retries=0)
            self._own_client = made
            finalize(self, _close, made, os.getpid()).atexit = False
        return self._own_client


class _PassingError(Exception):
    """A request failed in a way that may not happen again.

    It may say how long to wait, in seconds.
    """

    def __init__(self, text: str, seconds: float = 0.0) -> None:
        super().__init__(text)
        self.seconds = seconds


def _close(client: Any, process: int) -> None:
    """Close the connections of a client, without waiting for it."""
    if os.getpid() == process:
        Answer(client.close(), lambda answer: None)


def _seconds_to_wait(error: Exception) -> float:
    """Return the seconds that an endpoint asks to wait, 0.0 if it does not say."""
    headers = getattr(getattr(error, "response", None), "headers", None) or {}
    try:
        return float(headers.get("retry-after", 0.0))
    except ValueError:
        return 0.0
