"""Hooks: one for each function of a model that is decided or extended, with functions that stand in front of it.

A *stand-in* looks and behaves like the function, with its signature, and costs next to nothing while the hook has no
*takers*. Those are found by the greenlet in which a call arises: a driver enters the stack of its simulation for an
episode, with the decision of the environment inside and the handlers around it, and takes it out at the end.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from contextlib import suppress
from functools import partial, update_wrapper
from types import FunctionType
from typing import Any, Final
from weakref import WeakKeyDictionary, WeakSet

from greenlet import getcurrent, greenlet

from ..errors import PatchError
from .attached import CALLS, ITEMS
from .handlers import AROUND, Target
from .stacks import EVALUATING, LOCK, STACKS, Taker, spawner_of, stack_of

_ABSENT: Final = object()

_TAKEN: Final = ("ABSENT", "NOTHING", "bind", "rule")
"""Names that mean something in what is written below."""

_FILE: Final = "<stand-in for "

_ASK: Final = "TAKERS.get(getcurrent(), elsewhere)({}, {})".format

_SPAWNED: Final = 'a greenlet that the simulation has spawned on a hub of others (with driver="thread" it could be)'

_CALL = {"function": "{}", "generator": "(yield from {})", "coroutine": "(await {})"}

# What a call costs that has no takers is decided here. A method that takes nothing but
# ``self`` costs two plain calls. Where arguments can be passed by keyword it costs three, because mappings and
# handlers are to receive them as they were passed.
_WITHOUT_ARGUMENTS = """
{define} stand_in({names}):
    if not TAKERS:
        return {rule}
    return {ask}
"""
_WITH_ARGUMENTS = """
{define} stand_in({positional}, /, **kwargs):
    if TAKERS or kwargs or {last} is ABSENT:
        args = {passed}
        if not TAKERS:
            return {rule_as_passed}
        if kwargs or len(args) < {required}:
            bind(*args, **kwargs)
        return {ask}
    return {rule}
"""
_VARIADIC = """
{define} stand_in(*args, **kwargs):
    if not TAKERS:
        return {rule_as_passed}
    bind(*args, **kwargs)
    return {ask}
"""


def kind_of(function: Any, name: str) -> str:
    """What a call of a function returns: "function" (its value), "generator" or "coroutine".

    Raises:
        PatchError: An async generator function, which has neither a value nor items at hand.
    """
    if inspect.isasyncgenfunction(function):
        raise PatchError(f"{name} is an async generator function, which cannot return a decision or call handlers")
    if inspect.isgeneratorfunction(function):
        return "generator"
    return "coroutine" if inspect.iscoroutinefunction(function) else "function"


def is_method(function: Any, name: str) -> bool:
    """Whether a function of that dotted name was written in a class."""
    return "." in name.removeprefix(f"{function.__module__}.").rpartition("<locals>.")[2]


def is_alone(signature: inspect.Signature, *, bound: bool) -> bool:
    """Whether every call has one argument, which is what it is called on and is never passed by keyword."""
    parameters = list(signature.parameters.values())
    return bound and len(parameters) == 1 and _is_required(parameters[0])


def generate(
    rule: Any,
    signature: inspect.Signature | None,
    *,
    name: str,
    kind: str,
    alone: bool,
    namespace: Mapping[str, Any],
) -> FunctionType:
    """Write a function that stands in front of another one.

    Args:
        rule: The function.
        signature: Its own signature; None where that is not known.
        name: Its dotted name.
        kind: What a call of it returns, as ``kind_of`` has it.
        alone: As ``is_alone`` has it.
        namespace: What the names mean of which ``_ASK`` is made.
    """
    parameters = signature.parameters.values() if signature is not None else ()
    positional = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    names = [f"_{number}" for number in range(len(positional))]
    # Under its own name, by which it may be passed all the same where a staticmethod looks like a method.
    alone = alone and positional[0].name not in {*namespace, *_TAKEN}
    if alone:
        names = [positional[0].name]
    call = _CALL[kind].format
    values = {
        "define": "async def" if kind == "coroutine" else "def",
        "names": ", ".join(names),
        "rule": call(f"rule({', '.join(names)})"),
        "rule_as_passed": call("rule(*args, **kwargs)"),
        "ask": call(_ASK("args", "kwargs")),
    }
    if signature is None:
        template = _VARIADIC
    elif alone or not parameters:
        template = _WITHOUT_ARGUMENTS
        values["ask"] = call(_ASK(f"({names[0]},)" if names else "()", "NOTHING"))
    elif positional and not any(p.kind is p.VAR_POSITIONAL for p in parameters):
        template = _WITH_ARGUMENTS
        required = sum(p.default is p.empty for p in positional)
        if any(p.kind is p.KEYWORD_ONLY and p.default is p.empty for p in parameters):
            required = len(names) + 1  # a call without keywords is wrong
        passed = "()"
        for number, absent in enumerate(names):
            passed = f"({', '.join(names[: number + 1])},) if {absent} is not ABSENT else {passed}"
        values |= {
            "positional": ", ".join(f"{absent}=ABSENT" for absent in names),
            "passed": passed,
            "last": names[-1],
            "required": str(required),
        }
    else:
        template = _VARIADIC
    scope: dict[str, Any] = {
        "ABSENT": _ABSENT,
        "NOTHING": {},  # shared by all calls: it is only ever unpacked
        "bind": signature.bind if signature is not None else _anything,
        "rule": rule,
        "__name__": __name__,
        **namespace,
    }
    exec(compile(template.format(**values), f"{_FILE}{name}>", "exec"), scope)
    function: FunctionType = scope["stand_in"]
    function.__code__ = function.__code__.replace(co_name=getattr(rule, "__name__", "call"))  # what tracebacks show
    update_wrapper(function, rule)
    return function


def _anything(*args: Any, **kwargs: Any) -> None:
    """Bind arguments of which nothing is known."""


def _is_required(parameter: inspect.Parameter) -> bool:
    positional = parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
    return positional and parameter.default is parameter.empty


def stands_in(function: Any) -> bool:
    """Whether a function was generated here."""
    # Told by what nothing can copy: other decorators take over a function's attributes.
    return isinstance(function, FunctionType) and function.__code__.co_filename.startswith(_FILE)


# -- hooks ----------------------------------------------------------------------------------------

MADE_OF: Final[WeakKeyDictionary[Any, WeakSet[Hook]]] = WeakKeyDictionary()
"""By function: the hooks in front of it, each of a decoration of its own."""


class _Takers(dict[Any, Taker]):
    """Who takes part in the calls of one hook. A stand-in that is pickled by value finds them where it arrives."""

    __slots__ = ("hook",)

    def __init__(self, hook: Hook) -> None:
        super().__init__()
        self.hook = hook

    def __reduce__(self) -> Any:
        return _takers_of, (self.hook,)


def _takers_of(hook: Hook) -> _Takers:
    return hook.takers


class Elsewhere:
    """What a stand-in calls where its hook knows of no taker.

    Attributes:
        hook: The hook.
        made_with: What the stand-in was made with, for the layer above. It is kept here so that it stays with the
            stand-in when that is pickled by value, which takes along what its code names, and nothing else.
    """

    __slots__ = ("hook", "made_with")

    def __init__(self, hook: Hook, made_with: Any) -> None:
        self.hook, self.made_with = hook, made_with

    def __call__(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run a call.

        Raises:
            WrongThreadError: It is a decision of a simulation that cannot wait here for its answer.
        """
        hook = self.hook
        here = getcurrent()
        if here.parent is None and not EVALUATING and here not in STACKS:  # a thread of the user's
            taker = hook.takers.get(None)
        else:
            taker = hook.taker_at(here)
        if taker is not None:
            return taker(args, kwargs)
        rule = hook.rule
        return rule(*args, **kwargs) if kwargs else rule(*args)


class Hook(Target):
    """One function of a model, and who takes part in its calls.

    Attributes:
        function: The function.
        rule: What a call runs innermost: the function, or what stands for it for a while.
        kind: "function", "generator" or "coroutine": what a call of it returns.
        bound: Whether its first argument is what it is called on, which nothing passes by keyword.
        alone: Whether every call has one argument, which is what it is called on.
        takers: Who takes part. By greenlet: in calls on the stack of a simulation; by plugins, and by None, in all
            other calls while an environment with these plugins is at work, or none.
        stand_ins: The functions that stand in front of the function.
        place: Where one of them is set for as long as the hook is held; None where nothing is to be set.
        for_good: Whether one of them stands somewhere for good, as a decorated or exposed function.
        point: What the layer above makes of the hook.
    """

    def __init__(self, function: Any, name: str, *, bound: bool = True, like: Any = None, place: Any = None) -> None:
        """Make the hook of a function.

        Args:
            function: The function.
            name: Its dotted name.
            bound: Whether, in a class, its first argument is what it is called on.
            like: A function that tells what calls return, where the function only passes them on to it.
            place: Where a stand-in is to be set for a while.

        Raises:
            PatchError: An async generator function, to which no position applies.
        """
        self.function = self.rule = function
        self.kind = kind_of(function if like is None else like, name)
        self._own: inspect.Signature | None = None
        signature: inspect.Signature | None = None
        try:
            self._own = inspect.signature(function, follow_wrapped=False)
            signature = inspect.signature(function)
        except (TypeError, ValueError):
            self._own = None  # nothing is known of it
        self.bound = bound and is_method(function, name)
        self.alone = self._own is not None and is_alone(self._own, bound=self.bound)
        self.takers = _Takers(self)
        self.stand_ins: WeakSet[FunctionType] = WeakSet()
        self.place = place
        self.for_good = place is None
        self.point: Any = None
        self._holders: set[object] = set()
        self._stands = False
        self._set: FunctionType | None = None  # the stand-in that is set for a while
        iterates = self.kind == "generator"
        super().__init__(name, CALLS + ITEMS if iterates else CALLS, "is no generator function", signature)
        with suppress(TypeError):  # what cannot be referred to weakly
            MADE_OF.setdefault(function, WeakSet()).add(self)

    def __reduce__(self) -> Any:
        made_of = (self.function, self.name, self.bound, self.kind, self.exposed)
        return _restored, made_of, self.point, None, None, _came_along

    def stand_in(self, made_with: Any = None) -> FunctionType:
        """Make a function that stands in front of the hook's function for good.

        Args:
            made_with: What ``made_with`` is going to tell of it.
        """
        made = generate(
            self.function,
            self._own,
            name=self.name,
            kind=self.kind,
            alone=self.alone,
            namespace={
                "TAKERS": self.takers,
                "elsewhere": Elsewhere(self, made_with).__call__,
                "getcurrent": getcurrent,
            },
        )
        self.stand_ins.add(made)
        return made

    # -- where it is set --------------------------------------------------------------------------

    @property
    def stale(self) -> bool:
        """Whether something else has been set in its place, while nothing was set there for it."""
        return self.place is not None and not self._holders and not self.place.is_free(self)

    def hold(self, holder: object) -> None:
        """Have a stand-in set in its place until ``let_go``, by all who hold it.

        Raises:
            PatchError: The place refuses, or something else has been set there meanwhile.
        """
        with LOCK:
            # Noted at once: the collector may come in between and close an environment that holds it, too.
            self._holders.add(holder)
            if self._stands or self.place is None:
                return
            try:
                if self._set is None:
                    self._set = self.stand_in()
                self.place.put(self, self._set)
                self._stands = True
            except BaseException:
                self.let_go(holder)
                raise

    def let_go(self, holder: object) -> None:
        """Undo ``hold``; the last one puts back what stood there. After an interrupt it is to be called again."""
        with LOCK:
            self._holders.discard(holder)
            if not self._holders and self.place is not None and self._set is not None:
                self._stands = False
                self.place.put_back(self._set)

    # -- who takes part ---------------------------------------------------------------------------

    def enter(self, stack: greenlet, decide: Taker | None, plugins: Any) -> None:
        """Take part in calls on the stack of a simulation.

        Args:
            stack: The stack.
            decide: Who decides, in the rule's stead; None: the rule, where the plugins have handlers.
            plugins: The plugins of the simulation's environment.
        """
        if decide is not None:
            self.takers[stack] = self.around(decide, plugins)
        elif plugins in self.slot and plugins is not None:
            self.takers[stack] = self.around(self.run_rule, plugins)
        else:
            self.takers.pop(stack, None)

    def leave(self, stack: greenlet) -> None:
        """Take no part any more."""
        self.takers.pop(stack, None)

    def around(self, inner: Taker, plugins: Any) -> Taker:
        """The handlers that there are for plugins, or else for the whole process, around what is inside them."""
        found = self.slot.get(plugins) or self.slot.get(None)
        return inner if found is None else partial(AROUND[self.kind], found, self.slot, inner)

    def run_rule(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Have the rule decide."""
        return self.rule(*args, **kwargs)

    def replace_rule(self, rule: Any = None) -> None:
        """Have something else run where the function does; None: the function again.

        Simulations whose ``run`` has begun keep what they had.
        """
        self.rule = self.function if rule is None else rule
        self._changed()

    def taker_at(self, here: greenlet) -> Taker | None:
        """Who takes part in a call in a greenlet; None: nothing but the rule."""
        stack = stack_of(here)
        if stack is None:
            evaluation = EVALUATING.get(here)
            plugins = None if evaluation is None else evaluation.plugins
            if plugins is None and STACKS:
                spawner = spawner_of(here)
                refuse = None if spawner is None else spawner.refusal_of(self, _SPAWNED)
                if refuse is not None:
                    taker: Taker = refuse
                    return taker
        else:
            plugins = stack.plugins
            decide = stack.taker(self, here)
            if decide is not None:
                return self.around(decide, plugins)
        return self.takers.get(plugins) or self.takers.get(None)

    def _changed(self) -> None:
        takers, slot = self.takers, self.slot
        for plugins in list(slot) if self.rule is self.function else [None, *slot]:  # the collector may change it
            takers[plugins] = self.around(self.run_rule, plugins)
        for key, taker in list(takers.items()):
            if not isinstance(key, greenlet):
                if key not in slot and (key is not None or self.rule is self.function):
                    takers.pop(key, None)
                continue
            inner = taker.args[2] if isinstance(taker, partial) else taker
            plugins = getattr(STACKS.get(key), "plugins", None)
            self.enter(key, None if inner == self.run_rule else inner, plugins)


def hook_of(function: Any) -> Hook | None:
    """The hook of a stand-in; None for any other function."""
    if stands_in(function):
        hook: Hook = function.__globals__["elsewhere"].__self__.hook
        return hook
    return None


def made_with(function: FunctionType) -> Any:
    """What a stand-in was made with."""
    return function.__globals__["elsewhere"].__self__.made_with


def beneath(function: Any) -> Any:
    """What a stand-in stands in front of; any other function as it is."""
    hook = hook_of(function)
    return function if hook is None else hook.function


def _restored(function: Any, name: str, bound: bool, kind: str, exposed: bool) -> Hook:
    """The hook of a function, in whichever process: the one that is there, or a new one."""
    for hook in MADE_OF.get(function, ()):
        if hook.name == name:
            return hook
    hook = Hook(function, name, bound=bound)
    hook.bound, hook.kind, hook.exposed = bound, kind, exposed
    return hook


def _came_along(hook: Hook, point: Any) -> None:
    """What the layer above had made of a hook has come along, and is by now what it makes of this one."""
