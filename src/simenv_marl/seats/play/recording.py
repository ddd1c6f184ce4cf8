"""Recordings of what was decided on the page, and the episodes that they describe."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

from ... import RULE, aec_env
from ...data import collect_episodes
from ...errors import InvalidActionError, OptionValueError, ResetNeededError, StoreError, short_repr
from ..policies import digest_of
from .forms import action_of


def read(path: Any) -> list[tuple[int, list[dict[str, Any]]]]:
    """Read the episodes of a recording: seeds and decisions, each of which replaces those from its turn on."""
    episodes: list[tuple[int, list[dict[str, Any]]]] = []
    try:
        for text in Path(path).read_text(encoding="utf-8").splitlines():
            line = json.loads(text)
            if "seed" in line:
                episodes.append((line["seed"], []))
            else:
                episodes[-1][1][line["turn"] :] = [line]
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise StoreError(f"the recording {path} cannot be read: {error!r}") from error
    return episodes


def replay(
    path: Any, simulation: Any, points: Any = None, *, episode: int = -1, **options: Any
) -> dict[str, Any]:
    """Repeat a recorded episode, bit for bit, and return its trajectories, which ``save_dataset`` writes.

    Args:
        path: The file of ``--record``.
        simulation: The simulation that was played, as ``aec_env`` takes it.
        points: As ``aec_env`` takes them.
        episode: Which of the file's episodes: an index. It is truncated after its last recorded
            decision.
        **options: The options of ``aec_env``, as they were in the recorded episode: the page sets
            none.

    Returns:
        A dict from the name of each agent to its ``Trajectories``. What people decided has
        ``by_rule`` False.

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
    actions = list[Any]()
    try:
        with closing(aec_env(simulation, points, **options)) as env:
            env.reset(seed=seed)
            for turn, line in enumerate(decisions):
                while env.agents and (
                    env.terminations[env.agent_selection] or env.truncations[env.agent_selection]
                ):
                    env.step(None)
                agent = env.agent_selection if env.agents else ""
                if agent != line["agent"] or digest_of(env.observe(agent)) != line["seen"]:
                    raise OptionValueError(
                        f"{short_repr(simulation)} does not repeat {path}: decision {turn} was one"
                        f" of {line['agent']!r}, and is now one of {agent!r}, or with another"
                        " observation"
                    )
                action = line["action"]
                actions.append(
                    RULE if action is None else action_of(env.action_space(agent), action)
                )
                env.step(actions[-1])
    except (InvalidActionError, ResetNeededError) as error:
        raise OptionValueError(
            f"{short_repr(simulation)} does not repeat {path}: {error}"
        ) from error

    def policy(observations: Any, infos: Any, identities: Any) -> list[Any]:
        return [actions[turn] for _, turn in identities]

    agents = dict.fromkeys((line["agent"] for line in decisions), policy)
    return collect_episodes(
        simulation, agents, seeds=[seed], points=points, **{**options, "max_steps": len(actions)}
    )
