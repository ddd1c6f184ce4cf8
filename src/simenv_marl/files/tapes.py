"""Tapes that make a line of a file of each answer, and the files of episodes that are recorded."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4
from weakref import ref

from ..core import Action, Agent, Branched, EpisodeState, Plan, Reseeded, Session, Tape
from ..errors import StoreError, describe_error
from .lines import Lines
from .recipes import FORMAT, Json, recipe_of
from .values import digest_of, encode_value

Put = Callable[[Json], object]
"""Gets a line of a file."""


def decision_of(episode: EpisodeState, agent: Agent) -> Json:
    """Return the line of a pending decision: the agent, and digests of observation and mask.

    In rounds, these are the observations of all live agents.
    """
    if not episode.in_rounds or agent.delegated:
        line: Json = {"agent": agent.name, "seen": digest_of(agent.observation)}
        if agent.mask is not None:
            line["mask"] = digest_of(agent.mask)
        return line
    agents = episode.agents.items()
    line = {
        "agent": agent.name,
        "seen": {name: digest_of(each.observation) for name, each in agents},
    }
    masks = {name: digest_of(each.mask) for name, each in agents if each.mask is not None}
    return line | {"mask": masks} if masks else line


def end_of(episode: EpisodeState) -> Json:
    """Return the line of the pending decision, or of the end."""
    if episode.pending is not None:
        return decision_of(episode, episode.pending)
    return {"end": episode.outcome.value}


class FileTape(Tape):
    """A tape that makes a line of each answer, to write it or to compare it."""

    __slots__ = ("_compare", "_put", "_session")

    def __init__(self, session: Session, put: Put | None = None) -> None:
        """Make the tape of a session's next episode. ``put`` gets each line."""
        self._session = ref(session)
        self._put = put
        self._compare: Put | None = None

    def compare(self, compare: Put | None) -> None:
        """Pass each line on to another function, too, without the action. None: no more."""
        self._compare = compare

    def _episode(self) -> Any:
        """Return the episode. None in a fork, which must not write for its parent."""
        session = self._session()
        return None if session is None or session.where else session.episode

    def append(self, answer: Action) -> None:
        """Add an answer to the decision of the agent that decided last."""
        super().append(answer)
        if self._put is None and self._compare is None:
            return
        episode = self._episode()
        if episode is None:
            return
        kind = type(answer)
        if kind is Reseeded or kind is Branched:
            self._pass_on({"reseed": answer.seed} if kind is Reseeded else {"branch": answer.agent})
            return
        line = decision_of(episode, episode.latest)
        if episode.latest.delegated:
            line["by"] = "policy"
        self._pass_on(line, "action", answer)

    def note_exit(self, agent: str) -> None:
        """Add the ``None`` step of an agent that has ended."""
        if self._episode() is not None:
            self._pass_on({"exit": agent})

    def end(self, error: BaseException | None = None) -> str:
        """Note that the episode has ended, or failed."""
        return "" if self._compare is not None else super().end(error)

    def _pass_on(self, line: Json, key: str = "", answer: Action = None) -> None:
        if self._compare is not None:
            self._compare(line)
        if self._put is not None:
            if key:
                line[key] = answer if type(answer) is int else encode_value(answer)
            self._put(line)


# -- files that grow with their episodes -----------------------------------------------------------


def recorder(plan: Plan, view: str) -> Callable[[Session], FileTape]:
    """Return a function that makes the tapes of a plan's recorded episodes.

    Raises:
        EpisodeFileError: The environment has parts that have no name.
        StoreError: The folder cannot be made.
    """
    folder = Path(plan.options.record or "").absolute()
    recipe = plan.derive(recipe_of)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"{folder} cannot be made: {describe_error(error)}") from error
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

    __slots__ = ("_keeps", "path")

    def __init__(self, folder: Path, recipe: Json, view: str, session: Session) -> None:
        """Begin the file of a session's next episode."""
        seed = session.seed or 0
        self.path = folder / f"{time.strftime('%Y%m%d-%H%M%S')}-{seed}-{uuid4().hex[:8]}.jsonl"
        add = Lines(self.path).add
        super().__init__(session, add)
        self._keeps: bool | None = session.plan.options.record_all  # None: its end is written
        add(head_of(recipe, view, seed, session.options))

    def end(self, error: BaseException | None = None) -> str:
        """Finish the file after an error, or if all are kept. Else remove it."""
        episode = self._episode()
        if self._put is None or episode is None:
            return ""
        if error is not None and self._keeps is not None:
            self._put({"error": describe_error(error)})
            self._put = None
            return f"; the episode is in {self.path}"
        if error is None and self._keeps and (episode.terminated or episode.truncated):
            self._put(end_of(episode))
            self._keeps = None  # the steps of ended agents follow
        elif error is not None or self._keeps is False:  # without a decision, or as it is wanted
            self._put = None
            self.path.unlink(missing_ok=True)
        return ""
