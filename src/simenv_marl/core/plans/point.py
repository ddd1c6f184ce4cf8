"""Decision points under the definition of one environment: observations, actions and labels."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from copy import copy
from functools import partial
from numbers import Real
from types import coroutine
from typing import Any, Final, Protocol, TypeAlias

import numpy as np
from gymnasium import spaces as gym_spaces

from ...decision import (
    DecisionPoint,
    Definition,
    completed,
    decisions_by_action,
    inverse,
    label_of,
    parts_of,
    texts_of,
)
from ...errors import (
    DefinitionError,
    InvalidActionError,
    MaskError,
    OptionValueError,
    short_repr,
)
from ...hooks.hook import BOUND
from ...simulation import RULE, Action, Model, Observation, asks_for, signature_of
from ..values import actions, spaces
from ..values.actions import ILLEGAL, MASK, Mask
from .mappings import Mapped, adapt, taken_by

Space: TypeAlias = gym_spaces.Space[Any]
Args = tuple[Model, ...]
Kwargs = dict[str, Model]

Labels = Mapping[Any, str] | Sequence[str] | None
"""Texts: for a ``Discrete`` or ``Dict`` a dict, for a one-dimensional space a sequence."""

Policy: TypeAlias = "Callable[..., Action] | Model"
"""A policy, as a plan has it: a callable, or ``RULE``."""

_SENTENCE: Final = re.compile(r".+?[.!?](?=\s|$)|.+")
"""The first sentence of a text in one line."""

_LEADING: Final = {
    "agent": 0,
    "observation_space_mapping": 0,
    "reward_mapping": 0,
    "cost_mapping": 0,
    "action_mask_mapping": 0,
    "choices": 0,
    "action_labels": 0,
    "observation_labels": 0,
    "question": 0,
    "display_mapping": 0,
    "apply": 1,
    "rule_action_mapping": 1,
    "split": 0,
    "gather": 2,
    "part": 2,
}
"""The callables of a definition that get a call's arguments, and how many come before these."""

_TEXTS: Final = ("action_labels", "observation_labels", "question", "display_mapping")
"""The callables of a definition that are only for people and language models."""

_WITHOUT_ITEM = ("split", "gather", "part")
"""The callables of a definition that do not get an item of a split call first."""


_WITHOUT_ANSWERS = (*_WITHOUT_ITEM, "apply", "rule_action_mapping")
"""The callables of a definition that do not get the answers to earlier items of a split call."""


class Applier(Protocol):
    """An agent whose action is applied on the simulation's side."""

    def begin_apply(self) -> None:
        """Let the agent's calls run the rule."""

    def end_apply(self) -> None:
        """Undo ``begin_apply``."""


class Point:
    """A decision point under the definition of one environment. It has no state of any episode.

    Attributes:
        hook: The decision function.
        definition: Its definition in this environment.
        agent: The name of the agent. None if ``name_agent`` names it.
        policy: The policy that answers all decisions of the point. None: the agents' own policies
            answer them, or the environment's user does.
        cast: Casts an observation to the observation space.
        observes_arrays: Whether observations are arrays.
        check: Checks an action against the action space. Returns it in the form that ``convert``
            takes, or ``ILLEGAL``.
        applies: Whether an ``apply`` gets the action, on the simulation's side.
        reports_rule: Whether the decisions of the rule are reported.
        expects_one: Whether one object makes all decisions of an agent.
        gives_answers: Whether a callable asks for the answers to the items before.
        needs_simulation: Whether a callable asks for the simulation.
        name_agent: A callable of the call's arguments that names the agent, if ``agent`` is None.
        observation_mapping, reward_mapping: The mappings, callable with all arguments.
        takes_for_observation: The mappings that make an observation, with its mask and choices.
        takes_for_reward: The mappings of rewards and costs, with the arguments that they take.
        cost_mapping: The mapping of costs. None without.
        is_quick: Whether an observation and a reward are all that a decision needs.
        taken_places: The number of positional arguments up to the last one that mappings take after
            the decision. None: all.
        taken_keys: The keyword arguments that they take. None: all.
        convert: Turns a checked action into the reply to the simulation.
        legal: Returns the mask of a call, and its choices if it has any. None if all actions are
            always legal.
        masked_parts: The keys of the parts of the observation space that contain the mask; "" for
            the whole space.
        deliver: Turns the reply, on the simulation's side, into the value of the call. None if the
            reply is that value.
        split, gather, part: The callables for calls that decide for several items; None without.
        removed_by: The callables that name the agents that other functions end, by the functions'
            names. None in place of a callable: the agent of the call's first argument.
        rule_action_mapping: Returns the action for a decision of the rule. None without.
    """

    __slots__ = (
        "__weakref__", "_calls", "agent", "applies", "cast", "check", "convert", "cost_mapping",
        "definition", "deliver", "expects_one", "gather", "gives_answers", "hook", "is_quick",
        "legal", "masked_parts", "name_agent", "needs_simulation", "observation_mapping",
        "observes_arrays", "part",
        "policy", "removed_by", "reports_rule", "reward_mapping", "rule_action_mapping", "split",
        "taken_keys", "taken_places", "takes_for_observation", "takes_for_reward",
    )  # fmt: skip

    def __init__(
        self,
        hook: DecisionPoint,
        definition: Definition,
        agent: str | None,
        policy: Policy,
        *,
        records: bool,
        clips: bool,
    ) -> None:
        """Prepare a point.

        Args:
            hook: The decision function.
            definition: Its definition.
            agent: The name of its agent. None if the definition has a callable that names it.
            policy: The policy of all its decisions, if there is one.
            records: Whether the actions of the rule are recorded, where they can be known.
            clips: Whether actions are clipped to the bounds of a ``Box``.

        Raises:
            DefinitionError: A mapping requires more arguments than the decision function has.
        """
        self.hook = hook
        self.definition = definition
        self.agent = agent
        self.policy = policy
        self.cast = spaces.observation_cast(definition.observation_space)
        self.observes_arrays = isinstance(definition.observation_space, spaces.ArraySpace)
        self.check = actions.action_check(definition.action_space, clips=clips)
        self.applies = definition.apply is not None
        is_invertible = definition.choices is not None or inverse(definition) is not None
        informs = definition.rule_action_mapping is not None
        self.reports_rule = informs or (records and is_invertible)
        names_one = not isinstance(definition.agent, str) and definition.split is None
        self.expects_one = names_one and hook.bound
        callables = (*vars(definition).values(), *definition.removed_by.values())
        self.needs_simulation = any(asks_for(part, "_simulation") for part in callables)
        is_split = definition.split is not None
        self.gives_answers = is_split and any(asks_for(part, "_answers") for part in callables)
        self.fit_callables(None)

    def bind(self, simulation: Model) -> Point:
        """Return this point with the simulation given to the callables that ask for it."""
        if not self.needs_simulation:
            return self
        point = copy(self)
        point.fit_callables(simulation)
        return point

    def fit_callables(self, simulation: Model) -> None:
        """Fit the definition's callables to calls. Give the simulation to each that asks for it."""
        definition = self.definition
        parts = {name: _bound(part, simulation) for name, part in vars(definition).items()}
        if asks_for(parts["apply"], "_rule"):
            hook = self.hook
            parts["apply"] = partial(
                parts["apply"], _rule=lambda *args, **kwargs: hook.rule(*args, **kwargs)
            )
        fitted = {
            name: self.fit(parts[name], name, leading)
            for name, leading in _LEADING.items()
            if callable(parts[name])
        }
        self._calls = calls = {name: mapped.call for name, mapped in fitted.items()}
        self.name_agent = calls.get("agent", _same)
        self.observation_mapping = calls["observation_space_mapping"]
        self.reward_mapping = calls["reward_mapping"]
        self.cost_mapping = calls.get("cost_mapping")
        pays = ("reward_mapping", "cost_mapping")
        self.takes_for_reward = [fitted[name] for name in pays if name in fitted]
        makes_observation = ("observation_space_mapping", "action_mask_mapping", "choices")
        self.takes_for_observation = [fitted[name] for name in makes_observation if name in fitted]
        texts = [fitted[name] for name in _TEXTS if name in fitted]
        taken = taken_by([*self.takes_for_observation, *self.takes_for_reward, *texts])
        self.taken_places: int | None = None
        self.taken_keys = taken
        if taken is not None:
            places = [place for place in taken if isinstance(place, int)]
            self.taken_places = max(places, default=-1) + 1
            self.taken_keys = taken.difference(places)
        self.convert: Callable[[Action], Model] = parts["action_space_mapping"] or _same
        self.legal = self._legal()
        informs = definition.rule_action_mapping is not None
        self.is_quick = self.legal is None and self.cost_mapping is None and not informs
        self.masked_parts = _masked_parts(definition.observation_space) if self.legal else []
        self.deliver = self._delivery()
        self.split = calls.get("split")
        self.gather = calls.get("gather")
        self.part = calls.get("part")
        self.rule_action_mapping = calls.get("rule_action_mapping")
        removers = {**self.hook.removed_by, **definition.removed_by}
        self.removed_by = {name: _bound(part, simulation) for name, part in removers.items()}

    def has_spaces_of(self, other: Point) -> bool:
        """Return whether another point has the same spaces."""
        mine, its = (
            (point.definition.observation_space, point.definition.action_space)
            for point in (self, other)
        )
        return mine == its

    def fit(self, function: Callable[..., Model], name: str, leading: int = 0) -> Mapped:
        """Make a function callable with all arguments of a call, as ``adapt`` does."""
        signature = signature_of(function)
        if self.definition.split is not None and name not in _WITHOUT_ITEM:
            kinds = {None} if signature is None else {p.kind for p in signature.parameters.values()}
            if leading or kinds - {inspect.Parameter.KEYWORD_ONLY}:  # else it takes no argument
                leading += 1
        if name == "rule_action_mapping" and signature is None:  # such as int
            return Mapped(lambda decision, *args, **kwargs: function(decision), None)
        gives_answers = self.gives_answers and name not in _WITHOUT_ANSWERS
        return adapt(function, name, self.hook, leading, ("_answers",) * gives_answers)

    def decisions_of(self, call: Sequence[Model]) -> list[tuple[Args, Kwargs]]:
        """Return the bound arguments of the decisions of a call: one, or one for each item."""
        args, kwargs = self.hook.bind(tuple(call), BOUND) or (tuple(call), BOUND)
        if self.split is None:
            return [(args, kwargs)]
        items = self.split(*args, **kwargs)
        if self.gives_answers:
            kwargs = {**kwargs, "_answers": []}
        return [((item, *args), kwargs) for item in items]

    def answer_of(self, reply: Model) -> Model:
        """Return the decision, the action or the choice that a reply contains, or ``RULE``."""
        if reply is RULE:
            return RULE
        answer = reply[1] if self.applies else reply
        return answer[0] if self.definition.choices is not None else answer

    def _legal(self) -> Callable[[Args, Kwargs], tuple[Mask, list[Model] | None]] | None:
        """Make the function that returns the mask of a call, and its choices."""
        space = self.definition.action_space
        mapping = self._calls.get("action_mask_mapping")
        if mapping is not None:
            cast = actions.mask_cast(space)
            return lambda args, kwargs: (cast(mapping(*args, **kwargs)), None)
        choose = self._calls.get("choices")
        if choose is None or not isinstance(space, gym_spaces.Discrete):
            return None
        most = int(space.n)
        name = self.hook.name

        def legal(args: Args, kwargs: Kwargs) -> tuple[Mask, list[Model]]:
            choices = list(choose(*args, **kwargs))
            if not 1 <= len(choices) <= most:
                raise MaskError(
                    f"{name} has {len(choices)} choices; its action space holds 1 to {most}"
                )
            mask = np.zeros(most, np.int8)
            mask[: len(choices)] = 1
            return mask, choices

        return legal

    # -- observations -----------------------------------------------------------------------------

    def observe(self, args: Args, kwargs: Kwargs, mask: Mask) -> Observation:
        """Observe a call, with the mask where the observation space has an entry for it."""
        return self.cast(self._with_mask(self.observation_mapping(*args, **kwargs), mask))

    def blank(self) -> Observation:
        """Make the observation of an agent before the first one: zero, with all actions legal."""
        observation = spaces.blank(self.definition.observation_space)
        if not self.masked_parts:
            return observation
        return self.cast(self._with_mask(observation, self.open_mask()))

    def _with_mask(self, observation: Observation, mask: Mask) -> Observation:
        for key in self.masked_parts:
            part = observation[key] if key else observation
            if not isinstance(part, Mapping):
                continue
            part = {**part, MASK: mask}
            observation = {**observation, key: part} if key else part
        return observation

    # -- labels -----------------------------------------------------------------------------------

    def action_labels(self, choices: Sequence[Model] | None, args: Args, kwargs: Kwargs) -> Labels:
        """Return the texts of the actions of a call. Default: choices, decisions or numbers."""
        definition = self.definition
        space = definition.action_space
        values = decisions_by_action(definition.action_space_mapping) or {}
        parts = parts_of(space)
        if choices is not None:
            values = dict(enumerate(choices))
            parts = range(len(choices))
        defaults = {action: label_of(value) for action, value in values.items()}
        return self._labels("action_labels", space, parts, defaults, args, kwargs)

    def observation_labels(self, args: Args, kwargs: Kwargs) -> Labels:
        """Return the texts of the parts of an observation of a call."""
        space = self.definition.observation_space
        return self._labels("observation_labels", space, parts_of(space), {}, args, kwargs)

    def _labels(
        self,
        name: str,
        space: Space,
        parts: Collection[Any] | None,
        defaults: Mapping[Any, str],
        args: Args,
        kwargs: Kwargs,
    ) -> Labels:
        """Return labels as a dict or a tuple, completed by others. None if a space has no labels.

        Args:
            name: The part of the definition, which may be a callable of the call's arguments.
            space: The space.
            parts: Its parts with labels.
            defaults: The labels of parts that have none. Further ones are numbers.
            args: The arguments of the call.
            kwargs: Its keyword arguments.
        """
        labels = getattr(self.definition, name)
        if name in self._calls:
            labels = self._calls[name](*args, **kwargs)
        # Labels of a Discrete may leave out the illegal actions of this call.
        texts = {} if labels is None else texts_of(space, labels, all_parts=False)
        if texts is None:
            raise DefinitionError(
                f"the labels of {self.hook.name} for a call are {short_repr(labels)}, which are"
                f" not texts for the parts of {short_repr(space)}, all of them different"
            )
        if parts is None:
            return None
        named = completed(texts, {part: defaults.get(part, str(part)) for part in parts})
        has_keys = isinstance(space, (gym_spaces.Discrete, gym_spaces.Dict))
        return named if has_keys else tuple(named.values())

    # -- questions --------------------------------------------------------------------------------

    def question(self, args: Args, kwargs: Kwargs) -> str:
        """Return the question of a call. Default: the first sentence of the rule's docstring."""
        question = self.definition.question
        if callable(question):
            question = self._calls["question"](*args, **kwargs)
            if not isinstance(question, str):
                raise DefinitionError(
                    f"question of {self.hook.name} has returned {short_repr(question)}, which is no"
                    " text"
                )
        if question is not None:
            return question
        doc = inspect.getdoc(self.hook.function) or ""
        sentence = _SENTENCE.match(" ".join(doc.partition("\n\n")[0].split()))
        return f"By its rule: {sentence[0]}" if sentence else ""

    def display(self, args: Args, kwargs: Kwargs) -> dict[str, float | str] | None:
        """Return the labelled numbers and texts of a call. None without a ``display_mapping``."""
        mapping = self._calls.get("display_mapping")
        if mapping is None:
            return None
        shown = mapping(*args, **kwargs)
        if not isinstance(shown, Mapping) or not all(
            isinstance(label, str) and isinstance(value, (str, Real, np.bool))
            for label, value in shown.items()
        ):
            raise DefinitionError(
                f"display_mapping of {self.hook.name} has returned {short_repr(shown)}, which is no"
                " dict from texts to numbers or texts"
            )
        return dict(shown)

    # -- actions ----------------------------------------------------------------------------------

    def open_mask(self) -> Mask:
        """Make the mask that allows all actions."""
        mask: Mask = actions.open_mask(self.definition.action_space)
        return mask

    def validate(self, action: Action, agent: str, mask: Mask | None) -> Action:
        """Validate an action; return it as ``convert`` receives it.

        Raises:
            InvalidActionError: The action is not in the space, or it is masked.
            OptionValueError: The action is an awaitable of a policy that is no coroutine function.
        """
        legal = self.check(action)
        space = self.definition.action_space
        if legal is ILLEGAL and inspect.isawaitable(action):
            getattr(action, "close", int)()
            raise OptionValueError(
                f"the policy of {agent!r} has returned an awaitable; make it a coroutine function"
                " by async def, or give it an attribute waits = True"
            )
        if legal is ILLEGAL:
            problem = (
                f"the action {short_repr(action)} of {agent!r} is not in its action space"
                f" {short_repr(space)}"
            )
            try:
                actions.action_check(space, clips=True, raises=True)(action)
                actions.action_check(space, raises=True)(action)  # it names what can be clipped
            except InvalidActionError as error:
                if error.__cause__ is not None:  # an element of it is illegal
                    problem += f": {error}"
            raise InvalidActionError(problem)
        if mask is not None and not actions.mask_allows(space, mask, legal):
            raise InvalidActionError(
                f"the action {short_repr(action)} of {agent!r} is masked; its mask is"
                f" {short_repr(mask)}"
            )
        return legal

    # -- in the simulation ------------------------------------------------------------------------

    def _delivery(self) -> Callable[..., Model] | None:
        """Make the function that turns a reply into the value of a call.

        For a generator or coroutine function it returns a generator or an awaitable. A reply to an
        ``apply`` comes with its agent. A choice comes in a list, which is emptied, so that the
        user's side keeps no reference to it.
        """
        applies = self.applies
        has_choices = "choices" in self._calls
        kind = self.hook.kind
        if not applies and not has_choices and kind == "function":
            return None
        apply = self._calls.get("apply", _same)

        def deliver(reply: Model, *args: Model, **kwargs: Model) -> Model:
            if not applies:
                return reply.pop() if has_choices else reply
            agent, action = reply
            agent.begin_apply()
            try:
                return apply(action.pop() if has_choices else action, *args, **kwargs)
            finally:
                agent.end_apply()

        def deliver_later(
            reply: Model, *args: Model, **kwargs: Model
        ) -> Generator[Model, Model, Model]:
            value = deliver(reply, *args, **kwargs)
            if not applies:
                return value
            if inspect.isgenerator(value):
                return (yield from _applying(reply[0], value))
            if inspect.isawaitable(value):
                return (yield from _applying(reply[0], value.__await__()))
            return value

        if kind == "function":
            return deliver
        return coroutine(deliver_later) if kind == "coroutine" else deliver_later


def _bound(part: Model, simulation: Model) -> Model:
    """Give the simulation to a callable that asks for it."""
    return partial(part, _simulation=simulation) if asks_for(part, "_simulation") else part


def _masked_parts(space: Space) -> list[str]:
    """Return the keys of the parts of an observation that contain a mask."""
    parts: dict[str, Space] = {"": space}
    if isinstance(space, gym_spaces.Dict) and "desired_goal" in space.spaces:
        parts["observation"] = space["observation"]
    return [
        key
        for key, part in parts.items()
        if isinstance(part, gym_spaces.Dict) and MASK in part.spaces
    ]


def _same(value: Model) -> Model:
    return value


def _applying(
    agent: Applier, inner: Generator[Model, Model, Model]
) -> Generator[Model, Model, Model]:
    """Run a generator of ``apply``. While it runs, the agent's calls run the rule."""
    resume: Callable[[Model], Model] = inner.send
    sent: Model = None
    while True:
        agent.begin_apply()
        try:
            waits = resume(sent)
        except StopIteration as end:
            return end.value
        finally:
            agent.end_apply()
        try:
            sent = yield waits
            resume = inner.send
        except BaseException as error:
            resume, sent = inner.throw, error
