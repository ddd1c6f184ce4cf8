"""Decision points under the definitions of one environment, and the other events that a simulation sends."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from types import coroutine
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces as gym_spaces

from ..decision import DecisionPoint, Definition, fit_labels, inverse
from ..errors import (
    DefinitionError,
    InvalidActionError,
    MaskError,
    OptionValueError,
    short_repr,
    warn_user,
)
from ..hooks.hook import BOUND
from ..simulation import RULE, asks_for, positional
from . import actions, spaces
from .actions import ILLEGAL, MASK

if TYPE_CHECKING:
    from .agent import Agent
    from .episode import Episode


def given_simulation(definition: Definition, simulation: Any) -> Definition:
    """Give the simulation to the mappings that ask for it.

    Return the definition itself if no mapping asks.
    """

    def given(part: Any) -> Any:
        return partial(part, _simulation=simulation) if asks_for(part, "_simulation") else part

    changes = {name: given(part) for name, part in vars(definition).items()}
    changes["removed_by"] = {name: given(agent) for name, agent in definition.removed_by.items()}
    return definition if changes == vars(definition) else replace(definition, **changes)


class Point:
    """A decision point under the definition of one environment. It holds no state of any episode.

    It is also the event of a decision there, if the deciding agent must be found.

    Attributes:
        agent, name_agent: The name of the agent, or a callable of the call's arguments that returns
            it; one is None.
        policy: The policy that answers all decisions of the point. None: the agents' own policies
            answer them, or the environment's user does.
        cast: Casts an observation to the observation space.
        check: Checks an action against the action space. Returns it in the form that ``convert``
            takes, or ``ILLEGAL``.
        applies: Whether an ``apply`` gets the action, on the simulation's side.
        convert: Turns a checked action into the reply to the simulation.
        legal: Returns the mask of a call, and its choices if it has any. None if all actions are
            always legal.
        deliver: Turns the reply, on the simulation's side, into the value that the decision
            function returns. None if the reply is that value.
        report: The event of the rule's decisions. None if they are not reported.
        updates: The functions that reward and observe the agents of the point: see
            ``make_updates``.
        one_entity: Whether one object is expected to make all decisions, because the definition
            does not name agents.
    """

    __slots__ = (
        "agent",
        "applies",
        "cast",
        "check",
        "convert",
        "definition",
        "deliver",
        "hook",
        "informs_rule_action",
        "legal",
        "masked_parts",
        "name_agent",
        "one_entity",
        "policy",
        "report",
        "updates",
    )  # fmt: skip

    def __init__(
        self,
        hook: DecisionPoint,
        definition: Definition,
        agent: str | None,
        policy: Any,
        records: bool,
        clips: bool,
    ) -> None:
        """Prepare a point whose decisions are recorded, including those of the rule, and whose actions are clipped."""
        self.hook, self.definition = hook, definition
        self.agent, self.policy = agent, policy
        self.name_agent: Any = definition.agent if agent is None else None
        self.cast = spaces.observation_cast(definition.observation_space)
        self.check = actions.action_check(definition.action_space, clips=clips)
        self.convert: Any = definition.action_space_mapping or _same
        self.deliver, self.applies = _delivery(definition, hook), definition.apply is not None
        self.legal = _legal(definition, hook.name)
        self.masked_parts = (
            [] if self.legal is None else _masked_parts(definition.observation_space)
        )
        self.informs_rule_action = definition.rule_action_mapping is not None
        readable = definition.choices is not None or inverse(definition) is not None
        self.report = (
            RuleDecided(self) if self.informs_rule_action or (records and readable) else None
        )
        self.one_entity = definition.agent is None and hook.bound
        self.updates: Any = None

    def handle(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Find the agent that decides, or let it join; then handle its decision."""
        name = self.agent
        if name is None:
            name_agent = self.name_agent
            name = name_agent(*args, **kwargs) if kwargs else name_agent(*args)
            if name is None:
                return RULE
        agent = (
            (episode.agents.get(name) or episode.others.get(name)) if type(name) is str else None
        )
        if agent is None or agent.point is not self:
            agent = episode.agent_for(self, name)
        return agent.handle(episode, args, kwargs)

    def decisions_of(self, call: Any) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
        """Return the bound arguments of the decisions of a call: its own, or those of each of its items."""
        args, kwargs = self.hook.bind(call, BOUND) or (tuple(call), BOUND)
        split = self.definition.split
        return (
            [(args, kwargs)]
            if split is None
            else [((item, *args), kwargs) for item in split(*args, **kwargs)]
        )

    def warn_of_several(self, agent: str) -> None:
        """Warn once that several objects decide under the name of one agent."""
        self.one_entity = False
        warn_user(
            f"several objects decide at {self.hook.name} as one agent, {agent!r}: their rewards"
            " and differences mix. Set agent= of its make_step to a callable that names an agent"
            " for each object, or to a string if one agent is meant"
        )

    # -- observations -----------------------------------------------------------------------------

    def observe(self, args: tuple[Any, ...], kwargs: dict[str, Any], mask: Any) -> Any:
        """Observe a call.

        Where the observation space has an entry for the action mask, put the mask there.
        """
        return self.cast(
            self._with_mask(self.definition.observation_space_mapping(*args, **kwargs), mask)
        )

    def blank(self) -> Any:
        """Make the observation of an agent that was not observed yet: zero, with all actions legal."""
        observation = spaces.blank(self.definition.observation_space)
        return (
            self.cast(self._with_mask(observation, self.open_mask()))
            if self.masked_parts
            else observation
        )

    def _with_mask(self, observation: Any, mask: Any) -> Any:
        for part in self.masked_parts:
            if part and isinstance(observation[part], Mapping):
                observation = {**observation, part: {**observation[part], MASK: mask}}
            elif not part and isinstance(observation, Mapping):
                observation = {**observation, MASK: mask}
        return observation

    # -- labels -----------------------------------------------------------------------------------

    def action_labels(self, choices: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Return the texts of the actions for a call.

        Default: those of choices and decisions, else numbers.
        """
        given, space = self.definition.action_labels, self.definition.action_space
        if given is None and choices is not None:
            given = dict(enumerate(map(str, choices)))
        elif given is None and isinstance(space, gym_spaces.Discrete):
            given = {
                action: str(decision)
                for decision, action in (inverse(self.definition) or {}).items()
            }
        elif callable(given):
            given = self._labels_for_call(given, space, args, kwargs)
        return _labels(space, given)

    def observation_labels(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Return the texts of the parts of an observation for a call."""
        given, space = self.definition.observation_labels, self.definition.observation_space
        return _labels(
            space, self._labels_for_call(given, space, args, kwargs) if callable(given) else given
        )

    def _labels_for_call(
        self, function: Any, space: Any, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> Any:
        given = function(*args, **kwargs)
        # those of the legal actions
        some = isinstance(given, Mapping) and isinstance(space, gym_spaces.Discrete)
        if not some and not fit_labels(space, given):
            raise DefinitionError(
                f"the labels of {self.hook.name} for a call are {short_repr(given)}, which are"
                f" not texts for the parts of {short_repr(space)}"
            )
        return given

    # -- actions ----------------------------------------------------------------------------------

    def open_mask(self) -> Any:
        """Make the mask that allows all actions."""
        return actions.open_mask(self.definition.action_space)

    def allows(self, mask: Any, action: Any) -> bool:
        """Whether a mask allows an action that is in the space."""
        return actions.mask_allows(self.definition.action_space, mask, action)

    def validate(self, action: Any, agent: str, mask: Any) -> Any:
        """Return an action of an agent in the form that ``convert`` takes, or raise an ``InvalidActionError``."""
        legal, space = self.check(action), self.definition.action_space
        if legal is ILLEGAL and inspect.isawaitable(action):
            getattr(action, "close", int)()
            raise OptionValueError(
                f"the policy of {agent!r} has returned an awaitable; make it a coroutine function"
                " by async def, or give it an attribute waits = True"
            )
        if legal is ILLEGAL:
            raise InvalidActionError(
                f"the action {short_repr(action)} of {agent!r} is not in its action space"
                f" {short_repr(space)}"
            )
        if mask is not None and not self.allows(mask, legal):
            raise InvalidActionError(
                f"the action {short_repr(action)} of {agent!r} is masked; its mask is"
                f" {short_repr(mask)}"
            )
        return legal


def _same(action: Any) -> Any:
    return action


def _labels(space: Any, given: Any) -> Any:
    """Return labels as a dict for a ``Discrete`` or ``Dict``, as a tuple for a space with one dimension, else None."""
    if isinstance(space, gym_spaces.Discrete):
        start = int(space.start)
        texts = given if isinstance(given, Mapping) else dict(enumerate(given or (), start))
        return {
            action: str(texts.get(action, action)) for action in range(start, start + int(space.n))
        }
    if isinstance(space, gym_spaces.Dict):
        return {key: key for key in space.spaces} if given is None else dict(given)
    if space.shape is None or len(space.shape) != 1:
        return None
    return tuple(str(place) if given is None else given[place] for place in range(space.shape[0]))


def _masked_parts(space: gym_spaces.Space[Any]) -> list[str]:
    """The keys of the parts of an observation that contain a mask.

    "" stands for the whole observation.
    """
    parts: dict[str, Any] = {"": space}
    if isinstance(space, gym_spaces.Dict) and "desired_goal" in space.spaces:
        parts["observation"] = space["observation"]
    return [
        key
        for key, part in parts.items()
        if isinstance(part, gym_spaces.Dict) and MASK in part.spaces
    ]


def _legal(definition: Definition, name: str) -> Callable[[Any, Any], tuple[Any, Any]] | None:
    """Make the function that returns the mask of a call, and its choices."""
    mapping, choose, space = (
        definition.action_mask_mapping,
        definition.choices,
        definition.action_space,
    )
    if mapping is not None:
        cast = actions.mask_cast(space)
        return lambda args, kwargs: (cast(mapping(*args, **kwargs)), None)
    if choose is None:
        return None
    most = int(space.n)  # type: ignore[attr-defined]

    def legal(args: Any, kwargs: Any) -> tuple[Any, Any]:
        choices = list(choose(*args, **kwargs))
        if not 1 <= len(choices) <= most:
            raise MaskError(
                f"{name} has {len(choices)} choices; its action space holds 1 to {most}"
            )
        mask = np.zeros(most, np.int8)
        mask[: len(choices)] = 1
        return mask, choices

    return legal


# -- in the simulation ----------------------------------------------------------------------------


def _delivery(definition: Definition, hook: DecisionPoint) -> Callable[..., Any] | None:
    """Make the function that turns a reply into the value of a call.

    For a generator function that is a generator.

    A reply to an ``apply`` comes with its agent, whose calls run the rule meanwhile. A choice comes
    in a list of its own, so that the user's side keeps no reference to it.
    """
    apply: Any = definition.apply
    chosen, kind = definition.choices is not None, hook.kind
    if asks_for(apply, "_rule"):
        apply = partial(apply, _rule=lambda *args, **kwargs: hook.rule(*args, **kwargs))
    if apply is None and not chosen and kind == "function":
        return None
    wrap = {"function": _same, "generator": _returning, "coroutine": _awaiting}[kind]

    def deliver(reply: Any, *args: Any, **kwargs: Any) -> Any:
        if apply is None:
            return wrap(reply.pop() if chosen else reply)
        agent, action = reply
        agent.applying += 1
        try:
            value = apply(action.pop() if chosen else action, *args, **kwargs)
        finally:
            agent.applying -= 1
        if kind != "function" and inspect.isgenerator(value):
            return _applying(agent, value)
        if kind != "function" and inspect.isawaitable(value):
            awaited: Any = coroutine(_applying)
            return awaited(agent, value.__await__())
        return wrap(value)

    return deliver


def _applying(agent: Agent, inner: Any) -> Any:
    """Run a generator of ``apply``.

    The agent's own calls run the rule while it runs, but not while it waits.
    """
    resume, sent = inner.send, None
    while True:
        agent.applying += 1
        try:
            waits = resume(sent)
        except StopIteration as end:
            return end.value
        finally:
            agent.applying -= 1
        try:
            resume, sent = inner.send, (yield waits)
        except BaseException as error:
            resume, sent = inner.throw, error


def _returning(value: Any) -> Any:
    return value
    yield


async def _awaiting(value: Any) -> Any:
    return value


# -- other events ----------------------------------------------------------------------------------


class Removal:
    """The event of a call that ends the episode of agents. It changes nothing in the simulation: the function runs.

    Attributes:
        of: A tuple for each decision point whose agents it ends: the point (None: any); a callable
            that takes the call's arguments and names the agent, or None; the class whose instances
            are such agents, or None if it is not known.
    """

    deliver = report = None

    def __init__(self) -> None:
        self.of: list[tuple[Any, Callable[..., Any] | None, type | None]] = []

    def handle(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Give the agents their last rewards and observations while their entities are whole.

        Then run the call.
        """
        named: list[tuple[Any, Any]] = []  # first all names, since ending an agent may change them
        for point, name, owner in self.of:
            if name is not None:
                named.append((point, name(*args, **kwargs)))
            elif args and (owner is None or isinstance(args[0], owner)):
                found = point.agent or point.name_agent(args[0])
                named.append(
                    (point, episode.named_before(point, args[0]) if found is None else found)
                )
        for point, name in named:
            agent = episode.agents.get(name)
            if agent is not None and point in (None, agent.point):
                episode.end_agent(agent)
        return RULE


class RuleDecided:
    """The event of a decision that the rule of a point has made."""

    deliver = report = None

    def __init__(self, point: Point) -> None:
        self.point = point
        self._mapping = mapping = point.definition.rule_action_mapping
        self._takes_arguments = callable(mapping) and _takes_arguments(mapping)
        self._inverse = inverse(point.definition) or {}

    def handle(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Note the action that corresponds to the decision.

        ``args``: the decision, its call's args and kwargs.
        """
        decision, call_args, call_kwargs = args
        part = self.point.definition.part
        if self.point.definition.split is None:
            self._note(episode, decision, call_args, call_kwargs)
            return
        items, episode.items = episode.items, None
        for place, item in enumerate(items or ()):
            piece = (
                decision[place] if part is None else part(decision, item, *call_args, **call_kwargs)
            )
            self._note(episode, piece, (item, *call_args), call_kwargs)

    def _note(
        self,
        episode: Episode,
        decision: Any,
        call_args: tuple[Any, ...],
        call_kwargs: dict[str, Any],
    ) -> None:
        point = self.point
        name = point.agent or point.name_agent(*call_args, **call_kwargs)
        agent = (
            (episode.agents.get(name) or episode.others.get(name)) if type(name) is str else None
        )
        if agent is not None and agent.point is point:
            episode.latest = agent
            offered, agent.offered = agent.offered, None
            agent.rule_action = action = self._action(decision, call_args, call_kwargs, offered)
            agent.informs_rule_action = point.informs_rule_action and action is not None

    def _action(
        self, decision: Any, args: tuple[Any, ...], kwargs: dict[str, Any], choices: Any
    ) -> Any:
        """Find the action that a decision corresponds to; None if no action does."""
        mapping: Any = self._mapping
        point = self.point
        if mapping is None:
            for place, choice in enumerate(choices or ()):
                if choice is decision or choice == decision:
                    return place
            with suppress(TypeError):  # the decision is not hashable
                return self._inverse.get(decision)
            return None
        if not isinstance(mapping, Mapping):
            action = (
                mapping(decision, *args, **kwargs) if self._takes_arguments else mapping(decision)
            )
        else:
            try:
                action = mapping[decision]
            except (KeyError, TypeError):
                raise InvalidActionError(
                    "the dict rule_action_mapping has no action for the rule's decision"
                    f" {short_repr(decision)}; add one, or pass a callable that returns None where"
                    " no action corresponds"
                ) from None
        legal = None if action is None else point.check(action)
        if legal is ILLEGAL:
            raise InvalidActionError(
                f"rule_action_mapping of {point.hook.name} maps the rule's decision"
                f" {short_repr(decision)} to the action {short_repr(action)}, which is not in its"
                f" action space {short_repr(point.definition.action_space)}"
            )
        return legal


def _takes_arguments(mapping: Any) -> bool:
    """Whether a ``rule_action_mapping`` takes the call's arguments after the decision."""
    try:
        parameters = inspect.signature(mapping).parameters.values()
    except (TypeError, ValueError):
        return False
    required = [p for p in positional(mapping) if p.default is p.empty]
    return len(required) > 1 or any(p.kind is p.VAR_POSITIONAL for p in parameters)
