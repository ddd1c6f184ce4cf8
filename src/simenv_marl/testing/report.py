"""The results of a check or an inspection, as immutable objects that print as plain text."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from textwrap import TextWrapper
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


def finding(name: str, evidence: str = "", **words: Any) -> Finding:
    """Make a finding from its text in ``findings.toml``; words are the values of placeholders there."""
    severity = next(severity for severity in SEVERITIES if name in _TEXTS[severity])
    title, text = _TEXTS[severity][name].format(**words).split("\n", 1)
    return Finding(severity, title, " ".join(text.split()), evidence)


@dataclass(frozen=True)
class Range:
    """The range of one number over all episodes."""

    name: str  #: Which number: "reward", or a component of an observation, as in "position[0]".
    minimum: float
    mean: float
    maximum: float

    def __str__(self) -> str:
        return f"{self.name}: {self.minimum:.4g} to {self.maximum:.4g}, mean {self.mean:.4g}"


@dataclass(frozen=True)
class PointStatistics:
    """Statistics of a decision point under random legal actions."""

    point: str  #: Its dotted name.
    agents: str  #: Its agents: a name, or a description.
    decisions: int  #: The number of its calls, in all episodes.
    observations: tuple[Range, ...]  #: The components of its observations.
    rewards: Range | None  #: None if there were no rewards.
    never_legal: tuple[int, ...]  #: The actions that were never legal, if it has a mask.

    def __str__(self) -> str:
        ranges = [*([self.rewards] if self.rewards else []), *self.observations]
        lines = [f"{self.agents}, at {self.point}: {self.decisions} decisions", *map(str, ranges[:12])]
        return "\n    ".join(lines if len(ranges) <= 12 else [*lines, f"and {len(ranges) - 12} more"])


@dataclass(frozen=True)
class CheckReport:
    """The result of ``check_simulation``. Its ``str`` is a text for people."""

    simulation: str  #: What was checked.
    findings: tuple[Finding, ...]  #: The findings, the most important first.
    checked: tuple[str, ...]  #: What was examined, in words.
    statistics: tuple[PointStatistics, ...] = ()  #: By decision point, what random legal actions have shown.
    episodes: dict[str, int] = field(default_factory=dict)  #: The numbers of those episodes, by the way they ended.
    calls: str = ""  #: The order in which the decision points were called in a plain run: ``(a b){30} c``.

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
        """Return the report as dicts, tuples, strings and numbers, for JSON."""
        return {"ok": self.ok, **asdict(self)}

    def __str__(self) -> str:
        parts = [self._heading(), *map(str, self.findings)]
        if self.checked:
            parts.append("\n".join(["What was checked", *(_wrapped(line, 2) for line in self.checked)]))
        if self.statistics:
            ends = ", ".join(f"{number} {end}" for end, number in self.episodes.items() if number)
            statistics = [f"  {point}" for point in self.statistics]
            parts.append("\n".join([f"Episodes of random legal actions: {ends or 'none'}", *statistics]))
        if self.calls:
            parts.append(_wrapped(f"Order of the decisions in a plain run: {self.calls}", 0))
        return "\n\n".join(parts)

    def _heading(self) -> str:
        counts = [(len(self.of(severity)), severity) for severity in SEVERITIES]
        named = [f"{number} {severity}{'s' * (number != 1)}" for number, severity in counts if number]
        return f"{self.simulation}: {', '.join(named) or 'nothing to complain of'}"


@dataclass(frozen=True)
class Inspection:
    """The result of ``inspect_simulation``. Its ``str`` is a text for people."""

    simulation: str  #: What was inspected.
    points: tuple[dict[str, str], ...]  #: Of each decision point, its name, its agents, its spaces, and more.
    views: tuple[str, ...]  #: The views that its environments may have.
    calls: str  #: The order in which the points were called in one plain episode: ``(a b){30} c``.
    counts: dict[str, int]  #: The number of calls of each point.
    ended: str  #: How that episode ended, in words.

    def to_dict(self) -> dict[str, Any]:
        """Return the inspection as dicts, tuples, strings and numbers, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        counts = ", ".join(f"{point} {number} times" for point, number in self.counts.items())
        episode = f"calls    {counts or 'none'}\norder    {self.calls or '-'}"
        return "\n\n".join(
            [
                f"{self.simulation}: {len(self.points)} decision point{'s' * (len(self.points) != 1)}",
                *("\n  ".join(f"{key:<13} {text}" for key, text in point.items()) for point in self.points),
                f"Possible views: {', '.join(self.views)}",
                f"One episode with the model's own rules: {self.ended}\n{_wrapped(episode, 2)}",
            ]
        )


def order_of(calls: Sequence[str]) -> str:
    """Return the order in which decision points were called, with repetitions as in ``(a b){30} c``; it may be cut."""
    ends = {name: name.rpartition(".")[2] for name in calls}
    unique = len(set(ends.values())) == len(ends)
    text = "".join(f"{ends[name] if unique else name} " for name in calls[:3000])
    for _ in range(3):  # repetitions of repetitions
        text = re.sub(r"(?<!\S)((?:\S+ ){1,24}?)\1+", _fold, text)
    terms = text.split()
    left = [f"... and {len(calls)} calls in all"] if len(terms) > 30 or len(calls) > 3000 else []
    return " ".join([*terms[:30], *left]).replace("\0", " ")


def _fold(match: re.Match[str]) -> str:
    """Write a block and its repetitions as one term, in which null characters stand for blanks."""
    block, number = match[1].rstrip().replace(" ", "\0"), len(match[0]) // len(match[1])
    return f"({block}){{{number}}} " if "\0" in block else f"{block}{{{number}}} "


def _wrapped(text: str, margin: int) -> str:
    """Wrap the lines of a text, with a margin that is wider after the first line of each."""
    wrapper = TextWrapper(100, " " * margin, " " * (margin + 2), break_long_words=False, break_on_hyphens=False)
    return "\n".join(wrapper.fill(line) for line in text.splitlines())
