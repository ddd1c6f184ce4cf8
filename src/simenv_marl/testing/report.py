"""The results of a check or an inspection, as immutable objects that print as plain text."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from textwrap import TextWrapper, indent
from typing import Any, Final, Literal

from ..errors import CheckFailedError

Severity = Literal["error", "warning", "note"]

SEVERITIES: Final[tuple[Severity, ...]] = ("error", "warning", "note")
"""The severities, the most important first."""

WIDTH: Final = 100
_MOST_COMPONENTS: Final = 12


# -- findings -------------------------------------------------------------------------------------


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
        lines = [f"{self.severity.upper():<9}{self.title}", _wrapped(self.explanation)]
        if self.evidence:
            lines += [_wrapped(line, hang=11) for line in f"Seen: {self.evidence}".splitlines()]
        return "\n".join(lines)


_WORDS: Final = tomllib.loads(files(__package__).joinpath("findings.toml").read_text(encoding="utf-8"))


def finding(name: str, evidence: str = "", **words: Any) -> Finding:
    """Make a finding from its text in ``findings.toml``.

    Args:
        name: The name of the finding there.
        evidence: Where and when it was seen.
        **words: The values of placeholders in title and explanation.
    """
    entry = _WORDS[name]
    severity = next(severity for severity in SEVERITIES if severity in entry)
    title, text = entry[severity].format(**words), " ".join(entry["text"].split()).format(**words)
    return Finding(severity, title, text, evidence)


# -- statistics -----------------------------------------------------------------------------------


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
        rewards = "no rewards"
        if self.rewards:
            rewards = (
                f"rewards {in_digits(self.reward_minimum)} to {in_digits(self.reward_maximum)},"
                f" mean {in_digits(self.reward_mean)}"
            )
        lines = [f"{self.agents}, at {self.point}", f"  {self.decisions} decisions, {rewards}"]
        lines.append(f"  actions {self.action_space}, observations {self.observation_space}")
        if self.components:
            rows = [("observed", "least", "mean", "most", "bounds", "at a bound")]
            for part in self.components[:_MOST_COMPONENTS]:
                values = in_digits(part.minimum), in_digits(part.mean), in_digits(part.maximum)
                bounds = f"{in_digits(part.low)} to {in_digits(part.high)}"
                rows.append((part.name or "(value)", *values, bounds, f"{part.at_bounds:.0%}"))
            lines += [f"  {line}" for line in _table(rows)]
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
        ends = {"ended": self.terminated, "truncated by the simulation": self.truncated, "cut at max_steps": self.cut}
        length = f"{self.shortest}" if self.shortest == self.longest else f"{self.shortest} to {self.longest}"
        return (
            f"{self.episodes} of {length} decisions (mean {in_digits(self.mean)});"
            f" {', '.join(f'{number} {end}' for end, number in ends.items() if number)}"
        )


@dataclass(frozen=True)
class Timing:
    """The time per decision, in microseconds: in the plain run, and with ``RULE`` in the AEC view."""

    plain: float
    environment: float

    def __str__(self) -> str:
        return (
            f"{in_digits(self.plain)} us per decision in the plain run, {in_digits(self.environment)} us in the"
            " environment"
        )


# -- reports --------------------------------------------------------------------------------------


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
            raise CheckFailedError("\n\n".join([f"{self.simulation}: {self._counts()}", *map(str, errors)]))

    def to_dict(self) -> dict[str, Any]:
        """Return the report as dicts, lists, strings and numbers, for JSON; infinite numbers as strings."""
        made: dict[str, Any] = {"ok": self.ok, **_for_json(asdict(self))}
        return made

    def __str__(self) -> str:
        parts = [f"{self.simulation}: {self._counts()}", *map(str, self.findings)]
        if self.checked:
            parts.append("\n".join(["What was checked", *(_wrapped(line, "  ") for line in self.checked)]))
        points = [indent(str(point), "  ") for point in self.observations]
        parts.append("\n".join([f"Episodes of random legal actions: {self.episodes}", *points]))
        if self.calls:
            parts.append(f"Order of the decisions in a plain run\n{_wrapped(self.calls, '  ')}")
        if self.timing is not None:
            parts.append(f"Time: {self.timing}")
        return "\n\n".join(parts)

    def _counts(self) -> str:
        counts = [(len(self.of(severity)), severity) for severity in SEVERITIES]
        named = [f"{number} {severity}{'s' * (number != 1)}" for number, severity in counts if number]
        return ", ".join(named) if named else "nothing to complain of"


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
        made: dict[str, Any] = _for_json(asdict(self))
        return made

    def __str__(self) -> str:
        counts = ", ".join(f"{point} {number} times" for point, number in self.counts.items())
        more = f" and {len(self.agents) - 8} more" if len(self.agents) > 8 else ""
        episode = {"calls": counts, "order": self.calls, "agents": ", ".join(self.agents[:8]) + more}
        empty = {"calls": "none", "order": "-", "agents": "-"}
        lines = [f"One episode with the model's own rules: {self.ended}"]
        lines += [_wrapped(f"{name:<8} {text or empty[name]}", "  ", 11) for name, text in episode.items()]
        return "\n\n".join(
            [
                f"{self.simulation}: {len(self.points)} decision point{'s' * (len(self.points) != 1)}",
                *map(str, self.points),
                f"Possible views: {', '.join(self.views)}",
                "\n".join(lines),
            ]
        )


# -- the order of calls ---------------------------------------------------------------------------

_LONGEST_BLOCK: Final = 24
_MOST_CALLS: Final = 3000
_MOST_TERMS: Final = 30


def order_of(calls: Sequence[str]) -> str:
    """Return the order in which decision points were called, compressed and with the shortest names."""
    short = short_names(list(dict.fromkeys(calls)))
    return compressed(short[name] for name in calls)


def compressed(calls: Iterable[str]) -> str:
    """Write a sequence with its repetitions, as ``(a b){30} c``; long ones end with an ellipsis."""
    all_calls = list(calls)
    terms = all_calls[:_MOST_CALLS]
    for length in range(1, _LONGEST_BLOCK + 1):
        terms = _folded(terms, length)
    rest, left = len(terms) - _MOST_TERMS, len(all_calls) - _MOST_CALLS
    ending = f" ... and {rest} more such terms" if rest > 0 else f" ... and {left} more calls" if left > 0 else ""
    return " ".join(terms[:_MOST_TERMS]) + ending


def _folded(terms: Sequence[str], length: int) -> list[str]:
    """Return the terms, with repetitions of blocks of one length written as one term."""
    made: list[str] = []
    place = 0
    while place < len(terms):
        block = terms[place : place + length]
        times = 1
        while terms[place + times * length : place + (times + 1) * length] == block:
            times += 1
        if times > 1:
            made.append(f"{block[0]}{{{times}}}" if length == 1 else f"({' '.join(block)}){{{times}}}")
        else:
            made.append(terms[place])
        place += times * length if times > 1 else 1
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


# -- text -----------------------------------------------------------------------------------------


def _wrapped(text: str, margin: str = " " * 9, hang: int | None = None) -> str:
    """Wrap a text, with a margin before its first line and one of ``hang`` spaces before the others."""
    rest = margin if hang is None else " " * hang
    wrapper = TextWrapper(WIDTH, margin, rest, break_long_words=False, break_on_hyphens=False)
    return wrapper.fill(text)


def in_digits(value: float) -> str:
    """Return a number as text with four significant digits."""
    if not math.isfinite(value):
        return "not a number" if math.isnan(value) else "-inf" if value < 0 else "inf"
    return f"{value:.4g}"


def _table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *others in rows:
        cells = [first.ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))]
        yield "  ".join(cells).rstrip()


def _for_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _for_json(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_for_json(part) for part in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
