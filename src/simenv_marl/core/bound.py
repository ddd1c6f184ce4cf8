"""Decision points under one environment's definitions, made ready to be called."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces as gym_spaces

from ..decision import DecisionPoint, Definition, inverse
from ..errors import InvalidActionError, MaskError, shown, warn_user
from . import spaces
from .points import NamedPoint
from .spaces import ILLEGAL, MASK

Policy = Callable[[Any, dict[str, Any]], Any]
"""A policy as the episode calls it: of the observation and the info, returns the action."""


class DeferredPolicy:
    """A policy that answers many decisions at once: an episode waits for it as it waits for its user."""


class BoundPoint:
    """A decision point under one environment's definition. Holds nothing of any episode.

    Attributes:
        point: The decision point.
        definition: Its definition.
        agent: The name of its agent; None where ``name_agent`` tells it at each call.
        name_agent: A callable of the call's arguments; None where ``agent`` tells it.
        policy: The policy that answers all its decisions; None: its agents' own policies, or the environment's user.
        reward_mapping, observation_mapping: The mappings.
        cast: Casts observations to their space.
        check: Checks an action against its space; returns it as its mapping is to receive it, or ``ILLEGAL``.
        convert: Turns a checked action into the reply to the simulation.
        legal: Returns the mask of a call, and the choices if it has any; None where all actions are always legal.
        deliver: In the simulation, turns the reply into what a call of the decision function returns; None where the
            reply is that.
        tells: Whether infos tell which action a decision of the rule corresponds to.
        recorded: Whether the episode is told what the rule decides.
        told: The event that tells it; None if it is not told.
        settle: Rewards and observes the agents of the point.
        one_entity: Whether all its decisions are taken to be those of one object, since nothing was said of agents.
    """

    __slots__ = (
        "_inverse", "agent", "cast", "check", "convert", "definition", "deliver", "legal", "masked_parts",
        "name_agent", "observation_mapping", "one_entity", "point", "policy", "recorded", "reward_mapping", "settle",
        "tells", "told",
    )  # fmt: skip

    def __init__(
        self, named: NamedPoint, agent: str | None, policy: Policy | None = None, *, recorded: bool = False
    ) -> None:
        """Bind a decision point.

        Args:
            named: The decision point, and its definition.
            agent: The name of its agent; None where it has many.
            policy: The policy that answers all its decisions.
            recorded: Whether decisions are recorded, those of the rule included.
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
        self.check = spaces.action_check(definition.action_space)
        self.convert: Any = definition.action_space_mapping or _same
        self.deliver = _delivery(definition, named.point.kind)
        self.tells = definition.rule_action_mapping is not None
        self._inverse = inverse(definition)
        readable = definition.choices is not None or self._inverse is not None
        self.recorded = self.tells or (recorded and readable)
        self.masked_parts = _masked_parts(definition.observation_space)
        self.told: Any = None
        self.settle: Any = None
        self.one_entity = definition.agent is None and named.point.hook.bound
        self.legal = _legal(definition, named.point.name)

    def warn_of_several(self, agent: str) -> None:
        """Warn that several objects decide under one name; once."""
        self.one_entity = False
        warn_user(
            f"several objects decide at {self.point.name} as one agent, {agent!r}: their rewards and differences mix."
            " Give its make_step agent=, a callable that names an agent for each; or a string, where one agent is meant"
        )

    # -- observations -----------------------------------------------------------------------------

    def observe(self, args: tuple[Any, ...], kwargs: dict[str, Any], mask: Any) -> Any:
        """Observe a call, and put its mask where the observation space has a place for it.

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
        """Make the observation of an agent that was not observed yet: zero, and with all actions legal."""
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
        return spaces.open_mask(self.definition.action_space)

    def allows(self, mask: Any, action: Any) -> bool:
        """Whether a mask allows an action that is in the space."""
        return spaces.mask_allows(self.definition.action_space, mask, action)

    def checked(self, action: Any, agent: str, mask: Any) -> Any:
        """Check an action.

        Args:
            action: The action.
            agent: The agent whose action it is.
            mask: Which actions are legal; None: all of the space.

        Returns:
            The action as ``convert`` takes it.

        Raises:
            InvalidActionError: The action is not legal.
        """
        legal = self.check(action)
        if legal is ILLEGAL:
            raise InvalidActionError(
                f"the action {shown(action)} of {agent!r} is not in its action space"
                f" {shown(self.definition.action_space)}"
            )
        if mask is not None and not self.allows(mask, legal):
            raise InvalidActionError(f"the action {shown(action)} of {agent!r} is masked; its mask is {shown(mask)}")
        return legal

    def rule_action(self, decision: Any, args: tuple[Any, ...], kwargs: dict[str, Any], choices: Any) -> Any:
        """Find the action that a decision of the rule corresponds to.

        Args:
            decision: The decision.
            args: The arguments of the call that was decided.
            kwargs: Those passed by keyword.
            choices: The choices of the call, where the point has choices.

        Returns:
            The action; None if no action corresponds.

        Raises:
            InvalidActionError: The action that corresponds is not in the action space.
        """
        definition = self.definition
        if definition.rule_action_mapping is not None:
            action = definition.rule_action_mapping(decision, *args, **kwargs)
            legal = None if action is None else self.check(action)
            if legal is ILLEGAL:
                raise InvalidActionError(
                    f"rule_action_mapping of {self.point.name} says that the rule's decision {shown(decision)} is the"
                    f" action {shown(action)}, which is not in its action space {shown(definition.action_space)}"
                )
            return legal
        if choices is not None:
            same = (place for place, choice in enumerate(choices) if choice is decision or choice == decision)
            return next(same, None)
        try:
            return None if self._inverse is None else self._inverse.get(decision)
        except TypeError:  # a decision that cannot be looked up
            return None


def _same(action: Any) -> Any:
    return action


def _masked_parts(space: gym_spaces.Space[Any]) -> list[str]:
    """The keys of those parts of an observation that hold a mask; "" stands for the whole observation."""
    parts: dict[str, Any] = {"": space}
    if isinstance(space, gym_spaces.Dict) and "desired_goal" in space.spaces:
        parts["observation"] = space["observation"]
    return [key for key, part in parts.items() if isinstance(part, gym_spaces.Dict) and MASK in part.spaces]


# -- legal actions --------------------------------------------------------------------------------


def _legal(definition: Definition, name: str) -> Callable[[Any, Any], tuple[Any, Any]] | None:
    space: Any = definition.action_space
    if definition.action_mask_mapping is not None:
        return partial(_masked, definition.action_mask_mapping, spaces.mask_cast(space))
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
    """Make what turns a reply into the value of a call, which for a generator function is a generator."""
    apply = definition.apply if definition.choices is None else _unboxed
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
    """The choice in a box, in which it crosses so that the user's side keeps nothing of it alive."""
    return box.pop()


def _returning(value: Any) -> Any:
    return value
    yield


async def _awaiting(value: Any) -> Any:
    return value
