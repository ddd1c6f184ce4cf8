"""Checks that the simulation behind environments is the plain one, with ``RULE`` throughout."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, Final

from ..core.bindings import Binding
from ..envs import VIEWS
from ..errors import (
    AgentError,
    OptionValueError,
)
from ..simulation import RULE
from .base import Checks
from .fingerprint import ABSENT, alike, fingerprint
from .runs import (
    Run,
    TimeUp,
    all_rules,
    global_generators,
    rule_run,
    seed_global_generators,
    within,
)
from .words import first_difference, parts_in_words, seeds_in_words

DRIVERS: Final = ("greenlet", "thread")
"""The drivers with which the plain run is compared."""


class ViewChecks(Checks):
    """Compares views with plain runs."""

    def _compares_views(self) -> None:
        """Compare the plain run with every view and driver, with ``RULE`` throughout."""
        if not self._repeats:
            return
        drivers = (self._plan.options.driver,) if self._plan.options.driver != DRIVERS[0] else DRIVERS
        compared: dict[str, list[str]] = {}
        for driver in drivers:
            for view in VIEWS:
                if self._late():
                    return
                if self._slow:
                    return
                if not self._compares(view, driver):
                    continue
                compared.setdefault(view, []).append(driver)
        others = list(dict.fromkeys(view for view in self._different[1:] if view != self._different[0]))
        if others:
            first = self.findings[self._place_of_difference]
            evidence = f"{first.evidence}\nthe same in the views {', '.join(others)}"
            self.findings[self._place_of_difference] = replace(first, evidence=evidence)
        if compared:
            views = ", ".join(compared)
            if len(drivers) > 1:
                everywhere = all(len(by) == len(drivers) for by in compared.values())
                views = (
                    f"{views}; drivers {', '.join(drivers)}"
                    if everywhere
                    else ", ".join(f"{view} ({', '.join(by)})" for view, by in compared.items())
                )
            most = max(len(run.decisions) for run in self._plain.values())
            seeds = f"seeds {seeds_in_words(self._seeds)}"
            self.checked.append(f"plain runs against RULE throughout ({views}; {seeds}; up to {most} decisions each)")
            held = self._plain[self._seeds[0]].fingerprint
            if held is not None:
                left = f"; cannot be compared: {', '.join(sorted(held.left_out)[:6])}" if held.left_out else ""
                more = "" if held.complete else " (and there are more)"
                self.checked.append(f"what the simulation holds afterwards: {len(held.parts)} parts{more}{left}")

    def _compares(self, view: str, driver: str) -> bool:
        """Compare one view. Returns whether it fits, and could be run."""
        policies = self._plan.options.policies
        changes = {
            "driver": driver,
            "policies": dict.fromkeys(policies, RULE) if policies else None,
            "max_steps": None,
        }
        for seed, plain in self._plain.items():
            if not plain.decisions or self._late():
                continue
            env = None
            try:
                seed_global_generators(seed)
                env = self._make(view, changes)
                if env is None:
                    return False
                seed_global_generators(seed)
                run = rule_run(env, seed, self._max_steps, self._deadline(), self._own)
            except OptionValueError:
                return False  # a driver that this platform does not have
            except (Exception, SystemExit) as error:
                self._tell_of_error(error, f"when the {view} view was made")
                return False
            finally:
                self._close(env)
            if isinstance(run.error, TimeUp):
                self._slow = True
                self._add(
                    "warning",
                    f"The {view} view took too long to be compared",
                    "Give the check more time (time_limit=), or let it look at fewer decisions (max_steps=).",
                )
                return False
            if run.error is not None:
                # In the joint view nobody may join whom nobody could know beforehand.
                if not (view == "joint" and isinstance(run.error, AgentError)):
                    self._tell_of_error(run.error, f"in the {view} view with RULE throughout, seed {seed}")
                return False
            if run.drawn - self._drawn:
                self._tell_of_drawing_mappings(run.drawn - self._drawn)
            if not self._is_as_plain(plain, run, view, driver, seed):
                break
        return True

    def _tell_of_drawing_mappings(self, names: set[str]) -> None:
        self._drawn |= names
        self._add(
            "error",
            f"Mappings draw from generators that all of the process shares ({' and '.join(sorted(names))})",
            "The model by itself does not, but observations, rewards, masks or agents' names do. Seeds do not make them"
            " repeat. Draw in the model, from a generator of its own that reset() seeds, and let mappings only look.",
        )

    def _is_as_plain(self, plain: Run, run: Run, view: str, driver: str, seed: int) -> bool:
        where = f"{view} view, driver {driver}, seed {seed}"
        difference = first_difference(plain.decisions, run.decisions, "plainly", "behind the environment")
        parts = self._parts(plain, run)
        added = [part for part in parts if part[1] is ABSENT]
        if not difference and not parts:
            return True
        self._different.append(view)
        if len(self._different) > 1:
            return False  # said already
        culprits = self._mappings_that_change_the_model(seed)
        self._place_of_difference = len(self.findings)
        told = difference or parts_in_words(parts, "plainly", "behind the environment")
        evidence = "\n".join([f"{where}: {told}", *culprits])
        if not difference and len(parts) == len(added):
            self._add(
                "warning",
                "Mappings write into the model",
                "Behind an environment the simulation holds things that it does not hold in a plain run, though its"
                " decisions are the same. Keep such notes outside of the model; for changes since the last decision"
                " there is difference().",
                evidence,
            )
            return False
        self._add(
            "error",
            "The model behaves differently when it is observed",
            "With its own rule deciding everything, the run behind an environment must be the plain run. It is not, so"
            " that what is learned is learned on another model. Mappings (of observations, rewards, masks, agents'"
            " names) must only look: change nothing in the model, and draw no random numbers from it.",
            evidence,
        )
        return False

    def _mappings_that_change_the_model(self, seed: int) -> list[str]:
        """Play the AEC view once more, and look at the model before and after each call of a mapping."""
        found: dict[str, None] = {}
        env = None
        try:
            env = self._make("aec", {"max_steps": 50, "policies": None})
            if env is None:
                return []
            for binding in env._plan.bindings.values():
                if isinstance(binding, Binding):
                    self._watch_mappings(env, binding, found)
            seed_global_generators(seed)
            within(self._deadline(), partial(all_rules, env, seed))
        except (Exception, SystemExit):
            pass  # which mappings were seen until then is told
        finally:
            self._close(env)
        return list(found)

    def _watch_mappings(self, env: Any, binding: Binding, found: dict[str, None]) -> None:
        for slot, what in (
            ("observe", "observation_space_mapping"),
            ("reward", "reward_mapping"),
            ("legal", "mask or choices"),
            ("name_agent", "agent"),
        ):
            mapping = getattr(binding, slot)
            if mapping is not None:
                setattr(binding, slot, self._watched(env, mapping, f"{what} of {binding.point.name}", found))

    def _watched(self, env: Any, mapping: Any, what: str, found: dict[str, None]) -> Any:
        def watched(*args: Any, **kwargs: Any) -> Any:
            if what in found:
                return mapping(*args, **kwargs)
            before, drawn = fingerprint(env.simulation, self._own), global_generators()
            value = mapping(*args, **kwargs)
            changed = before.differences(fingerprint(env.simulation, self._own), self._chancy)
            if changed:
                found[f"the {what} changes {changed[0][0]}"] = None
            elif not alike(drawn, global_generators()):
                found[f"the {what} draws from a global generator"] = None
            return value

        return watched
