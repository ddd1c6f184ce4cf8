"""The options of environments, checked as soon as they are given."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from inspect import cleandoc
from math import inf
from textwrap import indent
from typing import Any, Literal, TypedDict, TypeVar

import numpy as np
from gymnasium import spaces

from ...errors import OptionValueError, UnknownOptionError, did_you_mean, short_repr
from ...simulation import RULE

Function = TypeVar("Function", bound=Callable[..., Any])

_ARGUMENTS = """Args:
    simulation: A simulation (which every environment copies), its class, a zero-argument factory, or a ``Variant``.
    points: The active decision points: a dotted name, a decision function, a list of these, or a dict from dotted name
        or function to its definition. With a dict, the model needs no decorators. None: the simulation's attribute
        ``points``, else all decorated points, which must then belong to one package."""
_RAISES = """Raises:
    SimEnvError: Something cannot work. The subclass tells what."""


class _CommonOptions(TypedDict, total=False):
    """Options for editors and type checkers. ``Options`` explains each."""

    driver: Literal["greenlet", "thread"]
    possible_agents: Iterable[str] | Mapping[Any, Iterable[str]] | None
    undeclared: Literal["error", "rule"]
    agent: str | None
    skip_forced: bool
    clip_actions: bool
    discount_rate: float | None
    plugins: Iterable[Any]
    global_rng: bool
    flatten: bool
    state_space: spaces.Space[Any] | Literal["observations"] | None
    render_mode: str | None


class EpisodeOptions(_CommonOptions, total=False):
    """The options of functions that run whole episodes."""

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
        driver: How control switches between the simulation and its user. "greenlet" is fast.
            "thread" is for models that cannot run on a greenlet, and for environments that several
            threads use.
        possible_agents: The names of all agents, where a callable names them: a list, or a dict
            from decision point to names. These agents are in ``agents`` from ``reset`` on.
        undeclared: What to do when an agent decides that is not in ``possible_agents``: "error"
            raises, "rule" lets the model's own rule decide.
        agent: The agent of a single view. All other agents are left to their policies or their
            rule. None: the only agent of the only active decision point.
        skip_forced: Whether a decision with one legal choice is taken without asking for an action.
        clip_actions: Whether an action outside a ``Box`` space is clipped instead of refused.
        discount_rate: The rate of continuous discounting, per unit of the simulation's ``time()``.
            Each info that has ``elapsed`` then has ``discount``, which is exp(-discount_rate *
            elapsed). None: infos have no discount.
        max_steps: The number of calls of ``step`` with an action after which an episode is
            truncated. None: no limit.
        policies: Policies that decide instead of the environment's user: a dict from the name of an
            agent, or from a decision point (dotted name or function), to a callable. The callable
            gets the observation, or the observation and the info, and returns an action. ``RULE``
            instead of a callable is the model's own rule.
        plugins: Handlers for the simulation of this environment alone. Each is a tuple of the
            handler, the target and the position, as ``attach_handler`` takes them.
        global_rng: Whether the simulation gets its own state of the global generators of ``random``
            and ``numpy.random``. Each reset seeds them with the seed of the episode.
        flatten: Whether the joint view has vectors instead of dicts.
        state_space: The space whose shape and dtype ``state()`` has. None: ``state()`` returns what
            the simulation's own ``state()`` returns. "observations": the state is the observations
            of all possible agents in one vector, and the simulation needs no ``state()``.
        render_mode: What ``render`` returns: one of the simulation's ``render_modes``.
    """

    driver: str = "greenlet"
    possible_agents: Any = None
    undeclared: str = "error"
    agent: str | None = None
    skip_forced: bool = False
    clip_actions: bool = False
    discount_rate: float | None = None
    max_steps: int | None = None
    policies: Mapping[Any, Any] | None = None
    plugins: Iterable[Any] = ()
    global_rng: bool = False
    flatten: bool = False
    state_space: spaces.Space[Any] | str | None = None
    render_mode: str | None = None

    def __post_init__(self) -> None:
        agents, agent, space, steps = (
            self.possible_agents,
            self.agent,
            self.state_space,
            self.max_steps,
        )
        rate: Any = self.discount_rate
        groups = (
            agents.values() if isinstance(agents, Mapping) else () if agents is None else (agents,)
        )
        is_space = space is None or isinstance(space, spaces.Space) or space == "observations"
        is_count = (
            isinstance(steps, (int, np.integer)) and not isinstance(steps, bool) and steps >= 1
        )
        is_rate = (
            isinstance(rate, (int, float, np.number))
            and not isinstance(rate, bool)
            and 0 <= rate < inf
        )
        policies = {} if self.policies is None else self.policies
        for name, is_allowed, expected in (
            ("driver", self.driver in ("greenlet", "thread"), '"greenlet" or "thread"'),
            (
                "possible_agents",
                all(map(_is_list, groups)),
                "a list of names, or a dict from points to lists of names",
            ),
            ("undeclared", self.undeclared in ("error", "rule"), '"error" or "rule"'),
            (
                "agent",
                agent is None or (isinstance(agent, str) and agent),
                "the name of an agent or None",
            ),
            (
                "discount_rate",
                rate is None or is_rate,
                "a finite number that is not negative, or None",
            ),
            ("clip_actions", isinstance(self.clip_actions, bool), "True or False"),
            ("global_rng", isinstance(self.global_rng, bool), "True or False"),
            ("skip_forced", isinstance(self.skip_forced, bool), "True or False"),
            ("state_space", is_space, 'a gymnasium space or "observations"'),
            ("render_mode", isinstance(self.render_mode, str | None), "a string or None"),
            ("max_steps", steps is None or is_count, "a positive integer or None"),
            (
                "policies",
                isinstance(policies, Mapping),
                "a dict from agents or points to callables",
            ),
            ("plugins", _is_list(self.plugins), "a list of (handler, target, position)"),
        ):
            if not is_allowed:
                raise OptionValueError(
                    f"{name} must be {expected}, not {short_repr(getattr(self, name))}"
                )
        for key, policy in policies.items():
            if policy is not RULE and not callable(policy):
                raise OptionValueError(
                    f"the policy of {short_repr(key)} must be a callable or RULE, not"
                    f" {short_repr(policy)}"
                )
        # They may be iterators, and every environment reads them.
        if isinstance(agents, Mapping):
            object.__setattr__(
                self, "possible_agents", {key: list(names) for key, names in agents.items()}
            )
        elif agents is not None:
            object.__setattr__(self, "possible_agents", list(agents))
        object.__setattr__(self, "plugins", tuple(self.plugins))

    @property
    def picture_mode(self) -> str | None:
        """The mode in which the simulation renders: ``render_mode`` without the ``_list`` of collected pictures."""
        return self.render_mode and self.render_mode.removesuffix("_list")

    @property
    def shows(self) -> bool:
        """Whether each reset and step renders: for people, or to collect pictures."""
        return self.picture_mode == "human" or self.picture_mode != self.render_mode

    def amended(self, options: Mapping[str, Any]) -> Options:
        """The same options, but for those that are given.

        Raise an error for an unknown name or a wrong value.
        """
        known = [field.name for field in fields(self)]
        for name in options:
            if name not in known:
                hint = did_you_mean(name, known)
                raise UnknownOptionError(
                    f"there is no option {name!r}{hint} (the options are {', '.join(known)})"
                )
        return replace(self, **options)


def explain_arguments(function: Function) -> Function:
    """Decorate a function that makes environments: complete its docstring.

    ``{arguments}`` becomes the arguments that all these functions have, and ``{options}`` the
    explanations of ``Options`` and the errors.
    """
    if function.__doc__ and Options.__doc__:  # neither is there under ``python -OO``
        _, _, attributes = cleandoc(Options.__doc__).partition("Attributes:\n")
        listed = re.sub(r"^    (\w+):", r"- ``\1``:", attributes, flags=re.MULTILINE).replace(
            "\n        ", "\n  "
        )
        options = f"**options: Any of these:\n\n{indent(listed, ' ' * 8)}\n\n{_RAISES}"
        function.__doc__ = (
            cleandoc(function.__doc__)
            .replace("{arguments}", _ARGUMENTS)
            .replace("{options}", options)
        )
    return function


def _is_list(value: Any) -> bool:
    return isinstance(value, Iterable) and not isinstance(value, (str, Mapping))
