"""The subject and the report that all check functions share."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from ..errors import (
    AgentError,
    MaskError,
    NoDecisionError,
    ObservationError,
    RewardError,
    ViewError,
    error_notes,
    error_text,
)
from ..simulation import RULE
from .fingerprint import Fingerprint, fingerprint
from .inside import Plan, make_environment, outside_simulation
from .report import SEVERITIES, CheckReport, EpisodeStatistics, Finding, PointStatistics, Timing, finding, order_of
from .runs import Run, Step, TimeUp, culprit, error_in_words, plain_run, random_steps, sources_of_chance, within

SHARE: Final = 0.25
"""The share of the time limit that a single run may take."""


@dataclass
class Subject:
    """A simulation with its decision points and options, the parameters of the check, and what is known so far.

    Attributes:
        plan: The plan of its environments.
        seeds: The seeds of plain runs that are compared.
        episodes: The number of episodes of random actions.
        max_steps: The number of decisions after which a run is cut.
        limit: The time limit of the check, in seconds.
        own: The user's callable by which simulations are compared.
        end: The end of the time limit, as ``time.monotonic()``.
        plain: Its plain runs, by seed.
        repeats: Whether the same seed gives the same plain run.
        unstable: The parts that differ between plain runs of the same seed and are not compared: paths in fingerprints.
        drawn: The global generators that it draws from.
        slow: Whether a view has taken too long.
        playable: Whether plain runs decide something and end, so that environments can be checked.
    """

    plan: Plan
    seeds: tuple[int, ...]
    episodes: int
    max_steps: int
    limit: float
    own: Callable[[Any], Any] | None
    end: float = field(init=False)
    plain: dict[int, Run] = field(default_factory=dict)
    repeats: bool = True
    unstable: frozenset[str] = frozenset()
    drawn: set[str] = field(default_factory=set)
    slow: bool = False
    playable: bool = True

    def __post_init__(self) -> None:
        self.end = time.monotonic() + self.limit

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() >= self.end

    def deadline(self) -> float:
        """Return the deadline of a run that begins now: all have the same time, however late it is."""
        return time.monotonic() + self.limit * SHARE

    @property
    def rules(self) -> dict[Any, Any] | None:
        """Return the option ``policies`` with the rule in place of each policy."""
        return dict.fromkeys(self.plan.options.policies or (), RULE) or None

    def look(self, simulation: Any) -> Fingerprint:
        """Return the fingerprint of a simulation."""
        with outside_simulation():  # decision functions called there run their rule
            return fingerprint(simulation, self.own)

    def run_plainly(self, seed: int) -> Run:
        """Run it once without any environment."""
        return plain_run(self.plan, seed, self.max_steps, self.deadline(), self.look)

    def differences(self, run: Run, other: Run) -> list[tuple[str, Any, Any]]:
        """Return the parts in which the simulations differ after two runs."""
        if run.fingerprint is None or other.fingerprint is None:
            return []
        return run.fingerprint.differences(other.fingerprint, self.unstable)

    def chance(self) -> list[str]:
        """Return the calls of the model that return something else each time."""
        try:
            return sources_of_chance(self.plan, self.seeds[0], self.deadline(), self.max_steps)
        except (Exception, SystemExit):  # it only helps with the explanation
            return []


class Opened:
    """An environment of a subject, which is closed at the end; None if the view does not fit."""

    def __init__(self, subject: Subject, report: Report, view: str = "aec", plan: Plan | None = None, **changes: Any):
        """Define the environment; it is made on entering.

        Args:
            subject: The subject.
            report: The report for errors of closing.
            view: The view.
            plan: The plan. None: that of the subject.
            **changes: Options that replace those of the subject.
        """
        self._subject, self._report, self._view = subject, report, view
        self._plan = (subject.plan if plan is None else plan).amended(changes)
        self._env: Any = None

    def __enter__(self) -> Any:
        try:
            self._env = make_environment(self._plan, self._view)
        except ViewError:
            return None
        return self._env

    def __exit__(self, *error: object) -> None:
        try:
            if self._env is not None:
                within(self._subject.deadline(), self._env.close)
        except TimeUp:
            self._report.add("unclosable")
        except (Exception, SystemExit) as raised:
            self._report.add_error(raised, "when an environment was closed in mid-episode")


@dataclass
class Played:
    """An episode of random actions: its steps, its exception, and the time of its last step."""

    steps: list[Step] = field(default_factory=list)
    error: BaseException | None = None
    latest: float = field(default_factory=time.monotonic)

    @property
    def told(self) -> list[Any]:
        """What the agents got."""
        return [(step.agent, step.told) for step in self.steps]

    def difference(self, other: Played) -> str:
        """Describe the first difference from another episode; empty if there is none."""
        for number, (here, there) in enumerate(zip(self.steps, other.steps, strict=False), 1):
            if difference := here.difference(there):
                return f"step {number}: {difference}"
        if other.error is not None:
            return f"the second one raises {error_in_words(other.error)}"
        if len(self.steps) != len(other.steps):
            return f"first there are {len(self.steps)} steps, then {len(other.steps)}"
        return ""


def play(subject: Subject, env: Any, seed: int, salt: int = 0) -> Played:
    """Play an episode of random legal actions, as far as the time allows."""
    played = Played()

    def steps() -> None:
        for step in random_steps(env, seed, salt):
            played.steps.append(step)
            played.latest = time.monotonic()

    try:
        within(subject.deadline(), steps)
    except (Exception, SystemExit) as error:
        played.error = error
    return played


# -- the report -----------------------------------------------------------------------------------

_OF_ERRORS: Final[tuple[tuple[type[BaseException], str, str], ...]] = (
    (AgentError, "after its end", "revival"),
    (ObservationError, "", "observation_error"),
    (RewardError, "", "reward_error"),
    (MaskError, "", "mask_error"),
    (NoDecisionError, "", "undecided_error"),
    (AgentError, "", "agent_error"),
)
"""The kind of an error, words in its text, and its finding. The first match counts."""

_ORIGINS: Final = {"plain run": "plain_error", "random legal actions": "action_error", "": "any_error"}
"""The findings of other errors, by words in the place where they were raised."""


class Report:
    """A report while it is written.

    Attributes:
        findings: The findings so far.
        checked: What was examined so far, in words.
        points, episodes, timing: As in ``CheckReport``.
    """

    def __init__(self) -> None:
        self.findings: list[Finding] = []
        self.checked: list[str] = []
        self.points: tuple[PointStatistics, ...] = ()
        self.episodes = EpisodeStatistics()
        self.timing: Timing | None = None
        self._errors: set[tuple[str, str]] = set()

    @property
    def has_errors(self) -> bool:
        """Whether there is a finding of severity "error"."""
        return any(finding.severity == "error" for finding in self.findings)

    def add(self, name: str, evidence: str = "", **words: Any) -> None:
        """Add a finding, as ``finding`` makes it."""
        self.findings.append(finding(name, evidence, **words))

    def add_error(self, error: BaseException, where: str) -> None:
        """Add the finding for an exception; the same one from the same place is reported once."""
        key = type(error).__name__, culprit(error) or error_text(error)
        if key in self._errors:
            return
        self._errors.add(key)
        name = next(
            (name for kind, words, name in _OF_ERRORS if isinstance(error, kind) and words in error_text(error)),
            next(name for words, name in _ORIGINS.items() if words in where),
        )
        notes = [note.removeprefix("simenv_marl: ") for note in error_notes(error)]
        self.add(name, "\n".join([f"{where}: {error_in_words(error, 400)}", *notes[:2]]), kind=type(error).__name__)

    def add_unrepeatable(self, subject: Subject, evidence: str) -> None:
        """Add the finding that two runs of the same seed differ."""
        sources = [source for source in subject.chance() if "global" not in source]
        self.add("unrepeatable", "\n".join([evidence, *(f"in the model, {source}" for source in sources[:4])]))

    def finished(self, subject: Subject) -> CheckReport:
        """Return the report for users."""
        plain = subject.plain.get(subject.seeds[0])
        return CheckReport(
            simulation=subject.plan.name,
            findings=tuple(sorted(dict.fromkeys(self.findings), key=lambda f: SEVERITIES.index(f.severity))),
            checked=tuple(self.checked),
            observations=self.points,
            episodes=self.episodes,
            calls=order_of(plain.calls) if plain else "",
            timing=self.timing,
        )
