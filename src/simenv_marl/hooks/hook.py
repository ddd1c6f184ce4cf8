"""Hooks: one for each function of a model that is decided or extended, with wrappers in front of it.

A *wrapper* looks and behaves like the function, has its signature, and costs almost nothing while the hook has no
*interceptors*. A call finds its interceptor by the greenlet it runs in. For an episode, a driver enters its
simulation's stack, with the environment's decision inside and the handlers around it; at the end it removes the entry.
"""

from __future__ import annotations

import inspect
from contextlib import suppress
from functools import partial, update_wrapper
from types import FunctionType
from typing import Any, Final
from weakref import WeakKeyDictionary, WeakSet

from greenlet import getcurrent, greenlet

from ..errors import PatchError
from .handlers import CALLS, ITEMS
from .stacks import EVALUATING, STACKS, Interceptor, spawner_of, stack_of
from .targets import Target

_SPAWNED: Final = 'a greenlet that the simulation has spawned with gevent (driver="thread" allows that)'

# -- wrappers -------------------------------------------------------------------------------------

_ABSENT: Final = object()
"""The default of arguments that a call may leave out, because interceptors must get them as they were passed."""

_FILE: Final = "<wrapper of "

_MADE_WITH: Final = "__simenv_marl__"
"""The attribute of a wrapper with its hook and the object that it was made with."""

_RULE = "not INTERCEPTORS or not OTHERS and getcurrent().parent is None"
"""Whether the rule decides at once: the hook has no interceptors, or they are all on stacks of simulations, and the
call comes from the root of a thread."""

_INTERCEPT = "(INTERCEPTORS.get(getcurrent()) or intercept)"

_RETURN = {"function": "return {}", "generator": "return (yield from {})", "coroutine": "return (await {})"}

# This determines the cost of a call without interceptors: two plain calls if ``incomplete`` is "False", else three.
_TEMPLATE = """
def wrapper({parameters}):
    if {incomplete}:
        args = {passed}
        if {rule} or ({doubtful}) and not fits(*args, **kwargs):
            {rule_as_passed}
        {intercept_as_passed}
    if {rule}:
        {rule_at_once}
    {intercept}
"""


def _source(hook: Hook, scope: dict[str, Any]) -> str:
    """Return the source code of a hook's wrappers; ``scope`` has the names that it uses."""
    signature = hook.signature
    parameters = [] if signature is None else list(signature.parameters.values())
    positional = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    names = [f"_{number}" for number in range(len(positional))]
    incomplete = doubtful = "True"
    passed, accepted = "args", "*args, **kwargs"
    if (hook.alone and parameters[0].name not in scope) or (signature is not None and not parameters):
        incomplete = "False"
        names = [p.name for p in positional]  # a staticmethod that looks like a method may be passed it by keyword
        accepted = ", ".join(names)
    elif positional and not any(p.kind is p.VAR_POSITIONAL for p in parameters):
        required = sum(p.default is p.empty for p in positional)
        doubtful = f"kwargs or len(args) < {required}"
        if any(p.kind is p.KEYWORD_ONLY and p.default is p.empty for p in parameters):
            doubtful = "True"
        else:
            incomplete = f"kwargs or {names[-1]} is ABSENT"
        accepted = ", ".join(f"{name}=ABSENT" for name in names) + ", /, **kwargs"
        passed = "()"
        for number, name in enumerate(names):
            passed = f"({', '.join(names[: number + 1])},) if {name} is not ABSENT else {passed}"
    given = ", ".join(names)
    answer = _RETURN[hook.kind].format
    source = _TEMPLATE.format(
        parameters=accepted,
        incomplete=incomplete,
        passed=passed,
        doubtful=doubtful,
        rule=_RULE,
        rule_as_passed=answer("rule(*args, **kwargs)"),
        intercept_as_passed=answer(f"{_INTERCEPT}(args, kwargs)"),
        rule_at_once=answer(f"rule({given})"),
        intercept=answer(f"{_INTERCEPT}(({given + ',' if given else ''}), {{}})"),
    )
    return f"async {source.lstrip()}" if hook.kind == "coroutine" else source


def is_wrapper(function: Any) -> bool:
    """Return whether a function is a wrapper."""
    # Checked by its code, not by an attribute: other decorators copy a function's attributes.
    return isinstance(function, FunctionType) and function.__code__.co_filename.startswith(_FILE)


def hook_of(function: Any) -> Hook | None:
    """Return the hook of a wrapper; None for any other function."""
    return vars(function)[_MADE_WITH][0] if is_wrapper(function) else None


def made_with(wrapper: FunctionType) -> Any:
    """Return the object that a wrapper was made with."""
    return vars(wrapper)[_MADE_WITH][1]


def unwrap(function: Any) -> Any:
    """Return the function behind a wrapper; any other function itself."""
    hook = hook_of(function)
    return function if hook is None else hook.function


# -- hooks ----------------------------------------------------------------------------------------

MADE_OF: Final[WeakKeyDictionary[Any, WeakSet[Hook]]] = WeakKeyDictionary()
"""The hooks in front of each function, one per decoration."""


class _Interceptors(dict[Any, Interceptor]):
    """The interceptors of one hook. A wrapper that is pickled by value finds those of the process it arrives in."""

    __slots__ = ("hook", "others")

    def __init__(self, hook: Hook) -> None:
        super().__init__()
        self.hook, self.others = hook, _Others(self)

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

    __slots__ = ("_interceptors",)

    def __init__(self, interceptors: _Interceptors) -> None:
        super().__init__()
        self._interceptors = interceptors

    def __reduce__(self) -> Any:
        return getattr, (self._interceptors, "others")


class Hook(Target):
    """A function of a model that is decided or extended, with the interceptors of its calls.

    Attributes:
        function: The function.
        rule: The innermost part of a call: the function, or its temporary replacement.
        kind: What a call returns: "function" (a value), "generator" or "coroutine".
        signature: The signature of the function itself, not of what it wraps; None if it is unknown.
        bound: Whether its first argument is the object it is called on, which is never passed by keyword.
        alone: Whether every call has one argument, the object it is called on.
        interceptors: Those of calls. Key: a greenlet for calls on the stack of a simulation; plugins, or None, for all
            other calls while an environment with these plugins, or without plugins, is evaluated.
        wrappers: The wrappers of the function.
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
        like = function if like is None else like
        if inspect.isasyncgenfunction(like):
            raise PatchError(f"{name} is an async generator function, which cannot return a decision or call handlers")
        awaited = "coroutine" if inspect.iscoroutinefunction(like) else "function"
        self.kind = "generator" if inspect.isgeneratorfunction(like) else awaited
        self.function = self.rule = function
        signature = None
        with suppress(TypeError, ValueError):  # the signature is unknown
            signature = inspect.signature(function, follow_wrapped=False)
        self.bound = bound and "." in name.removeprefix(f"{function.__module__}.").rpartition("<locals>.")[2]
        parameters = [] if signature is None else list(signature.parameters.values())
        first = [
            p for p in parameters if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
        ]
        self.alone = self.bound and len(first) == len(parameters) == 1
        self.interceptors = _Interceptors(self)
        self.wrappers: WeakSet[FunctionType] = WeakSet()
        self.place, self.permanent = place, place is None
        self.point: Any = None
        self._temporary: FunctionType | None = None  # the wrapper for the place
        positions = CALLS + ITEMS if self.kind == "generator" else CALLS
        super().__init__(name, positions, "is not a generator function", signature)
        with suppress(TypeError):  # not all objects can be referenced weakly
            MADE_OF.setdefault(function, WeakSet()).add(self)

    def __reduce__(self) -> Any:
        made_of = (self.function, self.name, self.bound, self.kind, self.exposed)
        return _restored, made_of, self.point, None, None, _came_along

    def make_wrapper(self, made_with: Any = None) -> FunctionType:
        """Make a wrapper of the hook's function.

        Args:
            made_with: The object that the function ``made_with`` returns for it.
        """
        scope: dict[str, Any] = {
            "__name__": __name__, "ABSENT": _ABSENT, "INTERCEPTORS": self.interceptors,
            "OTHERS": self.interceptors.others, "fits": self._fits, "getcurrent": getcurrent,
            "intercept": self._intercept, "rule": self.function,
        }  # fmt: skip
        exec(compile(_source(self, scope), f"{_FILE}{self.name}>", "exec"), scope)
        made: FunctionType = scope["wrapper"]
        name = getattr(self.function, "__name__", "call")
        made.__code__ = made.__code__.replace(co_name=name)  # the name in tracebacks
        update_wrapper(made, self.function)
        vars(made)[_MADE_WITH] = self, made_with
        self.wrappers.add(made)
        return made

    def _fits(self, *args: Any, **kwargs: Any) -> bool:
        """Return whether the function takes these arguments. If not, it is called, and raises Python's own error."""
        try:
            if self.signature is not None:
                self.signature.bind(*args, **kwargs)
        except TypeError:
            return False
        return True

    def _intercept(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run a call for which the stack itself has no interceptor.

        Raises:
            WrongThreadError: It is a decision, and the simulation cannot wait for its answer here.
        """
        return (self.interceptor_at(getcurrent()) or self.run_rule)(args, kwargs)

    # -- where it is set --------------------------------------------------------------------------

    @property
    def stale(self) -> bool:  # type: ignore[override]
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
        if self._temporary is None:
            self._temporary = self.make_wrapper()
        self.place.put(self, self._temporary)

    def _revert(self) -> None:
        if self.place is not None and self._temporary is not None:
            self.place.put_back(self._temporary)

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
        if found is None:
            return inner
        return partial(found.call if self.kind == "function" else found.wait, inner)

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
        spawner = spawner_of(here)
        if spawner is not None and not spawner.own_thread and spawner.decides(self):
            refuse: Interceptor = spawner.refuse(self, _SPAWNED)
            return refuse
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
            inner = interceptor.args[0] if isinstance(interceptor, partial) else interceptor
            plugins = getattr(STACKS.get(key), "plugins", None)
            self.enter(key, None if inner == self.run_rule else inner, plugins)


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
