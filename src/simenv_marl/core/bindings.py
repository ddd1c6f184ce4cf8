"""Decision points under one environment's definitions: what episodes need of them, made ready to be called."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from threading import get_ident
from typing import Any

import numpy as np
from gymnasium import spaces

from ..decision import DecisionPoint, Definition, inverse
from ..errors import (
    InvalidActionError,
    MaskError,
)
from . import spaces as _spaces
from .points import NamedPoint
from .spaces import ILLEGAL
from .switch import RUNNING

Policy = Callable[[Any, dict[str, Any]], Any]
"""A policy as the episode calls it: of the observation and the info, returns the action."""


class Binding:
    """A decision point under one environment's definition: what an episode needs, made ready to be called.

    Attributes:
        point: The decision point.
        definition: Its definition.
        agent: The name of its agent; None where ``name_agent`` tells it at each call.
        name_agent: A callable of the call's arguments; None where ``agent`` tells it.
        policy: Who answers all its decisions; None: its agents' own policies, or the environment's user.
        observe, reward: The mappings.
        cast: Casts observations to their space.
        legal: Returns the mask of a call, and the choices if it has any; None where all actions are always
            legal.
        convert: Turns a checked action into the reply to the simulation.
        deliver: In the simulation, turns the reply into what a call of the decision function returns; None
            where the reply is that.
        by_rule: In the simulation, has the rule decide a call and tells the user's side what it has decided; None
            where nobody wants to know.
        tells: Whether infos tell more than masks and times: which action the rule's decision corresponds to, or whether
            the agent is present.
        padded: Whether they tell whether it is present.
        check: Checks an action against its space.
        first, end: Which python integers are legal actions, whatever the call: from the first to before the end.
    """

    __slots__ = (
        "_masked_parts", "agent", "by_rule", "cast", "check", "convert", "definition", "deliver", "end", "first",
        "legal", "name_agent", "observe", "padded", "point", "policy", "reward", "ruled", "tells",
    )  # fmt: skip

    def __init__(
        self,
        named: NamedPoint,
        agent: str | None,
        policy: Policy | None,
        *,
        recorded: bool = False,
        padded: bool = False,
    ) -> None:
        """Make a binding.

        Args:
            named: The decision point, and its definition.
            agent: The name of its agent; None where it has many.
            policy: Who answers all its decisions.
            recorded: Whether somebody keeps what is decided, and so wants to know what the rule decides.
            padded: Whether agents are there that are not present.
        """
        definition = named.definition
        self.point: DecisionPoint = named.point
        self.definition: Definition = definition
        self.agent = agent
        self.name_agent: Any = definition.agent if agent is None else None
        self.policy = policy
        self.observe = definition.observation_space_mapping
        self.reward = definition.reward_mapping
        self.cast = _spaces.observation_cast(definition.observation_space)
        self.check = _spaces.action_check(definition.action_space)
        self.convert = definition.action_space_mapping or _same
        self.deliver = _delivery(definition, named.point.kind)
        self.padded = padded
        self.tells = padded or definition.rule_action_mapping is not None
        self.ruled = (
            Ruled(self)
            if definition.rule_action_mapping is not None or (recorded and _can_be_read_backwards(definition))
            else None
        )
        self.by_rule = None if self.ruled is None else partial(_BY_RULE[named.point.kind], self.ruled)
        space = definition.observation_space
        actions: Any = definition.action_space
        self._masked_parts = [
            path
            for path, part in (("", space), *_goal_parts(space))
            if isinstance(part, spaces.Dict) and _spaces.MASK in part.spaces
        ]
        self.legal: Callable[..., tuple[Any, Any]] | None = None
        if definition.action_mask_mapping is not None:
            self.legal = partial(_masked, definition.action_mask_mapping, _spaces.mask_cast(actions))
        elif definition.choices is not None:
            self.legal = partial(_chosen, definition.choices, int(actions.n), named.point.name)
        self.first = self.end = 0
        if isinstance(actions, spaces.Discrete) and self.legal is None:
            self.first, self.end = int(actions.start), int(actions.start + actions.n)

    @property
    def tells_of_many(self) -> bool:
        """Whether it ``tells`` something that is not over with the next decision at the point."""
        return self.padded or (self.tells and self.agent is None)

    def observation(self, args: tuple[Any, ...], kwargs: dict[str, Any], mask: Any) -> Any:
        """The observation of a call whose legal actions are known."""
        value = self.observe(*args, **kwargs)
        for part in self._masked_parts:
            if part and isinstance(value[part], Mapping):
                value = {**value, part: {**value[part], _spaces.MASK: mask}}
            elif not part and isinstance(value, Mapping):
                value = {**value, _spaces.MASK: mask}
        return self.cast(value)

    def blank(self) -> Any:
        """Make the observation of an agent of which nothing is known yet: zero, and with all actions legal."""
        observation = _spaces.blank(self.definition.observation_space)
        if self.legal is None or not self._masked_parts:
            return observation
        for part in self._masked_parts:
            whole = observation[part] if part else observation
            whole[_spaces.MASK] = _spaces.open_mask(self.definition.action_space)
        return self.cast(observation)

    def reply(self, action: Any, agent: str, mask: Any, choices: Any) -> Any:
        """Check an action, and turn it into the reply that the simulation gets.

        Args:
            action: The action.
            agent: Whose action it is.
            mask: Which actions are legal; None: all of the space.
            choices: What the action is an index into, where the point has choices.

        Raises:
            InvalidActionError: The action is not legal.
        """
        legal = self.checked(action, agent, mask)
        return self.convert(legal) if choices is None else [choices[legal]]

    def checked(self, action: Any, agent: str, mask: Any) -> Any:
        """Check an action: the first half of ``reply``."""
        legal = self.check(action)
        if legal is ILLEGAL:
            raise InvalidActionError(
                f"the action {action!r} of {agent!r} is not in its action space {self.definition.action_space}"
            )
        if mask is not None and not self.allowed(legal, mask):
            raise InvalidActionError(f"the action {action!r} of {agent!r} is masked; its mask is {mask!r}")
        return legal

    def allowed(self, legal: Any, mask: Any) -> bool:
        """Whether a mask allows an action that is in the space."""
        return _spaces.mask_allows(self.definition.action_space, mask, legal)


def _goal_parts(space: spaces.Space[Any]) -> list[tuple[str, spaces.Space[Any]]]:
    return (
        [("observation", space["observation"])]
        if isinstance(space, spaces.Dict) and "desired_goal" in space.spaces
        else []
    )


class Ruled:
    """Stands for a decision point where its rule has just decided, for the user's side to find out the action.

    Attributes:
        binding: The decision point.
        deliver, by_rule: None; the simulation just goes on.
    """

    __slots__ = ("_inverse", "binding")

    deliver = by_rule = None

    def __init__(self, binding: Binding) -> None:
        self.binding = binding
        self._inverse = inverse(binding.definition)

    def rule(self, *told: Any) -> None:
        """What drivers call where nobody is to be told: there is nothing to do."""

    def action(self, decision: Any, args: tuple[Any, ...], kwargs: dict[str, Any], offered: Any) -> Any:
        """The action that a decision of the rule corresponds to; None if there is none.

        Args:
            decision: The decision.
            args: The arguments of the call that was decided.
            kwargs: Those passed by keyword.
            offered: The choices there were, where the point has choices.

        Raises:
            InvalidActionError: The action that is said to correspond to it is not in the action space.
        """
        definition = self.binding.definition
        if definition.rule_action_mapping is None:
            return self._read_backwards(decision, offered)
        action = definition.rule_action_mapping(decision, *args, **kwargs)
        legal = None if action is None else self.binding.check(action)
        if legal is ILLEGAL:
            raise InvalidActionError(
                f"rule_action_mapping of {self.binding.point.name} says that the rule's decision {decision!r} is the"
                f" action {action!r}, which is not in its action space {definition.action_space}"
            )
        return legal

    def _read_backwards(self, decision: Any, offered: Any) -> Any:
        if offered is not None:
            return next(
                (place for place, choice in enumerate(offered) if choice is decision or choice == decision), None
            )
        try:
            return None if self._inverse is None else self._inverse.get(decision)
        except TypeError:  # which cannot be looked up
            return None


def _can_be_read_backwards(definition: Definition) -> bool:
    return definition.choices is not None or inverse(definition) is not None


def _tell(ruled: Ruled, decision: Any, args: Any, kwargs: Any) -> Any:
    ask: Any = RUNNING.get(get_ident())
    if ask is not None:  # else the simulation is being unwound
        ask(ruled, (decision, args, kwargs), {})
    return decision


def _call(ruled: Ruled, point: Any, args: Any, kwargs: Any) -> Any:
    return _tell(ruled, point.rule(*args, **kwargs), args, kwargs)


def _generate(ruled: Ruled, point: Any, args: Any, kwargs: Any) -> Any:
    return _tell(ruled, (yield from point.rule(*args, **kwargs)), args, kwargs)


async def _await(ruled: Ruled, point: Any, args: Any, kwargs: Any) -> Any:
    return _tell(ruled, await point.rule(*args, **kwargs), args, kwargs)


_BY_RULE: Mapping[str, Callable[..., Any]] = {"function": _call, "generator": _generate, "coroutine": _await}


class Removal:
    """A function of the model whose calls end the episode of agents.

    Attributes:
        point: The function.
        of: The bindings whose agents it ends; for each a callable of the call's arguments that names the
            agent, or None; and then the class whose instances are such agents, if it is known.
        deliver, by_rule: None; the call always runs the function, and nobody wants to know what comes of it.
    """

    __slots__ = ("of", "point")

    deliver = by_rule = None

    def __init__(self, point: DecisionPoint) -> None:
        self.point = point
        self.of: list[tuple[Binding, Callable[..., Any] | None, type | None]] = []

    def agents(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[tuple[Binding, Any]]:
        """The agents that a call ends, with their bindings."""
        named: list[tuple[Binding, Any]] = []  # a generator could not pass on a StopIteration
        for binding, name, owner in self.of:
            if name is not None:
                named.append((binding, name(*args, **kwargs)))
            elif args and (owner is None or isinstance(args[0], owner)):
                named.append((binding, binding.agent or binding.name_agent(args[0])))
        return named


def _same(action: Any) -> Any:
    return action


def _masked(mapping: Callable[..., Any], cast: Callable[[Any], Any], args: Any, kwargs: Any) -> tuple[Any, None]:
    return cast(mapping(*args, **kwargs)), None


def _chosen(mapping: Callable[..., Any], most: int, name: str, args: Any, kwargs: Any) -> tuple[Any, Any]:
    choices = list(mapping(*args, **kwargs))
    if not 1 <= len(choices) <= most:
        raise MaskError(f"{name} has {len(choices)} choices; its action space holds 1 to {most}")
    mask = np.zeros(most, np.int8)
    mask[: len(choices)] = 1
    return mask, choices


def _delivery(definition: Definition, kind: str) -> Callable[..., Any] | None:
    """Make what turns a reply into the value of a call, which for a generator function is a generator."""
    apply = definition.apply if definition.choices is None else _taken_out
    if kind == "function":
        return apply
    wrap = _returning if kind == "generator" else _awaiting
    if apply is None:
        return lambda reply, *args, **kwargs: wrap(reply)

    def deliver(reply: Any, *args: Any, **kwargs: Any) -> Any:
        value = apply(reply, *args, **kwargs)
        return value if inspect.isgenerator(value) or inspect.isawaitable(value) else wrap(value)

    return deliver


def _taken_out(box: list[Any], *args: Any, **kwargs: Any) -> Any:
    """The choice in a box, in which it crosses so that nothing on the user's side keeps it alive."""
    return box.pop()


def _returning(value: Any) -> Any:
    return value
    yield


async def _awaiting(value: Any) -> Any:
    return value
