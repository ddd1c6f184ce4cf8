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

    #: "error": results would be wrong. "warning": learning may suffer. "note": good to know.
    severity: Severity
    title: str  #: The finding in one line.
    explanation: str  #: Its meaning and remedy.
    evidence: str = ""  #: Where and when it appeared; may be empty.

    def __str__(self) -> str:
        text = f"{self.explanation}\nSeen: {self.evidence}" if self.evidence else self.explanation
        return f"{self.severity.upper():<9}{self.title}\n{_wrap(text, 9)}"


FINDINGS: Final[dict[str, tuple[Severity, str, str]]] = {
    "raises": (
        "error",
        "The simulation raises {kind}",
        """No mapping has raised it. Learning code tries every action that is in the action space
        and not masked: if an action causes the error, narrow the space or exclude the action
        with action_mask_mapping. If only a later episode fails, reset() must restore more.""",
    ),
    "mapping_raises": (
        "error",
        "{source} raises {kind}",
        """The model may be right: its mapping raises the error, or returns a value that the
        environment refuses. An environment calls mappings at each decision, and once more at
        an agent's end, where the model may have changed: let the mapping serve there, too.
        Labels are texts for each part of the space, or for actions in it.""",
    ),
    "stuck": (
        "error",
        "The simulation neither ends nor asks for a decision",
        """An environment would wait forever. Look for an endless loop, for a loop that waits for
        an event that some actions never cause, and for an except that catches everything,
        including SimulationExit. If the simulated time stands still, events cause each other
        without a delay. If the model is only slow, raise time_limit=.""",
    ),
    "no_decision": (
        "error",
        "The simulation never asks for a decision",
        """run() never calls {points}. Does it call an earlier reference instead of the attribute
        of a class or module?""",
    ),
    "silent_override": (
        "error",
        "Functions override a decision point, and their objects are no agents",
        """The model calls an overriding function, which is no decision point: its own code
        decides, and no environment is asked. Decorate it with make_step, or add it to points,
        too. If the subclass only extends the function, call super() in it. If its objects
        should not be agents, give their function another name.""",
    ),
    "standing_clock": (
        "error",
        "The simulated time stands still while agents decide",
        """The same agents decide again and again at one time, and the episode never ends. Look for
        a loop that waits for a decision which changes nothing, and for events without a
        delay. If the model is right, time() should tell these decisions apart.""",
    ),
    "backward_clock": (
        "error",
        "The simulated time goes back",
        """Infos, discounts and planners use the time elapsed since the previous decision, which is
        negative or no number here. Let time() return the model's own clock, which only grows in
        an episode.""",
    ),
    "hash_seed": (
        "error",
        "The same seed does not give the same run in another process",
        """Python hashes strings differently in each process. So the order of a set of strings, or
        of objects whose hash uses strings, differs, and so does hash(). Sort the set before
        you iterate over it, or use a dict, whose order is that of insertion. Only setting
        PYTHONHASHSEED would hide this.""",
    ),
    "unrepeatable": (
        "error",
        "The same seed does not give the same run",
        """Two runs with the same seed differ, so no result can be repeated. The usual causes: a
        generator that reset() does not seed, a clock, values left over in class attributes or
        global variables, or the order of a set.""",
    ),
    "unseeded_generators": (
        "error",
        "The model or a mapping draws from generators that the whole process shares ({generators})",
        """The same seed does not give the same episode: all other code that draws from these
        generators changes them. Give the model a generator of its own, random.Random(seed) or
        numpy.random.default_rng(seed), and seed it in reset(). If you cannot change the model,
        give environments the option global_rng=True. Mappings should only read the model.""",
    ),
    "changed_model": (
        "error",
        "The model behaves differently when it is observed",
        """With its own rule throughout, a run in an environment must be identical to the plain
        run, else agents learn on another model. Mappings (of observations, rewards, masks,
        agents' names) must not change it or draw random numbers from it.""",
    ),
    "left_over": (
        "error",
        "Something is left over from earlier episodes",
        """An episode after others in the same environment, the last of them broken off, differs
        from the same episode in a new environment. reset() must restore everything that run()
        changes. The usual cause is an attribute that __init__ sets.""",
    ),
    "disturbance": (
        "error",
        "Two environments of the model disturb each other",
        """Stepped in turns, they give other episodes than each alone. They share something:
        attributes of classes, global variables, a file, or objects that were made when the
        module was imported.""",
    ),
    "failed_test": (
        "error",
        "{test} fails",
        """Learning libraries rely on the properties that it tests.""",
    ),
    "not_finite": (
        "error",
        "Observations at {point} contain NaN or infinite numbers",
        """One such number spoils all weights of a network. Look for a division by zero, the mean of
        nothing, or a missing value in the observation_space_mapping, and return a number for
        it.""",
    ),
    "outside": (
        "error",
        "Observations at {point} lie outside their space",
        """Learning code relies on the bounds. Widen the observation_space, or clip in the
        observation_space_mapping.""",
    ),
    "shared_generators": (
        "warning",
        "The model uses generators that the whole process shares ({generators})",
        """The model seeds them itself, so that one environment repeats its episodes. But
        environments side by side and training code disturb each other. Give the model a
        generator of its own, or its environments the option global_rng=True.""",
    ),
    "writing_mappings": (
        "warning",
        "Mappings write into the model",
        """In an environment the simulation holds values that it does not hold in a plain run,
        though its decisions are the same. Keep such values outside the model; difference()
        computes changes since the last decision.""",
    ),
    "changing_rule": (
        "warning",
        "The rule of {point} changes the model by deciding",
        """An action takes the place of the rule, so that the model changes under RULE and not under
        actions. Let the function only choose, and its caller change the model. Or give the
        definition apply= in place of action_space_mapping=: it gets the action and makes the
        changes of the rule, too. If a change is harmless, as that of a log, leave it out by
        fingerprint=.""",
    ),
    "waiting_rule": (
        "warning",
        "The rule of {point} takes time, an action takes none",
        """The rule waits before it decides, and an action skips the wait. Wait outside of the
        decision function, or give the definition apply= in place of action_space_mapping=:
        apply may be a generator or coroutine function, which waits as the rule does and returns
        the decision.""",
    ),
    "vanishing": (
        "warning",
        "The rule of {point} yields values and returns none",
        """The decision of a generator function is the value that it returns. If the caller iterates
        over decisions that it yields, it gets none under an action: make one call for each
        decision, or return a list of them. If it yields delays, an action skips them: apply=
        may be a generator function, which yields them, too.""",
    ),
    "early_decisions": (
        "warning",
        "{point} decides before run()",
        """In a constructor or in reset(), the rule decides, and no environment is asked. Take the
        decision at the beginning of run(), or call another function if its rule should
        decide.""",
    ),
    "settings": (
        "warning",
        "{point} decides under settings that the model has changed",
        """While an environment waits for an action, the model stays in its with block, and the
        settings of the process hold for your training code, too: its warnings and output
        vanish, its gradients, or its relative paths. Leave the block before the decision:
        compute in the block, decide after it. Each thread has a grad mode of torch, so the
        option driver="thread" separates that.""",
    ),
    "same_observations": (
        "warning",
        "Observations at {point} are always the same",
        """Agents see nothing of the model. Does the observation_space_mapping read an old copy, or
        an attribute that never changes?""",
    ),
    "warned": (
        "warning",
        "An environment warns: {kind}",
        """The simulation may refuse to end (an except that catches everything), several objects
        may decide as one agent (see agent= of make_step), or agents that the options name do
        not exist.""",
    ),
    "out_of_time": (
        "warning",
        "The time limit has stopped the check",
        """Give it more time (time_limit=), or less work (episodes=, max_steps=, fewer seeds=).""",
    ),
    "no_effect": (
        "warning",
        "What the agents do changes nothing",
        """Two episodes of the same seed with different actions gave the same observations and
        rewards. Do the actions reach the model (action_space_mapping, apply)? Do observations
        and rewards show their effects?""",
    ),
    "never_called": (
        "warning",
        "{point} was never called",
        """No episode asked for this decision, so its agent cannot learn anything. Does the
        simulation call the function as an attribute of its class or module, and do episodes
        last long enough?""",
    ),
    "zero_rewards": (
        "warning",
        "Rewards at {point} are always zero",
        """Random actions never earned a reward, and rare rewards are hard to learn from. See the
        reward_mapping.""",
    ),
    "history": (
        "note",
        "{point} decides before run(), while the model is made or reset",
        """There, the rule decides, and no environment is asked. This is right for a history that no
        agent should decide. Else take these decisions in run().""",
    ),
    "unseeded_reset": (
        "note",
        "reset() takes no seed",
        """Write reset(self, seed=None) and seed the model's generator with it, unless nothing in
        the model is random.""",
    ),
    "cut_runs": (
        "note",
        "Runs were stopped before their end",
        """They make more than {most} decisions, or never end. If they never end, environments need
        the option max_steps.""",
    ),
    "unstable": (
        "note",
        "Some attributes of the model differ between two plain runs with the same seed",
        """The decisions were the same, so this may be harmless: the time of day, or a counter that
        all simulations of the process share. The comparisons leave it out.""",
    ),
    "same_seeds": (
        "note",
        "All seeds give the same episode",
        """If the model draws random numbers, reset() does not seed them. If it draws none, agents
        may memorise the episode.""",
    ),
    "same_rewards": (
        "note",
        "Rewards at {point} are always the same",
        """All random actions earned the same. Check the reward_mapping, unless only the length of
        the episode should count.""",
    ),
    "few_generators": (
        "note",
        "Entities that decide share random generators",
        """If one of them draws, the others draw other numbers afterwards, so that actions are hard
        to compare on the same seeds and futures. If several draw, give each a generator of its
        own: see Streams, and "One stream for each entity" in the documentation. If only the
        model draws, there is nothing to do.""",
    ),
    "never_legal": (
        "note",
        "Some actions at {point} were never legal",
        """Either there were too few episodes for them to be legal, or the action space is larger
        than necessary.""",
    ),
}
"""The severity, the title and the explanation of each finding, by its name."""


@dataclass(frozen=True)
class Range:
    """The range of one number over all episodes."""

    name: str  #: "reward", or a component of an observation, as in "position[0]".
    minimum: float  #: The lowest number.
    mean: float  #: The mean over all decisions.
    maximum: float  #: The highest number.

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
        ranges = (
            [*self.observations] if self.rewards is None else [self.rewards, *self.observations]
        )
        lines = [f"{self.agents}, at {self.point}: {self.decisions} decisions"]
        lines += map(str, ranges[:12])
        if len(ranges) > 12:
            lines.append(f"and {len(ranges) - 12} more")
        return "\n    ".join(lines)


@dataclass(frozen=True)
class CheckReport:
    """The result of ``check_simulation``. Its ``str`` is a text for people."""

    simulation: str  #: The name of the simulation.
    findings: tuple[Finding, ...]  #: The findings, the most important first.
    checked: tuple[str, ...]  #: A description of each check that was made.
    #: The statistics of each decision point under random legal actions.
    statistics: tuple[PointStatistics, ...] = ()
    #: The number of episodes of random legal actions, by the way they ended.
    episodes: dict[str, int] = field(default_factory=dict)
    #: The order of the calls of decision points in a plain run, as in ``(a b){30} c``.
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
        if not self.ok:
            raise CheckFailedError("\n\n".join([self._heading(), *map(str, self.of("error"))]))

    def to_dict(self) -> dict[str, Any]:
        """Return the report as dicts, tuples, strings and numbers, for JSON."""
        return {"ok": self.ok, **asdict(self)}

    def __str__(self) -> str:
        parts = [self._heading(), *map(str, self.findings)]
        if self.checked:
            parts.append(
                "\n".join(["What was checked", *(_wrap(line, 2) for line in self.checked)])
            )
        if self.statistics:
            ends = ", ".join(f"{number} {end}" for end, number in self.episodes.items() if number)
            heading = f"Episodes of random legal actions: {ends or 'none'}"
            parts.append("\n  ".join([heading, *map(str, self.statistics)]))
        if self.calls:
            parts.append(_wrap(f"Order of the decisions in a plain run: {self.calls}", 0))
        return "\n\n".join(parts)

    def _heading(self) -> str:
        counts = [(len(self.of(severity)), severity) for severity in SEVERITIES]
        texts = [_count(number, severity) for number, severity in counts if number]
        return f"{self.simulation}: {', '.join(texts) or 'nothing to complain of'}"


@dataclass(frozen=True)
class Inspection:
    """The result of ``inspect_simulation``. Its ``str`` is a text for people."""

    simulation: str  #: The name of the simulation.
    #: For each decision point, its name, its agents, its spaces, and more.
    points: tuple[dict[str, str], ...]
    views: tuple[str, ...]  #: The views that its environments may have.
    calls: str  #: The order of their calls in one plain run, as in ``(a b){30} c``.
    counts: dict[str, int]  #: The number of calls of each point.
    ended: str  #: The end of that episode, in words.

    def to_dict(self) -> dict[str, Any]:
        """Return the inspection as dicts, tuples, strings and numbers, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        parts = [f"{self.simulation}: {_count(len(self.points), 'decision point')}"]
        for point in self.points:
            parts.append("\n  ".join(f"{key:<13} {text}" for key, text in point.items()))
        options = {"single": "single with agent=", "joint": "joint with possible_agents="}
        views = [*self.views, *(text for view, text in options.items() if view not in self.views)]
        counts = ", ".join(f"{point} {number} times" for point, number in self.counts.items())
        episode = f"calls    {counts or 'none'}\norder    {self.calls or '-'}"
        parts += [
            f"Possible views: {', '.join(views)}",
            f"One episode with the model's own rules: {self.ended}\n{_wrap(episode, 2)}",
        ]
        return "\n\n".join(parts)


def order_of(calls: Sequence[str]) -> str:
    """Return the order of calls, with repetitions as in ``(a b){30} c``; a long text is cut."""
    ends = {name: name.rpartition(".")[2] for name in calls}
    unique = len(set(ends.values())) == len(ends)
    text = "".join(f"{ends[name] if unique else name} " for name in calls[:3000])
    for _ in range(3):  # repetitions of repetitions
        text = re.sub(r"(?<!\S)((?:\S+ ){1,24}?)\1+", _fold, text)
    terms = text.split()
    if len(terms) > 30 or len(calls) > 3000:
        terms[30:] = [f"... and {len(calls)} calls in all"]
    return " ".join(terms).replace("\0", " ")


def _fold(match: re.Match[str]) -> str:
    """Write a repeated block as one term, with null characters instead of blanks."""
    block = match[1].rstrip().replace(" ", "\0")
    number = len(match[0]) // len(match[1])
    return f"({block}){{{number}}} " if "\0" in block else f"{block}{{{number}}} "


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _wrap(text: str, margin: int) -> str:
    """Wrap the lines of a text, with a margin that is wider after the first line of each."""
    indents = " " * margin, " " * (margin + 2)
    wrapper = TextWrapper(100, *indents, break_long_words=False, break_on_hyphens=False)
    return "\n".join(map(wrapper.fill, text.splitlines()))
