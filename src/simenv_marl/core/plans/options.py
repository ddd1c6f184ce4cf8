"""The options of environments, checked as soon as they are given."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from inspect import cleandoc
from itertools import chain
from math import inf
from os import PathLike
from textwrap import indent
from typing import Any, Final, Literal, TypedDict, TypeVar

from gymnasium.spaces import Space

from ...errors import OptionValueError, UnknownOptionError, did_you_mean, short_repr
from ...simulation import RULE, is_integer, is_number

Function = TypeVar("Function", bound=Callable[..., Any])

_ARGUMENTS = """Args:
    simulation: A simulation (which every environment copies), its class, a zero-argument factory,
        or a ``Variant``.
    points: The active decision points: a dotted name, a decision function, a list of these, or a
        dict from dotted name or function to its definition. With a dict, the model needs no
        decorators. None: the simulation's attribute ``points``, else all decorated points, which
        must then belong to one package."""
_RAISES = """Raises:
    SimEnvError: An argument is invalid. The message says which."""


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
    team_reward: Callable[[Any], Any] | None
    state_in_info: bool
    state_space: Space[Any] | Literal["observations"] | None
    render_mode: str | None


class EpisodeOptions(_CommonOptions, total=False):
    """The options of functions that run whole episodes."""

    max_steps: int | None


class CheckOptions(_CommonOptions, total=False):
    """The options of functions that check a simulation and have their own ``max_steps``."""

    policies: Mapping[Any, Any] | None
    record: str | PathLike[str] | None
    record_all: bool
    step_timeout: float | None


class ViewOptions(EpisodeOptions, CheckOptions, total=False):
    """The options of functions that make environments."""


def _is_bool(value: object) -> bool:
    return isinstance(value, bool)


def _is_list(value: object) -> bool:
    if isinstance(value, (str, Mapping)):
        return False
    return isinstance(value, Iterable)


_VALID: dict[str, tuple[Callable[[Any], bool], str]] = {
    "driver": (
        lambda driver: driver in ("greenlet", "thread"),
        '"greenlet" or "thread"',
    ),
    "possible_agents": (
        lambda names: all(map(_is_list, names.values() if isinstance(names, Mapping) else [names])),
        "a list of names, or a dict from points to lists of names",
    ),
    "undeclared": (
        lambda reaction: reaction in ("error", "rule"),
        '"error" or "rule"',
    ),
    "agent": (
        lambda name: isinstance(name, str) and name != "",
        "the name of an agent or None",
    ),
    "discount_rate": (
        lambda rate: is_number(rate) and 0 <= float(rate) < inf,
        "a finite number that is not negative, or None",
    ),
    "clip_actions": (
        _is_bool,
        "True or False",
    ),
    "global_rng": (
        _is_bool,
        "True or False",
    ),
    "skip_forced": (
        _is_bool,
        "True or False",
    ),
    "state_in_info": (
        _is_bool,
        "True or False",
    ),
    "team_reward": (
        callable,
        "a callable of the simulation or None",
    ),
    "state_space": (
        lambda space: isinstance(space, Space) or space == "observations",
        'a gymnasium space or "observations"',
    ),
    "render_mode": (
        lambda mode: isinstance(mode, str),
        "a string or None",
    ),
    "max_steps": (
        lambda steps: is_integer(steps) and steps >= 1,
        "a positive integer or None",
    ),
    "policies": (
        lambda policies: isinstance(policies, Mapping),
        "a dict from agents or points to callables",
    ),
    "record": (
        lambda folder: isinstance(folder, (str, PathLike)),
        "a folder or None",
    ),
    "record_all": (
        _is_bool,
        "True or False",
    ),
    "step_timeout": (
        lambda seconds: is_number(seconds) and 0 < float(seconds) < inf,
        "a positive number of seconds or None",
    ),
    "plugins": (
        _is_list,
        "a list of (handler, target, position)",
    ),
}
"""The check of each option's value, unless it is the default, and the valid values in words."""


NOT_OF_RUNS: Final = {
    "agent": "single views",
    "record": "environments",
    "step_timeout": "environments",
}
"""The options that functions that run whole episodes refuse, and whose they are."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options that every view takes.

    Attributes:
        driver: How control switches between the simulation and its user. "greenlet" is fast.
            "thread" is for models that cannot run on a greenlet, and for environments that several
            threads use.
        possible_agents: The names of all agents, where a callable names them: a list, or a dict
            from decision point to names. These agents are in ``agents`` from ``reset`` on.
        undeclared: How to treat an agent that decides and is not in ``possible_agents``: "error"
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
        flatten: Whether joint and turn views have vectors instead of dicts.
        team_reward: One reward for all agents, in place of the ``reward_mapping`` of each: a
            callable of the simulation that returns what the team has earned since it was last
            called, such as ``difference(lambda simulation: simulation.profit)``. It is called when
            a reset and each step return. Each agent gets the sum since its previous decision; the
            joint and the turn view get it once.
        state_in_info: Whether ``info["state"]`` is ``state()``, in joint and turn views.
        state_space: The space whose shape and dtype ``state()`` has. None: ``state()`` returns the
            value of the simulation's ``state()`` as it is. "observations": the state is the
            observations of all possible agents in one vector, and the simulation needs no
            ``state()``. Agents that ``policies`` answers are no possible agents; where whole
            episodes run, only agents that policies answer are in the state.
        render_mode: The form of the result of ``render``: one of the simulation's ``render_modes``.
        record: A folder, in which each episode is written to a file while it runs. The file stays
            if an error or a kill ends the episode. ``load_episode`` loads it. None: no files.
        record_all: Whether the files of all episodes stay.
        step_timeout: The largest number of seconds that a step may take. After it, ``step`` raises
            a ``StepTimeoutError``, which shows where the model was, and the episode ends. Resets
            have no limit. With greenlets, only in the main thread. None: no limit.
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
    team_reward: Callable[[Any], Any] | None = None
    state_in_info: bool = False
    state_space: Space[Any] | str | None = None
    render_mode: str | None = None
    record: str | PathLike[str] | None = None
    record_all: bool = False
    step_timeout: float | None = None

    def __post_init__(self) -> None:
        for name, (is_valid, expected) in _VALID.items():
            value = getattr(self, name)
            if value is not getattr(Options, name) and not is_valid(value):
                raise OptionValueError(f"{name} must be {expected}, not {short_repr(value)}")
        for key, policy in (self.policies or {}).items():
            if policy is not RULE and not callable(policy):
                raise OptionValueError(
                    f"the policy of {short_repr(key)} must be a callable or RULE, not"
                    f" {short_repr(policy)}"
                )
        # Copy iterators, because each environment reads these again.
        agents = self.possible_agents
        if isinstance(agents, Mapping):
            agents = {key: list(names) for key, names in agents.items()}
        elif agents is not None:
            agents = list(agents)
        object.__setattr__(self, "possible_agents", agents)
        object.__setattr__(self, "plugins", tuple(self.plugins))

    @property
    def declared_agents(self) -> list[str]:
        """The names in ``possible_agents``."""
        declared = self.possible_agents or ()
        if isinstance(declared, Mapping):
            return list(chain.from_iterable(declared.values()))
        return list(declared)

    @property
    def picture_mode(self) -> str | None:
        """The mode of the simulation: ``render_mode`` without ``_list`` for collected pictures."""
        return self.render_mode and self.render_mode.removesuffix("_list")

    @property
    def shows(self) -> bool:
        """Whether each reset and step renders: for people, or to collect pictures."""
        if self.picture_mode == "human":
            return True
        return self.picture_mode != self.render_mode

    def amended(self, options: Mapping[str, Any]) -> Options:
        """Return these options with other values for some.

        Raises:
            UnknownOptionError: There is no option with a given name.
            OptionValueError: A value is invalid.
        """
        known = vars(self)
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
    if function.__doc__ and Options.__doc__:  # ``python -OO`` removes both
        attributes = cleandoc(Options.__doc__).partition("Attributes:\n")[2]
        items = re.sub(r"^    (\w+):", r"- ``\1``:", attributes, flags=re.MULTILINE)
        listing = indent(items.replace("\n        ", "\n  "), " " * 8)
        options = f"**options: Any of these:\n\n{listing}\n\n{_RAISES}"
        text = cleandoc(function.__doc__).replace("{arguments}", _ARGUMENTS)
        function.__doc__ = text.replace("{options}", options)
    return function
