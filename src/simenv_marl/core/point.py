"""Decision points under the definitions of one environment, and the other events that a simulation sends."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from gymnasium import spaces as gym_spaces

from ..decision import DecisionPoint, Definition, inverse
from ..errors import InvalidActionError, MaskError, short_repr, warn_user
from ..simulation import RULE, asks_for
from . import actions, spaces
from .actions import ILLEGAL, MASK
from .points import NamedPoint

if TYPE_CHECKING:
    from .episode import Episode

MAPPINGS: Final = (
    "observation_space_mapping", "action_space_mapping", "reward_mapping", "apply", "choices", "rule_action_mapping",
    "agent", "action_mask_mapping", "achieved_goal_mapping", "desired_goal_mapping",
)  # fmt: skip
"""The parts of a definition, besides ``removed_by``, that get the simulation if they ask for it."""


def given_simulation(definition: Definition, simulation: Any) -> Definition:
    """Give the simulation to the mappings that ask for it; return the definition itself if no mapping asks."""

    def given(function: Any) -> Any:
        return partial(function, _simulation=simulation) if asks_for(function, "_simulation") else function

    changes = {name: given(getattr(definition, name)) for name in MAPPINGS}
    changes = {name: function for name, function in changes.items() if function is not getattr(definition, name)}
    removals = {name: given(agent) for name, agent in definition.removed_by.items()}
    if removals != definition.removed_by:
        changes["removed_by"] = removals
    return replace(definition, **changes) if changes else definition


class Point:
    """A decision point under the definition of one environment. It holds no state of any episode.

    It is also the event of a decision there, if the deciding agent must be found.

    Attributes:
        point, definition: The decision point and its definition.
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
        report: The event of the rule's decisions. None if they are not reported.
        informs_rule_action: Whether infos contain the action that corresponds to a decision of the rule.
        updates: The functions that reward and observe the agents of the point: see ``make_updates``.
        one_entity: Whether one object is expected to make all decisions, because the definition does not name agents.
    """

    __slots__ = (
        "agent", "cast", "check", "convert", "definition", "deliver", "finite", "informs_rule_action", "legal",
        "masked_parts", "name_agent", "observation_mapping", "one_entity", "point", "policy", "report",
        "reward_mapping", "updates",
    )  # fmt: skip

    def __init__(
        self, named: NamedPoint, agent: str | None, policy: Any = None, *, records: bool = False, clips: bool = False
    ) -> None:
        """Prepare a decision point.

        Args:
            named: The decision point and its definition.
            agent: The name of its agent. None if a callable names its agents.
            policy: The policy that answers all decisions of the point.
            records: Whether decisions are recorded, including those of the rule.
            clips: Whether actions outside a ``Box`` are clipped.
        """
        definition = named.definition
        self.point: DecisionPoint = named.point
        self.definition: Definition = definition
        self.agent, self.policy = agent, policy
        self.name_agent: Any = definition.agent if agent is None else None
        self.reward_mapping: Any = definition.reward_mapping
        self.observation_mapping: Any = definition.observation_space_mapping
        self.cast = spaces.observation_cast(definition.observation_space)
        self.finite = spaces.finite_check(definition.observation_space)
        self.check = (actions.clipping_check if clips else actions.action_check)(definition.action_space)
        self.convert: Any = definition.action_space_mapping or _same
        self.deliver = _delivery(definition, named.point.hook.kind)
        self.legal = _legal(definition, named.point.name)
        self.masked_parts = _masked_parts(definition.observation_space)
        self.informs_rule_action = definition.rule_action_mapping is not None
        readable = definition.choices is not None or inverse(definition) is not None
        self.report = RuleDecided(self) if self.informs_rule_action or (records and readable) else None
        self.one_entity = definition.agent is None and named.point.hook.bound
        self.updates: Any = None

    def handle(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Find the agent that decides, or let it join; then handle its decision."""
        name = self.agent
        if name is None:
            name_agent = self.name_agent
            name = name_agent(*args, **kwargs) if kwargs else name_agent(*args)
            if name is None:
                return RULE
        agent = (episode.agents.get(name) or episode.others.get(name)) if type(name) is str else None
        if agent is None or agent.point is not self:
            agent = episode.agent_for(self, name)
        return agent.handle(episode, args, kwargs)

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


def _same(action: Any) -> Any:
    return action


def _masked_parts(space: gym_spaces.Space[Any]) -> list[str]:
    """The keys of the parts of an observation that contain a mask; "" stands for the whole observation."""
    parts: dict[str, Any] = {"": space}
    if isinstance(space, gym_spaces.Dict) and "desired_goal" in space.spaces:
        parts["observation"] = space["observation"]
    return [key for key, part in parts.items() if isinstance(part, gym_spaces.Dict) and MASK in part.spaces]


def _legal(definition: Definition, name: str) -> Callable[[Any, Any], tuple[Any, Any]] | None:
    """Make the function that returns the mask of a call, and its choices."""
    mapping, choose, space = definition.action_mask_mapping, definition.choices, definition.action_space
    if mapping is not None:
        cast = actions.mask_cast(space)
        return lambda args, kwargs: (cast(mapping(*args, **kwargs)), None)
    if choose is None:
        return None
    most = int(space.n)  # type: ignore[attr-defined]

    def legal(args: Any, kwargs: Any) -> tuple[Any, Any]:
        choices = list(choose(*args, **kwargs))
        if not 1 <= len(choices) <= most:
            raise MaskError(f"{name} has {len(choices)} choices; its action space holds 1 to {most}")
        mask = np.zeros(most, np.int8)
        mask[: len(choices)] = 1
        return mask, choices

    return legal


# -- in the simulation ----------------------------------------------------------------------------


def _delivery(definition: Definition, kind: str) -> Callable[..., Any] | None:
    """Make the function that turns a reply into the value of a call; for a generator function that is a generator."""
    apply = definition.apply
    if definition.choices is not None:
        apply = partial(_deliver_choice, definition.apply)
    if kind == "function":
        return apply
    wrap = _returning if kind == "generator" else _awaiting
    if apply is None:
        return lambda reply, *args, **kwargs: wrap(reply)

    def deliver(reply: Any, *args: Any, **kwargs: Any) -> Any:
        value = apply(reply, *args, **kwargs)
        return value if inspect.isgenerator(value) or inspect.isawaitable(value) else wrap(value)

    return deliver


def _deliver_choice(apply: Callable[..., Any] | None, box: list[Any], *args: Any, **kwargs: Any) -> Any:
    """Take the choice out of its list. It crosses in a list so that the user's side keeps no reference to it."""
    return box.pop() if apply is None else apply(box.pop(), *args, **kwargs)


def _returning(value: Any) -> Any:
    return value
    yield


async def _awaiting(value: Any) -> Any:
    return value


# -- other events -----------------------------------------------------------------------------------


class Notice:
    """An event that changes nothing in the simulation: the function itself runs, or has run.

    Attributes:
        deliver, report: None, because there is no reply to deliver and no result to report.
    """

    deliver = report = None


class Removal(Notice):
    """The notice of a call that ends the episode of agents: of a function that ``removed_by=`` names.

    Attributes:
        point: The function.
        of: A tuple for each decision point whose agents it ends: the point; a callable that takes the call's arguments
            and names the agent, or None; the class whose instances are such agents, or None if it is not known.
    """

    def __init__(self, point: DecisionPoint) -> None:
        self.point = point
        self.of: list[tuple[Point, Callable[..., Any] | None, type | None]] = []

    def handle(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Give the agents their last rewards and observations while their entities are whole; then run the call."""
        named: list[tuple[Point, Any]] = []  # first all names, since ending an agent may change them
        for point, name, owner in self.of:
            if name is not None:
                named.append((point, name(*args, **kwargs)))
            elif args and (owner is None or isinstance(args[0], owner)):
                found = point.agent or point.name_agent(args[0])
                named.append((point, episode.named_before(point, args[0]) if found is None else found))
        for point, name in named:
            agent = episode.agents.get(name)
            if agent is not None and agent.point is point:
                episode.end_agent(agent)
        return RULE


class EndAgent(Notice):
    """The notice of a call of the simulation's ``end_agent``."""

    def handle(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """End the agent's episode if it is a live agent of the environment."""
        name = kwargs["name"] if "name" in kwargs else args[1]
        agent = episode.agents.get(name) if isinstance(name, str) else None
        if agent is not None:
            episode.end_agent(agent)
        return RULE


class RuleDecided(Notice):
    """The notice of a decision that the rule of a point has made.

    Attributes:
        point: The decision point.
    """

    def __init__(self, point: Point) -> None:
        self.point = point
        definition, mapping = point.definition, point.definition.rule_action_mapping
        self._mapping = dict(mapping) if isinstance(mapping, Mapping) else mapping
        self._decision_only = mapping is not None and not _takes_arguments(mapping)
        self._inverse = None if mapping is not None or definition.choices is not None else inverse(definition)

    def handle(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Note the action that corresponds to the decision. ``args``: the decision, its call's args and kwargs."""
        decision, call_args, call_kwargs = args
        point = self.point
        name = point.agent or point.name_agent(*call_args, **call_kwargs)
        agent = (episode.agents.get(name) or episode.others.get(name)) if type(name) is str else None
        if agent is not None and agent.point is point:
            episode.latest = agent
            offered, agent.offered = agent.offered, None
            agent.rule_action = action = self._action(decision, call_args, call_kwargs, offered)
            agent.informs_rule_action = point.informs_rule_action and action is not None

    def _action(self, decision: Any, args: tuple[Any, ...], kwargs: dict[str, Any], choices: Any) -> Any:
        """Find the action that a decision corresponds to; None if no action does.

        Raises:
            InvalidActionError: The corresponding action is not in the action space, or the dict lacks the decision.
        """
        mapping, point = self._mapping, self.point
        if mapping is None and choices is not None:
            same = (place for place, choice in enumerate(choices) if choice is decision or choice == decision)
            return next(same, None)
        if mapping is None:
            with suppress(TypeError):  # the decision is not hashable
                return None if self._inverse is None else self._inverse.get(decision)
            return None
        if isinstance(mapping, dict):
            try:
                action = mapping[decision]
            except (KeyError, TypeError):
                raise InvalidActionError(
                    f"the dict rule_action_mapping has no action for the rule's decision {short_repr(decision)}; add"
                    " one, or pass a callable that returns None where no action corresponds"
                ) from None
        else:
            action = mapping(decision) if self._decision_only else mapping(decision, *args, **kwargs)
        legal = None if action is None else point.check(action)
        if legal is ILLEGAL:
            raise InvalidActionError(
                f"rule_action_mapping of {point.point.name} maps the rule's decision {short_repr(decision)} to the"
                f" action {short_repr(action)}, which is not in its action space"
                f" {short_repr(point.definition.action_space)}"
            )
        return legal


def _takes_arguments(mapping: Any) -> bool:
    """Whether a ``rule_action_mapping`` takes the call's arguments after the decision."""
    try:
        parameters = list(inspect.signature(mapping).parameters.values())
    except (TypeError, ValueError):
        return False
    positional = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    return any(p.default is p.empty for p in positional[1:]) or any(p.kind is p.VAR_POSITIONAL for p in parameters)
