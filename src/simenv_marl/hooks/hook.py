"""Hooks: one for each function of a model that is decided or extended, with wrappers in front of it.

A *wrapper* looks and behaves like the function, has its signature, and costs almost nothing while the hook has no
*interceptors*. A call finds its interceptor by the greenlet it runs in. For an episode, a driver enters its
simulation's stack, with the environment's decision inside and the handlers around it; at the end it removes the entry.
"""

from __future__ import annotations

import inspect
from contextlib import suppress
from functools import partial, update_wrapper
from threading import local
from types import FunctionType
from typing import Any, Final

from greenlet import getcurrent, greenlet

from ..errors import PatchError
from .handlers import CALLS, ITEMS, Target
from .stacks import EVALUATING, OUTSIDE, STACKS, Interceptor, spawner_of, stack_of

_SPAWNED: Final = 'a greenlet that the simulation has spawned with gevent (driver="thread" allows that)'

_ROOTS: Final[set[greenlet]] = set()
"""Roots of threads on which no simulation runs. Hooks without handlers run their rule there at once."""

_THREAD: Final = local()
"""Has a ``_Root`` in each thread whose root is in ``_ROOTS``."""


class _Root:
    """Forgets the root of a thread when the thread ends. A root that outlives its thread makes greenlets crash."""

    def __init__(self, root: greenlet) -> None:
        self._forget = partial(_ROOTS.discard, root)

    def __del__(self) -> None:
        self._forget()


# -- wrappers -------------------------------------------------------------------------------------

_ABSENT: Final = object()
"""The default of arguments that a call may leave out, because interceptors must get them as they were passed."""

_FILE: Final = "<wrapper of "

_MADE_WITH: Final = "__simenv_marl__"
"""The attribute of a wrapper with its hook and the object that it was made with."""

# No variable has the stack: a suspended stack that refers to itself could not be collected.
_RULE = "not INTERCEPTORS or getcurrent() in INTERCEPTORS.roots"
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


def unbind(value: Any) -> Any:
    """Return an attribute of a class or module without its binding."""
    return value.__func__ if isinstance(value, (staticmethod, classmethod)) else value


def hook_of(value: Any) -> Hook | None:
    """Return the hook of a wrapper, also as an attribute of a class; None for anything else."""
    function = unbind(value)
    # A wrapper is known by its code, not by an attribute: other decorators copy a function's attributes.
    if isinstance(function, FunctionType) and function.__code__.co_filename.startswith(_FILE):
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


class Hook(Target):
    """A function of a model that is decided or extended, with the interceptors of its calls.

    Attributes:
        function: The function. Its signature is its own, not that of what it wraps.
        rule: The innermost part of a call: the function, or its temporary replacement.
        kind: What a call returns: "function" (a value), "generator" or "coroutine".
        bound: Whether its first argument is the object it is called on, which is never passed by keyword.
        alone: Whether every call has one argument, the object it is called on.
        interceptors: Those of calls. Key: a greenlet for calls on the stack of a simulation; plugins, or None, for all
            other calls while an environment with these plugins, or without plugins, is evaluated.
        permanent: Whether a wrapper was set permanently, as a decorated or exposed function.
        point: The object that the layer above makes of the hook.
    """

    permanent = True

    def __init__(self, function: Any, name: str, *, bound: bool = True, like: Any = None) -> None:
        """Make the hook of a function; raise a ``PatchError`` for an async generator function.

        Args:
            function: The function.
            name: Its dotted name.
            bound: Whether, in a class, its first argument is the object it is called on.
            like: The function that determines what calls return, if ``function`` only forwards to it.
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
        super().__init__(name, CALLS + ITEMS if self.kind == "generator" else CALLS, signature)
        self.bound = bound and "." in name.removeprefix(f"{function.__module__}.").rpartition("<locals>.")[2]
        parameters = [] if signature is None else list(signature.parameters.values())
        first = [
            p for p in parameters if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
        ]
        self.alone = self.bound and len(first) == len(parameters) == 1
        self.interceptors = Interceptors(self)
        self.point: Any = None

    def __reduce__(self) -> Any:
        return _restored, (self.function, self.name, self.bound, self.kind, self.exposed), self.point

    def __setstate__(self, point: Any) -> None:
        """Do nothing: the layer above unpickles the point itself and gives it to the hook of this process."""

    def make_wrapper(self, made_with: Any = None) -> FunctionType:
        """Make a wrapper of the hook's function, for which the function ``made_with`` returns that object."""
        scope: dict[str, Any] = {
            "__name__": __name__, "ABSENT": _ABSENT, "INTERCEPTORS": self.interceptors, "fits": self._fits,
            "getcurrent": getcurrent, "intercept": self._intercept, "rule": self.function,
        }  # fmt: skip
        exec(compile(_source(self, scope), f"{_FILE}{self.name}>", "exec"), scope)
        made: FunctionType = scope["wrapper"]
        made.__code__ = made.__code__.replace(co_name=getattr(self.function, "__name__", "call"))  # for tracebacks
        update_wrapper(made, self.function)
        vars(made)[_MADE_WITH] = self, made_with
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
        """Run a call for which the stack itself has no interceptor, or refuse it with a ``WrongThreadError``."""
        return self._interceptor_at(getcurrent())(args, kwargs)

    def _interceptor_at(self, here: greenlet) -> Interceptor:
        driver = stack_of(here) if STACKS else None
        spawner = spawner_of(here)
        if spawner is not None and not spawner.own_thread and spawner.decides(self):
            refuse: Interceptor = spawner.refuse(self, _SPAWNED)
            return refuse
        evaluation = EVALUATING.get(here) if driver is None else driver
        plugins = None if evaluation is None else evaluation.plugins
        decide = None if driver is None else driver.interceptor(self)
        if decide is not None:
            return self.around(decide, plugins)
        if here.parent is None and here not in STACKS:
            if not hasattr(_THREAD, "root"):
                _THREAD.root = _Root(here)
            _ROOTS.add(here)
        return self.interceptors.get(plugins) or self.interceptors.get(None) or self.run_rule

    # -- who takes part ---------------------------------------------------------------------------

    def enter(self, stack: greenlet, decide: Interceptor | None, plugins: Any) -> None:
        """Enter an interceptor for calls on the stack of a simulation, whose environment has these plugins.

        ``decide`` decides instead of the rule. None: the rule decides, with handlers if the plugins have some.
        """
        _ROOTS.discard(stack)
        if decide is not None:
            self.interceptors[stack] = self.around(decide, plugins)
        elif plugins in self.slot and plugins is not None:
            self.interceptors[stack] = self.around(self.run_rule, plugins)
        else:
            self.leave(stack)

    def leave(self, stack: greenlet) -> None:
        """Remove the interceptor of a stack, if there is one."""
        self.interceptors.pop(stack, None)

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
        """Replace the rule; None restores the function."""
        self.rule = self.function if rule is None else rule
        self._update()

    def _update(self) -> None:
        super()._update()
        interceptors, replaced = self.interceptors, self.rule is not self.function
        for plugins in [None, *self.slot] if replaced else [*self.slot]:
            interceptors[plugins] = self.around(self.run_rule, plugins)
        for key in list(interceptors):
            if isinstance(key, greenlet):
                driver = STACKS.get(key, OUTSIDE)
                if driver is not OUTSIDE:
                    driver.enter_hooks()
            elif key not in self.slot and (key is not None or not replaced):  # garbage collection may change the slot
                interceptors.pop(key, None)
        interceptors.roots = set() if self.slot or replaced else _ROOTS


def _restored(function: Any, name: str, bound: bool, kind: str, exposed: bool) -> Hook:
    """Return the hook of an unpickled function: an existing one, or a new one."""
    for hook in list(Target.all.values()):
        if isinstance(hook, Hook) and hook.function is function and hook.name == name:
            return hook
    hook = Hook(function, name, bound=bound)
    hook.bound, hook.kind, hook.exposed = bound, kind, exposed
    return hook
