"""The options of environments, checked as soon as they are given."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import Any

import numpy as np
from gymnasium import spaces

from ..errors import (
    OptionValueError,
    UnknownOptionError,
    shown,
)
from ..simulation import RULE


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options that every view takes.

    Attributes:
        driver: What switches between the simulation and its user: "greenlet", or "thread" for what cannot live
            on a greenlet and for environments that are used from changing threads.
        possible_agents: The roster, where agents are named by a callable: their names, or a dict from
            decision point to names. Declared agents are there from ``reset`` on.
        undeclared: What a decision of an agent outside the roster becomes: "error", or "rule".
        agent: The one agent of a single view, all others being left to their policies or their rule; None: the one
            agent of the one active decision point.
        padded: Whether all agents of the roster stand in ``agents`` from the reset to the end of an episode: also those
            who are yet to be born or whom the model has removed, as agents that do not decide.
        skip_forced: Whether decisions with one legal choice are answered with it, without asking for an action.
        clip_actions: Whether actions of ``Box`` spaces that lie outside are clipped, and not refused.
        max_steps: After how many calls of ``step`` with an action an episode is truncated; None: never.
        policies: Who decides without being an agent of the environment: from the name of an agent, or from a
            decision point (dotted name or decision function), to a callable of the observation, or of the
            observation and the info, that returns an action. ``RULE`` in place of the callable stands for the
            model's own rule.
        plugins: Handlers for this environment's simulation alone: of each the handler, the target and the position,
            as ``attach_handler`` takes them.
        global_rng: Whether the simulation gets a state of its own of the global generators of ``random`` and
            ``numpy.random``, which each reset seeds with the seed of the episode.
        flatten: Whether the joint view has one vector in place of dicts.
        state_space: The space to whose shape and dtype the environment's ``state()`` is cast; None: what the
            simulation's own ``state()`` returns is taken as it is. "observations": the state is what all possible
            agents observe, in one vector, and the simulation needs no ``state()``.
        render_mode: What ``render`` returns; one of the simulation's ``render_modes``.
    """

    driver: str = "greenlet"
    possible_agents: Any = None
    undeclared: str = "error"
    agent: str | None = None
    padded: bool = False
    skip_forced: bool = False
    clip_actions: bool = False
    max_steps: int | None = None
    policies: Mapping[Any, Any] | None = None
    plugins: Iterable[Any] = ()
    global_rng: bool = False
    flatten: bool = False
    state_space: spaces.Space[Any] | str | None = None
    render_mode: str | None = None

    def __post_init__(self) -> None:
        if self.driver not in ("greenlet", "thread"):
            raise OptionValueError(f'driver must be "greenlet" or "thread", not {shown(self.driver)}')
        if isinstance(self.possible_agents, str):
            raise OptionValueError(
                f"possible_agents must be a list of names, not the one name {shown(self.possible_agents)}"
            )
        if self.undeclared not in ("error", "rule"):
            raise OptionValueError(f'undeclared must be "error" or "rule", not {shown(self.undeclared)}')
        if self.agent is not None and not (isinstance(self.agent, str) and self.agent):
            raise OptionValueError(f"agent must be the name of an agent or None, not {shown(self.agent)}")
        for name in ("clip_actions", "global_rng", "padded", "skip_forced"):
            if not isinstance(getattr(self, name), bool):
                raise OptionValueError(f"{name} must be True or False, not {shown(getattr(self, name))}")
        state_space = self.state_space
        if not (state_space is None or isinstance(state_space, spaces.Space) or state_space == "observations"):
            raise OptionValueError(f'state_space must be a gymnasium space or "observations", not {shown(state_space)}')
        steps = self.max_steps
        if steps is not None and (isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1):
            raise OptionValueError(f"max_steps must be a positive integer or None, not {shown(steps)}")
        if self.policies is not None and not isinstance(self.policies, Mapping):
            raise OptionValueError(
                f"policies must be a dict from agents or points to callables, not {shown(self.policies)}"
            )
        if self.possible_agents is not None:  # it may be an iterator, and is read by every environment
            object.__setattr__(self, "possible_agents", _listed(self.possible_agents))
        for key, policy in (self.policies or {}).items():
            if policy is not RULE and not callable(policy):
                raise OptionValueError(f"the policy of {shown(key)} must be a callable or RULE, not {shown(policy)}")

        if isinstance(self.plugins, (str, Mapping)) or not isinstance(self.plugins, Iterable):
            raise OptionValueError(f"plugins must be a list of (handler, target, position), not {shown(self.plugins)}")
        object.__setattr__(self, "plugins", tuple(self.plugins))  # an iterator is to serve more than once

    def amended(self, options: Mapping[str, Any]) -> Options:
        """The same options, but for those that are given.

        Raises:
            UnknownOptionError: There is no such option.
            OptionValueError: An option cannot have its value.
        """
        known = [field.name for field in fields(self)]
        for name in options:
            if name not in known:
                close = get_close_matches(name, known, n=1)
                hint = f"; did you mean {close[0]!r}?" if close else ""
                raise UnknownOptionError(f"there is no option {name!r}{hint} (the options are {', '.join(known)})")
        return replace(self, **options)


def _listed(names: Any) -> Any:
    if isinstance(names, Mapping):
        return {key: _listed(value) for key, value in names.items()}
    try:
        return list(names)
    except TypeError:
        raise OptionValueError(
            f"possible_agents must be names, or a dict from points to names, not {shown(names)}"
        ) from None
