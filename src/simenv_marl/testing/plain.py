"""Checks of the simulation by itself: does it run, does it decide, does a seed repeat it?"""

from __future__ import annotations

from ..simulation import make_simulation, takes
from .base import SHARE, Checks
from .fingerprint import alike, general
from .runs import (
    Run,
    TimeUp,
    plain_run,
    seed_global_generators,
)
from .words import first_difference, parts_in_words, seeds_in_words


class PlainChecks(Checks):
    """Runs the simulation without an environment."""

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
                f"plain runs with seeds {seeds_in_words(self._seeds)}",
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
        seconds = f"{self._limit * SHARE:.3g} seconds"
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
        difference = first_difference(first.decisions, again.decisions)
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
            parts_in_words(parts),
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
