"""Tapes that make a line of a file of each answer, and the files of episodes that are recorded."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4
from weakref import ref

from ..core import Action, Agent, EpisodeState, Plan, Reseeded, Session, Tape, Where
from ..errors import describe_error
from .recipes import FORMAT, Json, recipe_of
from .values import digest_of, encode_value

Put = Callable[[Json], object]
"""Gets a line of a file."""

to_text = json.JSONEncoder(ensure_ascii=False).encode
"""Returns the JSON of a value, faster than ``json.dumps``."""


def decision_of(episode: EpisodeState, agent: Agent) -> Json:
    """Return the line of a pending decision: the agent, and digests of observation and mask.

    In rounds, these are the observations of all live agents.
    """
    if not episode.in_rounds or agent.delegated:
        line: Json = {"agent": agent.name, "seen": digest_of(agent.observation)}
        return line if agent.mask is None else line | {"mask": digest_of(agent.mask)}
    agents = episode.agents
    line = {
        "agent": agent.name,
        "seen": {name: digest_of(agents[name].observation) for name in agents},
    }
    masks = {name: digest_of(each.mask) for name, each in agents.items() if each.mask is not None}
    return line | {"mask": masks} if masks else line


def end_of(episode: EpisodeState) -> Json:
    """Return the line of the pending decision, or of the end."""
    if episode.pending is not None:
        return decision_of(episode, episode.pending)
    return {"end": episode.outcome.value}


class FileTape(Tape):
    """A tape that makes a line of each answer, to write it or to compare it."""

    __slots__ = ("_compare", "_put", "_session")

    def __init__(
        self, session: Session, put: Put | None = None, compare: Put | None = None
    ) -> None:
        """Make the tape of a session's next episode.

        Args:
            session: The session.
            put: Gets each line.
            compare: Gets each line before that, without the action.
        """
        self._session = ref(session)
        self._put = put
        self._compare = compare

    def compare(self, compare: Put | None) -> None:
        """Pass lines on to another function. None: to none."""
        self._compare = compare

    def append(self, answer: Action) -> None:
        """Add an answer to the decision of the agent that decided last."""
        super().append(answer)
        session = self._session()
        if (self._put or self._compare) is None or session is None:
            return
        episode = session.episode
        if type(answer) is Reseeded:
            self._pass_on({"reseed": answer.seed})
        elif episode is not None and episode.latest is not None:
            line = decision_of(episode, episode.latest)
            if episode.latest.delegated:
                line["by"] = "policy"
            self._pass_on(line, answer)

    def note_exit(self, agent: str) -> None:
        """Add the ``None`` step of an agent that has ended."""
        self._pass_on({"exit": agent})

    def _pass_on(self, line: Json, answer: Action = None) -> None:
        if self._compare is not None:
            self._compare(line)
        if self._put is not None:
            if "agent" in line:
                line["action"] = encode_value(answer)
            self._put(line)


# -- files that grow with their episodes -----------------------------------------------------------


def recorder(plan: Plan, view: str) -> Callable[[Session], FileTape]:
    """Return a function that makes the tapes of a plan's recorded episodes.

    Raises:
        EpisodeFileError: The environment has parts that have no name.
        StoreError: The folder cannot be made.
    """
    recipe = plan.derive(recipe_of)
    folder = Path(plan.options.record or "")
    folder.mkdir(parents=True, exist_ok=True)
    return partial(Recorder, folder, recipe, view)


def head_of(recipe: Json, view: str, seed: int, options: Any) -> Json:
    """Return the first line of a file."""
    head = {"episode": FORMAT, "view": view, "seed": seed}
    return head | ({} if options is None else {"reset": encode_value(options)}) | recipe


class Recorder(FileTape):
    """The tape of an episode that is recorded. Its file is open only while it is written.

    Attributes:
        path: The file.
    """

    __slots__ = ("_has_ended", "_keeps", "path")

    def __init__(self, folder: Path, recipe: Json, view: str, session: Session) -> None:
        """Begin the file of a session's next episode."""
        super().__init__(session, self._write)
        seed = session.seed or 0
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{seed}-{uuid4().hex[:8]}.jsonl"
        self.path = (folder / name).absolute()
        self._keeps = session.plan.options.record_all
        self._has_ended = False
        self._write(head_of(recipe, view, seed, session.options))

    def _write(self, line: Json) -> None:
        """Append a line, unless this is a fork, whose episode is another one."""
        session = self._session()
        if session is None or session.where is not Where.USER or self._has_ended:
            return
        file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            os.write(file, f"{to_text(line)}\n".encode(errors="surrogatepass"))
        finally:
            os.close(file)

    def end(self, error: BaseException | None = None) -> str:
        """Finish the file after an error, or if all are kept. Else remove it."""
        session = self._session()
        if self._has_ended or session is None or session.where is not Where.USER:
            return ""
        if error is not None:
            self._write({"error": describe_error(error)})
        elif self._keeps and session.episode is not None:
            self._write(end_of(session.episode))
        else:
            self.path.unlink(missing_ok=True)
        self._has_ended = True
        return "" if error is None else f"; the episode is in {self.path}"
