"""Recordings of the page, and the episodes that they describe."""

import json
import os
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Unpack

from ... import aec_env
from ...core import EpisodeOptions, Points
from ...data import Trajectories, collect_episodes
from ...envs import SimulationAECEnv
from ...errors import (
    InvalidActionError,
    OptionValueError,
    ResetNeededError,
    StoreError,
    short_repr,
)
from ...simulation import Action, Model
from ..policies import digest_of
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
    actions: list[Action] = []
    problem = f"{short_repr(simulation)} does not repeat {path}"
    try:
        with closing(aec_env(simulation, points, **options)) as env:
            env.reset(seed=seed)
            for turn, line in enumerate(decisions):
                agent = _next_agent(env)
                if agent != line["agent"] or digest_of(env.observe(agent)) != line["seen"]:
                    raise OptionValueError(
                        f"{problem}: decision {turn} was one of {line['agent']!r}, and is now one"
                        f" of {agent!r}, or with another observation"
                    )
                actions.append(action_of(env.action_space(agent), line["action"]))
                env.step(actions[-1])
    except (InvalidActionError, ResetNeededError) as error:
        raise OptionValueError(f"{problem}: {error}") from error

    def policy(
        observations: object, infos: object, identities: Sequence[tuple[int, int]]
    ) -> list[Action]:
        return [actions[turn] for _, turn in identities]

    agents = {line["agent"]: policy for line in decisions}
    options["max_steps"] = len(actions)
    return collect_episodes(
        simulation,
        agents,
        seeds=[seed],
        points=points,
        **options,
    )


def _next_agent(env: SimulationAECEnv) -> str:
    """Return the agent that decides next; "" at the end of the episode."""
    while env.agents:
        agent = env.agent_selection
        if not (env.terminations[agent] or env.truncations[agent]):
            return agent
        env.step(None)
    return ""
