"""Functions that stand in front of others: written with their signature, and a single test from them.

There are two of them. A *decision function* stands in front of a rule and asks who decides. An *exposed
function* stands in front of anything, decision functions included, and calls handlers. Both look and behave
like the function itself, and cost next to nothing while their *guard*, a container, is empty.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import update_wrapper
from types import FunctionType
from typing import Any, Final

from ..errors import PatchError

DECISION: Final = "decision function"
EXPOSED: Final = "exposed function"

_ABSENT: Final = object()

_TAKEN: Final = ("ABSENT", "NOTHING", "bind", "found", "rule")
"""Names that mean something in what is written below."""

_CALL = {"function": "{}", "generator": "(yield from {})", "coroutine": "(await {})"}

# What a call costs where nobody asks and nothing is attached is decided here. A method that takes nothing but
# ``self`` costs two plain calls. Where arguments can be passed by keyword it costs three, because mappings and
# handlers are to receive them as they were passed.
_WITHOUT_ARGUMENTS = """
{define} stand_in({names}):
    if {idle}:
        return {rule}
    return {ask}
"""
_WITH_ARGUMENTS = """
{define} stand_in({positional}, /, **kwargs):
    if {guard} or kwargs or {last} is ABSENT:
        args = {passed}
        if {idle}:
            return {rule_as_passed}
        if kwargs or len(args) < {required}:
            bind(*args, **kwargs)
        return {ask}
    return {rule}
"""
_VARIADIC = """
{define} stand_in(*args, **kwargs):
    if {idle}:
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
    what: str,
    name: str,
    kind: str,
    alone: bool,
    guard: str,
    ask: str,
    unless: str = "",
    namespace: Mapping[str, Any],
) -> FunctionType:
    """Write a function that stands in front of another one.

    Args:
        rule: The function.
        signature: Its own signature; None where that is not known.
        what: ``DECISION`` or ``EXPOSED``.
        name: Its dotted name.
        kind: What a call of it returns, as ``kind_of`` has it.
        alone: As ``is_alone`` has it.
        guard: The name of the container that is empty while calls are to go straight on to ``rule``.
        ask: What is called otherwise, with two gaps for the arguments: positional, and by keyword.
        unless: What, if it is true, makes calls go straight on all the same.
        namespace: What these names mean.
    """
    parameters = list(signature.parameters.values()) if signature is not None else []
    positional = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    names = [f"_{number}" for number in range(len(positional))]
    # Under its own name, by which it may be passed all the same where a staticmethod looks like a method.
    alone = alone and positional[0].name not in {*namespace, *_TAKEN}
    if alone:
        names = [positional[0].name]
    call = _CALL[kind].format
    values = {
        "define": "async def" if kind == "coroutine" else "def",
        "guard": guard,
        "idle": f"not {guard} or {unless}" if unless else f"not {guard}",
        "names": ", ".join(names),
        "rule": call(f"rule({', '.join(names)})"),
        "rule_as_passed": call("rule(*args, **kwargs)"),
        "ask": call(ask.format("args", "kwargs")),
    }
    if signature is None:
        template = _VARIADIC
    elif alone or not parameters:
        template = _WITHOUT_ARGUMENTS
        values["ask"] = call(ask.format(f"({names[0]},)" if names else "()", "NOTHING"))
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
    exec(compile(template.format(**values), f"<{what} {name}>", "exec"), scope)
    function: FunctionType = scope["stand_in"]
    function.__code__ = function.__code__.replace(co_name=getattr(rule, "__name__", "call"))  # what tracebacks show
    update_wrapper(function, rule)
    return function


def positional(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """The parameters of a function that can be passed by position; none where its signature is not known."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return []
    return [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]


def _anything(*args: Any, **kwargs: Any) -> None:
    """Bind arguments of which nothing is known."""


def _is_required(parameter: inspect.Parameter) -> bool:
    positional = parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
    return positional and parameter.default is parameter.empty


def stands_in(function: Any, what: str) -> bool:
    """Whether a function was generated here, as a decision function or as an exposed one."""
    # Told by what nothing can copy: other decorators take over a function's attributes.
    return isinstance(function, FunctionType) and function.__code__.co_filename.startswith(f"<{what} ")


def beneath(function: Any) -> Any:
    """What an exposed function stands in front of; any other function as it is."""
    while stands_in(function, EXPOSED):
        function = function.__globals__["rule"]
    return function


def exposure(function: Any) -> Any:
    """The target of handlers that an exposed function belongs to; None for any other function."""
    return function.__globals__["target"] if stands_in(function, EXPOSED) else None


def with_exposure(function: Any, of: Callable[..., Any]) -> Any:
    """The function with the handlers of another one in front of it, if that is exposed."""
    target = exposure(of)
    return function if target is None else target.wrap(function)
