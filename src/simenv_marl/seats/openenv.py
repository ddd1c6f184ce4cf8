"""Agents' seats as OpenEnv environments, for trainers of language models.

This module alone uses OpenEnv: its base classes, and ``create_app``.
"""

import json
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

from ..core import Decision
from ..errors import InvalidActionError, OptionValueError, WrongThreadError
from ..many.parallel import import_extra
from .answers import parse
from .descriptions import at_decision, describe

MOST_SESSIONS: Final = 1024
"""The largest number of sessions at a time."""


class _Seat:
    """The methods of an OpenEnv environment. ``seat`` adds the base class and the attributes."""

    SUPPORTS_CONCURRENT_SESSIONS = True
    make: Callable[[], Any]
    observation_class: Any
    state_class: Any
    _env: Any = None

    def __init__(self) -> None:
        super().__init__()
        self._decision: dict[str, Any] = {}  # the pending decision, in words and as data
        self.state = self.state_class()

    def reset(
        self, seed: int | None = None, episode_id: str | None = None, options: Any = None
    ) -> Any:
        """Begin an episode, as ``env.reset`` does."""
        self._env = self._env or self.make()
        self._env.reset(seed=seed, options=options)
        self.state = self.state_class(episode_id=episode_id)
        return self._observe(None)

    def step(self, action: Any) -> Any:
        """Answer the pending decision. After an illegal answer, it is still pending."""
        self._env = self._env or self.make()
        said = action.action
        text = said if isinstance(said, str) else json.dumps({"action": said})
        try:
            parsed = parse(self._env, text)
        except InvalidActionError as error:
            return self.observation_class(**self._decision, error=str(error), reward=0.0)
        _, reward, *ends, _ = self._env.step(parsed)
        self.state = self.state.model_copy(update={"step_count": self.state.step_count + 1})
        if any(ends):
            return self.observation_class(reward=reward, done=True)
        return self._observe(reward)

    def _observe(self, reward: float | None) -> Any:
        self._decision = at_decision(self._env, "seat", _in_words)
        return self.observation_class(**self._decision, reward=reward)

    def web_actions(self, observation: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
        """Return the labels of the legal actions, and the actions."""
        labels = observation["decision"]["actions"].get("enum", ())
        return [(label, {"action": label}) for label in labels]

    def close(self) -> None:
        """Close the simulation."""
        with suppress(WrongThreadError):  # a request without a session; its thread unwinds it
            env, self._env = self._env, None
            if env is not None:
                env.close()


def _in_words(decision: Decision) -> dict[str, Any]:
    return {"prompt": describe(decision), "decision": describe(decision, as_json=True)}


def seat(make: Callable[[], Any], *, name: str | None = None) -> Any:
    """Make an OpenEnv environment of one agent's seat. It needs the extra ``openenv``.

    An action has a field ``action``: a label or a value, as ``parse`` takes it. An observation has
    ``prompt`` (the pending decision, as ``describe`` puts it), ``decision`` (the same as data) and
    ``error``: after an illegal answer the reason, with reward 0.0, while the simulation does not
    move.

    Args:
        make: Returns the environment of the agent: a new ``single_env``.
        name: The name of the environment. None: "Seat".

    Returns:
        A class of OpenEnv's environments. Its attribute ``action_class`` is the class of actions.

    Raises:
        MissingExtraError: The extra is missing.
    """
    server = import_extra("openenv.core.env_server", "seat")
    action = {
        "__doc__": "The label or the value of a legal action.",
        "__module__": __name__,
        "__annotations__": {"action": Any},
    }
    observation = {
        "__doc__": "A pending decision, or the end of an episode.",
        "__module__": __name__,
        "__annotations__": {"prompt": str, "decision": dict[str, Any] | None, "error": str | None},
        "prompt": "",
        "decision": None,
        "error": None,
    }
    parts = {
        "__doc__": f"A seat in the simulation {name}.",
        "make": staticmethod(make),
        "action_class": type("SeatAction", (server.Action,), action),
        "observation_class": type("SeatObservation", (server.Observation,), observation),
        "state_class": server.State,
        "state": None,
    }
    return type(name or "Seat", (_Seat, server.Environment), parts)


def serve(make: Callable[[], Any], *, name: str | None = None) -> Any:
    """Make an app that serves the environments of ``seat``. Each session has one of its own.

    Args:
        make: As ``seat`` takes it. It is called for each session, in the session's thread.
        name: As ``seat`` takes it.

    Returns:
        The app, for a server such as uvicorn.

    Raises:
        MissingExtraError: The extra ``openenv`` is missing.
    """
    kind = seat(make, name=name)
    server = import_extra("openenv.core.env_server", "serve")
    return server.create_app(
        kind,
        kind.action_class,
        kind.observation_class,
        env_name=kind.__name__,
        max_concurrent_envs=MOST_SESSIONS,
    )


def run(make: Callable[[], Any], name: str, port: int) -> str:
    """Serve a seat on the loopback address until an interrupt. Return a farewell.

    Raises:
        SimEnvError: There is no such seat, or the port cannot be used.
    """
    app = serve(make, name=name)
    env = make()
    try:
        env.reset()
    finally:
        env.close()
    try:
        listener = socket.create_server(("127.0.0.1", port))
    except (OSError, OverflowError) as error:
        raise OptionValueError(f"cannot listen on port {port}: {error}") from error
    with listener, suppress(KeyboardInterrupt):
        print(f"{name} is served at http://127.0.0.1:{listener.getsockname()[1]}", flush=True)
        uvicorn = import_extra("uvicorn", "serve")
        uvicorn.Server(uvicorn.Config(app, log_level="warning")).run(sockets=[listener])
    return f"{name} is no longer served"
