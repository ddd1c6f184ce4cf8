"""Decision points: functions of a model that decide something, and definitions of how an environment decides it.

``make_step`` makes a ``Definition``. Applied to a function, the definition gives a *decision function*. It looks and
behaves like the function, whose body is the *rule*. But if the calling simulation runs in an environment, it asks the
environment for its decision. A ``DecisionPoint`` is what is asked: one for every rule, with any number of definitions.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import KW_ONLY, dataclass
from functools import update_wrapper
from types import FunctionType
from typing import Any, Final
from weakref import WeakValueDictionary

import numpy as np
from greenlet import getcurrent
from gymnasium import spaces

from .errors import DefinitionError, PatchError, short_repr
from .hooks.hook import Hook, hook_of, made_with, unbind
from .hooks.places import permanent_hook
from .hooks.stacks import DIFFERENCES, EVALUATING

Mapped = Callable[..., Any]
"""A mapping: a callable of the decision call's arguments, as they were passed."""


# -- definitions ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Definition:
    """The definition of a decision point: how an environment observes, decides and rewards it.

    Made by ``make_step``; immutable. Apply it to a function, staticmethod, classmethod or method of a class to get the
    decision function. Its attributes are the arguments of ``make_step``.
    """

    _: KW_ONLY
    observation_space: spaces.Space[Any]
    observation_space_mapping: Mapped
    action_space: spaces.Space[Any]
    reward_mapping: Mapped
    action_space_mapping: Callable[[Any], Any] | None
    apply: Mapped | None
    choices: Mapped | None
    rule_action_mapping: Mapped | Mapping[Any, Any] | None
    agent: str | Mapped | None
    action_mask_mapping: Mapped | None
    removed_by: Mapping[str, Mapped | None]
    goal_space: spaces.Space[Any] | None
    achieved_goal_mapping: Mapped | None
    desired_goal_mapping: Mapped | None
    compute_reward: Callable[[Any, Any, Any], Any] | None

    def __post_init__(self) -> None:
        """Check the definition, and make callables of dicts; also after ``dataclasses.replace``.

        Raises:
            DefinitionError: The definition cannot work.
        """
        _check(self)
        answers = _answers(self.action_space_mapping)
        if answers is not None:
            object.__setattr__(self, "action_space_mapping", dict(answers).__getitem__)
        named: Any = [self.removed_by] if isinstance(self.removed_by, str) else self.removed_by
        removed_by = dict(named if isinstance(named, Mapping) else dict.fromkeys(named))
        for name, agent in removed_by.items():
            if not isinstance(name, str) or not (agent is None or callable(agent)):
                raise DefinitionError(
                    "make_step: removed_by must be a dict from dotted names to callables, not"
                    f" {short_repr(name)}: {short_repr(agent)}"
                )
        object.__setattr__(self, "removed_by", removed_by)

    def __call__(self, function: Any) -> Any:
        """Make the decision function.

        Args:
            function: The model's function that decides: a function, a staticmethod, a classmethod, or any of these as
                an attribute of its class.

        Returns:
            The decision function, bound like ``function``. A staticmethod or classmethod stays one.

        Raises:
            PatchError: ``function`` is none of these.
        """
        hook, binding = permanent_hook(function)
        point = point_for(hook)
        wrapper = hook.make_wrapper(self)
        point.definition = self
        _REGISTRY[point.name] = point
        return wrapper if binding is None else binding(wrapper)


def make_step(
    *,
    observation_space: spaces.Space[Any],
    observation_space_mapping: Mapped,
    action_space: spaces.Space[Any],
    action_space_mapping: Callable[[Any], Any] | Mapping[Any, Any] | None = None,
    reward_mapping: Mapped,
    apply: Mapped | None = None,
    choices: Mapped | None = None,
    rule_action_mapping: Mapped | Mapping[Any, Any] | None = None,
    agent: str | Mapped | None = None,
    action_mask_mapping: Mapped | None = None,
    removed_by: str | Iterable[str] | Mapping[str, Mapped | None] = (),
    goal_space: spaces.Space[Any] | None = None,
    achieved_goal_mapping: Mapped | None = None,
    desired_goal_mapping: Mapped | None = None,
    compute_reward: Callable[[Any, Any, Any], Any] | None = None,
) -> Definition:
    """Define a decision point: what its agent observes, may do and is rewarded with (paper, section 3.3).

    Callables other than ``compute_reward`` may have a keyword-only parameter ``_simulation``: it gets the simulation.

    Args:
        observation_space: The space of the agent's observations.
        observation_space_mapping: A callable of the decision call's arguments as they were passed (``self`` first for a
            method). It returns the observation, which is cast to the dtype of the space.
        action_space: The space of the agent's actions.
        action_space_mapping: The decision for an action: a callable of the action, or a dict with an entry for each
            action of a ``Discrete`` space. Its value is what the decision function returns.
        reward_mapping: A callable like ``observation_space_mapping``, called at each decision of the agent and at its
            end. It returns the reward of the agent's previous action.
        apply: An alternative to ``action_space_mapping``: a callable of the action and the call's arguments, which runs
            in the simulation instead of the rule. The decision function returns its result.
        choices: A callable of the call's arguments that returns the sequence of legal answers. The action is an index
            into it, ``action_space`` a ``Discrete`` (from 0) of the largest length. The action mask follows from it.
            The decision function returns the chosen answer; with ``apply``, that gets the answer instead of the action.
        rule_action_mapping: The action that corresponds to a decision of the rule, for learning from the rule: a
            callable of the decision (and the call's arguments, if it takes more than one), which returns an action or
            None; or a dict from decision to action. After a decision of the rule, the agent's next info has it as
            ``"rule_action"``.
        agent: The name of the deciding agent, or a callable of the call's arguments that returns it (None: the rule
            decides). Default: the letters of the function's name in lower case and a number, such as
            ``choosewateramount_0``.
        action_mask_mapping: A callable of the call's arguments that returns the action mask of a ``Discrete`` or
            ``MultiDiscrete``: 1 for each legal action, 0 for others.
        removed_by: The functions of the model whose calls end an agent's episode: a dotted name, several, or a dict
            from dotted name to a callable of that call's arguments that returns the agent's name. Without a callable,
            it is the agent that ``agent`` names for the call's first argument, or that it named for it last.
        goal_space: The space of goals. With it and the next three arguments, the single view is goal-based.
        achieved_goal_mapping: A callable like ``observation_space_mapping`` that returns the achieved goal.
        desired_goal_mapping: A callable like ``observation_space_mapping`` that returns the desired goal.
        compute_reward: A callable of achieved goals, desired goals and infos, of one step or stacked (shape ``(n,
            *goal_space.shape)``). It returns the reward of each, for learners that replay with other goals.

    Returns:
        The definition, which is a decorator for the function that decides.

    Raises:
        DefinitionError: The definition cannot work.
    """
    return Definition(**locals())  # which checks them


def _check(definition: Definition) -> None:
    """Check the parts of a definition, one by one and together."""
    for name in ("observation_space", "action_space", "goal_space"):
        space = getattr(definition, name)
        if not isinstance(space, spaces.Space) and (name != "goal_space" or space is not None):
            raise DefinitionError(f"make_step: {name} must be a gymnasium space, not {short_repr(space)}")
    required = ("observation_space_mapping", "reward_mapping")
    goal = ("goal_space", "achieved_goal_mapping", "desired_goal_mapping", "compute_reward")
    for name in (*required, "apply", "choices", "action_mask_mapping", *goal[1:]):
        function = getattr(definition, name)
        if not callable(function) and (name in required or function is not None):
            raise DefinitionError(f"make_step: {name} must be callable, not {short_repr(function)}")
    for name in ("action_space_mapping", "rule_action_mapping"):
        mapping = getattr(definition, name)
        if mapping is not None and not callable(mapping) and not isinstance(mapping, Mapping):
            raise DefinitionError(f"make_step: {name} must be a callable or a dict, not {short_repr(mapping)}")
    agent = definition.agent
    if agent is not None and not (callable(agent) or (isinstance(agent, str) and agent)):
        raise DefinitionError(f"make_step: agent must be a name or a callable, not {short_repr(agent)}")
    given = [name for name in ("action_space_mapping", "apply", "choices") if getattr(definition, name) is not None]
    if len(given) != 1 and given != ["apply", "choices"]:
        raise DefinitionError(
            "make_step: give one of action_space_mapping, apply and choices (or both apply and choices), to say what an"
            f" action decides; given: {', '.join(given) or 'none'}"
        )
    space, mask = definition.action_space, definition.action_mask_mapping
    if mask is not None and not isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        raise DefinitionError(
            f"make_step: action_mask_mapping needs a Discrete or MultiDiscrete action_space, not {space}"
        )
    if definition.choices is not None:
        if not isinstance(space, spaces.Discrete) or space.start != 0:
            raise DefinitionError(f"make_step: choices needs a Discrete action_space that starts at 0, not {space}")
        if mask is not None:
            raise DefinitionError("make_step: choices makes the mask itself; leave action_mask_mapping out")
    missing = [name for name in goal if getattr(definition, name) is None]
    if 0 < len(missing) < len(goal):
        raise DefinitionError(f"make_step: a goal needs all of its parts; missing: {', '.join(missing)}")
    answers = _answers(definition.action_space_mapping)
    if answers is None:
        return
    if not isinstance(space, spaces.Discrete):
        raise DefinitionError(f"make_step: a dict as action_space_mapping needs a Discrete action_space, not {space}")
    actions = range(int(space.start), int(space.start + space.n))
    absent = [action for action in actions if action not in answers]
    surplus = [action for action in answers if action not in actions]
    if absent or surplus:
        raise DefinitionError(
            f"make_step: the dict action_space_mapping must have just the actions of {space};"
            f" missing: {absent}, not in the space: {surplus}"
        )


def _answers(mapping: Any) -> Mapping[Any, Any] | None:
    """Return the dict from action to decision that was given as ``action_space_mapping``; None for a callable."""
    if isinstance(mapping, Mapping):
        return mapping
    owner = getattr(mapping, "__self__", None)
    return owner if isinstance(owner, dict) and mapping.__name__ == "__getitem__" else None


def inverse(definition: Definition) -> dict[Any, Any] | None:
    """Return the dict from decision to action, if ``action_space_mapping`` is a dict that can be inverted."""
    answers = _answers(definition.action_space_mapping) or {}
    try:
        actions = {decision: action for action, decision in answers.items()}
    except TypeError:  # unhashable decisions
        return None
    return actions if actions and len(actions) == len(answers) else None


# -- decision points ------------------------------------------------------------------------------

BY_NAME: Final = "simenv_marl_point"
"""The attribute with the name of a function that a simulation names itself and that is not in a module."""

_REGISTRY: "WeakValueDictionary[str, DecisionPoint]" = WeakValueDictionary()
"""The decorated points, by dotted name. Weak, so that a model can be garbage-collected with its points."""


class DecisionPoint:
    """A function of a model that decides something, under any definition.

    Attributes:
        hook: The hook of the function.
        name: The dotted name, ``package.module.Class.function``.
        rule: The undecorated function, which decides where no environment or policy does.
        definition: The latest definition, which the bare name means; None for a point that was named from outside the
            model and is a decision point for some environments only.
        removed_by: Functions (or names) whose calls end its agents, under every definition: see ``make_step``.
    """

    __slots__ = ("__weakref__", "definition", "hook", "name", "removed_by", "rule")

    def __init__(self, hook: Hook) -> None:
        self.hook, self.name, self.rule = hook, hook.name, hook.function
        self.definition: Definition | None = None
        self.removed_by: dict[Any, Mapped | None] = {}

    def __repr__(self) -> str:
        return f"<DecisionPoint {self.name}>"

    def __reduce__(self) -> Any:
        return point_for, (self.hook,), self.definition

    def __setstate__(self, definition: Definition) -> None:
        """Set the definition after unpickling, unless the point has one of this process."""
        if self.definition is None:
            self.definition = definition
            _REGISTRY.setdefault(self.name, self)

    @property
    def letters(self) -> str:
        """The letters of the function's name in lower case, for the default name of its agent."""
        return re.sub("[^a-z]", "", self.name.rpartition(".")[2].lower()) or "agent"


def point_for(hook: Hook) -> "DecisionPoint":
    """Return the decision point of a hook, which may be new.

    Raises:
        PatchError: The hook's function is not written in Python.
    """
    if not isinstance(hook.function, FunctionType):
        raise PatchError(f"{hook.name} cannot be a decision point: it is not a function written in Python")
    if hook.point is None:
        hook.point = DecisionPoint(hook)
    point: DecisionPoint = hook.point
    return point


def point_of(function: Any) -> "tuple[DecisionPoint, Definition | None] | None":
    """Return the point of a decision function, also as an attribute of a class, and its definition; or None."""
    hook = hook_of(function)
    if hook is None:
        return None
    definition: Definition | None = made_with(unbind(function))
    if definition is None and hook.point is None:
        return None
    return point_for(hook), definition


def registered(name: str) -> "DecisionPoint | None":
    """Return the decorated decision point with that dotted name."""
    return _REGISTRY.get(name)


def decision_points() -> list[str]:
    """Return the dotted names of all decorated decision points, in the order of decoration."""
    return list(_REGISTRY)


# -- differences ----------------------------------------------------------------------------------


class Difference:
    """A mapping that returns the change of another mapping's value. Made by ``difference``."""

    def __init__(self, function: Mapped) -> None:
        if not DIFFERENCES:  # one is enough
            DIFFERENCES.append(getattr(function, "__qualname__", None) or short_repr(function))
        self._function = function
        update_wrapper(self, function)

    def __reduce__(self) -> Any:
        return Difference, (self._function,)  # which notes, in another process too, that there are differences

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Return the change of the function's value for these arguments."""
        value = self._function(*args, **kwargs)
        evaluation = EVALUATING.get(getcurrent())
        memory = None if evaluation is None else evaluation.memory
        if memory is None:
            return 0.0
        before = memory.get(self, value)
        memory[self] = copy(value) if isinstance(value, np.ndarray) else value  # an array may change in place
        return value - before


def difference(function: Mapped) -> Difference:
    """Make a mapping that returns the change of ``function(*arguments)``.

    The change is the difference from its value at the last call for the same agent in the same episode; it is 0.0 at
    the first call. The result can be used as a mapping, or be called in one. It replaces the global variable that a
    reward such as "water used since the last decision" would need (paper, supplement S2).

    Args:
        function: A callable of the decision call's arguments that returns a number.

    Returns:
        The mapping. It returns 0.0 when it is not called for an environment's mapping.

    Raises:
        DefinitionError: ``function`` is not callable.
    """
    if not callable(function):
        raise DefinitionError(f"difference: {short_repr(function)} is not callable")
    return Difference(function)
