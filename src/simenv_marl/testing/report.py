"""The results of a check or an inspection, as immutable objects that print as plain text."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from textwrap import TextWrapper, indent
from typing import Any, Final, Literal

from ..errors import CheckFailedError

Severity = Literal["error", "warning", "note"]

SEVERITIES: Final[tuple[Severity, ...]] = ("error", "warning", "note")
"""The severities, the most important first."""


@dataclass(frozen=True)
class Finding:
    """A finding of a check."""

    severity: Severity  #: "error": results would be wrong. "warning": learning may suffer. "note": good to know.
    title: str  #: The finding in one line.
    explanation: str  #: What it means, and what to do.
    evidence: str = ""  #: Where and when it was seen; may be empty.

    def __str__(self) -> str:
        seen = f"\nSeen: {self.evidence}" if self.evidence else ""
        return f"{self.severity.upper():<9}{self.title}\n{_wrapped(self.explanation + seen, 9)}"


_TEXTS: Final[dict[Any, dict[str, str]]] = tomllib.loads(
    files(__package__).joinpath("findings.toml").read_text(encoding="utf-8")
)
"""By severity and name, the title of a finding, a line break, and its explanation."""


def finding_names() -> set[str]:
    """Return the names of all findings."""
    return {name for texts in _TEXTS.values() for name in texts}


def finding(name: str, evidence: str = "", **words: Any) -> Finding:
    """Make a finding from its text in ``findings.toml``; words are the values of placeholders there."""
    severity = next(severity for severity in SEVERITIES if name in _TEXTS[severity])
    title, text = _TEXTS[severity][name].format(**words).split("\n", 1)
    return Finding(severity, title, " ".join(text.split()), evidence)


@dataclass(frozen=True)
class ComponentStatistics:
    """The range of one component of an observation."""

    name: str  #: The component: "[2]", "position[0]"; empty if there is only one.
    low: float  #: Its lower bound.
    high: float  #: Its upper bound.
    minimum: float
    maximum: float
    mean: float
    at_bounds: float  #: The share of its values that were at a bound.
    beyond: float  #: The share of its values that were outside of the bounds (or nan).

    @property
    def constant(self) -> bool:
        """Whether all values were the same."""
        return self.minimum == self.maximum

    def __str__(self) -> str:
        return (
            f"{self.name or 'value'}: {self.minimum:.4g} to {self.maximum:.4g}, mean {self.mean:.4g};"
            f" bounds {self.low:.4g} to {self.high:.4g}, at a bound {self.at_bounds:.0%}"
        )


@dataclass(frozen=True)
class PointStatistics:
    """Statistics of a decision point under random legal actions."""

    point: str  #: Its dotted name.
    agents: str  #: Its agents: a name, or a description.
    observation_space: str
    action_space: str
    observations: int  #: The number of observations.
    components: tuple[ComponentStatistics, ...]  #: The ranges of the observations' components.
    decisions: int  #: The number of its calls, in all episodes.
    never_legal: tuple[int, ...]  #: The actions that were never legal, if it has a mask.
    rewards: int  #: The number of rewards.
    reward_minimum: float
    reward_maximum: float
    reward_mean: float

    def __str__(self) -> str:
        rewards = f"{self.reward_minimum:.4g} to {self.reward_maximum:.4g}, mean {self.reward_mean:.4g}"
        lines = [
            f"{self.agents}, at {self.point}",
            f"{self.decisions} decisions, {f'rewards {rewards}' if self.rewards else 'no rewards'}",
            f"actions {self.action_space}, observations {self.observation_space}",
            *map(str, self.components[:12]),
        ]
        return "\n  ".join(lines if len(self.components) <= 12 else [*lines, "..."])


@dataclass(frozen=True)
class EpisodeStatistics:
    """Statistics of the episodes of random legal actions. Lengths are in decisions."""

    episodes: int = 0  #: The number of episodes.
    shortest: int = 0
    longest: int = 0
    mean: float = 0.0
    terminated: int = 0  #: The number of episodes that terminated.
    truncated: int = 0  #: The number of episodes that reached the simulation's own limit.
    cut: int = 0  #: The number of episodes that reached ``max_steps``.

    def __str__(self) -> str:
        if not self.episodes:
            return "none was played to its end"
        return (
            f"{self.episodes} of {self.shortest} to {self.longest} decisions (mean {self.mean:.4g}); {self.terminated}"
            f" ended, {self.truncated} truncated by the simulation, {self.cut} cut at max_steps"
        )


@dataclass(frozen=True)
class Timing:
    """The time per decision, in microseconds: in the plain run, and with ``RULE`` in the AEC view.

    Both include the reset, and the recording of decisions for the comparison.
    """

    plain: float
    environment: float

    def __str__(self) -> str:
        return f"{self.plain:.4g} us per decision in the plain run, {self.environment:.4g} us in the environment"


@dataclass(frozen=True)
class CheckReport:
    """The result of ``check_simulation``. Its ``str`` is a text for people."""

    simulation: str  #: What was checked.
    findings: tuple[Finding, ...]  #: The findings, the most important first.
    checked: tuple[str, ...]  #: What was examined, in words.
    observations: tuple[PointStatistics, ...] = ()  #: The statistics under random legal actions, by decision point.
    episodes: EpisodeStatistics = EpisodeStatistics()  #: The statistics of these episodes.
    calls: str = ""  #: The order in which the decision points were called in a plain run, compressed.
    timing: Timing | None = None  #: The time per decision; None if it was not measured.

    @property
    def ok(self) -> bool:
        """Whether there is no finding of severity "error"."""
        return not self.of("error")

    def of(self, severity: Severity) -> tuple[Finding, ...]:
        """Return the findings of a severity."""
        return tuple(finding for finding in self.findings if finding.severity == severity)

    def raise_for_errors(self) -> None:
        """Raise an error if something is wrong, for tests.

        Raises:
            CheckFailedError: There are findings of severity "error"; the message has their text.
        """
        errors = self.of("error")
        if errors:
            raise CheckFailedError("\n\n".join([self._heading(), *map(str, errors)]))

    def to_dict(self) -> dict[str, Any]:
        """Return the report as dicts, lists, strings and numbers, for JSON; infinite numbers as strings."""
        return {"ok": self.ok, **_for_json(asdict(self))}

    def __str__(self) -> str:
        parts = [self._heading(), *map(str, self.findings)]
        if self.checked:
            parts.append("\n".join(["What was checked", *(_wrapped(line, 2) for line in self.checked)]))
        episodes = _wrapped(f"Episodes of random legal actions: {self.episodes}", 0)
        parts.append("\n".join([episodes, *(indent(str(point), "  ") for point in self.observations)]))
        if self.calls:
            parts.append(_wrapped(f"Order of the decisions in a plain run: {self.calls}", 0))
        if self.timing is not None:
            parts.append(f"Time: {self.timing}")
        return "\n\n".join(parts)

    def _heading(self) -> str:
        counts = [(len(self.of(severity)), severity) for severity in SEVERITIES]
        named = [f"{number} {severity}{'s' * (number != 1)}" for number, severity in counts if number]
        return f"{self.simulation}: {', '.join(named) or 'nothing to complain of'}"


@dataclass(frozen=True)
class PointDescription:
    """A decision point as an environment sees it."""

    name: str  #: Its dotted name.
    agents: str  #: Its agents: a name, or a description.
    observation_space: str
    action_space: str
    details: tuple[str, ...] = ()  #: Further properties: masks, choices, removals, policies.

    def __str__(self) -> str:
        spaces = f"observations  {self.observation_space}\n  actions       {self.action_space}"
        return "\n  ".join([self.name, f"agent         {self.agents}", spaces, *self.details])


@dataclass(frozen=True)
class Inspection:
    """The result of ``inspect_simulation``. Its ``str`` is a text for people."""

    simulation: str  #: What was inspected.
    points: tuple[PointDescription, ...]
    views: tuple[str, ...]  #: The views that its environments may have.
    calls: str  #: The order in which the points were called in one plain episode, compressed: ``(a b){30} c``.
    counts: dict[str, int]  #: The number of calls of each point.
    ended: str  #: How that episode ended, in words.
    agents: tuple[str, ...]  #: The agents of that episode in an environment, in the order in which they joined.

    def to_dict(self) -> dict[str, Any]:
        """Return the inspection as dicts, lists, strings and numbers, for JSON."""
        return dict(_for_json(asdict(self)))

    def __str__(self) -> str:
        counts = ", ".join(f"{point} {number} times" for point, number in self.counts.items())
        agents = ", ".join(self.agents[:8]) + f" and {len(self.agents) - 8} more" * (len(self.agents) > 8)
        episode = f"calls    {counts or 'none'}\norder    {self.calls or '-'}\nagents   {agents or '-'}"
        return "\n\n".join(
            [
                f"{self.simulation}: {len(self.points)} decision point{'s' * (len(self.points) != 1)}",
                *map(str, self.points),
                f"Possible views: {', '.join(self.views)}",
                f"One episode with the model's own rules: {self.ended}\n{_wrapped(episode, 2)}",
            ]
        )


def order_of(calls: Sequence[str]) -> str:
    """Return the order in which decision points were called: the shortest unique names, and repetitions in braces."""
    most_calls, most_terms = 3000, 30
    short = short_names(list(dict.fromkeys(calls)))
    terms = [short[name] for name in calls[:most_calls]]
    for length in range(1, 25):
        terms = _fold(terms, length)
    left = f" ... and {len(calls) - most_calls} more calls" if len(calls) > most_calls else ""
    left = f" ... and {len(terms) - most_terms} more such terms" if len(terms) > most_terms else left
    return " ".join(terms[:most_terms]) + left


def _fold(terms: list[str], length: int) -> list[str]:
    """Write repetitions of blocks of one length as one term."""
    folded, place = [], 0
    while place < len(terms):
        block, end = terms[place : place + length], place + length
        while terms[end : end + length] == block:
            end += length
        if end == place + length:
            folded.append(terms[place])
            place += 1
        else:
            text = block[0] if length == 1 else f"({' '.join(block)})"
            folded.append(f"{text}{{{(end - place) // length}}}")
            place = end
    return folded


def short_names(points: Sequence[str]) -> dict[str, str]:
    """Return the shortest unique ends of dotted names: of one part, else of two, and so on."""
    short = {}
    for point in points:
        parts = point.split(".")
        ends = [".".join(parts[-length:]) for length in range(1, len(parts) + 1)]
        unique = (end for end in ends if sum(f".{other}".endswith(f".{end}") for other in points) == 1)
        short[point] = next(unique, point)
    return short


def _wrapped(text: str, margin: int) -> str:
    """Wrap the lines of a text, with a margin that is wider after the first line of each."""
    wrapper = TextWrapper(100, " " * margin, " " * (margin + 2), break_long_words=False, break_on_hyphens=False)
    return "\n".join(wrapper.fill(line) for line in text.splitlines())


def _for_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _for_json(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_for_json(part) for part in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
