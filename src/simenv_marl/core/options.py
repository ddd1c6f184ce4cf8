"""The options of environments, checked as soon as they are given."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from inspect import cleandoc
from textwrap import indent
from typing import Any, Literal, TypedDict, TypeVar

import numpy as np
from gymnasium import spaces

from ..errors import (
    OptionValueError,
    UnknownOptionError,
    did_you_mean,
    short_repr,
)
from ..simulation import RULE

Function = TypeVar("Function", bound=Callable[..., Any])


class _CommonOptions(TypedDict, total=False):
    driver: Literal["greenlet", "thread"]
    possible_agents: Iterable[str] | Mapping[Any, Iterable[str]] | None
    undeclared: Literal["error", "rule"]
    agent: str | None
    skip_forced: bool
    clip_actions: bool
    plugins: Iterable[Any]
    global_rng: bool
    flatten: bool
    state_space: spaces.Space[Any] | Literal["observations"] | None
    render_mode: str | None


class EpisodeOptions(_CommonOptions, total=False):
    """The options of functions that run whole episodes, for editors and type checkers. ``Options`` explains each."""

    max_steps: int | None


class CheckOptions(_CommonOptions, total=False):
    """The options of functions that check a simulation and have a ``max_steps`` of their own."""

    policies: Mapping[Any, Any] | None


class ViewOptions(EpisodeOptions, total=False):
    """The options of functions that make environments."""

    policies: Mapping[Any, Any] | None


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options that every view takes.

    Attributes:
        driver: How control switches between the simulation and its user. "greenlet" is fast. "thread" is for models
            that cannot run on a greenlet, and for environments that several threads use.
        possible_agents: The names of all agents, where a callable names them: a list, or a dict from decision point to
            names. These agents are in ``agents`` from ``reset`` on.
        undeclared: What to do when an agent decides that is not in ``possible_agents``: "error" raises, "rule" lets the
            model's own rule decide.
        agent: The agent of a single view. All other agents are left to their policies or their rule. None: the only
            agent of the only active decision point.
        skip_forced: Whether a decision with one legal choice is taken without asking for an action.
        clip_actions: Whether an action outside a ``Box`` space is clipped instead of refused.
        max_steps: The number of calls of ``step`` with an action after which an episode is truncated. None: no limit.
        policies: Policies that decide instead of the environment's user: a dict from the name of an agent, or from a
            decision point (dotted name or function), to a callable. The callable gets the observation, or the
            observation and the info, and returns an action. ``RULE`` instead of a callable is the model's own rule.
        plugins: Handlers for the simulation of this environment alone. Each is a tuple of the handler, the target and
            the position, as ``attach_handler`` takes them.
        global_rng: Whether the simulation gets its own state of the global generators of ``random`` and
            ``numpy.random``. Each reset seeds them with the seed of the episode.
        flatten: Whether the joint view has vectors instead of dicts.
        state_space: The space whose shape and dtype ``state()`` has. None: ``state()`` returns what the simulation's
            own ``state()`` returns. "observations": the state is the observations of all possible agents in one
            vector, and the simulation needs no ``state()``.
        render_mode: What ``render`` returns: one of the simulation's ``render_modes``.
    """

    driver: str = "greenlet"
    possible_agents: Any = None
    undeclared: str = "error"
    agent: str | None = None
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
            raise OptionValueError(f'driver must be "greenlet" or "thread", not {short_repr(self.driver)}')
        if isinstance(self.possible_agents, str):
            raise OptionValueError(
                f"possible_agents must be a list of names, not the one name {short_repr(self.possible_agents)}"
            )
        if self.undeclared not in ("error", "rule"):
            raise OptionValueError(f'undeclared must be "error" or "rule", not {short_repr(self.undeclared)}')
        if self.agent is not None and not (isinstance(self.agent, str) and self.agent):
            raise OptionValueError(f"agent must be the name of an agent or None, not {short_repr(self.agent)}")
        for name in ("clip_actions", "global_rng", "skip_forced"):
            if not isinstance(getattr(self, name), bool):
                raise OptionValueError(f"{name} must be True or False, not {short_repr(getattr(self, name))}")
        state_space = self.state_space
        if not (state_space is None or isinstance(state_space, spaces.Space) or state_space == "observations"):
            raise OptionValueError(
                f'state_space must be a gymnasium space or "observations", not {short_repr(state_space)}'
            )
        steps = self.max_steps
        if steps is not None and (isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1):
            raise OptionValueError(f"max_steps must be a positive integer or None, not {short_repr(steps)}")
        if self.policies is not None and not isinstance(self.policies, Mapping):
            raise OptionValueError(
                f"policies must be a dict from agents or points to callables, not {short_repr(self.policies)}"
            )
        if self.possible_agents is not None:  # it may be an iterator, and is read by every environment
            object.__setattr__(self, "possible_agents", _listed(self.possible_agents))
        for key, policy in (self.policies or {}).items():
            if policy is not RULE and not callable(policy):
                raise OptionValueError(
                    f"the policy of {short_repr(key)} must be a callable or RULE, not {short_repr(policy)}"
                )

        if isinstance(self.plugins, (str, Mapping)) or not isinstance(self.plugins, Iterable):
            raise OptionValueError(
                f"plugins must be a list of (handler, target, position), not {short_repr(self.plugins)}"
            )
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
                listed = ", ".join(known)
                raise UnknownOptionError(
                    f"there is no option {name!r}{did_you_mean(name, known)} (the options are {listed})"
                )
        return replace(self, **options)


def explain_options(function: Function) -> Function:
    """Decorate a function whose docstring has a line ``{options}``: put the explanations of ``Options`` there."""
    if function.__doc__ and Options.__doc__:  # neither is there under ``python -OO``
        _, _, attributes = cleandoc(Options.__doc__).partition("Attributes:\n")
        listed = re.sub(r"^    (\w+):", r"- ``\1``:", attributes, flags=re.MULTILINE).replace("\n        ", "\n  ")
        function.__doc__ = re.sub(
            r"^( +)\{options\}$", lambda line: indent(listed, line[1]), function.__doc__, flags=re.MULTILINE
        )
    return function


def _listed(names: Any) -> Any:
    if isinstance(names, Mapping):
        return {key: _listed(value) for key, value in names.items()}
    try:
        return list(names)
    except TypeError:
        raise OptionValueError(
            f"possible_agents must be names, or a dict from points to names, not {short_repr(names)}"
        ) from None
