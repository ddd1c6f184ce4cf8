"""``check_wire``, for authors of clients: tests whether a simulator follows the protocol."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest
from subprocess import DEVNULL, TimeoutExpired, run
from typing import Any, Final, Literal, NamedTuple, TypeAlias

from ..core import is_seed
from ..errors import (
    OptionValueError,
    ProcessDiedError,
    ProcessError,
    RemoteError,
    WireError,
    did_you_mean,
    short_repr,
)
from ..simulation import check_count, check_seconds
from .child import MOST_FRAMES, Child
from .wire import KEYS, Frame, Json, decode, encode

PADDING: Final = 1 << 20
"""The number of blanks in a long line, which is longer than any pipe's buffer."""

INVALID: Final = {
    "an answer with the number of another call": encode({"act": 10**6, "rule": True}),
    "a frame that does not exist": encode({"desire": 1}),
    "a line that is not JSON": b"hello?\n",
    "half a line, then the end of its input": b'{"act',
    "the end of its input in mid-episode": b"",
}
"""Answers that a simulator must refuse. After a line without an end, its input ends."""

ABILITIES: Final = ("decided", "expect", "reseed")
"""The abilities that the "can" of a hello may list."""

GUESSES: Final = ([0, 1, 100], [False, True])
"""Possible decisions, for simulators that do not report the decisions of their rules."""

HIGH: Final = 1 << 30
"""The highest bit of a seed."""

Verdict: TypeAlias = Literal["ok", "note", "wrong"]

Outcome: TypeAlias = tuple[Verdict, str]
"""The verdict of a test that has not failed, "ok" or "note", and its text."""

Frames: TypeAlias = list[Frame]
"""The frames of an episode."""


class Finding(NamedTuple):
    """The outcome of one test: "ok", "wrong", or "note" for a result that may be intended."""

    tried: str
    verdict: Verdict
    text: str


@dataclass
class WireReport:
    """The findings of ``check_wire``, one for each test."""

    findings: list[Finding]

    @property
    def ok(self) -> bool:
        """Whether no test has failed."""
        return all(finding.verdict != "wrong" for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as JSON data."""
        return {"ok": self.ok, "findings": [finding._asdict() for finding in self.findings]}

    def __str__(self) -> str:
        lines = [f"{verdict:5}  {tried}: {text}" for tried, verdict, text in self.findings]
        wrong = sum(finding.verdict == "wrong" for finding in self.findings)
        summary = f"{wrong} of {len(lines)} tests failed" if wrong else "nothing is wrong"
        return "\n".join([*lines, "", summary])


def check_wire(
    command: Sequence[str],
    *,
    options: Mapping[str, Any] | None = None,
    seed: int = 1,
    decisions: int = 1000,
    timeout: float = 30.0,
) -> WireReport:
    """Run episodes of a simulator, and report its errors in the use of the protocol.

    The check runs episodes by the simulator's rule, in one process and in new ones; breaks episodes
    off; sends long lines, ``reseed``, other seeds, other decisions and invalid frames; closes the
    input; and runs the simulator without an environment.

    Args:
        command: The program and its arguments.
        options: The options that ``start`` brings.
        seed: The seed of the episodes.
        decisions: The number of decisions after which an episode is broken off.
        timeout: The time to wait for each line, in seconds.

    Raises:
        OptionValueError: An argument cannot be used.
        WireError: The options are not JSON data.
    """
    if not is_seed(seed) or seed >= 2**31:
        raise OptionValueError(
            f"seed must be an integer from 0 to 2**31 - 1, not {short_repr(seed)}"
        )
    check_count(decisions, "decisions", 1)
    check_seconds(timeout, "timeout")
    start = encode({"start": {"seed": seed, "options": options or {}}})
    return _Check(command, start, decisions, timeout).run()


@dataclass
class _Check:
    """A check of one simulator. Its tests raise a ``ProcessError`` if they fail."""

    _command: Sequence[str]
    _start: bytes
    _longest: int
    _timeout: float
    _first: Frames = field(default_factory=list)  # an episode by the rule, in a new process
    _calls: Frames = field(default_factory=list)  # its "decide" frames
    _can: frozenset[str] = frozenset()
    _draws: bool = False  # whether other random numbers are known to change an episode

    def run(self) -> WireReport:
        """Run all tests; if a simulator fails one of the first two, only these."""
        findings = []
        for name, test in self._tests():
            try:
                verdict, text = test()
            except ProcessError as error:
                verdict, text = "wrong", str(error)
            findings.append(Finding(name, verdict, text))
            if verdict == "wrong" and not self._calls:
                break
        return WireReport(findings)

    def _tests(self) -> Iterator[tuple[str, Callable[[], Outcome]]]:
        """Yield all tests with their names. Those after the second need its frames."""
        yield "starts, and says hello", self._hello
        yield "an episode by its own rule", self._episode
        yield "two episodes in a row with the same seed", self._repeat
        for number in sorted({1, self._middle(), len(self._calls)}):
            yield f"stop in place of the answer to call {number}", partial(self._repeat, number)
        yield "a line of 1 MiB", self._long_line
        yield "reseed", self._reseed
        yield "other seeds", self._seeds
        for point in dict.fromkeys(call["point"] for call in self._calls):
            yield f"other decisions at {point}", partial(self._values, point)
        for name, line in INVALID.items():
            yield name, partial(self._refusal, line)
        yield "the end of its input between episodes", self._end_of_input
        yield "a run without an environment", self._plain_run

    def _child(self, child: Child | None = None) -> AbstractContextManager[Child]:
        """Return a process, or a new one, which is closed at the end of the block."""
        return nullcontext(child) if child else closing(Child(self._command, self._timeout))

    def _middle(self) -> int:
        """Return the number of a call in the middle of the first episode."""
        return (len(self._calls) + 1) // 2

    def _play(
        self,
        child: Child | None = None,
        *,
        start: bytes | None = None,
        stop: int = 0,
        reseed: int | None = None,
        point: str | None = None,
        value: Json = None,
    ) -> Frames:
        """Play an episode by the rule, in a process or a new one; return its frames.

        ``start`` replaces the usual line. ``stop`` is the number of the call that ends the
        episode. ``reseed`` is a seed to send in the middle of the episode. ``value`` replaces the
        rule's decisions at ``point``.
        """
        frames = []
        removed_callers = set()
        with self._child(child) as child:
            frame = child.begin(start or self._start)
            while True:
                _check_keys(frame)
                frames.append(frame)
                if "end" in frame:
                    return frames
                caller = frame.get("point", ""), frame.get("entity")
                if "remove" in frame:
                    removed_callers.add(caller)
                elif "decide" in frame:
                    number = child.number
                    if caller in removed_callers:
                        raise WireError(
                            f"call {number} is of {caller[1]!r} at {caller[0]}, which was removed"
                            " before; an entity that comes needs a name that none had in the"
                            ' episode, and "remove" comes after the last call'
                        )
                    if number in (stop, self._longest) or len(frames) > MOST_FRAMES:
                        child.break_off()
                        return frames
                    if reseed is not None and number == self._middle():
                        child.reseed(reseed)
                    if caller[0] == point:
                        child.answer(value)
                    else:
                        child.decide_by_rule()
                        frames += [child.rule_frame] if child.rule_frame else []
                frame = child.next_frame()

    def _compare(self, frames: Frames) -> Outcome:
        """Compare an episode with the first one."""
        for number, (first, other) in enumerate(zip_longest(self._first, frames)):
            if first != other:
                raise WireError(
                    f"frame {number} is {short_repr(other)}, and in a new process it was"
                    f' {short_repr(first)}; seed all generators by the seed of "start", and forget'
                    " other episodes"
                )
        return "ok", "the same as in a new process"

    # -- tests ------------------------------------------------------------------------------------

    def _hello(self) -> Outcome:
        with self._child() as child:
            if not child.points:
                raise WireError("it has no points")
            _check_keys(child.hello)
            self._can = child.can
            for name in child.can.difference(ABILITIES):
                hint = did_you_mean(name, ABILITIES) or f"; it may list {', '.join(ABILITIES)}"
                raise WireError(
                    f'the "can" of its hello lists {name!r}, which does not exist{hint}'
                )
            can = ", ".join(sorted(child.can)) or "nothing else"
            return "ok", f"points {', '.join(sorted(child.points))}; can {can}"

    def _episode(self) -> Outcome:
        self._first = self._play()
        self._calls = [frame for frame in self._first if "decide" in frame]
        if not self._calls:
            raise WireError("it asked for no decision")
        counts = Counter(call["point"] for call in self._calls)
        points = ", ".join(f"{point} {count}" for point, count in counts.items())
        end = self._first[-1].get("end")
        if end is None:
            return "note", f"it was stopped after {self._longest} decisions ({points})"
        result = short_repr(end.get("result"))
        return "ok", f"{len(self._calls)} decisions ({points}), result {result}"

    def _repeat(self, stop: int = 0) -> Outcome:
        with self._child() as child:
            self._play(child, stop=stop)
            try:
                return self._compare(self._play(child))
            except ProcessDiedError:
                if child.number != 0 or child.exit_code() != 0:
                    raise
        self._compare(self._play())
        return "note", (
            "it exits with code 0 after an episode, and plays the same in a new process: one for"
            " each"
        )

    def _long_line(self) -> Outcome:
        start = self._start.replace(b"\n", b" " * PADDING + b"\n")
        return self._compare(self._play(start=start))

    def _reseed(self) -> Outcome:
        if "reseed" not in self._can:
            return "note", (
                'the "can" of its hello does not list "reseed": no branches with other futures'
            )
        one, again, other = [self._play(reseed=seed) for seed in (11, 11, 12)]
        if one != again:
            raise WireError("the same seed has led to two futures; seed all generators by it")
        if one == other:
            return "note", "two seeds have led to the same future; is nothing in the model random?"
        self._draws = True
        return "ok", (
            f"at call {self._middle()}, two seeds lead to two futures, and the same seed to the"
            " same future"
        )

    def _seeds(self) -> Outcome:
        """Play episodes with four low seeds, and with four that differ in the highest bit alone."""
        low = [self._seeded(number) for number in range(1, 5)]
        high = [self._seeded(HIGH + number) for number in range(1, 5)]
        if len(_distinct(low + high)) == 1:
            text = "seeds 1 to 4 lead to the same episode"
            if self._draws:
                raise WireError(
                    f'{text}, though "reseed" changes it: seed the generators with the seed of'
                    ' "start"'
                )
            return "note", (
                f'{text}; is nothing in the model random, or does it ignore the seed of "start"?'
            )
        different = len(_distinct(low))
        if different > 2:  # with fewer, it can be chance
            remedy = "keep all 31 bits of the seed, in an integer of 32 or 64 bits"
            high_seeds = f"{HIGH + 1} to {HIGH + 4}"
            if low == high:
                raise WireError(f"seeds 1 to 4 lead to the same episodes as {high_seeds}: {remedy}")
            if len(_distinct(high)) == 1:
                raise WireError(f"seeds {high_seeds} lead to the same episode: {remedy}")
        return "ok", f"four seeds lead to {different} different episodes, and all their bits count"

    def _seeded(self, seed: int) -> Frames:
        """Play an episode with another seed, in a new process."""
        start = encode({"start": {**decode(self._start)["start"], "seed": seed}})
        return self._play(start=start)

    def _values(self, point: str) -> Outcome:
        """Play episodes with one value for all decisions of a point."""
        calls = [call["decide"] for call in self._calls if call["point"] == point]
        rule_frames = [frame for frame in self._first if frame.get("decided") in calls]
        legal = _distinct(frame["value"] for frame in rule_frames)[:2]
        known = len(legal) == 2
        for values in [legal] if known else GUESSES:
            try:
                episodes = [self._play(point=point, value=value) for value in values]
            except ProcessError as error:
                if known or isinstance(error, WireError):
                    raise
                continue  # it does not take such a value
            decisions = f"the decisions {', '.join(map(short_repr, values))}"
            if len(_distinct(episodes)) == 1:
                raise WireError(
                    f'{decisions} lead to the same episode: continue with the "value" of "act"'
                )
            return "ok", f"{decisions} lead to different episodes"
        return "note", (
            "it takes neither numbers nor booleans here, so that other decisions were not tried"
        )

    def _refusal(self, line: bytes) -> Outcome:
        with self._child() as child:
            frame = child.begin(self._start)
            while "decide" not in frame:
                frame = child.next_frame()
            child.send(line)
            if not line.endswith(b"\n"):
                child.close_input()
            try:
                frame = child.receive()
            except ProcessDiedError:
                return "ok", "it ends"
            except RemoteError as error:
                return "ok", f"it reports an error: {short_repr(str(error))}"
        raise WireError(f"it continues with {short_repr(frame)}; it must end, or send an error")

    def _end_of_input(self) -> Outcome:
        with self._child() as child:
            self._play(child)
            child.close_input()
            with suppress(ProcessDiedError):
                raise WireError(f"it sends {short_repr(child.receive())}")
        return "ok", "it ends"

    def _plain_run(self) -> Outcome:
        try:
            process = run(
                self._command,
                stdin=DEVNULL,
                capture_output=True,
                timeout=self._timeout,
            )
        except TimeoutExpired:
            return "note", f"it still ran after {self._timeout:g} s"
        if process.returncode != 0:
            stderr = process.stderr.decode(errors="replace").strip()[-300:]
            return "note", f"it has exited with code {process.returncode}: {stderr}"
        return "ok", "it runs on its own rule, and exits with code 0"


def _distinct(items: Iterable[Any]) -> list[Any]:
    """Return the first of all equal items, in their order."""
    distinct: list[Any] = []
    for item in items:
        if item not in distinct:
            distinct.append(item)
    return distinct


def _check_keys(frame: Frame) -> None:
    """Raise a ``WireError`` if a frame has a key that the protocol does not have."""
    kind = next(kind for kind in KEYS if kind in frame)
    parts = [(frame, {kind, *KEYS[kind]})]
    if kind == "end":
        parts.append((frame["end"], {"truncated", "result"}))
    for part, keys in parts:
        for key in sorted(part.keys() - keys):
            hint = did_you_mean(key, keys)
            hint = hint or "; an argument belongs into args, another result into result"
            raise WireError(f"the key {key!r} of {short_repr(frame)} does not exist{hint}")
