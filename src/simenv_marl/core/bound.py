"""Decision points bound to the definitions of one environment, ready to be called."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import FunctionType
from typing import Any, Final

import numpy as np
from gymnasium import spaces as gym_spaces

from ..decision import DecisionPoint, Definition, inverse
from ..errors import InvalidActionError, MaskError, short_repr, warn_user
from . import actions, spaces
from .actions import ILLEGAL, MASK
from .points import NamedPoint

Policy = Callable[[Any, dict[str, Any]], Any]
"""A policy as the episode calls it: it takes the observation and the info, and returns the action."""


class DeferredPolicy:
    """A policy that answers many decisions in one call. An episode waits for it as it waits for the user."""

    def alone(self, episode: Any, agent: Any) -> Any:
        """Answer one decision at once, in an episode that is a branch and waits for one agent only."""
        raise NotImplementedError


MAPPINGS: Final = (
    "observation_space_mapping", "action_space_mapping", "reward_mapping", "apply", "choices", "rule_action_mapping",
    "agent", "action_mask_mapping", "achieved_goal_mapping", "desired_goal_mapping",
)  # fmt: skip
"""The parts of a definition, besides ``removed_by``, that get the simulation if they ask for it."""


def asks_for_simulation(function: Any) -> bool:
    """Whether a mapping has a keyword-only parameter ``_simulation``."""
    return asks_for(function, "_simulation")


def asks_for(function: Any, name: str) -> bool:
    """Whether a function has a keyword-only parameter with a given name."""
    if not callable(function):
        return False
    if type(function) is FunctionType and not hasattr(function, "__wrapped__"):
        code = function.__code__
        return name in code.co_varnames[code.co_argcount : code.co_argcount + code.co_kwonlyargcount]
    try:
        parameter = inspect.signature(function).parameters.get(name)
    except (TypeError, ValueError):
        return False
    if parameter is None or parameter.kind is not parameter.KEYWORD_ONLY:
        return False
    own = inspect.signature(function, follow_wrapped=False).parameters  # a wrapper may pass it on as **kwargs
    return name in own or any(p.kind is p.VAR_KEYWORD for p in own.values())


def given_simulation(definition: Definition, simulation: Any) -> Definition:
    """Give the simulation to the mappings of a definition that ask for it.

    Args:
        definition: The definition.
        simulation: The simulation. None serves to find out whether any mapping asks.

    Returns:
        The changed definition; the given definition itself if no mapping asks.
    """

    def given(function: Any) -> Any:
        return partial(function, _simulation=simulation) if asks_for_simulation(function) else function

    changes = {name: given(getattr(definition, name)) for name in MAPPINGS}
    changes = {name: function for name, function in changes.items() if function is not getattr(definition, name)}
    removals = {name: given(agent) for name, agent in definition.removed_by.items()}
    if removals != definition.removed_by:
        changes["removed_by"] = removals
    return replace(definition, **changes) if changes else definition


class BoundPoint:
    """A decision point bound to the definition of one environment. It holds no state of any episode.

    Attributes:
        point: The decision point.
        definition: The definition.
        agent: The name of the agent. None if ``name_agent`` names it at each call.
        name_agent: A callable that takes the call's arguments and names the agent. None if ``agent`` names it.
        policy: The policy that answers all decisions of the point. None: the agents' own policies answer them, or the
            environment's user does.
        reward_mapping, observation_mapping: The mappings.
        cast: Casts an observation to the observation space.
        finite: Raises for an observation that is not finite where its space is bounded. None if no bound is finite.
        check: Checks an action against the action space. Returns it in the form that its mapping receives, or
            ``ILLEGAL``.
        convert: Turns a checked action into the reply to the simulation.
        legal: Returns the mask of a call, and its choices if it has any. None if all actions are always legal.
        deliver: Turns the reply, on the simulation's side, into the value that the decision function returns. None if
            the reply is that value.
        tells: Whether infos contain the action that corresponds to a decision of the rule.
        recorded: Whether the simulation reports the rule's decisions to the episode.
        told: The event that reports them. None if they are not reported.
        settle: Rewards and observes the agents of the point.
        one_entity: Whether one object is expected to make all decisions, because the definition does not name agents.
    """

    __slots__ = (
        "_inverse", "_rule_action", "agent", "cast", "check", "convert", "definition", "deliver", "finite", "legal",
        "masked_parts", "name_agent", "observation_mapping", "one_entity", "point", "policy", "recorded",
        "reward_mapping", "settle", "tells", "told",
    )  # fmt: skip

    def __init__(
        self,
        named: NamedPoint,
        agent: str | None,
        policy: Policy | None = None,
        *,
        recorded: bool = False,
        clips: bool = False,
    ) -> None:
        """Bind a decision point.

        Args:
            named: The decision point and its definition.
            agent: The name of its agent. None if a callable names its agents.
            policy: The policy that answers all decisions of the point.
            recorded: Whether decisions are recorded, including those of the rule.
            clips: Whether actions outside a ``Box`` are clipped.
        """
        definition = named.definition
        self.point: DecisionPoint = named.point
        self.definition: Definition = definition
        self.agent = agent
        self.name_agent: Any = definition.agent if agent is None else None
        self.policy = policy
        self.reward_mapping: Any = definition.reward_mapping
        self.observation_mapping: Any = definition.observation_space_mapping
        self.cast = spaces.observation_cast(definition.observation_space)
        self.finite = spaces.finite_check(definition.observation_space)
        self.check = (actions.clipping_check if clips else actions.action_check)(definition.action_space)
        self.convert: Any = definition.action_space_mapping or _same
        self.deliver = _delivery(definition, named.point.hook.kind)
        self.tells = definition.rule_action_mapping is not None
        self._rule_action = _rule_action(definition.rule_action_mapping)
        self._inverse = inverse(definition)
        readable = definition.choices is not None or self._inverse is not None
        self.recorded = self.tells or (recorded and readable)
        self.masked_parts = _masked_parts(definition.observation_space)
        self.told: Any = None
        self.settle: Any = None
        self.one_entity = definition.agent is None and named.point.hook.bound
        self.legal = _legal(definition, named.point.name)

    def warn_of_several(self, agent: str) -> None:
        """Warn once that several objects decide under the name of one agent."""
        self.one_entity = False
        warn_user(
            f"several objects decide at {self.point.name} as one agent, {agent!r}: their rewards and differences mix."
            " Set agent= of its make_step to a callable that names an agent for each object, or to a string if one"
            " agent is meant"
        )

    # -- observations -----------------------------------------------------------------------------

    def observe(self, args: tuple[Any, ...], kwargs: dict[str, Any], mask: Any) -> Any:
        """Observe a call. Where the observation space has an entry for the action mask, put the mask there.

        Raises:
            ObservationError: The observation does not fit its space.
        """
        value = self.observation_mapping(*args, **kwargs)
        for part in self.masked_parts:
            if part and isinstance(value[part], Mapping):
                value = {**value, part: {**value[part], MASK: mask}}
            elif not part and isinstance(value, Mapping):
                value = {**value, MASK: mask}
        return self.cast(value)

    def blank(self) -> Any:
        """Make the observation of an agent that was not observed yet: zero, with all actions legal."""
        observation = spaces.blank(self.definition.observation_space)
        if self.legal is None or not self.masked_parts:
            return observation
        for part in self.masked_parts:
            whole = observation[part] if part else observation
            whole[MASK] = self.open_mask()
        return self.cast(observation)

    # -- actions ----------------------------------------------------------------------------------

    def open_mask(self) -> Any:
        """Make the mask that allows all actions."""
        return actions.open_mask(self.definition.action_space)

    def allows(self, mask: Any, action: Any) -> bool:
        """Whether a mask allows an action that is in the space."""
        return actions.mask_allows(self.definition.action_space, mask, action)

    def checked(self, action: Any, agent: str, mask: Any) -> Any:
        """Check an action.

        Args:
            action: The action.
            agent: The agent whose action it is.
            mask: The mask of the legal actions. None: all actions of the space are legal.

        Returns:
            The action in the form that ``convert`` takes.

        Raises:
            InvalidActionError: The action is not legal.
        """
        legal = self.check(action)
        if legal is ILLEGAL:
            raise InvalidActionError(
                f"the action {short_repr(action)} of {agent!r} is not in its action space"
                f" {short_repr(self.definition.action_space)}"
            )
        if mask is not None and not self.allows(mask, legal):
            raise InvalidActionError(
                f"the action {short_repr(action)} of {agent!r} is masked; its mask is {short_repr(mask)}"
            )
        return legal

    def rule_action(self, decision: Any, args: tuple[Any, ...], kwargs: dict[str, Any], choices: Any) -> Any:
        """Find the action that a decision of the rule corresponds to.

        Args:
            decision: The decision.
            args: The positional arguments of the call that was decided.
            kwargs: Its keyword arguments.
            choices: The choices of the call, if the point has choices.

        Returns:
            The action; None if no action corresponds.

        Raises:
            InvalidActionError: The corresponding action is not in the action space.
        """
        definition = self.definition
        if self._rule_action is not None:
            action = self._rule_action(decision, *args, **kwargs)
            legal = None if action is None else self.check(action)
            if legal is ILLEGAL:
                raise InvalidActionError(
                    f"rule_action_mapping of {self.point.name} maps the rule's decision {short_repr(decision)} to the"
                    f" action {short_repr(action)}, which is not in its action space"
                    f" {short_repr(definition.action_space)}"
                )
            return legal
        if choices is not None:
            same = (place for place, choice in enumerate(choices) if choice is decision or choice == decision)
            return next(same, None)
        try:
            return None if self._inverse is None else self._inverse.get(decision)
        except TypeError:  # the decision is not hashable
            return None


def _same(action: Any) -> Any:
    return action


def _masked_parts(space: gym_spaces.Space[Any]) -> list[str]:
    """The keys of the parts of an observation that contain a mask; "" stands for the whole observation."""
    parts: dict[str, Any] = {"": space}
    if isinstance(space, gym_spaces.Dict) and "desired_goal" in space.spaces:
        parts["observation"] = space["observation"]
    return [key for key, part in parts.items() if isinstance(part, gym_spaces.Dict) and MASK in part.spaces]


# -- actions of the rule --------------------------------------------------------------------------


def _rule_action(mapping: Any) -> Callable[..., Any] | None:
    """Make ``rule_action_mapping``, a dict or a callable, a function of the decision and the call's arguments."""
    if mapping is None:
        return None
    return _look_back(mapping) if isinstance(mapping, Mapping) else _of_decision(mapping)


def _look_back(actions: Mapping[Any, Any]) -> Callable[..., Any]:
    known = dict(actions)

    def look_back(decision: Any, *args: Any, **kwargs: Any) -> Any:
        try:
            return known[decision]
        except (KeyError, TypeError):
            raise InvalidActionError(
                "the dict rule_action_mapping has no action for the rule's decision"
                f" {short_repr(decision)}; add one, or"
                " pass a callable that returns None where no action corresponds"
            ) from None

    return look_back


def _of_decision(mapping: Callable[..., Any]) -> Callable[..., Any]:
    """Make a mapping a function of the decision and the call's arguments, even if it takes the decision only."""
    try:
        parameters = list(inspect.signature(mapping).parameters.values())
    except (TypeError, ValueError):
        parameters = []
    positional = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if any(p.default is p.empty for p in positional[1:]) or any(p.kind is p.VAR_POSITIONAL for p in parameters):
        return mapping
    return lambda decision, *args, **kwargs: mapping(decision)


# -- legal actions --------------------------------------------------------------------------------


def _legal(definition: Definition, name: str) -> Callable[[Any, Any], tuple[Any, Any]] | None:
    space: Any = definition.action_space
    if definition.action_mask_mapping is not None:
        return partial(_masked, definition.action_mask_mapping, actions.mask_cast(space))
    if definition.choices is not None:
        return partial(_chosen, definition.choices, int(space.n), name)
    return None


def _masked(mapping: Callable[..., Any], cast: Callable[[Any], Any], args: Any, kwargs: Any) -> tuple[Any, None]:
    return cast(mapping(*args, **kwargs)), None


def _chosen(mapping: Callable[..., Any], most: int, name: str, args: Any, kwargs: Any) -> tuple[Any, Any]:
    choices = list(mapping(*args, **kwargs))
    if not 1 <= len(choices) <= most:
        raise MaskError(f"{name} has {len(choices)} choices; its action space holds 1 to {most}")
    mask = np.zeros(most, np.int8)
    mask[: len(choices)] = 1
    return mask, choices


# -- in the simulation ----------------------------------------------------------------------------


def _delivery(definition: Definition, kind: str) -> Callable[..., Any] | None:
    """Make the function that turns a reply into the value of a call; for a generator function that is a generator."""
    apply = definition.apply
    if definition.choices is not None:
        apply = _unboxed if apply is None else partial(_applied, apply)
    if kind == "function":
        return apply
    wrap = _returning if kind == "generator" else _awaiting
    if apply is None:
        return lambda reply, *args, **kwargs: wrap(reply)

    def deliver(reply: Any, *args: Any, **kwargs: Any) -> Any:
        value = apply(reply, *args, **kwargs)
        return value if inspect.isgenerator(value) or inspect.isawaitable(value) else wrap(value)

    return deliver


def _unboxed(box: list[Any], *args: Any, **kwargs: Any) -> Any:
    """Take the choice out of its list. It crosses in a list so that the user's side keeps no reference to it."""
    return box.pop()


def _applied(apply: Callable[..., Any], box: list[Any], *args: Any, **kwargs: Any) -> Any:
    """Call ``apply`` with the choice, which crosses in a list."""
    return apply(box.pop(), *args, **kwargs)


def _returning(value: Any) -> Any:
    return value
    yield


async def _awaiting(value: Any) -> Any:
    return value
