"""Checks by episodes of random legal actions: what they range over, and whether they repeat."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from itertools import zip_longest
from statistics import fmean
from typing import Any, Final

from .base import SHARE, Checks
from .fingerprint import alike, fingerprint, general
from .report import (
    EpisodeStatistics,
)
from .runs import (
    Step,
    TimeUp,
    random_steps,
    seed_global_generators,
    within,
)
from .statistics import collectors
from .words import parts_in_words, seeds_in_words, step_difference

_MOST_ERRORS: Final = 3
"""After how many failing episodes of random actions no more are played."""


class EpisodeChecks(Checks):
    """Plays episodes."""

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

    def _tell_of_stall(self, where: str) -> None:
        if time.monotonic() - self._latest_step < self._limit * SHARE / 2:
            self._add(
                "warning",
                "An episode took too long",
                "It went on, but not to its end. Give the check more time (time_limit=), or cut episodes earlier"
                " (max_steps=).",
                where,
            )
            return
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
            difference = step_difference(known[first], steps, error)
            if difference:
                self._tell_of_chance(first, f"two environments, seed {first}, the same actions: {difference}")
                return
            seed_global_generators(first)
            steps, error = self._played(env, first)
            if isinstance(error, TimeUp) or self._late():
                return
            difference = step_difference(known[first], steps, error)
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
        return f"\nafter reset, {plan.name}: {parts_in_words(parts, 'at first', 'later')}" if parts else ""

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
            difference = step_difference(known[seed], steps, error)
            if difference:
                self._add(
                    "error",
                    "Two environments of the model disturb each other",
                    "Stepped in turns, they give other episodes than each by itself. They share something: attributes"
                    " of classes, global variables, a file, or objects that were made when the module was imported.",
                    f"seeds {seeds_in_words(seeds)}: {difference}",
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
                    f"seeds {seeds_in_words(known)}",
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


def _enough(seeds: tuple[int, ...], number: int) -> Iterator[int]:
    """As many seeds as there are to be episodes: those that are given, and then the next ones."""
    following = max(seeds) + 1
    for place in range(number):
        yield seeds[place] if place < len(seeds) else following + place - len(seeds)
