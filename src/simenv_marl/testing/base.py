"""What all checks share: what was found so far, how much time is left, and how to say what went wrong."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from ..core.plan import Plan
from ..envs import view_class
from ..errors import (
    AgentError,
    ViewError,
)
from .report import (
    EpisodeStatistics,
    Finding,
    PointStatistics,
    Severity,
    Timing,
)
from .runs import (
    Run,
    Step,
    TimeUp,
    culprit,
    random_steps,
    sources_of_chance,
    within,
)
from .words import OF_ANY_ERROR, OF_ERRORS, OF_ERRORS_OF_ACTIONS, OF_PLAIN_ERRORS, OF_REVIVAL, at, first_lines

SHARE: Final = 0.25
"""How much of the time limit a single run may take."""


class Checks:
    """Checks of one simulation.

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
        self._drawn: set[str] = set()
        self._errors: set[tuple[str, str]] = set()
        self._points: tuple[PointStatistics, ...] = ()
        self._statistics = EpisodeStatistics()
        self._timing: Timing | None = None
        self._different: list[str] = []  # the views in which the model has been found to behave differently
        self._slow = False  # whether a view has taken too long
        self._latest_step = 0.0  # when it was
        self._place_of_difference = 0  # of the finding that says so
        self._global_rng = plan.options.global_rng

    def _add(self, severity: Severity, title: str, explanation: str, evidence: str = "") -> None:
        self.findings.append(Finding(severity, title, explanation, evidence))

    def _late(self) -> bool:
        return time.monotonic() >= self._end

    def _deadline(self) -> float:
        """When a run that begins now must have ended: all have the same time, however late it is."""
        return time.monotonic() + self._limit * SHARE

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

    def _close(self, env: Any) -> None:
        if env is None:
            return
        try:
            within(self._deadline(), env.close)
        except TimeUp:
            self._add(
                "error",
                "An environment cannot be closed",
                "When it is closed in mid-episode, the model goes on for longer than the check had time. Look for what"
                " it does in stop(), in its finally blocks, and in an except that catches everything.",
            )
        except (Exception, SystemExit) as error:
            self._tell_of_error(error, "when an environment was closed in mid-episode")

    def _played(self, env: Any, seed: int, salt: int = 0) -> tuple[list[Step], BaseException | None]:
        steps: list[Step] = []

        def play() -> None:
            for step in random_steps(env, seed, salt):
                steps.append(step)
                self._latest_step = time.monotonic()

        self._latest_step = time.monotonic()
        try:
            within(self._deadline(), play)
        except (Exception, SystemExit) as error:
            return steps, error
        return steps, None

    def _parts(self, run: Run, other: Run | None) -> list[tuple[str, Any, Any]]:
        if other is None or run.fingerprint is None or other.fingerprint is None:
            return []
        return run.fingerprint.differences(other.fingerprint, self._chancy)

    def _sources(self) -> list[str]:
        try:
            return sources_of_chance(self._plan, self._seeds[0], self._deadline(), self._max_steps)
        except (Exception, SystemExit):  # it is only to help with the explanation
            return []

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

    def _tell_of_error(self, error: BaseException, where: str) -> None:
        """Add the finding of an error; the same one from the same place is told once."""
        key = type(error).__name__, culprit(error) or str(error)
        if key in self._errors:
            return
        self._errors.add(key)
        title, explanation = f"The simulation raises {type(error).__name__}", OF_ANY_ERROR
        if "plain run" in where:
            explanation = OF_PLAIN_ERRORS
        elif "random legal actions" in where:
            explanation = OF_ERRORS_OF_ACTIONS
        if isinstance(error, AgentError) and "after its end" in str(error):
            title, explanation = "An agent decides after it was removed", OF_REVIVAL
        else:
            for kind, of_title, of_explanation in OF_ERRORS:
                if isinstance(error, kind):
                    title, explanation = of_title, of_explanation
                    break
        notes = [str(note).removeprefix("simenv_marl: ") for note in getattr(error, "__notes__", ())]
        evidence = [f"{where}: {type(error).__name__}: {first_lines(str(error), 400)}{at(error)}", *notes[:2]]
        self._add("error", title, explanation, "\n".join(evidence))
