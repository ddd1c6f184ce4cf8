"""Recordings of the page, and the episodes that they describe."""

import os
from pathlib import Path
from typing import Unpack

from ...core import Decision, EpisodeOptions, Points
from ...data import Trajectories, collect_episodes
from ...errors import (
    EpisodeFileError,
    InvalidActionError,
    OptionValueError,
    StoreError,
    UnknownPointError,
    short_repr,
)
from ...files.reader import EpisodeLines, read_episodes
from ...files.recipes import Json
from ...files.values import decode_value, digest_of
from ...simulation import RULE, Action, Model, Observation
from .forms import action_of, jsonable


def read(path: str | os.PathLike[str]) -> list[EpisodeLines]:
    """Read the episodes of a recording.

    Raises:
        StoreError: The file cannot be read, or the lines do not fit together.
    """
    try:
        return read_episodes(path) if Path(path).stat().st_size else []
    except (OSError, EpisodeFileError) as error:
        raise StoreError(f"the recording {path} cannot be read: {error}") from error


def answer_in(line: Json) -> Action:
    """Return the action of a line as JSON for the page; None for the rule."""
    action = decode_value(line["action"])
    return None if action is RULE else jsonable(action)


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
    head = episodes[episode].head
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
        return action_of(_decision.action_space, answer_in(line))

    if head["options"].get("skip_forced"):
        options.setdefault("skip_forced", True)
    options["max_steps"] = len(decisions)
    try:
        trajectories = collect_episodes(
            simulation,
            {line["agent"]: answer for line in decisions},
            seeds=[head["seed"]],
            points=points,
            **options,
        )
    except (InvalidActionError, UnknownPointError) as error:
        raise OptionValueError(f"{problem}: {error}") from error
    missing = list(lines)
    if missing:
        raise OptionValueError(f"{problem}: it ends before decision {missing[0]['turn']}")
    return trajectories
