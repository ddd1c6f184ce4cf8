"""A check for authors of clients: does a simulator speak the wire as it should?"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import zip_longest
from math import inf
from subprocess import DEVNULL, PIPE, TimeoutExpired, run
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from ..core import is_seed
from ..errors import (
    OptionValueError,
    ProcessDiedError,
    ProcessError,
    WireError,
    did_you_mean,
    short_repr,
)
from ..simulation import RULE
from .child import MOST_FRAMES, Child
from .wire import DESCRIPTORS, KEYS, decode, encode, encode_answer

OK, NOTE, WRONG = "ok", "note", "wrong"

PADDING: Final = 1 << 20
"""The number of blanks in a long line, which is longer than any pipe's buffer."""

INVALID: Final = {
    "an answer with the number of another call": encode({"act": 10**6, "rule": True}),
    "a frame that does not exist": encode({"desire": 1}),
    "a line that is not JSON": b"hello?\n",
    "half a line, then the end of its input": b'{"act',
    "the end of its input in mid-episode": b"",
}
"""What a simulator must refuse in place of an answer.

Its input ends after a line without an end.
"""

ABILITIES: Final = ("decided", "expect", "reseed")
"""What the "can" of a hello may list."""

GUESSES: Final = ((0, 1, 100), (False, True))
"""Values that a decision may have, for simulators that do not tell what their rules decide."""

HIGH: Final = 1 << 30
"""The highest bit of a seed."""

Outcome = tuple[str, str]
"""The verdict of a test, and what happened."""


class Finding(NamedTuple):
    """The outcome of one test: the verdict is "ok", "wrong", or "note" for what may be intended."""

    tried: str
    verdict: str
    text: str


class WireReport:
    """The findings of ``check_wire``, one for each test, in the list ``findings``."""

    def __init__(self) -> None:
        self.findings: list[Finding] = []

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return all(finding.verdict != WRONG for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as JSON data."""
        return {"ok": self.ok, "findings": [finding._asdict() for finding in self.findings]}

    def __str__(self) -> str:
        lines = [
            f"{finding.verdict:5}  {finding.tried}: {finding.text}" for finding in self.findings
        ]
        wrong = sum(finding.verdict == WRONG for finding in self.findings)
        return "\n".join(
            [*lines, "", f"{wrong} of {len(lines)} tests failed" if wrong else "nothing is wrong"]
        )


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
    if decisions < 1 or not 0 < timeout < inf:
        raise OptionValueError(
            f"decisions and timeout must be positive, not {decisions} and {timeout}"
        )
    start = encode({"start": {"seed": seed, "options": options or {}}})
    return _Check(command, start, decisions, timeout).run()


class _Check:
    """A check of one simulator."""

    def __init__(self, command: Sequence[str], start: bytes, most: int, timeout: float) -> None:
        self._command, self._start, self._most, self._timeout = command, start, most, timeout
        self._report = WireReport()
        # the frames of an episode by the rule, in a new process
        self._first: list[dict[str, Any]] = []
        self._decisions = 0  # of that episode
        self._draws = False  # whether other random numbers are known to change an episode

    def run(self) -> WireReport:
        """Run all tests; if a simulator fails one of the first two, only these."""
        self._try("starts, and says hello", self._hello)
        if self._report.ok:
            self._try("an episode by its own rule", self._episode)
        if not self._report.ok:
            return self._report
        self._try("two episodes in a row with the same seed", self._repeat)
        for number in sorted({1, (self._decisions + 1) // 2, self._decisions}):
            self._try(
                f"stop in place of the answer to call {number}", partial(self._repeat, stop=number)
            )
        self._try("a line of 1 MiB", self._long_line)
        self._try("reseed", self._reseed)
        self._try("other seeds", self._seeds)
        for point in dict.fromkeys(frame["point"] for frame in self._first if "decide" in frame):
            self._try(f"other decisions at {point}", partial(self._values, point))
        for what, line in INVALID.items():
            self._try(what, partial(self._refusal, line))
        self._try("the end of its input between episodes", self._end_of_input)
        self._try("a run without an environment", self._plain_run)
        return self._report

    def _try(self, tried: str, test: Callable[[], Outcome]) -> None:
        try:
            verdict, text = test()
        except ProcessError as error:
            verdict, text = WRONG, str(error)
        self._report.findings.append(Finding(tried, verdict, text))

    def _child(self) -> closing[Child]:
        return closing(Child(self._command, self._timeout))

    def _play(
        self,
        child: Child,
        *,
        start: bytes | None = None,
        stop: int = 0,
        reseed: tuple[int, int] = (0, 0),
        decisions: Mapping[str, Any] = MappingProxyType({}),
    ) -> list[dict[str, Any]]:
        """Play an episode by the rule; return its frames.

        ``start`` replaces the usual line. ``stop`` is the call at which to break off, ``reseed`` a
        call and a seed. ``decisions`` has a value for each point at which the rule does not decide.
        """
        frames, removed = [child.begin(start or self._start)], set[tuple[str, Any]]()
        while True:
            frame = frames[-1]
            _check_keys(frame)
            if "end" in frame:
                return frames
            who = frame.get("point", ""), frame.get("entity")
            if "remove" in frame:
                removed.add(who)
            elif "decide" in frame:
                number = child.number
                if who in removed:
                    raise WireError(
                        f"call {number} is of {who[1]!r} at {who[0]}, which was removed before; an"
                        " entity that comes"
                        ' needs a name that none had in the episode, and "remove" comes after the'
                        " last call"
                    )
                if number in (stop, self._most) or len(frames) > MOST_FRAMES:
                    child.break_off()
                    return frames
                if who[0] in decisions:
                    child.answer(encode_answer(number, decisions[who[0]]))
                else:
                    value = child.leave_to_rule(
                        encode({"reseed": reseed[1]}) if number == reseed[0] else b""
                    )
                    frames += [] if value is RULE else [{"decided": number, "value": value}]
            frames.append(child.next_frame())

    def _compare(self, frames: list[dict[str, Any]]) -> Outcome:
        """Compare an episode with the first one."""
        for number, (one, other) in enumerate(zip_longest(self._first, frames)):
            if one != other:
                what = f"frame {number} is {short_repr(other)}, and in a new process it was {short_repr(one)}"
                return (
                    WRONG,
                    (
                        f'{what}; seed all generators by the seed of "start", and keep nothing of'
                        " other episodes"
                    ),
                )
        return OK, "the same as in a new process"

    # -- tests ------------------------------------------------------------------------------------

    def _hello(self) -> Outcome:
        with self._child() as child:
            if not child.points:
                return WRONG, "it has no points"
            _check_keys(child.hello)
            for name in child.can.difference(ABILITIES):
                hint = did_you_mean(name, ABILITIES) or f"; it may list {', '.join(ABILITIES)}"
                return WRONG, f'the "can" of its hello lists {name!r}, which does not exist{hint}'
            can = ", ".join(sorted(child.can)) or "nothing else"
            return OK, f"points {', '.join(sorted(child.points))}; can {can}"

    def _episode(self) -> Outcome:
        with self._child() as child:
            self._first, self._decisions = self._play(child), child.number
        count = Counter(frame["point"] for frame in self._first if "decide" in frame)
        points = ", ".join(f"{point} {number}" for point, number in count.items())
        if not count:
            return WRONG, "it asked for no decision"
        end = self._first[-1].get("end")
        if end is None:
            return NOTE, f"it was stopped after {self._most} decisions ({points})"
        return OK, f"{self._decisions} decisions ({points}), result {short_repr(end.get('result'))}"

    def _repeat(self, stop: int = 0) -> Outcome:
        with self._child() as child:
            self._play(child, stop=stop)
            try:
                return self._compare(self._play(child))
            except ProcessDiedError:
                if child.number == 0 and child.exit_code() == 0:
                    return self._restart()
                raise

    def _restart(self) -> Outcome:
        """Compare an episode in another process, for a simulator that exits after each."""
        with self._child() as child:
            verdict, text = self._compare(self._play(child))
        if verdict == OK:
            return (
                NOTE,
                (
                    "it exits with code 0 after an episode, and plays the same in a new process:"
                    " one for each"
                ),
            )
        return verdict, text

    def _long_line(self) -> Outcome:
        with self._child() as child:
            return self._compare(
                self._play(child, start=self._start.replace(b"\n", b" " * PADDING + b"\n"))
            )

    def _reseed(self) -> Outcome:
        middle, futures = (self._decisions + 1) // 2, []
        for seed in (11, 11, 12):
            with self._child() as child:
                if "reseed" not in child.can:
                    return (
                        NOTE,
                        (
                            'the "can" of its hello does not list "reseed": no branches with other'
                            " futures"
                        ),
                    )
                futures.append(self._play(child, reseed=(middle, seed)))
        one, again, other = futures
        if one != again:
            return WRONG, "the same seed has led to two futures; seed all generators by it"
        if one == other:
            return NOTE, "two seeds have led to the same future; is nothing in the model random?"
        self._draws = True
        return (
            OK,
            (
                f"at call {middle}, two seeds lead to two futures, and the same seed to the same"
                " future"
            ),
        )

    def _seeds(self) -> Outcome:
        """Play episodes with four low seeds, and with four that differ from them in the highest bit alone."""
        low, high = ([self._seeded(base + number) for number in range(1, 5)] for base in (0, HIGH))
        if all(one == low[0] for one in [*low, *high]):
            text = "seeds 1 to 4 lead to the same episode"
            if self._draws:
                return (
                    WRONG,
                    (
                        f'{text}, though "reseed" changes it: seed the generators with the seed of'
                        ' "start"'
                    ),
                )
            return (
                NOTE,
                f'{text}; is nothing in the model random, or does it ignore the seed of "start"?',
            )
        different = sum(one not in low[:number] for number, one in enumerate(low))
        for same, what in (
            (low == high, f"seeds 1 to 4 lead to the same episodes as {HIGH + 1} to {HIGH + 4}"),
            (
                all(one == high[0] for one in high),
                f"seeds {HIGH + 1} to {HIGH + 4} lead to the same episode",
            ),
        ):
            if same and different > 2:  # with fewer, it can be chance
                return (
                    WRONG,
                    f"{what}: keep all 31 bits of the seed, in an integer of 32 or 64 bits",
                )
        return OK, f"four seeds lead to {different} different episodes, and all their bits count"

    def _seeded(self, seed: int) -> list[dict[str, Any]]:
        """Play an episode with another seed, in a new process."""
        start = encode({"start": {**decode(self._start)["start"], "seed": seed}})
        with self._child() as child:
            return self._play(child, start=start)

    def _values(self, point: str) -> Outcome:
        """Play episodes in which all decisions of a point have the same value."""
        calls = {
            frame["decide"]
            for frame in self._first
            if frame.get("point") == point and "decide" in frame
        }
        told = [frame["value"] for frame in self._first if frame.get("decided") in calls]
        known = next(([told[0], value] for value in told if value != told[0]), None)
        for values in GUESSES if known is None else [known]:
            try:
                episodes = [self._valued(point, value) for value in values]
            except ProcessError as error:
                if known is not None or isinstance(error, WireError):
                    raise
                continue  # it does not take such a value
            shown = ", ".join(map(short_repr, values))
            if all(episode == episodes[0] for episode in episodes):
                return (
                    WRONG,
                    (
                        f"the decisions {shown} lead to the same episode: continue with the"
                        ' "value" of "act"'
                    ),
                )
            return OK, f"the decisions {shown} lead to different episodes"
        return (
            NOTE,
            "it takes neither numbers nor booleans here, so that other decisions were not tried",
        )

    def _valued(self, point: str, value: Any) -> list[dict[str, Any]]:
        with self._child() as child:
            return self._play(child, decisions={point: value})

    def _refusal(self, line: bytes) -> Outcome:
        with self._child() as child:
            frame = child.begin(self._start)
            while "decide" not in frame:
                frame = child.next_frame()
            child.answer(line)
            if not line.endswith(b"\n"):
                child.close_input()
            last = self._last_frame(child)
        if last is None:
            return OK, "it ends"
        if "error" in last:
            return OK, f"it sends the error {short_repr(last['error'])}"
        return WRONG, f"it continues with {short_repr(last)}; it must end, or send an error"

    def _end_of_input(self) -> Outcome:
        with self._child() as child:
            self._play(child)
            child.close_input()
            last = self._last_frame(child)
        return (OK, "it ends") if last is None else (WRONG, f"it sends {short_repr(last)}")

    def _last_frame(self, child: Child) -> dict[str, Any] | None:
        """Return what a process that should end sends before; None if it ends at once."""
        try:
            return child.receive()
        except ProcessDiedError:
            return None

    def _plain_run(self) -> Outcome:
        env = {name: value for name, value in os.environ.items() if name != DESCRIPTORS}
        try:
            done = run(
                self._command,
                env=env,
                stdin=DEVNULL,
                stdout=DEVNULL,
                stderr=PIPE,
                timeout=self._timeout,
            )
        except TimeoutExpired:
            return NOTE, f"it still ran after {self._timeout:g} s"
        if done.returncode != 0:
            last = done.stderr.decode(errors="replace").strip()[-300:]
            return NOTE, f"it has exited with code {done.returncode}: {last}"
        return OK, "it runs on its own rule, and exits with code 0"


def _check_keys(frame: Mapping[str, Any]) -> None:
    """Check that a frame has no keys that the wire does not know.

    Raises:
        WireError: It has one.
    """
    kind = next(kind for kind in KEYS if kind in frame)
    parts = [(frame, {kind, *KEYS[kind]})]
    if kind == "end":
        parts.append((frame["end"], {"truncated", "result"}))
    for part, keys in parts:
        for key in part:
            if key not in keys:
                hint = (
                    did_you_mean(key, keys)
                    or "; an argument belongs into args, another result into result"
                )
                raise WireError(f"the key {key!r} of {short_repr(frame)} does not exist{hint}")
