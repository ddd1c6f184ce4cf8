"""Recordings of the page, and the episodes that they describe."""

import json
import os
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
from ...simulation import Action, Model, Observation
from ..recordings import digest_of
from .forms import Message, action_of

Episode = tuple[int, list[Message]]
"""The seed of an episode, and the lines of its decisions."""


def read(path: str | os.PathLike[str]) -> list[Episode]:
    """Read the episodes of a recording: seeds and decisions.

    A decision replaces the earlier ones from its turn on, which were undone.
    """
    episodes: list[Episode] = []
    try:
        for text in Path(path).read_text(encoding="utf-8").splitlines():
            line = json.loads(text)
            if "seed" in line:
                episodes.append((line["seed"], []))
            else:
                _, decisions = episodes[-1]
                decisions[line["turn"] :] = [line]
    except (OSError, ValueError, TypeError, LookupError) as error:
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
        **options: The options of ``aec_env``, as they were in the recorded episode: the page sets
            none.

    Returns:
        A dict from the name of each agent to its ``Trajectories``, which ``save_dataset`` writes.
        Decisions of people have ``by_rule`` False.

    Raises:
        StoreError: The file cannot be read.
        OptionValueError: There is no such episode, or the simulation does not repeat it.
    """
    episodes = read(path)
    if not -len(episodes) <= episode < len(episodes) or not episodes[episode][1]:
        raise OptionValueError(
            f"nothing was decided in episode {episode} of the {len(episodes)} of {path}"
        )
    seed, decisions = episodes[episode]
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

    options["max_steps"] = len(decisions)
    try:
        trajectories = collect_episodes(
            simulation,
            {line["agent"]: answer for line in decisions},
            seeds=[seed],
            points=points,
            **options,
        )
    except (InvalidActionError, UnknownPointError) as error:
        raise OptionValueError(f"{problem}: {error}") from error
    missing = list(lines)
    if missing:
        raise OptionValueError(f"{problem}: it ends before decision {missing[0]['turn']}")
    return trajectories
