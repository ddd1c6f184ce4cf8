"""The results of a check or an inspection, as immutable objects that print as plain text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from textwrap import TextWrapper
from typing import Any, Final, Literal

from ..errors import CheckFailedError

Severity = Literal["error", "warning", "note"]

SEVERITIES: Final[tuple[Severity, ...]] = ("error", "warning", "note")
"""The severities, the most important first."""


@dataclass(frozen=True)
class Finding:
    """A finding of a check."""

    # : "error": results would be wrong. "warning": learning may suffer. "note": good to know.
    severity: Severity
    title: str  #: The finding in one line.
    explanation: str  #: What it means, and what to do.
    evidence: str = ""  #: Where and when it was seen; may be empty.

    def __str__(self) -> str:
        seen = f"\nSeen: {self.evidence}" if self.evidence else ""
        return f"{self.severity.upper():<9}{self.title}\n{_wrapped(self.explanation + seen, 9)}"


FINDINGS: Final[dict[Severity, dict[str, str]]] = {
    "error": {
        "raises": """The simulation raises {kind}
The error comes from the model, from one of its mappings, or from the environment, which refuses what they return.
Learning code tries every action that is in the action space and not masked: if an action causes the error, narrow the
space or exclude the action with action_mask_mapping. If only a later episode fails, reset() must restore more.""",
        "stuck": """The simulation neither ends nor asks for a decision
An environment would wait forever. Look for an endless loop, for a loop that waits for an event that some actions never
cause, and for an except that catches everything, SimulationExit too. If the model is only slow: time_limit=.""",
        "no_decision": """The simulation never asks for a decision
run() never calls {points}. Does it call an earlier reference instead of the attribute of a class or module?""",
        "unrepeatable": """The same seed does not give the same run
Two runs with the same seed differ, so no result can be repeated. The usual causes: a generator that reset() does not
seed, a clock, values left over in class attributes or global variables, or the order of a set.""",
        "unseeded_generators": """The model or a mapping draws from generators that the whole process shares ({names})
The same seed does not give the same episode: all other code that draws from these generators changes them. Give the
model a generator of its own, random.Random(seed) or numpy.random.default_rng(seed), seeded in reset(); or, if you
cannot change it, give environments the option global_rng=True. Mappings should only read the model.""",
        "changed_model": """The model behaves differently when it is observed
With its own rule throughout, a run in an environment must be identical to the plain run, else agents learn on another
model. Mappings (of observations, rewards, masks, agents' names) must not change it or draw random numbers from it.""",
        "left_over": """Something is left over from earlier episodes
An episode after others in the same environment, the last of them broken off, differs from the same episode in a new
environment. reset() must restore everything that run() changes. The usual cause is an attribute that __init__ sets.""",
        "disturbance": """Two environments of the model disturb each other
Stepped in turns, they give other episodes than each alone. They share something: attributes of classes, global
variables, a file, or objects that were made when the module was imported.""",
        "failed_test": """{test} fails
Learning libraries rely on the properties that it tests.""",
        "outside": """Observations at {point} lie outside their space
Learning code relies on the bounds. Widen the observation_space, or clip in the observation_space_mapping.""",
    },
    "warning": {
        "shared_generators": """The model uses generators that the whole process shares ({names})
The model seeds them itself, so that one environment repeats its episodes. But environments side by side and training
code disturb each other. Give the model a generator of its own, or its environments the option global_rng=True.""",
        "writing_mappings": """Mappings write into the model
In an environment the simulation holds values that it does not hold in a plain run, though its decisions are the
same. Keep such values outside the model; difference() computes changes since the last decision.""",
        "warned": """An environment warns
The simulation may refuse to end (an except that catches everything), several objects may decide as one agent (see
agent= of make_step), or agents that the options name do not exist.""",
        "out_of_time": """The time limit has stopped the check
Give it more time (time_limit=), or less work (episodes=, max_steps=, fewer seeds=).""",
        "no_effect": """What the agents do changes nothing
Two episodes of the same seed with different actions gave the same observations and rewards. Do the actions reach the
model (action_space_mapping, apply), and do observations and rewards show what they bring about?""",
        "never_called": """{point} was never called
No episode asked for this decision, so its agent cannot learn anything. Does the simulation call the function as an
attribute of its class or module, and do episodes last long enough?""",
        "zero_rewards": """Rewards at {point} are always zero
Random actions never earned a reward, and what is rare is hard to learn. Should it be rare? See the reward_mapping.""",
    },
    "note": {
        "unseeded_reset": """reset() takes no seed
Write reset(self, seed=None) and seed the model's generator with it, unless nothing in the model is random.""",
        "cut_runs": """Runs were stopped before their end
They make more than {most} decisions, or never end. If they never end, environments need the option max_steps.""",
        "unstable": """Some attributes of the model differ between two plain runs with the same seed
The decisions were the same, so this may be harmless: the time of day, or a counter that all simulations of the
process share. The comparisons leave it out.""",
        "same_seeds": """All seeds give the same episode
If the model draws random numbers, reset() does not seed them. If it draws none, agents may memorise the episode.""",
        "same_rewards": """Rewards at {point} are always the same
All random actions earned the same. Check the reward_mapping, unless only the length of the episode should count.""",
        "few_generators": """Entities that decide share random generators
If one of them draws, the others draw something else afterwards, so that actions are hard to compare on the same seeds
and futures. If several draw, give each a generator of its own: see Streams, and "One stream for each entity" in the
documentation. If only the model draws, there is nothing to do.""",
        "never_legal": """Some actions at {point} were never legal
Either there were too few episodes for them to be legal, or the action space is larger than necessary.""",
    },
}
"""By severity and name, the title of a finding in the first line, then what it means and what to do."""


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
        lines = [
            f"{self.agents}, at {self.point}: {self.decisions} decisions",
            *map(str, ranges[:12]),
        ]
        return "\n    ".join(
            lines if len(ranges) <= 12 else [*lines, f"and {len(ranges) - 12} more"]
        )


@dataclass(frozen=True)
class CheckReport:
    """The result of ``check_simulation``. Its ``str`` is a text for people."""

    simulation: str  #: What was checked.
    findings: tuple[Finding, ...]  #: The findings, the most important first.
    checked: tuple[str, ...]  #: What was examined, in words.
    # : By decision point, what random legal actions have shown.
    statistics: tuple[PointStatistics, ...] = ()
    # : The numbers of those episodes, by the way they ended.
    episodes: dict[str, int] = field(default_factory=dict)
    # : The order in which the decision points were called in a plain run: ``(a b){30} c``.
    calls: str = ""

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
            parts.append(
                "\n".join(["What was checked", *(_wrapped(line, 2) for line in self.checked)])
            )
        if self.statistics:
            ends = ", ".join(f"{number} {end}" for end, number in self.episodes.items() if number)
            statistics = [f"  {point}" for point in self.statistics]
            parts.append(
                "\n".join([f"Episodes of random legal actions: {ends or 'none'}", *statistics])
            )
        if self.calls:
            parts.append(_wrapped(f"Order of the decisions in a plain run: {self.calls}", 0))
        return "\n\n".join(parts)

    def _heading(self) -> str:
        counts = [(len(self.of(severity)), severity) for severity in SEVERITIES]
        named = [
            f"{number} {severity}{'s' * (number != 1)}" for number, severity in counts if number
        ]
        return f"{self.simulation}: {', '.join(named) or 'nothing to complain of'}"


@dataclass(frozen=True)
class Inspection:
    """The result of ``inspect_simulation``. Its ``str`` is a text for people."""

    simulation: str  #: What was inspected.
    # : Of each decision point, its name, its agents, its spaces, and more.
    points: tuple[dict[str, str], ...]
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
        parts = [
            f"{self.simulation}: {len(self.points)} decision point{'s' * (len(self.points) != 1)}"
        ]
        parts += [
            "\n  ".join(f"{key:<13} {text}" for key, text in point.items()) for point in self.points
        ]
        options = {"single": "single with agent=", "joint": "joint with possible_agents="}
        views = [*self.views, *(text for view, text in options.items() if view not in self.views)]
        parts.append(f"Possible views: {', '.join(views)}")
        parts.append(
            f"One episode with the model's own rules: {self.ended}\n{_wrapped(episode, 2)}"
        )
        return "\n\n".join(parts)


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
    wrapper = TextWrapper(
        100, " " * margin, " " * (margin + 2), break_long_words=False, break_on_hyphens=False
    )
    return "\n".join(wrapper.fill(line) for line in text.splitlines())
