"""What all check functions share: the subject that they check, and the report that they write."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from ..errors import AgentError, MaskError, NoDecisionError, ObservationError, RewardError, ViewError, notes_of, text_of
from ..simulation import RULE
from .fingerprint import Fingerprint, fingerprint
from .inside import Plan, make_environment, outside_simulation
from .report import SEVERITIES, CheckReport, EpisodeStatistics, Finding, PointStatistics, Timing, finding, order_of
from .runs import Run, Step, TimeUp, culprit, error_in_words, plain_run, random_steps, sources_of_chance, within

SHARE: Final = 0.25
"""How much of the time limit a single run may take."""


@dataclass
class Subject:
    """A simulation with its decision points and options, how it is checked, and what is known of it by now.

    Attributes:
        plan: What its environments are made of.
        seeds: With which seeds plain runs are compared.
        episodes: How many episodes of random actions are played.
        max_steps: After how many decisions a run is cut.
        limit: For how many seconds it is checked at most.
        own: What its user compares simulations by.
        end: When its time is up, by ``time.monotonic()``.
        plain: Its plain runs, by seed.
        repeats: Whether the same seed gives the same plain run.
        unstable: What differs between plain runs of the same seed, and is not compared: paths in fingerprints.
        drawn: The global generators that it draws from.
        slow: Whether a view has taken too long.
        playable: Whether plain runs decide something and come to an end, so that environments are worth a look.
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
        """When a run that begins now must have ended: all have the same time, however late it is."""
        return time.monotonic() + self.limit * SHARE

    @property
    def rules(self) -> dict[Any, Any] | None:
        """The option ``policies`` with the rule in place of each policy."""
        return dict.fromkeys(self.plan.options.policies or (), RULE) or None

    def look(self, simulation: Any) -> Fingerprint:
        """Write down what a simulation of it holds."""
        with outside_simulation():  # what that calls is not to be decided
            return fingerprint(simulation, self.own)

    def run_plainly(self, seed: int) -> Run:
        """Run it once without any environment."""
        return plain_run(self.plan, seed, self.max_steps, self.deadline(), self.look)

    def differences(self, run: Run, other: Run) -> list[tuple[str, Any, Any]]:
        """In which parts two runs have left the simulation different."""
        if run.fingerprint is None or other.fingerprint is None:
            return []
        return run.fingerprint.differences(other.fingerprint, self.unstable)

    def chance(self) -> list[str]:
        """What the model asks that is different each time."""
        try:
            return sources_of_chance(self.plan, self.seeds[0], self.deadline(), self.max_steps)
        except (Exception, SystemExit):  # it is only to help with the explanation
            return []


class Opened:
    """An environment of a subject, which is closed at the end; None where the view does not fit."""

    def __init__(self, subject: Subject, report: Report, view: str = "aec", plan: Plan | None = None, **changes: Any):
        """Say which environment; it is made on entering.

        Args:
            subject: Whose environment it is.
            report: Where errors of its closing are told.
            view: Its view.
            plan: Its plan; None: the subject's.
            **changes: Options that it has in place of the subject's.
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
    """An episode of random actions: its steps, what it raised, and when its last step was."""

    steps: list[Step] = field(default_factory=list)
    error: BaseException | None = None
    latest: float = field(default_factory=time.monotonic)

    @property
    def told(self) -> list[Any]:
        """What agents were told."""
        return [(step.agent, step.told) for step in self.steps]

    def difference(self, other: Played) -> str:
        """Where another one differs first, in words; empty where it does not."""
        for number, (here, there) in enumerate(zip(self.steps, other.steps, strict=False), 1):
            if difference := here.difference(there):
                return f"step {number}: {difference}"
        if other.error is not None:
            return f"the second one raises {error_in_words(other.error)}"
        if len(self.steps) != len(other.steps):
            return f"there are first {len(self.steps)} steps, then {len(other.steps)}"
        return ""


def play(subject: Subject, env: Any, seed: int, salt: int = 0) -> Played:
    """Play an episode of random legal actions, as far as it gets in the time there is."""
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
"""The kind of an error, words in its text, and the finding that it is. The first one holds."""

_ORIGINS: Final = {"plain run": "plain_error", "random legal actions": "action_error", "": "any_error"}
"""The findings of other errors, by words in where they were raised."""


class Report:
    """A report while it is written.

    Attributes:
        findings: What was found so far.
        checked: What was looked at so far, in words.
        points, episodes, timing: As ``CheckReport`` has them.
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
        """Add the finding of what was raised; the same one from the same place is told once."""
        key = type(error).__name__, culprit(error) or text_of(error)
        if key in self._errors:
            return
        self._errors.add(key)
        name = next(
            (name for kind, words, name in _OF_ERRORS if isinstance(error, kind) and words in text_of(error)),
            next(name for words, name in _ORIGINS.items() if words in where),
        )
        notes = [note.removeprefix("simenv_marl: ") for note in notes_of(error)]
        self.add(name, "\n".join([f"{where}: {error_in_words(error, 400)}", *notes[:2]]), kind=type(error).__name__)

    def add_unrepeatable(self, subject: Subject, evidence: str) -> None:
        """Add the finding that two runs of the same seed differ."""
        sources = [source for source in subject.chance() if "global" not in source]
        self.add("unrepeatable", "\n".join([evidence, *(f"in the model, {source}" for source in sources[:4])]))

    def finished(self, subject: Subject) -> CheckReport:
        """The report as users get it."""
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
