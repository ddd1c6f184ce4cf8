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
from ..hooks.hook import Hook, hook_of, unbind
from ..hooks.places import all_classes
from ..hooks.stacks import Args, Kwargs, outside_simulation
from ..simulation import Model
from .fingerprint import STATE, Difference, Fingerprint, differences, fingerprint
from .runs import Rule, Run


class Watch(Run):
    """A plain run that watches the rules. Names are those of decision points.

    Attributes:
        changes: For each name, the differences that one decision of the rule has made in the model,
            in its arguments, and in the variables that it uses.
        yielded: The first value that the generator or coroutine of each name has yielded.
        returning: The names of generators and coroutines that have returned a value.
        settings: For each name, the settings that differ from those before the main loop.
        overriding: Classes whose functions override a decision point and were called.
        deciding: The classes of the objects that have made decisions, with their base classes.
    """

    def __init__(self, state_of: Callable[[Model], Model] | None, plan: Plan) -> None:
        super().__init__(state_of)
        self.changes: dict[str, list[Difference]] = {}
        self.yielded: dict[str, Model] = {}
        self.returning: set[str] = set()
        self.settings: dict[str, list[str]] = {}
        self.overriding: set[type] = set()
        self.deciding: set[type] = set()
        self._settings_before: dict[str, object] = {}
        self._overrides = {
            code: kind for point in plan.active for code, kind in _overrides(point.hook, plan)
        }
        self._looked: defaultdict[str, float] = defaultdict(float)  # seconds, by name

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
        name = hook.name
        for owner in args[:1]:
            self.deciding.update(type(owner).__mro__)
        before = self._settings_before
        changed = [key for key, value in _settings().items() if value != before.get(key, value)]
        if changed:
            self.settings[name] = changed
        # Looks are slow, so that their time is limited.
        is_watched = self._looked[name] < 1.0 and name not in self.changes
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
                self.changes[name] = changes
        self._looked[name] += time.process_time() - begin
        return value

    def follow(self, hook: Hook, rule: Rule) -> Rule:
        """Note the first value that a rule yields, and whether it returns one.

        An error that the model raises in the rule ends it, because the run's result is not used.
        """
        sent = None
        while True:
            try:
                value = rule.send(sent)
            except StopIteration as stop:
                if stop.value is not None:
                    self.returning.add(hook.name)
                return stop.value
            self.yielded.setdefault(hook.name, value)
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
