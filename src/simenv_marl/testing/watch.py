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
from collections.abc import Callable
from contextlib import suppress
from inspect import getclosurevars
from types import coroutine

from ..errors import short_repr
from ..hooks.hook import Hook
from ..hooks.stacks import Args, Kwargs
from ..simulation import Model
from .fingerprint import STATE, Fingerprint, describe_differences, differences, fingerprint
from .runs import Rule, Run


class Watch(Run):
    """A plain run that watches the rules.

    Attributes:
        found: For each decision function, the evidence of findings by their names in ``FINDINGS``.
    """

    def __init__(self, state_of: Callable[[Model], Model] | None) -> None:
        super().__init__(state_of)
        self.found: defaultdict[Hook, dict[str, str]] = defaultdict(dict)
        self._settings = _settings()
        self._looked = 0.0  # seconds

    def decide(self, hook: Hook, args: Args, kwargs: Kwargs) -> Model:
        """Let the rule decide, and compare the model before and after."""
        found = self.found[hook]
        changed = [
            name for name, value in _settings().items() if value != self._settings.get(name, value)
        ]
        if changed:
            found["settings"] = ", ".join(changed)
        if self._looked > 2.0:  # looks are slow
            return super().decide(hook, args, kwargs)
        begin = time.process_time()
        steps = len(self.calls)
        parts = self._look(hook, args)
        value = super().decide(hook, args, kwargs)
        changes = differences(parts, self._look(hook, args))
        # Lazy values that libraries store do not change a model.
        changes = [part for part in changes if STATE not in part.path and "cache" not in part.path]
        # A rule that asks for other decisions is left out: their rules make changes, too.
        if changes and steps == len(self.calls):
            found.setdefault("changing_rule", describe_differences(changes))
        self._looked += time.process_time() - begin
        return value

    @coroutine
    def follow(self, hook: Hook, step: str, rule: Rule) -> Rule:
        """Note whether a rule yields, and whether it returns a value.

        An error that the model raises in the rule ends it, because the run's result is not used.
        """
        value = sent = None
        waits = False
        while True:
            try:
                value = rule.send(sent)
            except StopIteration as stop:
                if waits:
                    is_plain = isinstance(value, (int, float, str, tuple))
                    name = "vanishing" if is_plain and stop.value is None else "waiting_rule"
                    self.found[hook][name] = f"the last value that it yields: {short_repr(value)}"
                return stop.value
            waits = True
            sent = yield value

    def _look(self, hook: Hook, args: Args) -> Fingerprint:
        parts = self.look()
        if self.state_of is None:
            with suppress(TypeError):  # the function is not written in Python
                parts |= fingerprint("variables", getclosurevars(hook.function))
            parts |= fingerprint("arguments", args)
        return parts


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
