"""Hooks: one for each function of a model that is decided or extended, with wrappers in front of it.

A *wrapper* looks and behaves like the function, has its signature, and costs almost nothing while
the hook has no *interceptors*. A call finds its interceptor by the greenlet it runs in. For an
episode, a driver enters its simulation's stack, with the environment's decision inside and the
handlers around it; at the end it removes the entry.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial, update_wrapper
from threading import current_thread, local
from types import FunctionType
from typing import Any, Final
from weakref import WeakValueDictionary, finalize

from greenlet import getcurrent, greenlet

from ..errors import PatchError
from .handlers import CALLS, ITEMS, Handler, each, run, slots, wait
from .stacks import EVALUATING, LOCK, OUTSIDE, STACKS, Interceptor, spawner_of, stack_of

_ROOTS: Final[set[greenlet]] = set()
"""Roots of threads on which no simulation runs.

Hooks without handlers run their rule there at once.
"""

_THREAD: Final = local()
"""Has a mark in each thread whose root is in ``_ROOTS``. It is freed with the thread."""


# -- wrappers -------------------------------------------------------------------------------------

_ABSENT: Final = object()
"""The default of arguments that a call may leave out, because interceptors must get them as they were passed."""

BOUND: Final[dict[str, Any]] = {}
"""The keyword arguments of a call that passes each parameter by position, and so needs no binding."""

_MADE_WITH: Final = "__simenv_marl__"
"""The attribute of a wrapper with its hook and the object that it was made with."""

# No variable has the stack: a suspended stack that refers to itself could not be collected.
_RULE = "not INTERCEPTORS or getcurrent() in INTERCEPTORS.roots"
_INTERCEPT = "(INTERCEPTORS.get(getcurrent()) or intercept)"

_RETURN = {
    "function": "return {}",
    "generator": "return (yield from {})",
    "coroutine": "return (await {})",
}

# These determine the cost of a call without interceptors: two plain calls if no call can be
# incomplete, else three.
_INCOMPLETE = """
    if {incomplete}:
        args = {passed}
        if {rule} or ({doubtful}) and fits(args, kwargs) is None:
            {rule_as_passed}
        {intercept_as_passed}"""
_COMPLETE = """
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
    incomplete, doubtful, template = "True", "True", _INCOMPLETE + _COMPLETE
    passed, accepted = "args", "*args, **kwargs"
    if (hook.alone and parameters[0].name not in scope) or (
        signature is not None and not parameters
    ):
        template = _COMPLETE
        # a staticmethod that looks like a method may be passed it by keyword
        names = [p.name for p in positional]
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
    bound = "{}" if any(p.kind is p.KEYWORD_ONLY for p in parameters) else "BOUND"
    answer = _RETURN[hook.kind].format
    source = f"def wrapper({accepted}):" + template.format(
        incomplete=incomplete,
        passed=passed,
        doubtful=doubtful,
        rule=_RULE,
        rule_as_passed=answer("rule(*args, **kwargs)"),
        intercept_as_passed=answer(f"{_INTERCEPT}(args, kwargs)"),
        rule_at_once=answer(f"rule({given})"),
        intercept=answer(f"{_INTERCEPT}(({given + ',' if given else ''}), {bound})"),
    )
    return f"async {source}" if hook.kind == "coroutine" else source


def _binder(signature: inspect.Signature) -> Callable[..., tuple[tuple[Any, ...], dict[str, Any]]]:
    """Make a function with a signature that returns its arguments: by position where they can be, with defaults."""
    parameters = signature.parameters.values()
    prefixes: dict[Any, str] = {
        inspect.Parameter.VAR_POSITIONAL: "*",
        inspect.Parameter.VAR_KEYWORD: "**",
    }
    # Short defaults, and no annotations: code can name neither. The defaults themselves are set
    # below.
    declared = [
        p.replace(annotation=p.empty, default=p.empty if p.default is p.empty else 0)
        for p in parameters
    ]
    names = {p.name: prefixes.get(p.kind, "") + p.name for p in parameters}
    placed = [f"{names[p.name]}," for p in parameters if p.kind < inspect.Parameter.KEYWORD_ONLY]
    keyed = [
        names[p.name] if p.kind is p.VAR_KEYWORD else f"{p.name!r}: {p.name}"
        for p in parameters
        if p.kind >= inspect.Parameter.KEYWORD_ONLY
    ]
    found: dict[str, Any] = {}
    source = f"def bind{inspect.Signature(declared)}: return ({' '.join(placed)}), {{{', '.join(keyed)}}}"
    exec(source, found)
    bind: FunctionType = found["bind"]
    optional = [p for p in parameters if p.default is not p.empty]
    bind.__defaults__ = tuple(p.default for p in optional if p.kind is not p.KEYWORD_ONLY)
    bind.__kwdefaults__ = {p.name: p.default for p in optional if p.kind is p.KEYWORD_ONLY}
    return bind


def unbind(value: Any) -> Any:
    """Return an attribute of a class or module without its binding."""
    return value.__func__ if isinstance(value, (staticmethod, classmethod)) else value


def hook_of(value: Any) -> Hook | None:
    """Return the hook of a wrapper, also as an attribute of a class; None for anything else."""
    function = unbind(value)
    # A wrapper is known by its globals, not by an attribute: other decorators copy a function's
    # attributes.
    if isinstance(function, FunctionType) and isinstance(
        function.__globals__.get("INTERCEPTORS"), Interceptors
    ):
        hook: Hook = vars(function)[_MADE_WITH][0]
        return hook
    return None


def made_with(wrapper: FunctionType) -> Any:
    """Return the object that a wrapper was made with."""
    return vars(wrapper)[_MADE_WITH][1]


def unwrap(function: Any) -> Any:
    """Return the function behind a wrapper; any other function itself, unbound."""
    function = getattr(function, "__func__", function)
    hook = hook_of(function)
    return function if hook is None else hook.function


# -- hooks ----------------------------------------------------------------------------------------


class Interceptors(dict[Any, Interceptor]):
    """The interceptors of one hook. A wrapper that is pickled by value finds those of the process it arrives in.

    ``roots`` has the roots of threads from which calls run the rule at once.
    """

    __slots__ = ("hook", "roots")

    def __init__(self, hook: Hook) -> None:
        super().__init__()
        self.hook, self.roots = hook, _ROOTS

    def __reduce__(self) -> Any:
        return getattr, (self.hook, "interceptors")


class Hook:
    """A function of a model that is decided or extended, or an exposed iterable: handlers, and interceptors of calls.

    It is in force while it has users: its handlers, and environments.

    Attributes:
        function: The function. Its signature is its own, not that of what it wraps.
        rule: The innermost part of a call: the function, or its temporary replacement.
        kind: What a call returns: "function" (a value), "generator" or "coroutine".
        bound: Whether its first argument is the object it is called on, which is never passed by
            keyword.
        alone: Whether every call has only that argument.
        interceptors: Those of calls on the stacks of simulations. An entry for None says that all
            other calls do not just run the function.
        slot: Its handlers, as ``slots`` returns them. Empty while it has none.
        stale: Whether another object has replaced it while nothing was set in its place.
        permanent: Whether a wrapper was set permanently, as a decorated or exposed function.
        threads: The names of threads that called it before anything else, and where its rule
            decides.
        definition: The latest definition of a decision function, which its name means; None for all
            other functions.
        removed_by: Functions (or names) whose calls end its agents, under every definition: see
            ``make_step``.
    """

    permanent = True
    stale = False

    def __init__(self, function: Any, name: str, *, bound: bool = True, like: Any = None) -> None:
        """Make the hook of a function with a dotted name.

        Raise a ``PatchError`` for an async generator function.

        ``bound`` tells whether, in a class, its first argument is the object it is called on;
        ``like`` determines what calls return if the function only forwards to it.
        """
        like = function if like is None else like
        if inspect.isasyncgenfunction(like):
            raise PatchError(
                f"{name} is an async generator function, which cannot return a decision or call"
                " handlers"
            )
        awaited = "coroutine" if inspect.iscoroutinefunction(like) else "function"
        self.kind = "generator" if inspect.isgeneratorfunction(like) else awaited
        self.function = self.rule = function
        self.name, self.positions = name, CALLS + ITEMS if self.kind == "generator" else CALLS
        self.signature: inspect.Signature | None = None
        with suppress(TypeError, ValueError):  # the signature is unknown
            self.signature = inspect.signature(function, follow_wrapped=False)
        self.bound = (
            bound and "." in name.removeprefix(f"{function.__module__}.").rpartition("<locals>.")[2]
        )
        parameters = () if self.signature is None else self.signature.parameters.values()
        first = [
            p
            for p in parameters
            if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
        ]
        self.alone = self.bound and len(first) == len(parameters) == 1
        # made when it is needed
        self._binder: Callable[..., tuple[tuple[Any, ...], dict[str, Any]]] | None = None
        self.interceptors = Interceptors(self)
        self.threads: set[str] = set()
        self.definition: Any = None
        self.removed_by: dict[Any, Any] = {}
        self.slot: dict[Any, list[list[list[Handler]]]] = {}
        self.exposed = self._applied = False
        # The users of each handler, and those of the hook itself under None, in the order in which
        # they came.
        self._users: dict[Handler | None, set[object]] = {}
        _HOOKS[id(self)] = self

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name}>"

    def __reduce__(self) -> Any:
        return (
            _restored,
            (self.function, self.name, self.bound, self.kind, self.exposed),
            self.definition,
        )

    def __setstate__(self, definition: Any) -> None:
        """Set the definition after unpickling, unless the hook has one of this process."""
        self.definition = self.definition or definition

    @property
    def letters(self) -> str:
        """The letters of the function's name in lower case, for the default name of its agent."""
        return re.sub("[^a-z]", "", self.name.rpartition(".")[2].lower()) or "agent"

    def make_wrapper(self, made_with: Any = None) -> FunctionType:
        """Make a wrapper of the hook's function, for which the function ``made_with`` returns that object."""
        scope: dict[str, Any] = {
            "__name__": __name__, "ABSENT": _ABSENT, "INTERCEPTORS": self.interceptors, "fits": self.bind,
            "getcurrent": getcurrent, "intercept": self._intercept, "rule": self.function, "BOUND": BOUND,
        }  # fmt: skip
        exec(compile(_source(self, scope), f"<wrapper of {self.name}>", "exec"), scope)
        made: FunctionType = scope["wrapper"]
        # for tracebacks
        made.__code__ = made.__code__.replace(co_name=getattr(self.function, "__name__", "call"))
        update_wrapper(made, self.function)
        vars(made)[_MADE_WITH] = self, made_with
        return made

    def bind(
        self, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
        """Bind a call to the function's own signature, with defaults.

        None if the function does not take it.
        """
        if self.signature is None:
            return args, kwargs
        if self._binder is None:
            self._binder = _binder(self.signature)
        try:
            return self._binder(*args, **kwargs)
        except TypeError:
            return None

    def _intercept(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run a call for which the stack itself has no interceptor, or refuse it with a ``WrongThreadError``."""
        return self._interceptor_at(getcurrent())(args, kwargs)

    def _interceptor_at(self, here: greenlet) -> Interceptor:
        driver = (stack_of(here) or spawner_of(here)) if STACKS else None
        evaluation = EVALUATING.get(here) if driver is None else driver
        plugins = None if evaluation is None else evaluation.plugins
        decide = None if driver is None else driver.interceptor(self)
        if here.parent is None and here not in STACKS:
            if not hasattr(_THREAD, "mark"):
                _THREAD.mark = set()
                # a root that outlives its thread makes greenlets crash
                finalize(_THREAD.mark, _ROOTS.discard, here)
            _ROOTS.add(here)
            self.threads.add(current_thread().name)
        return self.around(decide or self.run_rule, plugins)

    # -- who takes part ---------------------------------------------------------------------------

    def enter(self, stack: greenlet, decide: Interceptor | None, plugins: Any) -> None:
        """Enter an interceptor for calls on the stack of a simulation, whose environment has these plugins.

        ``decide`` decides instead of the rule. None: the rule decides, with handlers if the plugins
        have some.
        """
        _ROOTS.discard(stack)
        if decide is None and plugins not in self.slot:
            self.leave(stack)
        else:
            self.interceptors[stack] = self.around(decide or self.run_rule, plugins)

    def leave(self, stack: greenlet) -> None:
        """Remove the interceptor of a stack, if there is one."""
        self.interceptors.pop(stack, None)

    def around(self, inner: Interceptor, plugins: Any) -> Interceptor:
        """Return an interceptor that runs the handlers of plugins, or of the whole process, around ``inner``."""
        found = self.slot.get(plugins) or self.slot.get(None)
        if found is None:
            return inner
        calls, items, (traces,) = found
        if any(items):
            inner = partial(each, self, inner)
        around: Interceptor = partial(run if self.kind == "function" else wait, calls, inner)
        for trace in traces:
            around = trace.function(self, self.kind, around)
        return around

    def run_rule(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run the rule."""
        return self.rule(*args, **kwargs)

    def replace_rule(self, rule: Any = None) -> None:
        """Replace the rule; None restores the function."""
        self.rule = self.function if rule is None else rule
        self._update()

    # -- users ------------------------------------------------------------------------------------

    @property
    def handlers(self) -> list[Handler]:
        """The handlers of all owners, in the order in which they were attached."""
        return [handler for handler in list(self._users) if handler is not None]

    def install(self, user: object, handler: Handler | None = None) -> None:
        """Set it in its place, or attach a handler, until every user has called ``uninstall``.

        Handlers of the whole process have one user. Raise a ``PatchError`` if it cannot be set.
        """
        with LOCK:
            user = user if handler is None else handler.owner and user
            try:
                # Noted first: garbage collection may close another environment that uses it
                # meanwhile.
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

    def uninstall(self, user: object, handler: Handler | None = None) -> None:
        """Undo ``install``; the last user restores the original.

        After an interrupt, call it again.
        """
        with LOCK:
            users = self._users.get(handler, set())
            users.discard(user if handler is None else handler.owner and user)
            if not users:
                self._users.pop(handler, None)
                if handler is not None:
                    self._update()
            if not self._users:
                self._applied = False
                self._revert()

    def _apply(self) -> None:
        """Set it in its place."""

    def _revert(self) -> None:
        """Undo ``_apply``, also where that failed half-way or was never called."""

    def _update(self) -> None:
        """Fill the slot, and enter the stacks of simulations again."""
        present: Any = None
        # Meanwhile, garbage collection may close an environment and remove its handlers.
        while present != (attached := self.handlers):
            present = attached
            self.slot = slots(present)  # one assignment, because another thread may run a call
        if self.slot or self.rule is not self.function:
            self.interceptors[None], self.interceptors.roots = self.run_rule, set()
        else:
            self.interceptors.pop(None, None)
            self.interceptors.roots = _ROOTS
        for stack in list(self.interceptors):
            driver = STACKS.get(stack, OUTSIDE)
            if driver is not OUTSIDE:
                driver.enter_hooks()


_HOOKS: Final[WeakValueDictionary[int, Hook]] = WeakValueDictionary()


def hooks() -> list[Hook]:
    """Return all hooks, in the order in which they were made."""
    # The list of references is taken at once: other threads may make hooks meanwhile.
    return [hook for reference in _HOOKS.valuerefs() if (hook := reference()) is not None]


def _restored(function: Any, name: str, bound: bool, kind: str, exposed: bool) -> Hook:
    """Return the hook of an unpickled function: an existing one, or a new one."""
    for hook in hooks():
        if hook.function is function and hook.name == name:
            return hook
    hook = Hook(function, name, bound=bound)
    hook.bound, hook.kind, hook.exposed = bound, kind, exposed
    return hook
