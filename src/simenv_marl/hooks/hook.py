"""Hooks: one for each function of a model that is decided or extended, with functions that stand in front of it.

A *wrapper* looks and behaves like the function, has its signature, and costs almost nothing while the hook has no
*interceptors*. A call finds its interceptor by the greenlet it runs in. For an episode, a driver enters its
simulation's stack, with the environment's decision inside and the handlers around it; at the end it removes the entry.
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
from .handlers import CALLS, ITEMS
from .stacks import EVALUATING, STACKS, Interceptor, spawner_of, stack_of
from .targets import AROUND, Target

_ABSENT: Final = object()

_TAKEN: Final = ("ABSENT", "NOTHING", "bind", "rule")
"""Names that the code below uses."""

_FILE: Final = "<wrapper of "

_ASK: Final = "(INTERCEPTORS.get(getcurrent()) or elsewhere)({}, {})".format

_RULE = "not INTERCEPTORS or not OTHERS and getcurrent().parent is None"
"""Whether the rule decides at once: the hook has no interceptors, or they are all on stacks of simulations, and the
call comes from the root of a thread."""

_SPAWNED: Final = 'a greenlet that the simulation has spawned with gevent (driver="thread" allows that)'

_CALL = {"function": "{}", "generator": "(yield from {})", "coroutine": "(await {})"}

# This determines the cost of a call without interceptors. A method with no argument but ``self`` costs two plain calls.
# If arguments can be passed by keyword it costs three, because mappings and handlers must get them as they were
# passed.
_WITHOUT_ARGUMENTS = """
{define} wrapper({names}):
    if {at_once}:
        return {rule}
    return {ask}
"""
_WITH_ARGUMENTS = """
{define} wrapper({positional}, /, **kwargs):
    if kwargs or {last} is ABSENT:
        args = {passed}
        if {at_once}:
            return {rule_as_passed}
        if kwargs or len(args) < {required}:
            bind(*args, **kwargs)
        return {ask}
    if {at_once} or {wrong}:
        return {rule}
    return {ask_all}
"""
_VARIADIC = """
{define} wrapper(*args, **kwargs):
    if {at_once}:
        return {rule_as_passed}
    bind(*args, **kwargs)
    return {ask}
"""


def kind_of(function: Any, name: str) -> str:
    """Return what a call of a function returns: "function" (its value), "generator" or "coroutine".

    Raises:
        PatchError: It is an async generator function.
    """
    if inspect.isasyncgenfunction(function):
        raise PatchError(f"{name} is an async generator function, which cannot return a decision or call handlers")
    if inspect.isgeneratorfunction(function):
        return "generator"
    return "coroutine" if inspect.iscoroutinefunction(function) else "function"


def is_method(function: Any, name: str) -> bool:
    """Return whether a function of that dotted name was defined in a class."""
    return "." in name.removeprefix(f"{function.__module__}.").rpartition("<locals>.")[2]


def is_alone(signature: inspect.Signature, *, bound: bool) -> bool:
    """Return whether every call has one argument: the object it is called on, never passed by keyword."""
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
    """Generate the wrapper of a function.

    Args:
        rule: The function.
        signature: Its signature; None if it is unknown.
        name: Its dotted name.
        kind: What a call returns, as ``kind_of`` returns it.
        alone: The result of ``is_alone``.
        namespace: The values of the names in ``_ASK``.
    """
    parameters = signature.parameters.values() if signature is not None else ()
    positional = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    names = [f"_{number}" for number in range(len(positional))]
    # Keep the parameter's name: if a staticmethod looks like a method, it may be passed by keyword.
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
        "at_once": _RULE,
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
            "wrong": str(required > len(names)),  # the rule raises Python's own error
            "ask_all": call(_ASK(f"({', '.join(names)},)", "kwargs")),
        }
    else:
        template = _VARIADIC
    scope: dict[str, Any] = {
        "ABSENT": _ABSENT,
        "NOTHING": {},  # shared by all calls, since it is only unpacked
        "bind": signature.bind if signature is not None else _anything,
        "rule": rule,
        "__name__": __name__,
        **namespace,
    }
    exec(compile(template.format(**values), f"{_FILE}{name}>", "exec"), scope)
    function: FunctionType = scope["wrapper"]
    function.__code__ = function.__code__.replace(co_name=getattr(rule, "__name__", "call"))  # the name in tracebacks
    update_wrapper(function, rule)
    return function


def _anything(*args: Any, **kwargs: Any) -> None:
    """Accept any arguments, if the signature is unknown."""


def _is_required(parameter: inspect.Parameter) -> bool:
    positional = parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
    return positional and parameter.default is parameter.empty


def is_wrapper(function: Any) -> bool:
    """Return whether a function is a wrapper."""
    # Checked by its code, not by an attribute: other decorators copy a function's attributes.
    return isinstance(function, FunctionType) and function.__code__.co_filename.startswith(_FILE)


# -- hooks ----------------------------------------------------------------------------------------

MADE_OF: Final[WeakKeyDictionary[Any, WeakSet[Hook]]] = WeakKeyDictionary()
"""The hooks in front of each function, one per decoration."""


class _Interceptors(dict[Any, Interceptor]):
    """The interceptors of one hook. A wrapper that is pickled by value finds those of the process it arrives in."""

    __slots__ = ("hook", "others")

    def __init__(self, hook: Hook) -> None:
        super().__init__()
        self.hook = hook
        self.others = _Others(hook)

    def __setitem__(self, key: Any, interceptor: Interceptor) -> None:
        super().__setitem__(key, interceptor)
        if not isinstance(key, greenlet) or key.parent is None:
            self.others.add(key)

    def remove(self, key: Any) -> None:
        """Remove the interceptor of a key, if there is one."""
        self.pop(key, None)
        self.others.discard(key)

    def __reduce__(self) -> Any:
        return getattr, (self.hook, "interceptors")


class _Others(set[Any]):
    """The keys that are no stack of a greenlet (a thread's root, plugins, None), and drivers with threads."""

    __slots__ = ("_hook",)

    def __init__(self, hook: Hook) -> None:
        super().__init__()
        self._hook = hook

    def __reduce__(self) -> Any:
        return _others_of, (self._hook,)


def _others_of(hook: Hook) -> _Others:
    return hook.interceptors.others


class Elsewhere:
    """What a wrapper calls if its hook has no interceptor for the call.

    Attributes:
        hook: The hook.
        made_with: The object that the wrapper was made with, for the layer above. It is kept here because a wrapper
            that is pickled by value takes along only what its code names.
    """

    __slots__ = ("hook", "made_with")

    def __init__(self, hook: Hook, made_with: Any) -> None:
        self.hook, self.made_with = hook, made_with

    def __call__(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run a call.

        Raises:
            WrongThreadError: It is a decision, and the simulation cannot wait for its answer here.
        """
        hook = self.hook
        interceptor = hook.interceptor_at(getcurrent())
        if interceptor is not None:
            return interceptor(args, kwargs)
        rule = hook.rule
        return rule(*args, **kwargs) if kwargs else rule(*args)


class Hook(Target):
    """A function of a model that is decided or extended, with the interceptors of its calls.

    Attributes:
        function: The function.
        rule: The innermost part of a call: the function, or its temporary replacement.
        kind: What a call returns: "function" (a value), "generator" or "coroutine".
        bound: Whether its first argument is the object it is called on, which is never passed by keyword.
        alone: Whether every call has one argument, the object it is called on.
        interceptors: Those of calls. Key: a greenlet for calls on the stack of a simulation; plugins, or None, for all
            other calls while an environment with these plugins, or without plugins, is evaluated.
        wrappers: The functions that stand in front of the function.
        place: The place of a wrapper while the hook is installed; None if none is to be set.
        permanent: Whether a wrapper was set permanently, as a decorated or exposed function.
        point: The object that the layer above makes of the hook.
    """

    def __init__(self, function: Any, name: str, *, bound: bool = True, like: Any = None, place: Any = None) -> None:
        """Make the hook of a function.

        Args:
            function: The function.
            name: Its dotted name.
            bound: Whether, in a class, its first argument is the object it is called on.
            like: The function that determines what calls return, if ``function`` only forwards to it.
            place: The place for a temporary wrapper.

        Raises:
            PatchError: It is an async generator function.
        """
        self.function = self.rule = function
        self.kind = kind_of(function if like is None else like, name)
        self._own: inspect.Signature | None = None
        signature: inspect.Signature | None = None
        try:
            self._own = inspect.signature(function, follow_wrapped=False)
            signature = inspect.signature(function)
        except (TypeError, ValueError):
            self._own = None  # the signature is unknown
        self.bound = bound and is_method(function, name)
        self.alone = self._own is not None and is_alone(self._own, bound=self.bound)
        self.interceptors = _Interceptors(self)
        self.wrappers: WeakSet[FunctionType] = WeakSet()
        self.place = place
        self.permanent = place is None
        self.point: Any = None
        self._set: FunctionType | None = None  # the temporary wrapper
        iterates = self.kind == "generator"
        super().__init__(name, CALLS + ITEMS if iterates else CALLS, "is not a generator function", signature)
        with suppress(TypeError):  # not all objects can be referenced weakly
            MADE_OF.setdefault(function, WeakSet()).add(self)

    def __reduce__(self) -> Any:
        made_of = (self.function, self.name, self.bound, self.kind, self.exposed)
        return _restored, made_of, self.point, None, None, _came_along

    def make_wrapper(self, made_with: Any = None) -> FunctionType:
        """Make a permanent wrapper of the hook's function.

        Args:
            made_with: The object that the function ``made_with`` returns for it.
        """
        made = generate(
            self.function,
            self._own,
            name=self.name,
            kind=self.kind,
            alone=self.alone,
            namespace={
                "INTERCEPTORS": self.interceptors,
                "OTHERS": self.interceptors.others,
                "elsewhere": Elsewhere(self, made_with).__call__,
                "getcurrent": getcurrent,
            },
        )
        self.wrappers.add(made)
        return made

    # -- where it is set --------------------------------------------------------------------------

    @property
    def stale(self) -> bool:
        """Whether something else has replaced it while no wrapper was set in its place."""
        return self.place is not None and not self._users and not self.place.is_free(self)

    def install(self, user: object) -> None:
        """Set a wrapper in its place until every user has called ``uninstall``.

        Raises:
            PatchError: The place cannot be patched, or something else was set there meanwhile.
        """
        if self.place is not None:
            super().install(user)

    def _apply(self) -> None:
        if self._set is None:
            self._set = self.make_wrapper()
        self.place.put(self, self._set)

    def _revert(self) -> None:
        if self.place is not None and self._set is not None:
            self.place.put_back(self._set)

    # -- who takes part ---------------------------------------------------------------------------

    def enter(self, stack: greenlet, decide: Interceptor | None, plugins: Any) -> None:
        """Enter an interceptor for calls on the stack of a simulation.

        Args:
            stack: The stack.
            decide: What decides instead of the rule. None: the rule decides, with handlers if the plugins have some.
            plugins: The plugins of the simulation's environment.
        """
        if decide is not None:
            self.interceptors[stack] = self.around(decide, plugins)
        elif plugins in self.slot and plugins is not None:
            self.interceptors[stack] = self.around(self.run_rule, plugins)
        else:
            self.interceptors.remove(stack)

    def leave(self, stack: greenlet) -> None:
        """Remove the interceptor of a stack."""
        self.interceptors.remove(stack)

    def around(self, inner: Interceptor, plugins: Any) -> Interceptor:
        """Return an interceptor that runs the handlers of plugins, or of the whole process, around ``inner``."""
        found = self.slot.get(plugins) or self.slot.get(None)
        return inner if found is None else partial(AROUND[self.kind], found, self.slot, inner)

    def run_rule(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run the rule."""
        return self.rule(*args, **kwargs)

    def replace_rule(self, rule: Any = None) -> None:
        """Replace the rule; None restores the function.

        Simulations that are already running keep the rule they had.
        """
        self.rule = self.function if rule is None else rule
        self._changed()

    def interceptor_at(self, here: greenlet) -> Interceptor | None:
        """Return the interceptor of a call in a greenlet; None if only the rule runs."""
        driver = stack_of(here) if STACKS else None
        if hasattr(here, "spawning_greenlet"):
            spawner = spawner_of(here)
            if spawner is not None and not spawner.own_thread and spawner.decides(self):
                interceptor: Interceptor = spawner.refuse(self, _SPAWNED)
                return interceptor
        if driver is None:
            evaluation = EVALUATING.get(here)
            plugins = None if evaluation is None else evaluation.plugins
        else:
            plugins = driver.plugins
            decide = driver.interceptor(self)
            if decide is not None:
                return self.around(decide, plugins)
        return self.interceptors.get(plugins) or self.interceptors.get(None)

    def _changed(self) -> None:
        interceptors, slot = self.interceptors, self.slot
        for plugins in list(slot) if self.rule is self.function else [None, *slot]:  # garbage collection may change it
            interceptors[plugins] = self.around(self.run_rule, plugins)
        for key, interceptor in list(interceptors.items()):
            if not isinstance(key, greenlet):
                if key not in slot and (key is not None or self.rule is self.function):
                    interceptors.remove(key)
                continue
            inner = interceptor.args[2] if isinstance(interceptor, partial) else interceptor
            plugins = getattr(STACKS.get(key), "plugins", None)
            self.enter(key, None if inner == self.run_rule else inner, plugins)


def hook_of(function: Any) -> Hook | None:
    """Return the hook of a wrapper; None for any other function."""
    if is_wrapper(function):
        hook: Hook = function.__globals__["elsewhere"].__self__.hook
        return hook
    return None


def made_with(function: FunctionType) -> Any:
    """Return the object that a wrapper was made with."""
    return function.__globals__["elsewhere"].__self__.made_with


def unwrap(function: Any) -> Any:
    """Return the function behind a wrapper; any other function itself."""
    hook = hook_of(function)
    return function if hook is None else hook.function


def _restored(function: Any, name: str, bound: bool, kind: str, exposed: bool) -> Hook:
    """Return the hook of an unpickled function: an existing one, or a new one."""
    for hook in MADE_OF.get(function, ()):
        if hook.name == name:
            return hook
    hook = Hook(function, name, bound=bound)
    hook.bound, hook.kind, hook.exposed = bound, kind, exposed
    return hook


def _came_along(hook: Hook, point: Any) -> None:
    """Do nothing: the layer above unpickles the point itself and gives it to the hook of this process."""
