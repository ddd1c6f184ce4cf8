"""All checks of a simulation, one after the other; each adds to the findings what it has found."""

from __future__ import annotations

import io
import re
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from statistics import fmean
from typing import Any, Final

from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from .._driver import unattended
from .._plan import Binding, Plan
from ..envs import VIEWS, SimulationJointEnv, view_class
from ..errors import (
    AgentError,
    InvalidActionError,
    MaskError,
    NoDecisionError,
    ObservationError,
    OptionValueError,
    RewardError,
    SimEnvError,
    ViewError,
)
from ..simulation import RULE, TRUNCATED, make_simulation, takes
from ._fingerprint import ABSENT, Fingerprint, alike, fingerprint, general, shown
from ._report import (
    SEVERITIES,
    CheckReport,
    EpisodeStatistics,
    Finding,
    PointDescription,
    PointStatistics,
    Severity,
    Timing,
    compressed,
    short_names,
)
from ._runs import (
    Run,
    Step,
    TimeUp,
    all_rules,
    culprit,
    global_generators,
    plain_run,
    random_steps,
    rule_run,
    seed_global_generators,
    set_global_generators,
    sources_of_chance,
    untouched_run,
    within,
)
from ._statistics import agents_in_words, collectors

DRIVERS: Final = ("greenlet",)
"""The drivers with which the plain run is compared."""

_MOST_ERRORS: Final = 3
"""After how many failing episodes of random actions no more are played."""

_SHARE: Final = 0.25
"""How much of the time that is left a single run may take."""


class Checker:
    """Checks one simulation.

    Attributes:
        findings: What was found so far.
        checked: What was looked at so far, in words.
    """

    def __init__(
        self,
        plan: Plan,
        *,
        seeds: tuple[int, ...],
        episodes: int,
        max_steps: int,
        limit: float,
        own: Callable[[Any], Any] | None,
    ) -> None:
        self.findings: list[Finding] = []
        self.checked: list[str] = []
        self._plan, self._seeds, self._episodes, self._max_steps = plan, seeds, episodes, max_steps
        self._end, self._limit, self._own = time.monotonic() + limit, limit, own
        self._plain: dict[int, Run] = {}
        self._chancy: frozenset[str] = frozenset()  # parts that differ between plain runs of the same seed
        self._repeats = True
        self._stopped = False
        self._drawn: set[str] = set()
        self._errors: set[tuple[str, str]] = set()
        self._points: tuple[PointStatistics, ...] = ()
        self._statistics = EpisodeStatistics()
        self._timing: Timing | None = None
        self._different: list[str] = []  # the views in which the model has been found to behave differently
        self._global_rng = bool(getattr(plan.options, "global_rng", False))

    # -- all of it --------------------------------------------------------------------------------

    def check(self) -> CheckReport:
        """Check all there is; the more basic first, and nothing that can only fail for a reason known already."""
        states = global_generators()
        silenced = io.StringIO()
        try:
            with (
                unattended(),
                warnings.catch_warnings(record=True) as caught,
                redirect_stdout(silenced),
                redirect_stderr(silenced),
            ):
                warnings.simplefilter("ignore")
                warnings.filterwarnings("always", ".* refuses to end", ResourceWarning)
                self._check_all()
        finally:
            set_global_generators(states)
        if caught:
            self._add(
                "warning",
                "The simulation refuses to end",
                "When an environment is closed or reset in mid-episode, SimulationExit is raised in the model, which"
                " has to let it pass. Look for an except that catches everything and goes on.",
                _first_lines(str(caught[0].message)),
            )
        if self._late():
            self._add(
                "warning",
                f"The time limit of {self._limit:g} seconds has stopped the check",
                "What is missing below was not looked at. Give more time (time_limit=), or less to do (episodes=,"
                " max_steps=, fewer seeds=).",
            )
        plain = self._plain.get(self._seeds[0])
        return CheckReport(
            simulation=self._plan.name,
            findings=tuple(sorted(dict.fromkeys(self.findings), key=lambda f: SEVERITIES.index(f.severity))),
            checked=tuple(self.checked),
            observations=self._points,
            episodes=self._statistics,
            calls=order_of(plain.decisions) if plain else "",
            timing=self._timing,
        )

    def _check_all(self) -> None:
        try:
            if not self._runs_plainly():
                return
            for look in (
                self._compares_views,
                self._plays_episodes,
                self._ends_early,
                self._conforms,
                self._takes_time,
            ):
                look()
        except (Exception, SystemExit) as error:  # of the model, from where nobody expects it
            self._tell_of_error(error, "while it was checked")

    def _add(self, severity: Severity, title: str, explanation: str, evidence: str = "") -> None:
        self.findings.append(Finding(severity, title, explanation, evidence))

    def _late(self) -> bool:
        return time.monotonic() >= self._end

    def _deadline(self) -> float:
        now = time.monotonic()
        return now + max(0.0, self._end - now) * _SHARE

    # -- the plain simulation ---------------------------------------------------------------------

    def _runs_plainly(self) -> bool:
        """Run the simulation by itself. Returns whether anything else can be looked at."""
        if not takes(make_simulation(self._plan.source).reset, "seed"):
            self._add(
                "note",
                "reset() takes no seed",
                "Whoever resets an environment with a seed expects the same episode each time. Write"
                " reset(self, seed=None) and seed the model's generator with it, unless nothing in it is random.",
            )
        for seed in self._seeds:
            seed_global_generators(seed)
            run = self._plain[seed] = plain_run(self._plan, seed, self._max_steps, self._deadline(), self._own)
            if not self._global_rng:
                self._drawn |= run.drawn
            if isinstance(run.error, TimeUp):
                self._tell_of_time(run, seed)
                return False
            if run.error is not None:
                self._tell_of_error(run.error, f"in a plain run without any environment, seed {seed}")
                return False
        if not any(run.decisions for run in self._plain.values()):
            points = ", ".join(binding.point.name for binding in self._plan.active)
            self._add(
                "error",
                "No decision is ever asked for",
                f"run() comes to its end and never calls {points}. Does the simulation call the function as an"
                " attribute of its class or module, and not by a reference that it took earlier?",
                f"plain runs with seeds {_seeds(self._seeds)}",
            )
            return False
        cut = [run for run in self._plain.values() if run.cut]
        if cut:
            self._add(
                "note",
                "Plain runs were not run to their end",
                f"They make more than {self._max_steps} decisions, or never end. What comes after so many was not"
                " looked at; max_steps= says how many.",
            )
        self._runs_again()
        return True

    def _tell_of_time(self, run: Run, seed: int) -> None:
        seconds = f"{self._limit * _SHARE:.3g} seconds"
        if run.decisions:
            self._add(
                "warning",
                "A plain run took too long to be compared",
                "Give the check more time (time_limit=), or let it look at fewer decisions (max_steps=).",
                f"{len(run.decisions)} decisions in {seconds}, seed {seed}",
            )
        else:
            self._add(
                "error",
                "The simulation neither ends nor asks for a decision",
                "An environment would wait for it for ever. Look for a loop in run() that has no end; or, if it only"
                " is slow, give the check more time (time_limit=).",
                f"{seconds} of a plain run, seed {seed}",
            )

    def _runs_again(self) -> None:
        """Run a seed a second time: what differs then has nothing to do with environments."""
        seed = self._seeds[0]
        first = self._plain[seed]
        if self._drawn:
            seed_global_generators(seed + 1)
            other = self._again(seed)
            same = other is not None and alike(other.decisions, first.decisions)
            self._tell_of_global_generators(seeded_by_model=same and not self._parts(first, other))
        seed_global_generators(seed)
        again = self._again(seed)
        if again is None:
            return
        difference = _first_difference(first.decisions, again.decisions)
        if difference:
            self._repeats = False
            self._tell_of_chance(seed, f"two plain runs of seed {seed}: {difference}")
            return
        parts = self._parts(first, again)
        if not parts:
            return
        self._chancy = frozenset(general(path) for path, _, _ in parts)
        generators = [path for path, _, _ in parts if "state of the generator" in path]
        if generators:
            self._repeats = False
            self._tell_of_chance(seed, f"after two plain runs of seed {seed}, {generators[0]} differs")
            return
        self._add(
            "note",
            "Some of what the model holds differs even between two plain runs of the same seed",
            "The decisions were the same, so this may be harmless: the time of day, or numbers that count on over all"
            " simulations of the process. It was left out of the comparisons below.",
            _parts_in_words(parts),
        )

    def _again(self, seed: int) -> Run | None:
        run = plain_run(self._plan, seed, self._max_steps, self._deadline(), self._own)
        if run.error is None:
            return run
        if not isinstance(run.error, TimeUp):
            self._tell_of_error(run.error, f"in a second plain run of seed {seed}, though not in the first")
        return None

    def _tell_of_global_generators(self, *, seeded_by_model: bool) -> None:
        names = " and ".join(sorted(self._drawn))
        sources = [source for source in self._sources() if "global" in source]
        if seeded_by_model:
            self._add(
                "warning",
                f"The model uses generators that all of the process shares ({names})",
                "It seeds them itself, so that one environment alone repeats its episodes. Two environments side by"
                " side disturb each other, and so does training code that draws from them. Give the model a generator"
                " of its own, random.Random(seed) or numpy.random.default_rng(seed); or give environments the option"
                " global_rng=True.",
                "; ".join(sources),
            )
            return
        self._add(
            "error",
            f"The model draws from generators that all of the process shares ({names})",
            "Seeds do not make its episodes repeat: whatever else draws from these generators changes them. Give the"
            " model a generator of its own, random.Random(seed) or numpy.random.default_rng(seed), seeded in reset();"
            " or, if you cannot change it, give environments the option global_rng=True. (For the comparisons below,"
            " they were seeded alike.)",
            "; ".join(sources),
        )

    def _tell_of_chance(self, seed: int, evidence: str) -> None:
        sources = [source for source in self._sources() if "global" not in source]
        self._add(
            "error",
            "The same seed does not give the same run",
            "Even without an environment two runs of the same seed differ, so that no result can be repeated. The"
            " usual causes: a generator that reset() does not seed, a clock, something left over in attributes of"
            " classes or in global variables, or the order of a set.",
            "\n".join([evidence, *(f"in the model, {source}" for source in sources[:4])]),
        )

    def _sources(self) -> list[str]:
        try:
            return sources_of_chance(self._plan, self._seeds[0], self._deadline(), self._max_steps)
        except (Exception, SystemExit):  # it is only to help with the explanation
            return []

    def _parts(self, run: Run, other: Run | None) -> list[tuple[str, Any, Any]]:
        if other is None or run.fingerprint is None or other.fingerprint is None:
            return []
        return run.fingerprint.differences(other.fingerprint, self._chancy)

    # -- RULE throughout --------------------------------------------------------------------------

    def _compares_views(self) -> None:
        """Compare the plain run with every view and driver, with ``RULE`` throughout."""
        if not self._repeats:
            return
        if self._global_rng:
            self._add(
                "note",
                "The plain run was not compared with environments",
                "With global_rng=True an environment's random numbers begin elsewhere than those of a plain run.",
            )
            return
        drivers = (self._plan.options.driver,) if self._plan.options.driver != DRIVERS[0] else DRIVERS
        compared: dict[str, list[str]] = {}
        for driver in drivers:
            for view in VIEWS:
                if self._late():
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
                views = ", ".join(f"{view} ({', '.join(by)})" for view, by in compared.items())
            most = max(len(run.decisions) for run in self._plain.values())
            seeds = f"seeds {_seeds(self._seeds)}"
            self.checked.append(f"plain runs against RULE throughout ({views}; {seeds}; up to {most} decisions each)")
            held = self._plain[self._seeds[0]].fingerprint
            if held is not None:
                left = f"; cannot be compared: {', '.join(sorted(held.left_out)[:6])}" if held.left_out else ""
                more = "" if held.complete else " (and there are more)"
                self.checked.append(f"what the simulation holds afterwards: {len(held.parts)} parts{more}{left}")

    def _make(self, view: str, changes: Mapping[str, Any]) -> Any:
        """A new environment with a plan of its own; None where the view does not fit."""
        changes = dict(changes)
        if view != "joint" and self._plan.options.flatten:
            changes["flatten"] = False
        plan = self._plan.amended({"policies": self._plan.options.policies, **changes})
        try:
            return view_class(plan, view)(plan)
        except ViewError:
            return None

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

    def _close(self, env: Any) -> None:
        if env is None:
            return
        try:
            within(self._deadline(), env.close)
        except (Exception, SystemExit) as error:
            self._tell_of_error(error, "when an environment was closed in mid-episode")

    def _is_as_plain(self, plain: Run, run: Run, view: str, driver: str, seed: int) -> bool:
        where = f"{view} view, driver {driver}, seed {seed}"
        difference = _first_difference(plain.decisions, run.decisions, "plainly", "behind the environment")
        parts = self._parts(plain, run)
        added = [part for part in parts if part[1] is ABSENT]
        if not difference and not parts:
            return True
        self._different.append(view)
        if len(self._different) > 1:
            return False  # said already
        culprits = self._mappings_that_change_the_model(seed)
        self._place_of_difference = len(self.findings)
        told = difference or _parts_in_words(parts, "plainly", "behind the environment")
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

    # -- episodes of random actions ---------------------------------------------------------------

    def _plays_episodes(self) -> None:
        """Play episodes with random legal actions; collect statistics; compare episodes of the same seed."""
        env = self._make("aec", {"max_steps": self._max_steps})
        collected = collectors(env._plan)
        known: dict[int, list[Step]] = {}
        lengths: list[int] = []
        ends = {"terminated": 0, "truncated": 0, "cut": 0}
        failures = 0
        for number, seed in enumerate(_enough(self._seeds, self._episodes), 1):
            if self._late() or failures == _MOST_ERRORS:
                break
            seed_global_generators(seed)
            steps, error = self._played(env, seed)
            if error is not None:
                failures += 1
                if isinstance(error, TimeUp):
                    self._tell_of_stall(f"episode {number}, seed {seed}, after {len(steps)} steps")
                    break
                self._tell_of_error(error, f"in episode {number} of random legal actions, seed {seed}")
                continue
            if number <= max(2, len(self._seeds)):
                known.setdefault(seed, steps)
            met: set[str] = set()
            for step in steps:
                collected[step.point].stepped(step, first=step.agent not in met)
                met.add(step.agent)
            decided = sum(not (step.told[2] or step.told[3]) for step in steps)
            lengths.append(decided)
            truncated = bool(steps) and steps[-1].told[3]
            how = "cut" if truncated and decided >= self._max_steps else "truncated" if truncated else "terminated"
            ends[how] += 1
        self._points = tuple(collector.statistics() for collector in collected.values())
        if lengths:
            self._statistics = EpisodeStatistics(len(lengths), min(lengths), max(lengths), fmean(lengths), **ends)
            for collector in collected.values():
                self.findings += collector.findings()
            if ends["cut"] == len(lengths):
                self._add(
                    "note",
                    "No episode came to its end",
                    f"All were cut after {self._max_steps} steps. Environments of a model that never ends need the"
                    " option max_steps.",
                )
            self.checked.append(f"{len(lengths)} episodes of random legal actions in the AEC view")
        if not failures and known and self._repeats:
            self._compares_episodes(env, known)
        self._close(env)

    def _played(self, env: Any, seed: int, salt: int = 0) -> tuple[list[Step], BaseException | None]:
        steps: list[Step] = []
        try:
            within(self._deadline(), lambda: steps.extend(random_steps(env, seed, salt)))
        except (Exception, SystemExit) as error:
            return steps, error
        return steps, None

    def _tell_of_stall(self, where: str) -> None:
        self._add(
            "error",
            "An episode came to a standstill",
            "After random legal actions the simulation neither ended nor asked for a decision in the time that the"
            " check had for it. Look for a loop that waits for what some actions never bring about; or, if it only is"
            " slow, give the check more time (time_limit=) or fewer steps (max_steps=).",
            where,
        )

    def _compares_episodes(self, env: Any, known: dict[int, list[Step]]) -> None:
        """Compare episodes of the same seed: in a new environment, in a used one, and beside another one."""
        first, *others = known
        fresh = self._make("aec", {"max_steps": self._max_steps})
        beside = self._make("aec", {"max_steps": self._max_steps})
        try:
            seed_global_generators(first)
            steps, error = self._played(fresh, first)
            if isinstance(error, TimeUp) or self._late():
                return
            difference = _step_difference(known[first], steps, error)
            if difference:
                self._tell_of_chance(first, f"two environments, seed {first}, the same actions: {difference}")
                return
            seed_global_generators(first)
            steps, error = self._played(env, first)
            if isinstance(error, TimeUp) or self._late():
                return
            difference = _step_difference(known[first], steps, error)
            if difference:
                self._add(
                    "error",
                    "Something is left over from earlier episodes",
                    "An episode in an environment that has played others differs from the same one in a new"
                    " environment. reset() must bring back everything that run() changes; what is set in __init__ and"
                    " changed later is the usual cause.",
                    f"seed {first}, the same actions: {difference}" + self._left_over(first),
                )
                return
            if others and not self._drawn:
                self._compares_side_by_side(fresh, beside, known)
            self._compares_seeds(env, known)
            self.checked.append(
                "the same seed and actions in a new environment, in one that was used before, and beside another one"
            )
        finally:
            self._close(fresh)
            self._close(beside)

    def _left_over(self, seed: int) -> str:
        """What a simulation holds after a run and a reset that it does not hold after the first reset."""
        try:
            plan = self._plan
            env = self._make("aec", {"max_steps": self._max_steps, "policies": None})
            looks = []

            def look() -> None:
                seed_global_generators(seed)
                env.reset(seed=seed)
                looks.append(fingerprint(env.simulation, self._own))
                for _ in random_steps(env, seed + 1):
                    pass

            for _ in range(2):
                within(self._deadline(), look)
            env.close()
            parts = looks[0].differences(looks[1], self._chancy)
        except (Exception, SystemExit):
            return ""
        return f"\nafter reset, {plan.name}: {_parts_in_words(parts, 'at first', 'later')}" if parts else ""

    def _compares_side_by_side(self, one: Any, other: Any, known: dict[int, list[Step]]) -> None:
        seeds = list(known)[:2]
        played: list[list[Step]] = [[], []]
        error: BaseException | None = None

        def play() -> None:
            games = [random_steps(env, seed) for env, seed in zip((one, other), seeds, strict=True)]
            for pair in zip_longest(*games):
                for steps, step in zip(played, pair, strict=True):
                    if step is not None:
                        steps.append(step)

        try:
            within(self._deadline(), play)
        except TimeUp:
            return
        except (Exception, SystemExit) as raised:
            error = raised
        for seed, steps in zip(seeds, played, strict=True):
            difference = _step_difference(known[seed], steps, error)
            if difference:
                self._add(
                    "error",
                    "Two environments of the model disturb each other",
                    "Stepped in turns, they give other episodes than each by itself. They share something: attributes"
                    " of classes, global variables, a file, or objects that were made when the module was imported.",
                    f"seeds {_seeds(seeds)}: {difference}",
                )
                return

    def _compares_seeds(self, env: Any, known: dict[int, list[Step]]) -> None:
        if len(known) > 1:
            starts = [(steps[0].agent, steps[0].told) for steps in known.values() if steps]
            rules = [run.decisions for run in self._plain.values()]
            prints = [run.fingerprint for run in self._plain.values() if run.fingerprint is not None]
            same_runs = all(alike(rules[0], other) for other in rules[1:])
            same_runs = same_runs and not any(prints[0].differences(other, self._seed_like) for other in prints[1:])
            if same_runs and all(alike(starts[0], other) for other in starts[1:]):
                self._add(
                    "note",
                    "All seeds give the same episode",
                    "If something in the model is random, reset() does not seed it with what it is given. If nothing"
                    " is, every episode begins alike, and agents may learn it by heart.",
                    f"seeds {_seeds(known)}",
                )
        first = next(iter(known))
        seed_global_generators(first)
        steps, error = self._played(env, first, salt=1)
        if error is None and not self._drawn and len(steps) > 1:
            acted = [step.action for step in known[first] if step.action is not None]
            other = [step.action for step in steps if step.action is not None]
            unmoved = alike([(s.agent, s.told) for s in known[first]], [(s.agent, s.told) for s in steps])
            if unmoved and not alike(acted, other):
                self._add(
                    "warning",
                    "What the agents do changes nothing",
                    "Two episodes of the same seed with different actions gave the same observations and rewards. Do"
                    " the actions reach the model (action_space_mapping, apply), and do observations and rewards show"
                    " what they bring about?",
                    f"seed {first}, {len(acted)} actions",
                )

    @property
    def _seed_like(self) -> frozenset[str]:
        """Parts that hold nothing but the seed itself."""
        return self._chancy | {
            general(path)
            for seed, run in self._plain.items()
            if run.fingerprint is not None
            for path, value in run.fingerprint.parts.items()
            if type(value) is int and value == seed and "seed" in path
        }

    def _ends_early(self) -> None:
        """Close an environment in mid-episode."""
        if self._late() or any(finding.severity == "error" for finding in self.findings):
            return
        env = self._make("aec", {"max_steps": None})
        seed_global_generators(self._seeds[0])
        try:
            within(self._deadline(), partial(env.reset, seed=self._seeds[0]))
        except TimeUp:
            pass
        finally:
            self._close(env)
        self.checked.append("an environment that is closed in mid-episode")

    # -- PettingZoo's and Gymnasium's own tests ---------------------------------------------------

    def _conforms(self) -> None:
        """Run what PettingZoo and Gymnasium check; say what they warn of in plain words."""
        if self._late() or any(finding.severity == "error" for finding in self.findings):
            # They could only say the same in other words.
            self.checked.append("not, because of the errors: what PettingZoo and Gymnasium test themselves")
            return
        limits = {"max_steps": self._max_steps}
        passed = []
        seed_global_generators(0)

        def make(view: str) -> Callable[[], Any]:
            return lambda: self._make(view, limits)

        for name, view, test in (
            ("PettingZoo's api_test", "aec", lambda make: api_test(make(), num_cycles=50)),
            ("seed_test", "aec", lambda make: seed_test(make, num_cycles=20)),
            ("parallel_api_test", "parallel", lambda make: parallel_api_test(make(), num_cycles=50)),
            ("parallel_seed_test", "parallel", lambda make: parallel_seed_test(make, num_cycles=20)),
            ("Gymnasium's check_env (single view)", "single", _check_env),
            ("Gymnasium's check_env (joint view)", "joint", _check_env),
        ):
            if self._late() or (self._drawn and "seed" in name):
                continue
            try:
                if (env := self._make(view, limits)) is None:
                    continue
                self._close(env)
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    within(self._deadline(), partial(test, make(view)))
            except TimeUp:
                continue
            except InvalidActionError:
                continue  # the test knows nothing of masks, or of those that change within a round
            except AgentError as error:
                if view != "joint":
                    self._tell_of_error(error, f"in {name}")
                continue
            except AssertionError as error:
                self._add(
                    "error",
                    f"{name} fails",
                    "Learning libraries rely on what it tests.",
                    _first_lines(str(error)) + _at(error),
                )
                continue
            except (Exception, SystemExit) as error:
                self._tell_of_error(error, f"in {name}")
                continue
            passed.append(name)
            self._tell_of_warnings(name, caught)
        if passed:
            self.checked.append(", ".join(passed))

    def _tell_of_warnings(self, name: str, caught: Iterable[warnings.WarningMessage]) -> None:
        for message in dict.fromkeys(_bare(str(warning.message)) for warning in caught):
            if any(known in message for known in _SAID_OTHERWISE):
                continue
            for pattern, title, explanation in _IN_PLAIN_WORDS:
                if pattern in message:
                    self._add("note", title, explanation)
                    break
            else:
                self._add("note", f"{name} warns", "Learning libraries may trip over this.", _first_lines(message))

    # -- time -------------------------------------------------------------------------------------

    def _takes_time(self) -> None:
        """Measure what a decision takes, where runs come to their end."""
        seed = self._seeds[0]
        run = self._plain[seed]
        if run.cut or not run.decisions or self._late() or self._global_rng:
            return
        env = None
        try:
            seed_global_generators(seed)
            plain = untouched_run(self._plan, seed, self._deadline())
            env = self._make("aec", {"max_steps": None})
            seed_global_generators(seed)
            start = time.perf_counter()
            within(self._deadline(), partial(all_rules, env, seed))
            seconds = time.perf_counter() - start
        except (Exception, SystemExit):
            return
        finally:
            self._close(env)
        number = len(run.decisions)
        self._timing = Timing(plain / number * 1e6, seconds / number * 1e6)

    # -- errors -----------------------------------------------------------------------------------

    def _tell_of_error(self, error: BaseException, where: str) -> None:
        """Add the finding of an error; the same one from the same place is told once."""
        key = type(error).__name__, culprit(error) or str(error)
        if key in self._errors:
            return
        self._errors.add(key)
        title, explanation = f"The simulation raises {type(error).__name__}", _OF_ANY_ERROR
        if "plain run" in where:
            explanation = _OF_PLAIN_ERRORS
        elif "random legal actions" in where:
            explanation = _OF_ERRORS_OF_ACTIONS
        if isinstance(error, AgentError) and "after its end" in str(error):
            title, explanation = "An agent decides after it was removed", _OF_REVIVAL
        else:
            for kind, of_title, of_explanation in _OF_ERRORS:
                if isinstance(error, kind):
                    title, explanation = of_title, of_explanation
                    break
        notes = [str(note).removeprefix("simenv_marl: ") for note in getattr(error, "__notes__", ())]
        evidence = [f"{where}: {type(error).__name__}: {_first_lines(str(error), 400)}{_at(error)}", *notes[:2]]
        self._add("error", title, explanation, "\n".join(evidence))


# -- words ----------------------------------------------------------------------------------------

_OF_ANY_ERROR: Final = "The error comes from the model itself, or from one of its mappings."
_OF_PLAIN_ERRORS: Final = "The error comes from the model itself: no environment was around it."
_OF_ERRORS_OF_ACTIONS: Final = (
    "Every action that is in the action space and not masked is one that learning code will try, and that the model"
    " must be able to take. If it is an action that fails: narrow the space, or say by action_mask_mapping which actions"
    " are legal. If it is only a later episode that fails: reset() must bring back everything that run() changes."
)
_OF_REVIVAL: Final = (
    "removed_by says that the agent's episode has ended, and then the agent of that name decides again. Let removed_by"
    " name what really ends an entity, and agent= give each entity a name that no other ever had."
)
_OF_ERRORS: Final[tuple[tuple[type[BaseException], str, str], ...]] = (
    (
        ObservationError,
        "An observation does not fit its space",
        "The observation_space_mapping returned something of another shape or kind than the observation_space holds."
        " Change one of the two.",
    ),
    (
        RewardError,
        "A reward is not one finite number",
        "The reward_mapping must return one number that is neither infinite nor NaN. Look for a division by zero, and"
        " for values that were never set.",
    ),
    (
        MaskError,
        "The legal actions do not fit the action space",
        "A mask needs a 0 or 1 for each action of the space, and at least one 1; choices must be 1 to as many as the"
        " space holds. See action_mask_mapping and choices of make_step.",
    ),
    (
        NoDecisionError,
        "An episode ends before any decision",
        "With some seeds or actions run() returns before it calls a decision function. Environments need at least one"
        " decision in each episode.",
    ),
    (AgentError, "The names of agents do not fit", "See what it says of agent= and possible_agents=."),
)

_SAID_OTHERWISE: Final = (
    "possible_agents defined",  # PettingZoo's rule where agents are only known when they decide
    "No agents present",  # after the end of each episode of such an environment
    "alternative render modes",
    "not a NumPy array",  # PettingZoo knows Dict observations of its own environments alone
    "should be gymnasium.spaces.box",
    "space for each agent probably should be",
    "infinity. This is probably",
    "normalized space",
    "different classes",
    "different shapes",
    "different number of dimensions",
    "different observation space sizes",
    "different action space sizes",
    "different between two agents",
    "all zeros",
    "single number",
    "does not have a render() method",
    "has not defined a render() method",
)
"""What PettingZoo and Gymnasium warn of that is no fault, or that the check says in words of its own."""

_IN_PLAIN_WORDS: Final = (
    (
        "more than 3 dimensions",
        "Observations have more than three dimensions",
        "Learning libraries know what to do with up to three (pictures).",
    ),
    (
        "minimum and maximum values are equal",
        "A space holds only one value somewhere",
        "Lower and upper bound of a component are the same, so that nothing can be observed or decided there.",
    ),
)


def _check_env(make: Callable[[], Any]) -> None:
    check_env(make(), skip_render_check=True)


def _bare(message: str) -> str:
    """A message without the codes of colours and what Gymnasium begins it with."""
    return re.sub(r"\x1b\[[0-9;]*m", "", message).removeprefix("WARN: ").strip()


def _first_lines(text: str, most: int = 300) -> str:
    text = " ".join(text.split())
    return text if len(text) <= most else f"{text[: most - 4]} ..."


def _at(error: BaseException) -> str:
    place = culprit(error)
    return f" ({place})" if place else ""


def _seeds(seeds: Iterable[int]) -> str:
    return ", ".join(map(str, seeds))


def _enough(seeds: tuple[int, ...], number: int) -> Iterator[int]:
    """As many seeds as there are to be episodes: those that are given, and then the next ones."""
    following = max(seeds) + 1
    for place in range(number):
        yield seeds[place] if place < len(seeds) else following + place - len(seeds)


def _first_difference(one: list[list[Any]], other: list[list[Any]], here: str = "first", there: str = "then") -> str:
    """Where two sequences of decisions differ first, in words; empty where they do not."""
    for number, (left, right) in enumerate(zip(one, other, strict=False), 1):
        if left[0] != right[0]:
            return f"decision {number} is {here} of {left[0]}, {there} of {right[0]}"
        if not alike(left[1], right[1]):
            return f"decision {number}, of {left[0]}, is {here} {shown(left[1])}, {there} {shown(right[1])}"
    if len(one) != len(other):
        return f"there are {here} {len(one)} decisions, {there} {len(other)}"
    return ""


def _step_difference(one: list[Step], other: list[Step], error: BaseException | None) -> str:
    """Where two episodes differ first, in words; empty where they do not."""
    names = ("observation", "reward", "terminated", "truncated", "info")
    for number, (left, right) in enumerate(zip(one, other, strict=False), 1):
        if left.agent != right.agent:
            return f"step {number} is first of {left.agent}, then of {right.agent}"
        for name, here, there in zip(names, left.told, right.told, strict=True):
            if not alike(here, there):
                return f"at step {number} the {name} of {left.agent} is first {shown(here)}, then {shown(there)}"
        if left != right:
            return f"at step {number} the action of {left.agent} differs"
    if error is not None:
        return f"the second one raises {type(error).__name__}: {_first_lines(str(error))}{_at(error)}"
    if len(one) != len(other):
        return f"there are first {len(one)} steps, then {len(other)}"
    return ""


def _parts_in_words(parts: list[tuple[str, Any, Any]], here: str = "first", there: str = "then") -> str:
    listed = [f"{path} is {here} {shown(left)}, {there} {shown(right)}" for path, left, right in parts[:3]]
    more = f"; {len(parts) - 3} more" if len(parts) > 3 else ""
    return "; ".join(listed) + more


def order_of(decisions: list[list[Any]]) -> str:
    """The order in which points were called, compressed."""
    names = [name for name, _ in decisions]
    short = short_names(list(dict.fromkeys(names)))
    return compressed(short[name] for name in names)


# -- inspection -----------------------------------------------------------------------------------


def described(binding: Binding) -> PointDescription:
    """What is to be known of a decision point."""
    definition = binding.definition
    details = []
    if definition.action_mask_mapping is not None:
        details.append("a mask says which actions are legal")
    if definition.choices is not None:
        details.append("the legal answers come with each call")
    if definition.apply is not None:
        details.append("actions are carried out in place of the rule")
    if definition.removed_by:
        details.append(f"agents end by {', '.join(definition.removed_by)}")
    if definition.goal_space is not None:
        details.append(f"has goals in {definition.goal_space}")
    return PointDescription(
        name=binding.point.name,
        agents=agents_in_words(binding),
        observation_space=str(definition.observation_space),
        action_space=str(definition.action_space),
        details=tuple(details),
    )


def ending(run: Run) -> str:
    """How a plain run ended, in words."""
    number = f"{len(run.decisions)} decisions"
    if run.cut:
        return f"cut after {number}"
    if isinstance(run.error, TimeUp):
        return f"stopped by the time limit after {number}"
    if run.error is not None:
        return f"{number}, then {type(run.error).__name__}: {_first_lines(str(run.error))}{_at(run.error)}"
    how = "truncated (a limit of time)" if run.result is TRUNCATED else "terminated (an end of the task)"
    return f"{number}, then {how}"


def fitting_views(plan: Plan) -> Iterator[str]:
    """The views that a plan allows."""
    for view in VIEWS:
        try:
            base = view_class(
                plan if view == "joint" or not plan.options.flatten else plan.amended({"flatten": False}), view
            )
            if base is SimulationJointEnv:
                base(plan).close()
        except SimEnvError:
            continue
        except Exception:
            continue
        yield view


__all__ = ["DRIVERS", "Checker", "Fingerprint", "described", "ending", "fitting_views", "order_of"]
