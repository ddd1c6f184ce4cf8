"""The episodes of a file, without the lines that later ones have replaced."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field

from ..errors import EpisodeFileError, StoreError, describe_error
from .lines import Lines
from .recipes import Json
from .values import encode_value


@dataclass
class EpisodeLines:
    """An episode of a file. A game can have decisions that were undone.

    Attributes:
        head: The first line.
        lines: The numbers of the further lines, and their values.
        turn: The number of decisions before the pending one.
    """

    head: Json
    lines: list[tuple[int, Json]] = field(default_factory=list)
    turn: int = 0
    _places: list[int] = field(default_factory=list)  # of the decisions in ``lines``

    @property
    def decisions(self) -> list[Json]:
        """The lines of the decisions, undone ones included, with the notes of a game."""
        lines = [self.lines[place][1] for place in self._places]
        return [{**line, **line.get("play", {})} for line in lines]

    @property
    def present(self) -> list[tuple[int, Json]]:
        """The lines up to the pending decision."""
        ends = self.turn < len(self._places)
        return self.lines[: self._places[self.turn] if ends else None]

    def add(self, number: int, line: Json) -> None:
        """Add a line, which may replace others.

        Raises:
            ValueError: It does not follow from those before it.
        """
        turn = line.get("turn", self.turn)
        if "play" in line:
            turn = line["play"].get("turn", turn)
        if not 0 <= turn <= len(self._places):
            raise ValueError(f"the decision before turn {turn} is missing")
        self.turn = turn
        if "turn" in line:
            return
        if "action" in line:
            if turn < len(self._places):
                self.lines = self.present
                del self._places[turn:]
            self._places.append(len(self.lines))
            self.turn += 1
        self.lines.append((number, line))


def follow(episodes: list[EpisodeLines], number: int, line: Json) -> None:
    """Add a line to the episodes that the lines before it describe.

    Raises:
        ValueError, LookupError: It does not fit the lines before it.
    """
    if "seed" in line:
        episodes.append(EpisodeLines(line))
    elif "back" in line:
        episodes.pop()  # the game before the restart goes on
    else:
        episodes[-1].add(number, line)


def read_episodes(path: str | os.PathLike[str]) -> list[EpisodeLines]:
    """Read the episodes of a file. A game has several, others have one.

    Raises:
        EpisodeFileError: It has none, or is malformed.
        StoreError: It cannot be read.
    """
    episodes: list[EpisodeLines] = []
    number = expected = 0
    try:
        for number, value in Lines(path).read():
            expected += 1
            is_old = "turn" in value or "simulation" in value
            for line in _renewed(value) if is_old else (value,):
                follow(episodes, number, line)
            # A game is resumed after a crash, and the turns of its lines fit together.
            if number != expected and "play" not in episodes[-1].head:
                raise ValueError("there is a torn line before it")
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {describe_error(error)}") from error
    except Exception as error:
        raise malformed(path, number) from error
    if not episodes:
        raise malformed(path, 1)
    return episodes


def malformed(path: str | os.PathLike[str], number: int) -> EpisodeFileError:
    """Make the error for a line of a file."""
    return EpisodeFileError(f"line {number} of {path} is not what this version writes")


def _renewed(line: Json) -> Iterator[Json]:
    """Yield a line, or those in place of one of a game of an older version."""
    if "seed" in line and "episode" not in line:
        game = {name: line.pop(name) for name in ("simulation", "seats") if name in line}
        yield {"seed": line.pop("seed"), "play": game, "options": line}
    elif "agent" in line and "turn" in line:
        action = line.pop("action")
        parts = {name: line.pop(name) for name in ("agent", "seen")}
        end = line.pop("end", None)
        answer = {"rule": True} if action is None else encode_value(action)
        yield {**parts, "action": answer, "play": line}
        if end is not None:
            yield {"end": end}
    else:
        yield line
