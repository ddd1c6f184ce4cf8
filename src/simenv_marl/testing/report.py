"""The results of a check or an inspection, as immutable objects that print as plain text."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from textwrap import fill, indent
from typing import Any, Final, Literal

from ..errors import CheckFailedError

Severity = Literal["error", "warning", "note"]

SEVERITIES: Final[tuple[Severity, ...]] = ("error", "warning", "note")
"""The severities, the most important first."""

_MOST_COMPONENTS: Final = 12


@dataclass(frozen=True)
class Finding:
    """A finding of a check.

    Attributes:
        severity: "error": results would be wrong. "warning": learning may suffer. "note": good to know.
        title: The finding in one line.
        explanation: What it means, and what to do.
        evidence: Where and when it was seen; may be empty.
    """

    severity: Severity
    title: str
    explanation: str
    evidence: str = ""

    def __str__(self) -> str:
        lines = [f"{self.severity.upper():<9}{self.title}", _wrapped(self.explanation, 9)]
        if self.evidence:
            lines += [_wrapped(line, 9) for line in f"Seen: {self.evidence}".splitlines()]
        return "\n".join(lines)


_TEXTS: Final[dict[Any, dict[str, str]]] = tomllib.loads(
    files(__package__).joinpath("findings.toml").read_text(encoding="utf-8")
)
"""By severity and name, the title of a finding, a line break, and its explanation."""


def finding_names() -> set[str]:
    """Return the names of all findings."""
    return {name for texts in _TEXTS.values() for name in texts}


def finding(name: str, evidence: str = "", **words: Any) -> Finding:
    """Make a finding from its text in ``findings.toml``.

    Args:
        name: The name of the finding there.
        evidence: Where and when it was seen.
        **words: The values of placeholders in title and explanation.
    """
    severity = next(severity for severity in SEVERITIES if name in _TEXTS[severity])
    title, text = _TEXTS[severity][name].format(**words).split("\n", 1)
    return Finding(severity, title, " ".join(text.split()), evidence)


@dataclass(frozen=True)
class ComponentStatistics:
    """The range of one component of an observation.

    Attributes:
        name: The component: "[2]", "position[0]"; empty if there is only one.
        low, high: Its bounds.
        minimum, maximum, mean: The minimum, maximum and mean of its values.
        at_bounds, beyond: The share of its values that were at a bound, and outside of the bounds (or nan).
    """

    name: str
    low: float
    high: float
    minimum: float
    maximum: float
    mean: float
    at_bounds: float
    beyond: float

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
    """Statistics of a decision point under random legal actions.

    Attributes:
        point: Its dotted name.
        agents: Its agents: a name, or a description.
        observation_space, action_space: Its spaces, as text.
        observations: The number of observations.
        components: The ranges of the observations' components.
        decisions: The number of its calls, in all episodes.
        never_legal: The actions that were never legal, if it has a mask.
        rewards: The number of rewards.
        reward_minimum, reward_maximum, reward_mean: The minimum, maximum and mean of the rewards.
    """

    point: str
    agents: str
    observation_space: str
    action_space: str
    observations: int
    components: tuple[ComponentStatistics, ...]
    decisions: int
    never_legal: tuple[int, ...]
    rewards: int
    reward_minimum: float
    reward_maximum: float
    reward_mean: float

    def __str__(self) -> str:
        rewards = f"{self.reward_minimum:.4g} to {self.reward_maximum:.4g}, mean {self.reward_mean:.4g}"
        lines = [
            f"{self.agents}, at {self.point}",
            f"  {self.decisions} decisions, {f'rewards {rewards}' if self.rewards else 'no rewards'}",
            f"  actions {self.action_space}, observations {self.observation_space}",
            *(f"    {component}" for component in self.components[:_MOST_COMPONENTS]),
        ]
        if len(self.components) > _MOST_COMPONENTS:
            lines.append(f"    ... and {len(self.components) - _MOST_COMPONENTS} more")
        return "\n".join(lines)


@dataclass(frozen=True)
class EpisodeStatistics:
    """Statistics of the episodes of random legal actions.

    Attributes:
        episodes: The number of episodes.
        shortest, longest, mean: Their lengths in decisions.
        terminated, truncated, cut: The number of episodes that terminated, that reached the simulation's own limit, and
            that reached ``max_steps``.
    """

    episodes: int = 0
    shortest: int = 0
    longest: int = 0
    mean: float = 0.0
    terminated: int = 0
    truncated: int = 0
    cut: int = 0

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
    """The result of ``check_simulation``. Its ``str`` is a text for people.

    Attributes:
        simulation: What was checked.
        findings: The findings, the most important first.
        checked: What was examined, in words.
        observations: The statistics under random legal actions, by decision point.
        episodes: The statistics of these episodes.
        calls: The order in which the decision points were called in a plain run, compressed.
        timing: The time per decision; None if it was not measured.
    """

    simulation: str
    findings: tuple[Finding, ...]
    checked: tuple[str, ...]
    observations: tuple[PointStatistics, ...] = ()
    episodes: EpisodeStatistics = field(default_factory=EpisodeStatistics)
    calls: str = ""
    timing: Timing | None = None

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
        points = [indent(str(point), "  ") for point in self.observations]
        parts.append("\n".join([_wrapped(f"Episodes of random legal actions: {self.episodes}", 0), *points]))
        if self.calls:
            parts.append(f"Order of the decisions in a plain run\n{_wrapped(self.calls, 2)}")
        if self.timing is not None:
            parts.append(f"Time: {self.timing}")
        return "\n\n".join(parts)

    def _heading(self) -> str:
        counts = [(len(self.of(severity)), severity) for severity in SEVERITIES]
        named = [f"{number} {severity}{'s' * (number != 1)}" for number, severity in counts if number]
        return f"{self.simulation}: {', '.join(named) or 'nothing to complain of'}"


@dataclass(frozen=True)
class PointDescription:
    """A decision point as an environment sees it.

    Attributes:
        name: Its dotted name.
        agents: Its agents: a name, or a description.
        observation_space, action_space: Its spaces, as text.
        details: Further properties: masks, choices, removals, policies.
    """

    name: str
    agents: str
    observation_space: str
    action_space: str
    details: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [
            self.name,
            f"  agent         {self.agents}",
            f"  observations  {self.observation_space}",
            f"  actions       {self.action_space}",
        ]
        return "\n".join(lines + [f"  {detail}" for detail in self.details])


@dataclass(frozen=True)
class Inspection:
    """The result of ``inspect_simulation``. Its ``str`` is a text for people.

    Attributes:
        simulation: What was inspected.
        points: Its decision points.
        views: The views that its environments may have.
        calls: The order in which the points were called in one plain episode, compressed: ``(a b){30} c``.
        counts: The number of calls of each point.
        ended: How that episode ended, in words.
        agents: The agents of that episode in an environment, in the order in which they joined.
    """

    simulation: str
    points: tuple[PointDescription, ...]
    views: tuple[str, ...]
    calls: str
    counts: dict[str, int]
    ended: str
    agents: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the inspection as dicts, lists, strings and numbers, for JSON."""
        return dict(_for_json(asdict(self)))

    def __str__(self) -> str:
        counts = ", ".join(f"{point} {number} times" for point, number in self.counts.items())
        more = f" and {len(self.agents) - 8} more" if len(self.agents) > 8 else ""
        episode = [
            f"One episode with the model's own rules: {self.ended}",
            _wrapped(f"calls    {counts or 'none'}", 2),
            _wrapped(f"order    {self.calls or '-'}", 2),
            _wrapped(f"agents   {', '.join(self.agents[:8]) or '-'}{more}", 2),
        ]
        return "\n\n".join(
            [
                f"{self.simulation}: {len(self.points)} decision point{'s' * (len(self.points) != 1)}",
                *map(str, self.points),
                f"Possible views: {', '.join(self.views)}",
                "\n".join(episode),
            ]
        )


def order_of(calls: Sequence[str], longest_block: int = 24, most_calls: int = 3000, most_terms: int = 30) -> str:
    """Return the order in which decision points were called: the shortest unique names, and repetitions in braces.

    Args:
        calls: The dotted names of the points, in the order of their calls.
        longest_block: The length of the longest blocks whose repetitions are found.
        most_calls: The number of calls that are looked at.
        most_terms: The number of terms that are written.
    """
    short = short_names(list(dict.fromkeys(calls)))
    terms = [short[name] for name in calls[:most_calls]]
    for length in range(1, longest_block + 1):
        terms = _folded(terms, length)
    left = f"{len(terms) - most_terms} more such terms" if len(terms) > most_terms else ""
    if not left and len(calls) > most_calls:
        left = f"{len(calls) - most_calls} more calls"
    return " ".join(terms[:most_terms]) + (f" ... and {left}" if left else "")


def _folded(terms: Sequence[str], length: int) -> list[str]:
    """Return the terms, with repetitions of blocks of one length written as one term."""
    made: list[str] = []
    place = 0
    while place < len(terms):
        block = list(terms[place : place + length])
        times = 1
        while terms[place + times * length : place + (times + 1) * length] == block:
            times += 1
        if times == 1:
            made.append(terms[place])
            place += 1
        else:
            made.append(f"{block[0]}{{{times}}}" if length == 1 else f"({' '.join(block)}){{{times}}}")
            place += times * length
    return made


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
    """Wrap a text, with a margin before its lines that is wider after the first one."""
    first, rest = " " * margin, " " * (margin + 2)
    return fill(text, 100, initial_indent=first, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False)


def _for_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _for_json(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_for_json(part) for part in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
