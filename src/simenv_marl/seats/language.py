"""A policy that asks a language model, over an endpoint that speaks OpenAI's chat completions."""

import json
import os
from collections import deque
from collections.abc import Callable
from copy import deepcopy
from time import perf_counter
from typing import Any
from uuid import uuid4
from weakref import finalize

from ..core import COUNTS, Answer, Decision, count
from ..errors import (
    InvalidActionError,
    LanguageModelError,
    MissingExtraError,
    OptionValueError,
    describe_error,
    short_repr,
)
from ..files.values import digest_of
from ..many.parallel import import_extra
from ..simulation import Action, Observation, check_count
from . import descriptions
from .answers import parse
from .descriptions import Schema, action_schema, at_decision
from .policies import kind_of

Message = dict[str, str]
"""A message of the conversation, with its ``role`` and ``content``."""


class LanguageModelPolicy:
    """A coroutine policy that asks a language model for each decision.

    A request contains the decision as ``describe`` puts it, and the JSON schema of the legal
    actions. Endpoints without structured output are asked without a schema; an answer in plain text
    is parsed. The policy validates each answer. After an illegal or a missing answer it asks again;
    the client repeats failed requests. Then the policy raises an error, which a ``FallbackPolicy``
    catches. In clones, the rule decides. Each process has its own connections.

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
        **request: object,
    ) -> None:
        """Define a policy.

        The first decision needs the extra ``language``, unless there is a ``client``.

        Args:
            model: The name of the model, as the endpoint knows it.
            base_url: The address of the endpoint, such as ``http://localhost:11434/v1``. None:
                OpenAI's, or the environment variable ``OPENAI_BASE_URL``.
            api_key: The key of the endpoint. None: the environment variable ``OPENAI_API_KEY``.
            instructions: Further instructions, at the end of the system message.
            describe: A callable of the ``Decision`` that puts it into words. None:
                ``simenv_marl.seats.describe``.
            history: How many of the latest decisions of the same agent, with their answers, each
                request contains.
            retries: How often the model is asked again for a decision, and how often a new client
                repeats a request.
            timeout: The time limit of a request, in seconds.
            structured: Whether to ask for structured output.
            client: An ``openai.AsyncOpenAI``, an object like it, or a callable that makes one. It
                must not be used in another event loop. Other processes use copies, or make one.
            **request: Further arguments of each request, such as ``temperature=0.0``.

        Raises:
            OptionValueError: An argument has an invalid value.
        """
        if describe is not None and not callable(describe):
            raise OptionValueError(
                f"describe must be a callable of a Decision, or None, not {short_repr(describe)}"
            )
        self.model = model
        self.structured = structured
        self._client_options: dict[str, object] = {
            "base_url": base_url,
            "api_key": api_key,
            "max_retries": retries,
        }
        self._instructions = instructions
        self._describe = describe or descriptions.describe
        self._history_length = check_count(history, "history")
        self._retries = check_count(retries, "retries")
        self._request = {"timeout": timeout, **request}
        self._client = client
        # A forked process keeps its parent's clients: their end would close the connections.
        self._clients = {os.getpid(): client} if hasattr(client, "chat") else {}
        self._token = uuid4().hex

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_clients": {}}

    @property
    def usage(self) -> dict[str, float]:
        """The numbers of requests and tokens, and the seconds that the requests took.

        The keys are ``requests``, ``prompt_tokens``, ``completion_tokens`` and ``seconds``.
        """
        counts = COUNTS.get(self._token, {})
        names = ("requests", "prompt_tokens", "completion_tokens", "seconds")
        return {name: counts.get(name, 0) for name in names}

    def prompt(self, env_or_decision: object) -> str:
        """Return the prompt for the pending decision: the instructions and the description.

        Raises:
            ResetNeededError: No decision is pending.
        """
        text: str = at_decision(env_or_decision, "prompt", self._prompt)
        return text

    def _prompt(self, decision: Decision) -> str:
        return f"{self._system_text(decision, self.structured)}\n\n{self._describe(decision)}"

    def identify(self, decision: Decision) -> dict[str, str]:
        """Return the name of the model and a digest of the prompt, for recordings."""
        prompt = (self._system_text(decision, True), self._describe(decision))
        return {"model": self.model, "prompt": digest_of(prompt)}

    async def __call__(
        self, observation: Observation, info: object = None, *, _decision: Decision
    ) -> Action:
        """Ask the model for an action.

        Raises:
            InvalidActionError: Its last answer was not legal.
            LanguageModelError: The last request failed, or brought no answer.
            MissingExtraError: The package ``openai`` is missing.
        """
        past: deque[Message] = _decision.memory.setdefault(
            self._token, deque(maxlen=2 * self._history_length)
        )
        question = {"role": "user", "content": self._describe(_decision)}
        messages = [*past, question]
        for retry in range(self._retries + 1):
            text = ""
            try:
                text = await self._ask(messages, _decision, self.structured)
                action = parse(_decision, text)
                break
            except (InvalidActionError, _NoAnswerError) as error:
                if retry == self._retries:
                    raise
                if text:
                    messages += [
                        {"role": "assistant", "content": text},
                        {"role": "user", "content": str(error)},
                    ]
        past += [question, {"role": "assistant", "content": text}]
        return action

    # -- prompts ----------------------------------------------------------------------------------

    def _system_text(self, decision: Decision, structured: bool) -> str:
        lines = [f"You decide for {decision.agent!r} in a running simulation."]
        form = 'of the form {"action": ...} with a legal action, and nothing else'
        if structured:
            schema = json.dumps(_answer_schema(decision), ensure_ascii=False)
            form = f"that fits this JSON schema, and nothing else: {schema}"
        lines.append(f"Answer with one JSON object {form}")
        if self._instructions:
            lines.append(self._instructions)
        return "\n".join(lines)

    # -- requests ---------------------------------------------------------------------------------

    async def _ask(self, messages: list[Message], decision: Decision, structured: bool) -> str:
        """Send a request; return the text of the answer.

        Raises:
            LanguageModelError: The request failed.
            _NoAnswerError: The model did not answer.
        """
        request: dict[str, object] = {
            "model": self.model,
            "messages": [
                {"role": "system", "content": self._system_text(decision, structured)},
                *messages,
            ],
            **self._request,
        }
        if structured:
            schema = {"name": "decision", "schema": _answer_schema(decision), "strict": True}
            request["response_format"] = {"type": "json_schema", "json_schema": schema}
        start = perf_counter()
        try:
            client = self._client_here()
            response = await client.chat.completions.create(**request)
        except MissingExtraError:
            raise
        except Exception as error:
            if structured and _may_refuse_schema(error):
                return await self._ask(messages, decision, structured=False)
            raise LanguageModelError(
                f"{self.model} cannot be asked: {describe_error(error)}", kind_of(error)
            ) from error
        finally:
            count(self._token, requests=1, seconds=perf_counter() - start)
        usage = getattr(response, "usage", None)
        tokens = {
            name: getattr(usage, name, 0) or 0 for name in ("prompt_tokens", "completion_tokens")
        }
        count(self._token, **tokens)
        decision.count(tokens=sum(tokens.values()))
        self.structured &= structured
        return _content(response, self.model)

    def _client_here(self) -> Any:
        """Return the client of this process."""
        process = os.getpid()
        if process not in self._clients:
            client = self._client
            if client is None:
                openai = import_extra("openai", "LanguageModelPolicy")
                client = openai.AsyncOpenAI(**self._client_options)
            else:
                client = _copied(client) if hasattr(client, "chat") else client()
            self._clients[process] = client
            finalizer = finalize(self, _close, client, process)
            finalizer.atexit = False
        return self._clients[process]


class _NoAnswerError(LanguageModelError):
    """The endpoint has answered, but not the model."""


def _answer_schema(decision: Decision) -> Schema:
    return {
        "type": "object",
        "properties": {"action": action_schema(decision)},
        "required": ["action"],
        "additionalProperties": False,
    }


def _content(response: Any, model: str) -> str:
    """Return the text of a model's response.

    Raises:
        _NoAnswerError: It has none, or not the whole.
    """
    choice, *_ = getattr(response, "choices", None) or [None]
    message = getattr(choice, "message", None)
    content = getattr(message, "content", None)
    refusal = getattr(message, "refusal", None)
    reason = getattr(choice, "finish_reason", None)
    if isinstance(content, list):
        refusal = refusal or "".join(part.get("refusal", "") for part in content)
        content = "".join(part["text"] for part in content if part.get("type") == "text")
    kind = "failed"
    if message is None:
        problem = f"the endpoint returned {short_repr(response)}"
    elif refusal or reason == "content_filter":
        problem = f"it refused: {short_repr(refusal or reason)}"
        kind = "refused"
    elif reason == "length":
        problem = "it was cut off, because max_tokens is used up"
    elif content and content.strip():
        return str(content)
    else:
        problem = f"its content is empty, and its finish_reason {reason!r}"
    raise _NoAnswerError(f"{model} gave no answer: {problem}", kind)


def _may_refuse_schema(error: Exception) -> bool:
    """Return whether an endpoint may have refused a request because of its ``response_format``.

    Endpoints say so in many ways.
    """
    status = getattr(error, "status_code", None)
    return status in (400, 404, 415, 422, 501) or "response_format" in str(error)


def _copied(client: Any) -> Any:
    """Copy a client of the user, without its connections.

    Raises:
        LanguageModelError: It cannot be copied.
    """
    http: Any = getattr(client, "_client", None)
    try:
        if type(http).__module__.startswith("openai"):
            http = type(http)(base_url=client.base_url, timeout=client.timeout)
            return client.copy(http_client=http)
        return deepcopy(client)
    except Exception as error:
        raise LanguageModelError(
            f"{short_repr(client)} belongs to another process, and cannot be copied; let client= be"
            f" a function that makes it ({describe_error(error)})"
        ) from error


def _close(client: Any, process: int) -> None:
    """Close the connections of a client in the policies' thread, without waiting for it."""
    if os.getpid() == process and hasattr(client, "close"):  # not in a fork
        Answer(client.close(), lambda answer: None)
