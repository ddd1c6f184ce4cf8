"""Hooks: one for each function of a model that is decided or extended, with its wrappers.

A *wrapper* looks and behaves like the function, has its signature, and costs almost nothing while
the hook has no *interceptors*. A call finds its interceptor by the greenlet it runs in. For an
episode, a driver enters its simulation's stack, with the environment's decision inside and the
handlers around it; at the end it removes the entry.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Set
from functools import cached_property, partial, update_wrapper
from inspect import (
    Parameter,
    Signature,
    isasyncgenfunction,
    iscoroutinefunction,
    isgeneratorfunction,
)
from threading import current_thread, main_thread
from types import FunctionType
from typing import Any, Final
from weakref import WeakValueDictionary

from greenlet import getcurrent, greenlet

from ..errors import PatchError
from ..simulation import POSITIONAL, Function, Model, signature_of
from .handlers import (
    CALLS,
    ITEMS,
    Handler,
    Slot,
    each,
    make_slots,
    run,
    wait,
)
from .stacks import (
    EVALUATING,
    LOCK,
    STACKS,
    Args,
    Interceptor,
    Kwargs,
    spawner_of,
    stack_of,
)

Bound = tuple[Args, Kwargs]
"""The arguments of a call, bound to a signature."""

Binding = Callable[[FunctionType], Model]
"""``staticmethod`` or ``classmethod``."""

_MAIN: Final[set[greenlet]] = set()
"""The root of the main thread, if it has called hooks. Those without handlers run their rule there
at once. It has no root of another thread, because greenlets crash where one outlives its thread.
"""


# -- wrappers -------------------------------------------------------------------------------------

_ABSENT: Final = object()
"""The default of arguments that a call may leave out. Interceptors do not get it."""

BOUND: Final[Kwargs] = {}
"""The keyword arguments of a call that passes each parameter by position and needs no binding."""

_MADE_WITH: Final = "__simenv_marl__"
"""The attribute of a wrapper with the object that it was made with."""

_RETURN: Final = {
    "function": "return {}",
    "generator": "return (yield from {})",
    "coroutine": "return (await {})",
}

# No variable has the stack, because a suspended stack that refers to itself cannot be collected.
_RULE_DECIDES: Final = "not INTERCEPTORS or getcurrent() in INTERCEPTORS.roots"
_INTERCEPT: Final = "(INTERCEPTORS.get(getcurrent()) or intercept)"


def _source(hook: Hook, reserved: Set[str]) -> str:
    """Return the source code of a hook's wrappers, which uses the reserved names.

    It determines the cost of a call without interceptors: two plain calls if no call can be
    incomplete, else three.
    """
    signature = hook.signature
    parameters = [] if signature is None else list(signature.parameters.values())
    positional = [p for p in parameters if p.kind in POSITIONAL]
    required = [p.name for p in positional if p.default is p.empty]
    others = [p for p in parameters if p.kind is p.VAR_POSITIONAL or p.kind is p.KEYWORD_ONLY]
    names = [f"_{number}" for number in range(len(positional))]
    is_incomplete = "True"
    may_not_fit = "True"
    declaration = "*args, **kwargs"
    arguments = "args"
    only_self = signature is not None and len(parameters) == len(required) == int(hook.bound)
    if only_self and reserved.isdisjoint(required):
        is_incomplete = ""
        # A staticmethod that looks like a method may receive its argument by keyword.
        names = required
        declaration = ", ".join(names)
    elif positional and all(p.default is not p.empty for p in others):
        is_incomplete = f"kwargs or {names[-1]} is ABSENT"
        may_not_fit = f"kwargs or len(args) < {len(required)}"
        declaration = ", ".join(f"{name}=ABSENT" for name in names) + ", /, **kwargs"
        arguments = "()"
        for number, name in enumerate(names, start=1):
            arguments = f"({', '.join(names[:number])},) if {name} is not ABSENT else {arguments}"
    values = "".join(f"{name}, " for name in names)
    result = _RETURN[hook.kind].format
    source = f"def wrapper({declaration}):"
    if hook.kind == "coroutine":
        source = f"async {source}"
    if is_incomplete:
        source += f"""
    if {is_incomplete}:
        args = {arguments}
        if {_RULE_DECIDES} or ({may_not_fit}) and fits(args, kwargs) is None:
            {result("rule(*args, **kwargs)")}
        {result(f"{_INTERCEPT}(args, kwargs)")}"""
    return f"""{source}
    if {_RULE_DECIDES}:
        {result(f"rule({values})")}
    {result(f"{_INTERCEPT}(({values}), {'{}' if others else 'BOUND'})")}
"""


class _Code(str):
    """A string that is shown without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


_PLACED: Final = ("{}, ", "{}, ", "*{}, ", "", "")
"""The source of a bound parameter among the positional arguments, by its kind."""

_NAMED: Final = ("", "", "", "{0!r}: {0}, ", "**{}, ")
"""The same among the keyword arguments."""


def _make_binder(signature: Signature | None) -> Callable[..., Bound]:
    """Make a function that returns its arguments: by position where possible, with defaults."""
    if signature is None:
        return lambda *args, **kwargs: (args, kwargs)
    own: list[Parameter] = []
    for name, p in signature.parameters.items():
        default = p.empty if p.default is p.empty else _Code(f"parameters[{name!r}].default")
        own.append(Parameter(name, p.kind, default=default))
    args = "".join(_PLACED[p.kind].format(p.name) for p in own)
    kwargs = "".join(_NAMED[p.kind].format(p.name) for p in own)
    scope: dict[str, Any] = {"parameters": signature.parameters}
    exec(f"def bind{Signature(own)}: return ({args}), {{{kwargs}}}", scope)
    bind: Callable[..., Bound] = scope["bind"]
    return bind


def unbind(value: Model) -> Model:
    """Return an attribute of a class or module, or a method, without its binding."""
    return getattr(value, "__func__", value)


def hook_of(value: object) -> Hook | None:
    """Return the hook of a wrapper, also of a bound one; None for anything else."""
    function = unbind(value)
    if not isinstance(function, FunctionType):
        return None
    # Not an attribute of the wrapper, because other decorators copy attributes.
    interceptors = function.__globals__.get("INTERCEPTORS")
    return interceptors.hook if isinstance(interceptors, Interceptors) else None


def made_with(wrapper: object) -> Any:
    """Return the object that a wrapper was made with: a definition, or None as for all others."""
    return None if hook_of(wrapper) is None else vars(unbind(wrapper))[_MADE_WITH]


def unwrap(function: object) -> Model:
    """Return the function behind a wrapper; any other function itself, unbound."""
    hook = hook_of(function)
    return unbind(function) if hook is None else hook.function


# -- hooks ----------------------------------------------------------------------------------------


class Interceptors(dict[greenlet | None, Interceptor]):
    """The interceptors of one hook, by stack.

    A wrapper that was pickled by value gets the interceptors of the process that unpickles it.

    Attributes:
        hook: The hook.
        roots: The roots of threads whose calls run the rule at once: ``_MAIN`` or none.
    """

    __slots__ = ("hook", "roots")

    def __init__(self, hook: Hook) -> None:
        super().__init__()
        self.hook = hook
        self.roots = _MAIN

    def __reduce__(self) -> tuple[Any, ...]:
        return getattr, (self.hook, "interceptors")

    def intercept_elsewhere(self, wanted: bool) -> None:
        """Intercept calls away from all simulations, or let them run the function again."""
        if wanted:
            self[None] = self.hook.run_rule
            self.roots = set()
        else:
            self.pop(None, None)
            self.roots = _MAIN


class Hook:
    """A function of a model that is decided or extended, or an exposed iterable.

    It holds the handlers and the interceptors of calls. Its wrapper is in place while the hook has
    users: handlers and environments.

    Attributes:
        function: The function.
        rule: The innermost part of a call: the function, or its temporary replacement.
        name: The dotted name of the function.
        kind: The result of a call: "function" (a value), "generator" or "coroutine"; or "iterable".
        positions: The positions of handlers.
        bound: Whether the first argument is the object that the function is called on, which is
            never passed by keyword.
        interceptors: The interceptors of calls on the stacks of simulations. An entry for None
            intercepts all other calls.
        slot: The handlers by owner. Empty without handlers.
        permanent: Whether a wrapper was set permanently, on a decorated or exposed function.
        exposed: Whether the function is exposed to plugins.
        threads: The names of threads that called the function outside of simulations.
        definition: The latest definition of a decision function; None for other functions.
        removed_by: Functions (or names) whose calls end the hook's agents, under every definition:
            see ``make_step``.
    """

    permanent = True

    def __init__(
        self,
        function: Function,
        name: str,
        *,
        bound: bool | None = None,
        kind: str | None = None,
        exposed: bool = False,
    ) -> None:
        """Make the hook of a function with a dotted name.

        Args:
            function: The function.
            name: The dotted name.
            bound: See ``Hook``. None: whether the function is an attribute of a class, by its name.
            kind: See ``Hook``. None: the kind of the function.
            exposed: Whether the function is exposed to plugins.

        Raises:
            PatchError: The function is an async generator function.
        """
        if bound is None:
            local_name = name.removeprefix(f"{function.__module__}.").rpartition("<locals>.")[2]
            bound = "." in local_name
        self.function = function
        self.rule = function
        # A worker of multiprocessing imports the user's script under the first name.
        self.name = name.replace("__mp_main__.", "__main__.", 1)
        self.bound = bound
        self.kind = kind or kind_of(function, name)
        self.positions = _POSITIONS[self.kind]
        self.exposed = exposed
        self.signature = signature_of(function, follow_wrapped=False)
        self.interceptors = Interceptors(self)
        self.threads: set[str] = set()
        self.definition: Any = None
        self.removed_by: dict[Any, Function | None] = {}
        self.slot: dict[Hashable, Slot] = {}
        self._applied = False
        # The users of each handler, and of the hook itself under None, in the order of arrival.
        self._users: dict[Handler | None, set[Hashable]] = {}
        _HOOKS[id(self)] = self

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name}>"

    def __reduce__(self) -> tuple[Any, ...]:
        properties = {"bound": self.bound, "kind": self.kind, "exposed": self.exposed}
        return _restore, (self.function, self.name, properties), self.definition

    def __setstate__(self, definition: Any) -> None:
        """Set the definition after unpickling, unless the hook has one of this process."""
        self.definition = self.definition or definition

    @property
    def letters(self) -> str:
        """The letters of the function's name in lower case, for the default name of its agent."""
        return re.sub("[^a-z]", "", self.name.rpartition(".")[2].lower()) or "agent"

    def make_permanent(self, definition: Any, exposed: bool) -> None:
        """Note that a wrapper was set permanently: for a definition, or exposed to plugins."""
        self.permanent = True
        self.definition = definition or self.definition
        self.exposed = exposed or self.exposed

    def make_wrapper(self, made_with: Any = None) -> FunctionType:
        """Make a wrapper of the function. ``made_with`` returns the given object for it."""
        scope: dict[str, Any] = {
            "__name__": __name__,
            "ABSENT": _ABSENT,
            "BOUND": BOUND,
            "INTERCEPTORS": self.interceptors,
            "fits": self.bind,
            "getcurrent": getcurrent,
            "intercept": self._intercept,
            "rule": self.function,
        }
        exec(compile(_source(self, scope.keys()), f"<wrapper of {self.name}>", "exec"), scope)
        wrapper: FunctionType = scope.pop("wrapper")
        update_wrapper(wrapper, self.function)
        vars(wrapper)[_MADE_WITH] = made_with
        return wrapper

    def bind(self, args: Args, kwargs: Kwargs) -> Bound | None:
        """Bind a call to the function's own signature, with defaults.

        None if the function does not take it.
        """
        try:
            return self._binder(*args, **kwargs)
        except TypeError:
            return None

    @cached_property
    def _binder(self) -> Callable[..., Bound]:
        return _make_binder(self.signature)

    def _intercept(self, args: Args, kwargs: Kwargs) -> Model:
        """Run a call on a stack without an interceptor, or refuse it with a ``WrongThreadError``.

        No variable has the stack here, because the frame may be suspended on it.
        """
        return self._interceptor_at(getcurrent())(args, kwargs)

    def _interceptor_at(self, here: greenlet) -> Interceptor:
        driver = (stack_of(here) or spawner_of(here)) if STACKS else None
        evaluation = driver or EVALUATING.get(here)
        decide = self.run_rule if driver is None else driver.interceptor(self)
        if here.parent is None and here not in STACKS:
            thread = current_thread()
            if thread is main_thread():
                _MAIN.add(here)
            self.threads.add(thread.name)
        plugins = None if evaluation is None else evaluation.plugins
        return self.around(decide, plugins)

    # -- interceptors -----------------------------------------------------------------------------

    def enter(
        self,
        stack: greenlet,
        decide: Interceptor,
        plugins: Hashable | None,
    ) -> None:
        """Enter an interceptor for calls on the stack of a simulation.

        Args:
            stack: The stack.
            decide: The interceptor inside the handlers: ``run_rule``, or one that decides.
            plugins: The plugins of the simulation's environment.
        """
        self.interceptors[stack] = self.around(decide, plugins)

    def leave(self, stack: greenlet) -> None:
        """Remove the interceptor of a stack, if there is one."""
        self.interceptors.pop(stack, None)

    def around(self, inner: Interceptor, plugins: Hashable | None) -> Interceptor:
        """Return an interceptor that runs handlers around ``inner``.

        These are the handlers of the plugins, if there are any, or of the whole process.
        """
        slot = self.slot.get(plugins) or self.slot.get(None)
        if slot is None:
            return inner
        if slot.items is not None:
            inner = partial(each, self, inner)
        if slot.calls is not None:
            inner = partial(run if self.kind == "function" else wait, slot.calls, inner)
        for trace in slot.traces:
            inner = trace.function(self.name, self.kind, inner)
        return inner

    def run_rule(self, args: Args, kwargs: Kwargs) -> Model:
        """Run the rule."""
        return self.rule(*args, **kwargs)

    def replace_rule(self, rule: Function | None = None) -> None:
        """Replace the rule; None restores the function."""
        self.rule = rule or self.function
        self._update()

    # -- users ------------------------------------------------------------------------------------

    @property
    def handlers(self) -> list[Handler]:
        """The handlers of all owners, in the order of their attachment."""
        return [handler for handler in list(self._users) if handler is not None]

    def install(self, user: Hashable, handler: Handler | None = None) -> None:
        """Set the wrapper in its place, or attach a handler, until every user uninstalls it.

        Raises:
            PatchError: The wrapper cannot be set.
        """
        with LOCK:
            try:
                # The user comes first, because garbage collection may close another environment
                # that uses the hook meanwhile.
                users = self._users.get(handler, set())
                users.add(user)
                self._users[handler] = users
                if not self._applied:
                    self._apply()
                    self._applied = True
                if handler is not None and len(users) == 1:
                    self._update()
            except BaseException:
                self.uninstall(user, handler)
                raise

    def uninstall(self, user: Hashable, handler: Handler | None = None) -> None:
        """Undo ``install``; the last user restores the original.

        After an interrupt, call this again. A handler of the whole process has one user.
        """
        with LOCK:
            users = self._users.get(handler, set())
            users.discard(user)
            if handler is not None and handler.owner is None:
                users.clear()
            if not users:
                self._users.pop(handler, None)
                if handler is not None:
                    self._update()
            if not self._users:
                self._applied = False
                self._revert()

    def _apply(self) -> None:
        """Set the wrapper in its place."""

    def _revert(self) -> None:
        """Undo ``_apply``, also after an error in it, or without a call of it."""

    def _update(self) -> None:
        """Fill the slot, and enter the stacks of simulations again."""
        while True:
            present = self.handlers
            self.slot = make_slots(present)  # one assignment: another thread may run a call
            # Meanwhile, garbage collection may close an environment and remove its handlers.
            if present == self.handlers:
                break
        self.interceptors.intercept_elsewhere(bool(self.slot) or self.rule is not self.function)
        for stack in list(self.interceptors):
            driver = None if stack is None else STACKS.get(stack)
            if driver is not None:
                driver.enter_hooks()


_POSITIONS: Final = {
    "function": CALLS,
    "coroutine": CALLS,
    "generator": CALLS + ITEMS,
    "iterable": ITEMS,
}


def kind_of(function: Function, name: str) -> str:
    """Return the kind of a function with a dotted name.

    Raises:
        PatchError: It is an async generator function.
    """
    if isasyncgenfunction(function):
        raise PatchError(
            f"{name} is an async generator function, which cannot return a decision or call"
            " handlers"
        )
    if isgeneratorfunction(function):
        return "generator"
    return "coroutine" if iscoroutinefunction(function) else "function"


_HOOKS: Final[WeakValueDictionary[int, Hook]] = WeakValueDictionary()


def hooks() -> list[Hook]:
    """Return all hooks, the oldest first."""
    # The list of references is taken at once, because other threads may make hooks meanwhile.
    return [hook for reference in _HOOKS.valuerefs() if (hook := reference()) is not None]


def _restore(
    function: Function,
    name: str,
    properties: dict[str, Any],
) -> Hook:
    """Return the hook of an unpickled function: an existing one, or a new one."""
    for hook in hooks():
        if hook.function is function and hook.name == name:
            return hook
    return Hook(function, name, **properties)
