"""A plain run that watches the rules: what they change, their waits, and settings around them.

An action replaces a rule. So the model misses all other effects of the rule; and the settings of
the model at a decision reach the environment's user.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from inspect import getclosurevars
from types import CodeType, FrameType, FunctionType

from ..core import Plan
from ..errors import short_repr
from ..hooks.hook import Hook, hook_of, unbind
from ..hooks.places import all_classes
from ..hooks.stacks import Args, Kwargs, outside_simulation
from ..simulation import Model
from .fingerprint import STATE, Fingerprint, describe_differences, differences, fingerprint
from .runs import Rule, Run


class Watch(Run):
    """A plain run that watches the rules.

    Attributes:
        found: The evidence of findings, by their names in ``FINDINGS`` and by decision function.
        overriding: Classes whose functions override a decision function and were called.
        deciding: The classes of the objects that have made decisions, with their base classes.
    """

    def __init__(self, state_of: Callable[[Model], Model] | None, plan: Plan) -> None:
        super().__init__(state_of)
        self.found: dict[tuple[str, Hook], str] = {}
        self.overriding: set[type] = set()
        self.deciding: set[type] = set()
        self._settings_before: dict[str, object] = {}
        self._overrides = {
            code: kind for point in plan.active for code, kind in _overrides(point.hook, plan)
        }
        self._looked: defaultdict[Hook, float] = defaultdict(float)  # seconds

    def run_main_loop(self, simulation: Model) -> None:
        """Run the main loop, and note calls of overriding functions."""
        self._settings_before = _settings()
        before = sys.getprofile()
        if self._overrides:
            sys.setprofile(self._note_call)
        try:
            super().run_main_loop(simulation)
        finally:
            sys.setprofile(before)

    def _note_call(self, frame: FrameType, event: str, value: object) -> None:
        if event == "call" and frame.f_code in self._overrides:
            self.overriding.add(self._overrides[frame.f_code])

    def decide(self, hook: Hook, args: Args, kwargs: Kwargs) -> Model:
        """Let the rule decide, and compare the model before and after."""
        for owner in args[:1]:
            self.deciding.update(type(owner).__mro__)
        before = self._settings_before
        changed = [name for name, value in _settings().items() if value != before.get(name, value)]
        if changed:
            self.found["settings", hook] = ", ".join(changed)
        # Looks are slow, so that their time is limited.
        is_watched = self._looked[hook] < 1.0 and ("changing_rule", hook) not in self.found
        begin = time.process_time()
        steps = len(self.calls)
        parts = self._look(hook, args) if is_watched else {}
        value = super().decide(hook, args, kwargs)
        # A rule that asks for other decisions is left out: their rules make changes, too.
        if is_watched and steps == len(self.calls):
            changes = differences(parts, self._look(hook, args))
            # Lazy values that libraries store do not change a model.
            changes = [c for c in changes if STATE not in c.path and "cache" not in c.path]
            if changes:
                self.found["changing_rule", hook] = describe_differences(changes)
        self._looked[hook] += time.process_time() - begin
        return value

    def follow(self, hook: Hook, rule: Rule) -> Rule:
        """Note whether a rule yields, and whether it returns a value.

        An error that the model raises in the rule ends it, because the run's result is not used.
        """
        value = sent = None
        finding = ""
        while True:
            try:
                value = rule.send(sent)
            except StopIteration as stop:
                is_plain = isinstance(value, (int, float, str, tuple))
                if finding and stop.value is None and is_plain:
                    finding = "vanishing"
                if finding:
                    self.found[finding, hook] = (
                        f"the last value that it yields: {short_repr(value)}"
                    )
                return stop.value
            finding = "waiting_rule"
            sent = yield value

    def _look(self, hook: Hook, args: Args) -> Fingerprint:
        with outside_simulation():
            if self.state_of is not None:
                return fingerprint("fingerprint", self.state_of(self.simulation))
            parts = fingerprint("simulation", self.simulation)
            with suppress(TypeError):  # the function is not written in Python
                nonlocals, variables, *_ = getclosurevars(hook.function)
                parts.update(fingerprint("variables", {**nonlocals, **variables}))
            return {**parts, **fingerprint("arguments", args)}


def _settings() -> dict[str, object]:
    """Return the settings of the process or thread that models often change around a decision."""
    settings: dict[str, object] = {
        "warnings.filters": (id(warnings.filters), [*warnings.filters]),
        "warnings.showwarning": warnings.showwarning,
        "sys.stdout": sys.stdout,
        "sys.stderr": sys.stderr,
    }
    with suppress(OSError):  # the folder is gone
        settings["the working directory"] = os.getcwd()
    with suppress(KeyError, AttributeError):  # torch is not imported, or not yet completely
        settings["torch's grad mode"] = sys.modules["torch"].is_grad_enabled()
    return settings


def _overrides(hook: Hook, plan: Plan) -> Iterator[tuple[CodeType, type]]:
    """Yield the code of functions that override a point and are no points, with their classes."""
    attribute = hook.name.rpartition(".")[2]
    points = {point.hook.function for point in plan.points}
    for owner in all_classes():
        if f"{owner.__module__}.{owner.__qualname__}.{attribute}" != hook.name:
            continue
        for kind in all_classes(owner):
            function = unbind(vars(kind).get(attribute))
            # A decorated function is a point that the user has not chosen.
            is_plain = hook_of(function) is None and function not in points
            if isinstance(function, FunctionType) and is_plain and kind is not owner:
                yield function.__code__, kind
