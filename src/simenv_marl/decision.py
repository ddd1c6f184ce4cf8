"""Decision points: functions of a model that decide something, and their definitions.

``make_step`` makes a ``Definition``. Applied to a function, the definition gives a *decision
function*. It looks and behaves like the function, whose body is the *rule*. But if the calling
simulation runs in an environment, it asks the environment for its decision. One function is one
decision point, its hook, with any number of definitions.
"""

from collections import Counter
from collections.abc import (
    Callable,
    Collection,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import dataclass, fields, is_dataclass
from functools import partial, update_wrapper
from types import FunctionType
from typing import Any, Final

import numpy as np
from greenlet import getcurrent
from gymnasium import spaces

from .errors import DefinitionError, PatchError, name_of, short_repr
from .hooks.hook import Hook, hook_of, hooks
from .hooks.places import decorate, is_outdated
from .hooks.stacks import DIFFERENCES, EVALUATING
from .simulation import Function, Model

Space = spaces.Space[Any]
"""A space of Gymnasium."""

Mapped = Function
"""A mapping: a callable of the decision call's arguments, bound to the function's signature."""

Labels = Mapped | Mapping[Any, str] | Sequence[str] | None
"""Texts for the parts of a space, or a callable of the call's arguments that returns them."""


# -- definitions ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Definition:
    """The definition of a decision point: how an environment observes, decides and rewards it.

    ``make_step`` makes it; it is immutable. Apply it to a function, staticmethod, classmethod or
    method of a class to get the decision function. Its attributes are the arguments of
    ``make_step``.
    """

    observation_space: Space
    observation_space_mapping: Mapped
    action_space: Space
    reward_mapping: Mapped
    cost_mapping: Mapped | None
    action_space_mapping: Function | None
    apply: Mapped | None
    choices: Mapped | None
    split: Mapped | None
    gather: Mapped | None
    part: Mapped | None
    rule_action_mapping: Mapped | Mapping[Any, Any] | None
    agent: str | Mapped | None
    action_mask_mapping: Mapped | None
    removed_by: Mapping[str | Function, Mapped | None]
    goal_space: Space | None
    achieved_goal_mapping: Mapped | None
    desired_goal_mapping: Mapped | None
    compute_reward: Function | None
    action_labels: Labels
    observation_labels: Labels
    question: str | Mapped | None
    display_mapping: Mapped | None

    def __post_init__(self) -> None:
        """Check the definition, and make callables of dicts; also after ``dataclasses.replace``.

        Raises:
            DefinitionError: An argument is invalid. The message says which.
        """
        for problem in _problems(self):
            raise DefinitionError(f"make_step: {problem}")
        decisions = decisions_by_action(self.action_space_mapping)
        if decisions is not None:
            object.__setattr__(self, "action_space_mapping", dict(decisions).__getitem__)
        names: Any = self.removed_by
        if isinstance(names, str) or callable(names):
            names = [names]
        removed_by = dict(names if isinstance(names, Mapping) else dict.fromkeys(names))
        for name, agent in removed_by.items():
            if not (isinstance(name, str) or callable(name)) or not (
                agent is None or callable(agent)
            ):
                raise DefinitionError(
                    "make_step: removed_by must be a dict from dotted names or functions to"
                    f" callables, not {short_repr(name)}: {short_repr(agent)}"
                )
        object.__setattr__(self, "removed_by", removed_by)

    def __call__(self, function: Any) -> Any:
        """Make the decision function.

        Args:
            function: The model's function that decides: a function, a staticmethod, a classmethod,
                or any of these as an attribute of its class.

        Returns:
            The decision function, bound like ``function``. A staticmethod or classmethod stays one.

        Raises:
            PatchError: ``function`` is none of these.
        """
        hook = hook_of(function)
        if hook is not None:
            point_for(hook)  # refuses an exposed builtin
        return decorate(function, self)


def make_step(
    *,
    observation_space: Space,
    observation_space_mapping: Mapped,
    action_space: Space,
    action_space_mapping: Function | Mapping[Any, Any] | None = None,
    reward_mapping: Mapped,
    cost_mapping: Mapped | None = None,
    apply: Mapped | None = None,
    choices: Mapped | None = None,
    split: Mapped | None = None,
    gather: Mapped | None = None,
    part: Mapped | None = None,
    rule_action_mapping: Mapped | Mapping[Any, Any] | None = None,
    agent: str | Mapped | None = None,
    action_mask_mapping: Mapped | None = None,
    removed_by: (
        str | Function | Iterable[str | Function] | Mapping[str | Function, Mapped | None]
    ) = (),
    goal_space: Space | None = None,
    achieved_goal_mapping: Mapped | None = None,
    desired_goal_mapping: Mapped | None = None,
    compute_reward: Function | None = None,
    action_labels: Labels = None,
    observation_labels: Labels = None,
    question: str | Mapped | None = None,
    display_mapping: Mapped | None = None,
) -> Definition:
    """Define a decision point: the observations, actions and rewards of its agent.

    See section 3.3 of the paper.

    Callables other than ``compute_reward`` may have a keyword-only parameter ``_simulation``: it
    gets the simulation.

    Args:
        observation_space: The space of the agent's observations.
        observation_space_mapping: A callable of the decision call's arguments (``self`` first for a
            method). It takes as many of them as it wants: positional ones from the first on,
            keyword-only ones by name, however the model writes the call; defaults are filled in.
            It returns the observation, which is cast to the dtype of the space.
        action_space: The space of the agent's actions.
        action_space_mapping: The decision for an action: a callable of the action, or a dict with
            an entry for each action of a ``Discrete`` space. The decision function returns its
            value.
        reward_mapping: A callable like ``observation_space_mapping``, called at each decision of
            the agent and at its end. It returns the reward of the agent's previous action.
        cost_mapping: A callable like ``reward_mapping`` that returns the cost of the agent's
            previous action, for learners with constraints: ``info["cost"]``. Costs are summed where
            rewards are.
        apply: An alternative to ``action_space_mapping``: a callable of the action and the call's
            arguments, which runs in the simulation instead of the rule. The decision function
            returns its result. With a keyword-only parameter ``_rule`` it gets the rule, to run it
            with other arguments or under other parameters of the model. Calls of the same decision
            point by the same agent inside ``apply`` run the rule.
        choices: A callable of the call's arguments that returns the sequence of legal answers. The
            action is an index into it, ``action_space`` a ``Discrete`` (from 0) of the largest
            length. The action mask follows from it. The decision function returns the chosen
            answer; with ``apply``, that gets the answer instead of the action.
        split: For a call that decides for many entities at once: a callable of the call's arguments
            that returns the items, with one decision for each. All other callables get the item
            before the call's arguments (``apply`` after the action). The function must return its
            decisions, and not act in place.
        gather: With ``split``: a callable of the items, their decisions and the call's arguments.
            It returns the value of the call. Default: a list of the decisions.
        part: With ``split``: a callable of the rule's result, an item and the call's arguments. It
            returns the part of the result that is for the item, where the rule decides for this
            item only. Default: by position.
        rule_action_mapping: The action that corresponds to a decision of the rule, for learning
            from the rule: a callable of the decision (and the call's arguments, if it takes more
            than one), which returns an action or None; or a dict from decision to action. After a
            decision of the rule, the agent's next info has it as ``"rule_action"``.
        agent: The name of the deciding agent, or a callable of the call's arguments that returns it
            (None: the rule decides). Default: the letters of the function's name in lower case and
            a number, such as ``choosewateramount_0``.
        action_mask_mapping: A callable of the call's arguments that returns the action mask of a
            ``Discrete`` or ``MultiDiscrete``: 1 for each legal action, 0 for others.
        removed_by: The functions of the model whose calls end an agent's episode: a function or
            its dotted name, several, or a dict from these to a callable of that call's arguments
            that returns the agent's name. Without a callable, it is the agent that ``agent`` names
            for the call's first argument, or that it named for it last.
        goal_space: The space of goals. With it and the next three arguments, the single view is
            goal-based.
        achieved_goal_mapping: A callable like ``observation_space_mapping`` that returns the
            achieved goal.
        desired_goal_mapping: A callable like ``observation_space_mapping`` that returns the desired
            goal.
        compute_reward: A callable of achieved goals, desired goals and infos, of one step or
            stacked (shape ``(n, *goal_space.shape)``). It returns the reward of each, for learners
            that replay with other goals.
        action_labels: The texts that people and language models read instead of numbers: for a
            ``Discrete`` a sequence of texts, or a dict from action to text; for a space with one
            dimension a sequence, with a text for each component; for a ``Dict`` a dict; or a
            callable of the call's arguments that returns one of these. All texts differ. Default:
            choices and decisions as text, else numbers; equal ones are followed by the number of
            their action.
        observation_labels: The same for the parts of observations.
        question: The question that people and language models answer, or a callable of the call's
            arguments that returns it. Default: "By its rule: " and the first sentence of the
            function's docstring.
        display_mapping: A callable of the call's arguments that returns a dict from label to number
            or text, such as ``{"temperature": "22 °C"}``. People and language models read it
            instead of the observation. It is called only for them.

    Returns:
        The definition, which is a decorator for the function that decides.

    Raises:
        DefinitionError: An argument is invalid. The message says which.
    """
    return Definition(**locals())


_GOAL: Final = ("goal_space", "achieved_goal_mapping", "desired_goal_mapping", "compute_reward")

_REQUIRED: Final = (
    "observation_space",
    "observation_space_mapping",
    "action_space",
    "reward_mapping",
)


def _problems(definition: Definition) -> Iterator[str]:
    """Yield the faults of a definition: first in single parts, then between parts."""
    for name, part in vars(definition).items():
        if name != "removed_by" and (part is not None or name in _REQUIRED):
            required = _required_kind(definition, name, part)
            if required is not None:
                yield f"{name} must be {required}, not {short_repr(part)}"
    deciding = [
        name
        for name in ("action_space_mapping", "apply", "choices")
        if getattr(definition, name) is not None
    ]
    if len(deciding) != 1 and deciding != ["apply", "choices"]:
        yield (
            "give one of action_space_mapping, apply and choices (or both apply and choices), to"
            f" say what an action decides; given: {', '.join(deciding) or 'none'}"
        )
    space = definition.action_space
    has_mask = definition.action_mask_mapping is not None
    if has_mask and not isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        yield f"action_mask_mapping needs a Discrete or MultiDiscrete action_space, not {space}"
    if definition.choices is not None:
        if not isinstance(space, spaces.Discrete) or space.start != 0:
            yield f"choices needs a Discrete action_space that starts at 0, not {space}"
        if has_mask:
            yield "choices makes the mask itself; leave action_mask_mapping out"
    if definition.split is None and (definition.gather is not None or definition.part is not None):
        yield "gather and part need split"
    missing = [name for name in _GOAL if getattr(definition, name) is None]
    if 0 < len(missing) < len(_GOAL):
        yield f"a goal needs all of its parts; missing: {', '.join(missing)}"
    decisions = decisions_by_action(definition.action_space_mapping)
    if decisions is None:
        return
    if not isinstance(space, spaces.Discrete):
        yield f"a dict as action_space_mapping needs a Discrete action_space, not {space}"
        return
    differing = decisions.keys() ^ set(parts_of(space) or ())
    if differing:
        yield (
            f"the dict action_space_mapping must have just the actions of {space}; these are in"
            f" one of both only: {differing}"
        )


def _required_kind(
    definition: Definition,
    name: str,
    part: object,
) -> str | None:
    """Return the kind of value that a part must be; None if the part is of this kind."""
    if name.endswith("_space"):
        return None if isinstance(part, spaces.Space) else "a gymnasium space"
    if callable(part) and not (name.endswith("_labels") and isinstance(part, Iterable)):
        return None  # an Enum is callable, too, but does not return labels
    if name in ("agent", "question"):
        return None if isinstance(part, str) and part else "a text or a callable"
    if name in ("action_space_mapping", "rule_action_mapping"):
        return None if isinstance(part, Mapping) else "a callable or a dict"
    if name.endswith("_labels"):
        space = getattr(definition, name.removesuffix("_labels") + "_space")
        fits = texts_of(space, part) is not None
        if fits:
            return None
        return f"texts for the parts of {short_repr(space)}, all of them different, or a callable"
    return "callable"


def parts_of(space: Space) -> Collection[int | str] | None:
    """Return the parts of a space that may have labels; None for a space without such parts."""
    if isinstance(space, spaces.Discrete):
        return range(int(space.start), int(space.start + space.n))
    if isinstance(space, spaces.Dict):
        return space.spaces
    shape = space.shape or ()
    return range(*shape) if len(shape) == 1 else None


def texts_of(space: Space, labels: object, *, all_parts: bool = True) -> dict[Any, str] | None:
    """Return labels as a dict from the parts of a space to texts. None if they do not fit it.

    ``all_parts``: whether the parts of a ``Discrete`` must have labels, too.
    """
    parts = parts_of(space) or ()
    if isinstance(parts, range) and isinstance(labels, Sequence) and not isinstance(labels, str):
        labels = dict(zip(parts, labels, strict=False)) if len(labels) == len(parts) else None
    if not isinstance(labels, Mapping):
        return None
    texts = {text for text in labels.values() if isinstance(text, str) and text.strip()}
    may_leave_out = isinstance(space, spaces.Discrete) and not all_parts
    least = 0 if may_leave_out else len(parts)
    fits = least <= len(labels) == len(texts) and labels.keys() <= set(parts)
    return dict(labels) if fits else None


def completed(labels: Mapping[Any, str], defaults: Mapping[Any, str]) -> dict[Any, str]:
    """Return the labels of the parts that have a default, which stands where there is no label.

    Defaults that are equal to other labels are followed by the number of the part.
    """
    texts = {part: labels.get(part, default) for part, default in defaults.items()}
    while True:
        counts = Counter(texts.values())
        equal = {part for part, text in texts.items() if counts[text] > 1}
        if equal <= labels.keys():
            return texts
        texts |= {part: f"{texts[part]} ({part})" for part in equal - labels.keys()}


def label_of(value: object, *, quoted: bool = False) -> str:
    """Return a decision or a choice as text: numbers without types, and records by their fields.

    ``quoted``: whether a text is quoted, because it is a part of another value.
    """
    kind = type(value)
    if kind.__str__ is not object.__str__:
        text = str(value)
        is_text = isinstance(value, str)
        return repr(text) if is_text and (quoted or not text.strip()) else text
    part_of = partial(label_of, quoted=True)
    names = getattr(kind, "_fields", ())
    if is_dataclass(value) and hasattr(kind.__repr__, "__wrapped__"):  # not one of the user's
        names = [field.name for field in fields(value) if field.repr]
    if names:
        parts = [f"{name}={part_of(getattr(value, name))}" for name in names]
        return f"{kind.__name__}({', '.join(parts)})"
    if isinstance(value, dict):
        parts = [f"{part_of(key)}: {part_of(item)}" for key, item in value.items()]
        return f"{{{', '.join(parts)}}}"
    if isinstance(value, (list, tuple)):
        text = ", ".join(map(part_of, value))
        if isinstance(value, list):
            return f"[{text}]"
        return f"({text},)" if len(value) == 1 else f"({text})"
    return kind.__name__ if kind.__repr__ is object.__repr__ else str(value)


def decisions_by_action(mapping: object) -> Mapping[Any, Any] | None:
    """Return the dict from action to decision that an ``action_space_mapping`` was made of.

    None for a callable.
    """
    if isinstance(mapping, Mapping):
        return mapping
    owner = getattr(mapping, "__self__", None)
    is_lookup = getattr(mapping, "__name__", None) == "__getitem__"
    return owner if is_lookup and isinstance(owner, dict) else None


def inverse(definition: Definition) -> dict[Any, Any] | None:
    """Return the dict from decision to action; None without an invertible dict of decisions."""
    decisions = decisions_by_action(definition.action_space_mapping) or {}
    try:
        actions = {decision: action for action, decision in decisions.items()}
    except TypeError:  # unhashable decisions
        return None
    return actions if actions and len(actions) == len(decisions) else None


# -- decision points ------------------------------------------------------------------------------

BY_NAME: Final = "simenv_marl_point"
"""The attribute with the name of a function that is in no module, but named by a simulation."""

DecisionPoint = Hook
"""A function of a model that decides something, under any definition: the hook of that function."""


def point_for(hook: Hook) -> DecisionPoint:
    """Return a hook as a decision point.

    Raises:
        PatchError: The hook's function is not written in Python.
    """
    if hook.kind == "iterable" or not isinstance(hook.function, FunctionType):
        raise PatchError(
            f"{hook.name} cannot be a decision point: it is not a function written in Python"
        )
    return hook


def registered() -> dict[str, DecisionPoint]:
    """Return the decorated points, by dotted name.

    These references are weak, so that a model is collected with its points.
    """
    decorated = [hook for hook in hooks() if hook.definition is not None]
    return {hook.name: hook for hook in decorated if not is_outdated(hook)}


def decision_points() -> list[str]:
    """Return the dotted names of all decorated decision points, in the order of decoration."""
    return list(registered())


# -- differences ----------------------------------------------------------------------------------


class difference:  # noqa: N801 - it is used like a function
    """A mapping that returns the change of ``function(*arguments)``.

    The change is the difference from its value at the last call for the same agent in the same
    episode; it is 0.0 at the first call, and wherever the mapping is not called for an environment.
    It can be used as a mapping, or be called in one. It replaces the global variable that a reward
    such as "water used since the last decision" would need (paper, supplement S2).
    """

    def __init__(self, function: Mapped) -> None:
        """Make the mapping.

        Args:
            function: A callable of the decision call's arguments that returns a number.

        Raises:
            DefinitionError: ``function`` is not callable.
        """
        if not callable(function):
            raise DefinitionError(f"difference: {short_repr(function)} is not callable")
        if not DIFFERENCES:
            DIFFERENCES.append(name_of(function))
        self._function = function
        update_wrapper(self, function)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Mapped]]:
        # The constructor notes, also in another process, that there are differences.
        return difference, (self._function,)

    def __call__(self, *args: Model, **kwargs: Model) -> Any:
        """Return the change of the function's value for these arguments."""
        value = self._function(*args, **kwargs)
        evaluation = EVALUATING.get(getcurrent())
        memory = None if evaluation is None else evaluation.memory
        if memory is None:
            return 0.0
        before = memory.get(self, value)
        # A copy, because an array may change in place.
        memory[self] = value.copy() if isinstance(value, np.ndarray) else value
        return value - before
