"""Recordings of the page, and the episodes that they describe."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Unpack

from ...core import Decision, EpisodeOptions, Points
from ...data import Trajectories, collect_episodes
from ...errors import (
    InvalidActionError,
    OptionValueError,
    StoreError,
    UnknownPointError,
    short_repr,
)
from ...files.lines import Lines
from ...files.values import digest_of
from ...simulation import Action, Model, Observation
from .forms import Message, action_of


@dataclass
class Episode:
    """A recorded episode.

    Attributes:
        header: Its first line, with the simulation, the seed, the seats and the options.
        decisions: The lines of its decisions, without those that later ones have replaced.
        turn: Where the game stands: the number of decisions before the pending one.
    """

    header: Message
    decisions: list[Message] = field(default_factory=list)
    turn: int = 0

    def add(self, line: Message) -> None:
        """Add a line: a decision, or a move to another turn.

        Raises:
            ValueError: The line before it is missing.
        """
        if not 0 <= line["turn"] <= len(self.decisions):
            raise ValueError(f"the decision before turn {line['turn']} is missing")
        self.turn = line["turn"]
        if "agent" in line:
            self.decisions[self.turn :] = [line]
            self.turn += 1


def follow(episodes: list[Episode], line: Message) -> None:
    """Add a line to the episodes that the lines before it describe.

    Raises:
        ValueError, LookupError: The line does not fit the lines before it.
    """
    if "seed" in line:
        episodes.append(Episode(line))
    elif line.get("back"):
        episodes.pop()  # the game before the restart goes on
    else:
        episodes[-1].add(line)


def read(path: str | os.PathLike[str]) -> list[Episode]:
    """Read the episodes of a recording.

    A decision replaces the earlier ones from its turn on, which were undone. A line that a crash
    has torn is left out.

    Raises:
        StoreError: The file cannot be read, or the lines do not fit together.
    """
    episodes: list[Episode] = []
    try:
        for _, line in Lines(path).read():
            follow(episodes, line)
        if not episodes and Path(path).stat().st_size:
            raise ValueError("it has no episode")
    except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise StoreError(f"the recording {path} cannot be read: {error!r}") from error
    return episodes


def replay(
    path: str | os.PathLike[str],
    simulation: Model,
    points: Points = None,
    *,
    episode: int = -1,
    **options: Unpack[EpisodeOptions],
) -> dict[str, Trajectories]:
    """Repeat a recorded episode, bit for bit.

    Args:
        path: The file of ``--record``.
        simulation: The simulation that was played, as ``aec_env`` takes it.
        points: As ``aec_env`` takes them.
        episode: The index of the episode in the file. It is truncated after its last recorded
            decision.
        **options: The options of ``aec_env``, as they were in the recorded episode. The file has
            ``skip_forced``.

    Returns:
        A dict from the name of each agent to its ``Trajectories``, which ``save_dataset`` writes.
        Decisions of people and policies have ``by_rule`` False.

    Raises:
        StoreError: The file cannot be read.
        OptionValueError: There is no such episode, or the simulation does not repeat it.
    """
    episodes = read(path)
    if not -len(episodes) <= episode < len(episodes) or not episodes[episode].decisions:
        raise OptionValueError(
            f"nothing was decided in episode {episode} of the {len(episodes)} of {path}"
        )
    header = episodes[episode].header
    decisions = episodes[episode].decisions
    lines = iter(decisions)
    problem = f"{short_repr(simulation)} does not repeat {path}"

    def answer(observation: Observation, *, _decision: Decision) -> Action:
        line = next(lines)
        agent = _decision.agent
        if agent != line["agent"] or digest_of(observation) != line["seen"]:
            raise OptionValueError(
                f"{problem}: decision {line['turn']} was one of {line['agent']!r}, and is now one"
                f" of {agent!r}, or with another observation"
            )
        return action_of(_decision.action_space, line["action"])

    if header.get("skip_forced"):
        options.setdefault("skip_forced", True)
    options["max_steps"] = len(decisions)
    try:
        trajectories = collect_episodes(
            simulation,
            {line["agent"]: answer for line in decisions},
            seeds=[header["seed"]],
            points=points,
            **options,
        )
    except (InvalidActionError, UnknownPointError) as error:
        raise OptionValueError(f"{problem}: {error}") from error
    missing = list(lines)
    if missing:
        raise OptionValueError(f"{problem}: it ends before decision {missing[0]['turn']}")
    return trajectories
